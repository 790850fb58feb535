//! The tokens of other architectures: types without values, so that code may name them everywhere.

use crate::simd::Kernel;

macro_rules! absent {
    ($token:ident, $what:literal) => {
        #[doc = concat!("A CPU with ", $what, ". There is none on this architecture.")]
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum $token {}

        impl $token {
            /// None.
            pub fn detect() -> impl Iterator<Item = Self> {
                core::iter::empty()
            }

            pub(super) fn name(self) -> &'static str {
                match self {}
            }

            pub(crate) fn run<K: Kernel>(self, _: K) -> K::Output {
                match self {}
            }
        }
    };
}

#[cfg(not(target_arch = "x86_64"))]
absent!(Avx2, "AVX2");
#[cfg(not(target_arch = "x86_64"))]
absent!(Avx512, "AVX-512");
#[cfg(not(target_arch = "aarch64"))]
absent!(Neon, "NEON");

//! Which instruction set a kernel runs on: a value that is detected once and passed down.
//!
//! A token such as [`Avx2`] can only be made by asking the CPU, so holding one proves that its instructions exist. It also
//! carries what more the CPU has: with [`Avx2`] maybe [`Avx2::vnni`]. Tokens of another architecture are types without
//! values. Nothing is chosen behind the caller's back: no global, and no detection per call (but for the specification's,
//! which asks for a fused multiply-add that is faster than the library's and has the same bits).
//!
//! Without the feature `std` nothing is detected: there are the instruction sets that the crate is compiled for.

#[cfg(target_arch = "aarch64")]
mod aarch64;
mod absent;
#[cfg(target_arch = "x86_64")]
mod x86_64;

#[cfg(target_arch = "aarch64")]
pub use aarch64::*;
#[allow(unused_imports, reason = "an architecture may have all tokens")]
pub use absent::*;
#[cfg(target_arch = "x86_64")]
pub use x86_64::*;

use crate::simd::{Kernel, Simd, Tile, dispatch};
use core::fmt;

/// Whether this CPU has some features.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
macro_rules! has {
    ($($feature:tt),+) => {{
        #[cfg(all(feature = "std", target_arch = "x86_64"))]
        let has = [$(std::arch::is_x86_feature_detected!($feature)),+];
        #[cfg(all(feature = "std", target_arch = "aarch64"))]
        let has = [$(std::arch::is_aarch64_feature_detected!($feature)),+];
        #[cfg(not(feature = "std"))]
        let has = [$(cfg!(target_feature = $feature)),+];
        has.into_iter().all(|has| has)
    }};
}
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
pub(crate) use has;

/// An instruction set that kernels can run on. All of them give the same bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Isa {
    /// The specification: plain loops, `f32::mul_add`, no vector code. For comparison, not for speed.
    Scalar,
    /// x86-64 with AVX2, FMA and F16C.
    Avx2(Avx2),
    /// x86-64 with AVX-512 F, VL, DQ and BW besides.
    Avx512(Avx512),
    /// AArch64 with NEON.
    Neon(Neon),
}

/// A request for an instruction set that cannot be met.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum IsaError<'a> {
    /// No instruction set has this name.
    Unknown(&'a str),
    /// This CPU, or this build, does not have it.
    Unavailable(&'static str),
}

impl fmt::Display for IsaError<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            IsaError::Unknown(name) => {
                write!(f, "unknown instruction set \"{name}\", expected one of ")?;
                Isa::NAMES.iter().enumerate().try_for_each(|(i, name)| {
                    let comma = if i == 0 { "" } else { ", " };
                    write!(f, "{comma}{name}")
                })
            }
            IsaError::Unavailable(name) => write!(f, "this CPU does not have the instruction set {name}"),
        }
    }
}

impl core::error::Error for IsaError<'_> {}

impl Isa {
    /// Every name that [`Isa::parse`] knows, slowest first on each architecture.
    pub const NAMES: [&'static str; 8] =
        ["scalar", "avx2", "avx2-vnni", "avx512", "avx512-vnni", "neon", "neon-dot", "neon-i8mm"];

    /// The fastest instruction set of this CPU.
    pub fn best() -> Self {
        Self::available().last().unwrap_or(Isa::Scalar)
    }

    /// Every instruction set of this CPU, slowest first; the first is the scalar one.
    pub fn available() -> impl Iterator<Item = Self> {
        core::iter::once(Isa::Scalar)
            .chain(Avx2::detect().map(Isa::Avx2))
            .chain(Avx512::detect().map(Isa::Avx512))
            .chain(Neon::detect().map(Isa::Neon))
    }

    /// The instruction set of that name.
    ///
    /// # Errors
    /// [`IsaError`] if there is none of that name, or this CPU lacks it.
    pub fn parse(name: &str) -> Result<Self, IsaError<'_>> {
        let known = Self::NAMES.into_iter().find(|known| *known == name).ok_or(IsaError::Unknown(name))?;
        Self::available().find(|isa| isa.name() == known).ok_or(IsaError::Unavailable(known))
    }

    /// The name that [`Isa::parse`] takes.
    pub fn name(self) -> &'static str {
        match self {
            Isa::Scalar => "scalar",
            Isa::Avx2(token) => token.name(),
            Isa::Avx512(token) => token.name(),
            Isa::Neon(token) => token.name(),
        }
    }

    /// What a product computes in registers at once. Work that is divided into multiples of it wastes nothing.
    pub fn tile(self) -> Tile {
        struct Ask;
        impl Kernel for Ask {
            type Output = Tile;
            #[inline(always)]
            fn reference(self) -> Tile {
                Tile { rows: 1, panels: 1 }
            }
            #[inline(always)]
            fn run<S: Simd>(self, _: S) -> Tile {
                S::TILE
            }
        }
        dispatch(self, Ask)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_available_isa_parses_back() {
        for isa in Isa::available() {
            assert_eq!(Isa::parse(isa.name()), Ok(isa));
        }
        assert!(Isa::available().any(|isa| isa == Isa::best()));
    }

    /// Says what the tests run on, even where the harness keeps what tests print. `VOXCAST_REQUIRE_ISA=avx2,avx512` makes
    /// a test run fail where those would be left out.
    #[test]
    fn the_required_instruction_sets_are_here() {
        use std::io::Write as _;
        writeln!(std::io::stderr(), "kernels are tested on: {}", crate::cases::isas_in_words())
            .expect("standard error");
        let required = std::env::var("VOXCAST_REQUIRE_ISA").unwrap_or_default();
        for name in required.split(',').filter(|name| !name.is_empty()) {
            if let Err(e) = Isa::parse(name) {
                panic!("VOXCAST_REQUIRE_ISA={required}: {e}");
            }
        }
    }

    #[test]
    fn names_go_from_slow_to_fast() {
        let available: Vec<_> = Isa::available().map(Isa::name).collect();
        let known: Vec<_> = Isa::NAMES.into_iter().filter(|name| available.contains(name)).collect();
        assert_eq!(available, known);
        assert_eq!(available[0], "scalar");
        assert_eq!(Isa::best().name(), *available.last().unwrap());
    }

    #[test]
    fn junk_is_an_error_not_a_fallback() {
        assert_eq!(Isa::parse("AVX2"), Err(IsaError::Unknown("AVX2")));
        assert_eq!(Isa::parse(""), Err(IsaError::Unknown("")));
    }
}

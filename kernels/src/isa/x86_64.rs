//! The tokens of x86-64.

use super::has;
use crate::simd::{Kernel, avx2, avx512};

/// Proof that this CPU has AVX2, FMA and F16C, and of what more it has in 256 bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Avx2 {
    vnni: Option<AvxVnni>,
}

/// Proof that this CPU has AVX-VNNI: dot products of bytes in 256 bits. In tests a signal handler may carry them out for it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AvxVnni(());

/// Proof that this CPU has AVX-512 F, VL, DQ and BW and what a plain [`Avx2`] proves, that the system keeps their registers,
/// and of what more it has in 512 bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Avx512 {
    vnni: Option<Avx512Vnni>,
}

/// Proof that this CPU has AVX-512 VNNI: dot products of bytes in 512 bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Avx512Vnni(());

impl Avx2 {
    /// The tokens that this CPU has, the one that proves least first.
    pub fn detect() -> impl Iterator<Item = Self> {
        let base = has!("avx2", "fma", "f16c").then_some(Self { vnni: None });
        let vnni = has!("avxvnni").then_some(AvxVnni(()));
        base.into_iter().chain(base.and(vnni).map(|vnni| Self { vnni: Some(vnni) }))
    }

    /// Dot products of bytes, if the token was made with them.
    pub fn vnni(self) -> Option<AvxVnni> {
        self.vnni
    }

    /// With AVX-VNNI, whoever executes it.
    ///
    /// # Safety
    /// The process must execute `vpdpbusd` of AVX-VNNI: the CPU does, or a handler of the signal that it gives.
    #[cfg(all(feature = "cases", target_os = "linux", target_env = "gnu"))]
    pub(crate) unsafe fn with_vnni(self) -> Self {
        Self { vnni: Some(AvxVnni(())) }
    }

    pub(super) fn name(self) -> &'static str {
        if self.vnni.is_some() { "avx2-vnni" } else { "avx2" }
    }

    #[inline(always)]
    pub(crate) fn run<K: Kernel>(self, kernel: K) -> K::Output {
        // SAFETY: the token proves that this CPU has AVX2, FMA and F16C.
        unsafe { avx2::run(self, kernel) }
    }
}

impl Avx512 {
    /// The tokens that this CPU has, the one that proves least first.
    pub fn detect() -> impl Iterator<Item = Self> {
        let wide = has!("avx512f", "avx512vl", "avx512dq", "avx512bw");
        let base = Avx2::detect().next().filter(|_| wide).map(|_| Self { vnni: None });
        let vnni = has!("avx512vnni").then_some(Avx512Vnni(()));
        base.into_iter().chain(base.and(vnni).map(|vnni| Self { vnni: Some(vnni) }))
    }

    /// Dot products of bytes, if the token was made with them.
    pub fn vnni(self) -> Option<Avx512Vnni> {
        self.vnni
    }

    pub(super) fn name(self) -> &'static str {
        if self.vnni.is_some() { "avx512-vnni" } else { "avx512" }
    }

    #[inline(always)]
    pub(crate) fn run<K: Kernel>(self, kernel: K) -> K::Output {
        // SAFETY: the token proves that this CPU has AVX-512 F, VL, DQ and BW besides AVX2, FMA and F16C.
        unsafe { avx512::run(self, kernel) }
    }
}

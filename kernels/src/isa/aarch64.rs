//! The token of AArch64.

use super::has;
use crate::simd::{Kernel, neon};

/// Proof that this CPU has Advanced SIMD (NEON), and of what more it has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Neon {
    dot: Option<NeonDot>,
    i8mm: Option<NeonI8mm>,
}

/// Proof that this CPU has FEAT_DotProd: `sdot`, dot products of bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NeonDot(());

/// Proof that this CPU has FEAT_I8MM: `smmla`, products of byte matrices.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NeonI8mm(());

impl Neon {
    /// The tokens that this CPU has, the one that proves least first.
    pub fn detect() -> impl Iterator<Item = Self> {
        let base = has!("neon").then_some(Self { dot: None, i8mm: None });
        let dot = base.filter(|_| has!("dotprod")).map(|base| Self { dot: Some(NeonDot(())), ..base });
        let i8mm = dot.filter(|_| has!("i8mm")).map(|dot| Self { i8mm: Some(NeonI8mm(())), ..dot });
        base.into_iter().chain(dot).chain(i8mm)
    }

    /// Dot products of bytes, if the token was made with them.
    pub fn dot(self) -> Option<NeonDot> {
        self.dot
    }

    /// Products of byte matrices, if the token was made with them.
    pub fn i8mm(self) -> Option<NeonI8mm> {
        self.i8mm
    }

    pub(super) fn name(self) -> &'static str {
        match (self.dot, self.i8mm) {
            (_, Some(_)) => "neon-i8mm",
            (Some(_), None) => "neon-dot",
            (None, None) => "neon",
        }
    }

    #[inline(always)]
    pub(crate) fn run<K: Kernel>(self, kernel: K) -> K::Output {
        // SAFETY: the token proves that this CPU has NEON.
        unsafe { neon::run(self, kernel) }
    }
}

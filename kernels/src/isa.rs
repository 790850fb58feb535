//! Which instruction set a kernel runs on: a value that is detected once and passed down.
//!
//! There is no global and no per-call detection. A token such as [`Avx2`] can only be made by asking the CPU, so holding
//! one proves that its instructions exist.

use std::fmt;

/// Proof that this CPU has AVX2, FMA and F16C.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Avx2(());

impl Avx2 {
    /// The token, if the CPU has the instructions.
    pub fn detect() -> Option<Self> {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2")
            && std::arch::is_x86_feature_detected!("fma")
            && std::arch::is_x86_feature_detected!("f16c")
        {
            return Some(Self(()));
        }
        None
    }
}

/// An instruction set that kernels can run on. All of them give the same bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Isa {
    /// The specification: plain loops, `f32::mul_add`, no vector code. For comparison, not for speed.
    Scalar,
    /// x86-64 with AVX2, FMA and F16C.
    Avx2(Avx2),
}

/// A request for an instruction set that cannot be met.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum IsaError {
    /// No instruction set has this name.
    Unknown(String),
    /// This CPU, or this build, does not have it.
    Unavailable(&'static str),
}

impl fmt::Display for IsaError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            IsaError::Unknown(name) => {
                write!(f, "unknown instruction set \"{name}\", expected one of {}", Isa::NAMES.join(", "))
            }
            IsaError::Unavailable(name) => write!(f, "this CPU does not have the instruction set {name}"),
        }
    }
}

impl std::error::Error for IsaError {}

impl Isa {
    /// Every name that [`Isa::parse`] knows, slowest first.
    pub const NAMES: [&'static str; 2] = ["scalar", "avx2"];

    /// The fastest instruction set of this CPU.
    pub fn best() -> Self {
        Avx2::detect().map_or(Isa::Scalar, Isa::Avx2)
    }

    /// Every instruction set of this CPU, the scalar one first.
    pub fn available() -> impl Iterator<Item = Self> {
        std::iter::once(Isa::Scalar).chain(Avx2::detect().map(Isa::Avx2))
    }

    /// The instruction set of that name.
    ///
    /// # Errors
    /// [`IsaError`] if there is none of that name, or this CPU lacks it.
    pub fn parse(name: &str) -> Result<Self, IsaError> {
        match name {
            "scalar" => Ok(Isa::Scalar),
            "avx2" => Avx2::detect().map(Isa::Avx2).ok_or(IsaError::Unavailable("avx2")),
            _ => Err(IsaError::Unknown(name.to_owned())),
        }
    }

    /// The name that [`Isa::parse`] takes.
    pub fn name(self) -> &'static str {
        match self {
            Isa::Scalar => "scalar",
            Isa::Avx2(_) => "avx2",
        }
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

    #[test]
    fn junk_is_an_error_not_a_fallback() {
        assert_eq!(Isa::parse("AVX2"), Err(IsaError::Unknown("AVX2".to_owned())));
        assert_eq!(Isa::parse(""), Err(IsaError::Unknown(String::new())));
    }
}

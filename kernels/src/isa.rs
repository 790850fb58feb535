//! Which instruction set a kernel runs on: a value that is detected once and passed down.
//!
//! A token such as [`Avx2`] can only be made by asking the CPU, so holding one proves that its instructions exist. Nothing
//! is chosen behind the caller's back: no global, and no detection per call (but for the specification's, which asks for a
//! fused multiply-add that is faster than the library's and has the same bits).

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

/// Proof that this CPU has AVX-512 F, VL, DQ and BW, that the system keeps their registers, and what [`Avx2`] proves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Avx512(Avx2);

impl Avx512 {
    /// The token, if the CPU has the instructions.
    pub fn detect() -> Option<Self> {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx512f")
            && std::arch::is_x86_feature_detected!("avx512vl")
            && std::arch::is_x86_feature_detected!("avx512dq")
            && std::arch::is_x86_feature_detected!("avx512bw")
        {
            return Avx2::detect().map(Self);
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
    /// x86-64 with AVX-512 F, VL, DQ and BW besides.
    Avx512(Avx512),
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
    pub const NAMES: [&'static str; 3] = ["scalar", "avx2", "avx512"];

    /// The fastest instruction set of this CPU.
    pub fn best() -> Self {
        Self::available().last().expect("the scalar one is everywhere")
    }

    /// Every instruction set of this CPU, slowest first; the first is the scalar one.
    pub fn available() -> impl Iterator<Item = Self> {
        let vectors = [Avx2::detect().map(Isa::Avx2), Avx512::detect().map(Isa::Avx512)];
        std::iter::once(Isa::Scalar).chain(vectors.into_iter().flatten())
    }

    /// The instruction set of that name.
    ///
    /// # Errors
    /// [`IsaError`] if there is none of that name, or this CPU lacks it.
    pub fn parse(name: &str) -> Result<Self, IsaError> {
        let known = Self::NAMES.into_iter().find(|known| *known == name);
        let known = known.ok_or_else(|| IsaError::Unknown(name.to_owned()))?;
        Self::available().find(|isa| isa.name() == known).ok_or(IsaError::Unavailable(known))
    }

    /// The name that [`Isa::parse`] takes.
    pub fn name(self) -> &'static str {
        match self {
            Isa::Scalar => "scalar",
            Isa::Avx2(_) => "avx2",
            Isa::Avx512(_) => "avx512",
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

    /// `VOXCAST_REQUIRE_ISA=avx2,avx512` makes a test run fail where those would be left out silently.
    #[test]
    fn the_required_instruction_sets_are_here() {
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
        assert_eq!(Isa::parse("AVX2"), Err(IsaError::Unknown("AVX2".to_owned())));
        assert_eq!(Isa::parse(""), Err(IsaError::Unknown(String::new())));
    }
}

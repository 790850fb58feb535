//! exp and sigmoid as one fixed polynomial each: no library's exp, so the same bits everywhere.

use crate::simd::Simd;

/// What `std` adds to f32, for `core` alone. Every one of them is correctly rounded, so the bits are the same.
#[cfg(not(feature = "std"))]
pub(crate) trait Float {
    /// `self * a + b`, rounded once.
    fn mul_add(self, a: f32, b: f32) -> f32;
    /// The largest integer that is not above.
    fn floor(self) -> f32;
    /// The square root.
    fn sqrt(self) -> f32;
    /// The nearest integer, ties to even.
    fn round_ties_even(self) -> f32;
}

#[cfg(not(feature = "std"))]
impl Float for f32 {
    #[inline(always)]
    fn mul_add(self, a: f32, b: f32) -> f32 {
        libm::fmaf(self, a, b)
    }
    #[inline(always)]
    fn floor(self) -> f32 {
        libm::floorf(self)
    }
    #[inline(always)]
    fn sqrt(self) -> f32 {
        libm::sqrtf(self)
    }
    #[inline(always)]
    fn round_ties_even(self) -> f32 {
        libm::rintf(self)
    }
}

/// Arguments outside are clamped: below, exp is under the smallest normal f32; above, it overflows.
const EXP_MIN: f32 = -87.0;
const EXP_MAX: f32 = 88.0;
const LOG2_E: f32 = core::f32::consts::LOG2_E;
/// ln 2 in two parts (Cody and Waite, 1980). The products are fused, so the high part may use every bit of an f32.
const LN2_HI: f32 = core::f32::consts::LN_2;
const LN2_LO: f32 = -1.904_654_3e-9;
/// Taylor coefficients 1/7! to 1/0!, adequate on |r| <= ln 2 / 2: the truncation is below 1e-8 of the result.
const EXP_POLY: [f32; 8] = [1.0 / 5040.0, 1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0];

/// e^x within 2 ulp on [-87, 88], clamped outside. NaN gives NaN.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    let x = if x < EXP_MIN { EXP_MIN } else { x };
    let x = if x > EXP_MAX { EXP_MAX } else { x };
    let n = (x * LOG2_E).round_ties_even();
    let r = n.mul_add(-LN2_LO, n.mul_add(-LN2_HI, x));
    let mut p = EXP_POLY[0];
    for c in &EXP_POLY[1..] {
        p = p.mul_add(r, *c);
    }
    if x.is_nan() { x } else { p * f32::from_bits(((n as i32 + 127) as u32) << 23) }
}

/// 1 / (1 + e^-x).
#[inline(always)]
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// [`exp`] in every lane, for lanes that are not NaN; a NaN lane gives NaN of any payload.
#[inline(always)]
pub(crate) fn exp_v<S: Simd>(s: S, x: S::V) -> S::V {
    // `min` and `max` return their second operand for NaN, so NaN reaches the polynomial and stays.
    let x = s.max(s.splat(EXP_MIN), x);
    let x = s.min(s.splat(EXP_MAX), x);
    let n = s.round(s.mul(x, s.splat(LOG2_E)));
    let r = s.mul_add(n, s.splat(-LN2_LO), s.mul_add(n, s.splat(-LN2_HI), x));
    let mut p = s.splat(EXP_POLY[0]);
    for c in &EXP_POLY[1..] {
        p = s.mul_add(p, r, s.splat(*c));
    }
    s.mul(p, s.exp2_int(n))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::isa::Isa;
    use crate::simd::{Kernel, LANES, dispatch};

    struct Exp<'a>(&'a mut [f32; LANES]);

    impl Kernel for Exp<'_> {
        type Output = ();
        #[inline(always)]
        fn reference(self) {
            self.0.iter_mut().for_each(|x| *x = exp(*x));
        }
        #[inline(always)]
        fn run<S: Simd>(self, s: S) {
            let y = exp_v(s, s.load(self.0));
            s.store(self.0, y);
        }
    }

    #[test]
    fn exp_is_within_two_ulp_of_f64() {
        let mut worst = 0.0f64;
        for i in -870_000..880_000 {
            let x = i as f32 * 1e-4;
            let want = f64::from(x).exp();
            let ulp = f64::from(f32::from_bits((want as f32).to_bits() + 1)) - f64::from(want as f32);
            worst = worst.max((f64::from(exp(x)) - want).abs() / ulp);
        }
        assert!(worst <= 2.0, "worst error {worst} ulp");
    }

    #[test]
    fn extremes() {
        assert_eq!(exp(0.0), 1.0);
        assert_eq!(exp(f32::NEG_INFINITY), exp(-87.0));
        assert_eq!(exp(f32::INFINITY), exp(88.0));
        assert!(exp(f32::NAN).is_nan());
        assert_eq!(sigmoid(0.0), 0.5);
        assert!(sigmoid(-200.0) < 1e-37 && sigmoid(200.0) == 1.0);
    }

    #[test]
    fn vectors_give_the_scalar_bits() {
        for isa in Isa::available() {
            for block in 0..200_000u32 {
                let mut x: [f32; LANES] =
                    std::array::from_fn(|i| f32::from_bits((block * 16 + i as u32).wrapping_mul(0x9E37_79B1)));
                let want = x.map(exp);
                dispatch(isa, Exp(&mut x));
                for (got, want) in x.iter().zip(want) {
                    assert!(got.to_bits() == want.to_bits() || (got.is_nan() && want.is_nan()), "{got} {want}");
                }
            }
        }
    }
}

//! Values to 8-bit integers.
//!
//! ```text
//! out[i] = clamp(round(in[i] * inverse))          f32 product, rounded; then to the nearest integer, ties to even
//! ```
//!
//! `inverse` is 1 / scale of the output. NaN becomes 0, infinities the ends.

use crate::isa::Isa;
#[cfg(not(feature = "std"))]
use crate::math::Float as _;
use crate::simd::{Kernel, LANES, Simd, dispatch};

/// Fills `out` with the quantised values of `input`.
///
/// # Panics
/// If the two have different lengths.
///
/// # Determinism
/// The same on every instruction set and for every division into pieces.
pub fn quantise(isa: Isa, input: &[f32], inverse: f32, out: &mut [i8]) {
    assert_eq!(input.len(), out.len(), "the lengths differ");
    dispatch(isa, Run { input, inverse, out });
}

struct Run<'a> {
    input: &'a [f32],
    inverse: f32,
    out: &'a mut [i8],
}

impl Kernel for Run<'_> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        for (out, x) in self.out.iter_mut().zip(self.input) {
            let scaled = x * self.inverse;
            *out = if scaled.is_nan() { 0 } else { scaled.clamp(-127.0, 127.0).round_ties_even() as i8 };
        }
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let (inverse, low, high) = (s.splat(self.inverse), s.splat(-127.0), s.splat(127.0));
        for (out, x) in self.out.chunks_mut(LANES).zip(self.input.chunks(LANES)) {
            let scaled = s.mul(s.load_part(x), inverse);
            let nearest = s.nearest(s.max(s.min(scaled, high), low));
            // Only NaN is not at least itself.
            s.store_bytes_part(out, s.narrow(s.keep(s.at_least(scaled, scaled), nearest)));
        }
    }
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Rng;

    fn all(isa: Isa, input: &[f32], inverse: f32) -> Vec<i8> {
        let mut out = vec![55; input.len()];
        quantise(isa, input, inverse, &mut out);
        out
    }

    #[test]
    fn by_hand() {
        let (inf, max) = (f32::INFINITY, f32::MAX);
        let input = [
            0.0,
            -0.0,
            0.25,
            0.75,
            1.25,
            -0.25,
            -0.75,
            63.4,
            63.5,
            -63.5,
            1e9,
            -1e9,
            inf,
            -inf,
            f32::NAN,
            -f32::NAN,
            max,
            0.26,
        ];
        let want = [0, 0, 0, 2, 2, 0, -2, 127, 127, -127, 127, -127, 127, -127, 0, 0, 127, 1];
        for isa in Isa::available() {
            assert_eq!(all(isa, &input, 2.0), want);
            // 0 * inf is NaN.
            assert_eq!(all(isa, &[0.0, 1.0, -1.0], inf), [0, 127, -127]);
            assert_eq!(all(isa, &[3.0; 5], f32::NAN), [0; 5]);
        }
    }

    #[test]
    fn every_isa_agrees_with_f64() {
        for n in [0, 1, 15, 16, 17, 1000] {
            let mut rng = Rng::new(n as u64);
            let mut input = rng.ordinary(n);
            input.iter_mut().for_each(|x| *x *= 1.2);
            let want = all(Isa::Scalar, &input, 127.0);
            for (got, x) in want.iter().zip(&input) {
                let exact = (f64::from(*x) * 127.0).clamp(-127.0, 127.0);
                assert!((f64::from(*got) - exact).abs() <= 0.5 + 1e-5, "{got} is not {exact}");
            }
            let special = rng.special(n);
            for isa in Isa::available() {
                assert_eq!(all(isa, &input, 127.0), want, "{}", isa.name());
                assert_eq!(all(isa, &special, 4.0), all(Isa::Scalar, &special, 4.0), "{}", isa.name());
            }
        }
    }

    #[test]
    #[should_panic(expected = "the lengths differ")]
    fn short_output() {
        quantise(Isa::best(), &[0.0; 3], 1.0, &mut [0; 2]);
    }
}

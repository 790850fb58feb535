//! 8-bit integers to the values that they stand for.
//!
//! ```text
//! out[i] = in[i] * scale          one f32 product, rounded
//! ```

use crate::isa::Isa;
use crate::simd::{Kernel, LANES, Simd, dispatch};

/// Fills `out` with the values of `input`.
///
/// # Panics
/// If the two have different lengths.
///
/// # Determinism
/// The same bits on every instruction set and for every division into pieces.
pub fn dequantise(isa: Isa, input: &[i8], scale: f32, out: &mut [f32]) {
    assert_eq!(input.len(), out.len(), "the lengths differ");
    dispatch(isa, Run { input, scale, out });
}

struct Run<'a> {
    input: &'a [i8],
    scale: f32,
    out: &'a mut [f32],
}

impl Kernel for Run<'_> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        for (out, x) in self.out.iter_mut().zip(self.input) {
            *out = f32::from(*x) * self.scale;
        }
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let scale = s.splat(self.scale);
        for (out, x) in self.out.chunks_mut(LANES).zip(self.input.chunks(LANES)) {
            s.store_part(out, s.mul(s.to_float(s.bytes_to_int(s.load_bytes_part(x))), scale));
        }
    }
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests {
    use super::*;
    use crate::ops::quantise::quantise;
    use crate::testing::{assert_close, assert_same_bits};

    fn all(isa: Isa, input: &[i8], scale: f32) -> Vec<f32> {
        let mut out = vec![f32::NAN; input.len()];
        dequantise(isa, input, scale, &mut out);
        out
    }

    #[test]
    fn by_hand() {
        for isa in Isa::available() {
            assert_same_bits(
                &all(isa, &[0, 1, -1, 127, -127, -128], 0.5),
                &[0.0, 0.5, -0.5, 63.5, -63.5, -64.0],
                isa.name(),
            );
            assert_same_bits(&all(isa, &[0, 2], -0.5), &[-0.0, -1.0], isa.name());
        }
    }

    /// Every value, against f64, and back.
    #[test]
    fn every_isa_agrees_with_f64() {
        let input: Vec<i8> = (-127..=127).collect();
        for scale in [1.0, 0.037, 1e-20, 3e30] {
            let want: Vec<f64> = input.iter().map(|x| f64::from(*x) * f64::from(scale)).collect();
            for isa in Isa::available() {
                let out = all(isa, &input, scale);
                assert_same_bits(&out, &all(Isa::Scalar, &input, scale), isa.name());
                assert_close(
                    &out.iter().map(|x| x / scale).collect::<Vec<_>>(),
                    &want.iter().map(|x| x / f64::from(scale)).collect::<Vec<_>>(),
                    1e-6,
                    isa.name(),
                );
                let mut back = vec![55; input.len()];
                quantise(isa, &out, 1.0 / scale, &mut back);
                assert_eq!(back, input);
            }
        }
    }

    #[test]
    #[should_panic(expected = "the lengths differ")]
    fn short_output() {
        dequantise(Isa::best(), &[0; 3], 1.0, &mut [0.0; 2]);
    }
}

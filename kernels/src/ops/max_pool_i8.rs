//! Two-dimensional max pooling of an 8-bit tensor.
//!
//! ```text
//! out[y][x][c] = max over (ky, kx) of in[y * stride + ky - pad][x * stride + kx - pad][c]
//! ```
//!
//! Taps outside are left out, so padding never wins. Input and output have one scale: the maximum of values is that of their
//! integers, and nothing rounds.
//!
//! The body runs up to sixty-four channels at a time.

use super::max_pool::MaxPool;
use crate::isa::Isa;
use crate::simd::{Kernel, LANES, Simd, dispatch};
use core::ops::Range;

/// Vectors that are compared at once.
const VECTORS: usize = 4;

/// Computes the output rows `rows` into `out`, `[rows, output width, channels]`.
///
/// # Panics
/// As [`max_pool`](super::max_pool::max_pool).
///
/// # Determinism
/// Exact, so the same on every instruction set and for every division into rows.
pub fn max_pool_i8(isa: Isa, args: &MaxPool<'_, i8>, rows: Range<usize>, out: &mut [i8]) {
    args.check(&rows, out);
    dispatch(isa, Run { args, rows, out });
}

struct Run<'a> {
    args: &'a MaxPool<'a, i8>,
    rows: Range<usize>,
    out: &'a mut [i8],
}

impl Kernel for Run<'_> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        let a = self.args;
        let [_, width] = a.output();
        for (i, out) in self.out.iter_mut().enumerate() {
            let (c, x) = (i % a.channels, i / a.channels % width);
            let y = self.rows.start + i / (a.channels * width);
            let taps = a.window(y, a.height).flat_map(|iy| a.window(x, a.width).map(move |ix| iy * a.width + ix));
            *out = taps.map(|pixel| a.input[pixel * a.channels + c]).fold(i8::MIN, i8::max);
        }
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let a = self.args;
        let [_, width] = a.output();
        for (y, row) in self.rows.zip(self.out.chunks_exact_mut(width * a.channels)) {
            for (x, out) in row.chunks_exact_mut(a.channels).enumerate() {
                let window = [a.window(y, a.height), a.window(x, a.width)];
                let (pieces, rest) = out.as_chunks_mut::<{ VECTORS * LANES }>();
                let channel = pieces.len() * VECTORS * LANES;
                for (i, piece) in pieces.iter_mut().enumerate() {
                    a.wide(s, &window, i * VECTORS * LANES, piece);
                }
                for (i, out) in rest.chunks_mut(LANES).enumerate() {
                    a.narrow(s, &window, channel + i * LANES, out);
                }
            }
        }
    }
}

impl MaxPool<'_, i8> {
    /// Channels from `channel` on of the largest of a window of rows and columns.
    #[inline(always)]
    fn wide<S: Simd>(
        &self,
        s: S,
        [rows, columns]: &[Range<usize>; 2],
        channel: usize,
        out: &mut [i8; VECTORS * LANES],
    ) {
        let mut max = [s.splat_bytes(i8::MIN); VECTORS];
        for y in rows.clone() {
            for x in columns.clone() {
                let pixel = &self.input[(y * self.width + x) * self.channels + channel..][..VECTORS * LANES];
                let (x, _) = pixel.as_chunks::<LANES>();
                for v in 0..VECTORS {
                    max[v] = s.max_bytes(max[v], s.load_bytes(&x[v]));
                }
            }
        }
        let (out, _) = out.as_chunks_mut::<LANES>();
        for v in 0..VECTORS {
            s.store_bytes(&mut out[v], max[v]);
        }
    }

    /// The same of up to 16 channels.
    #[inline(always)]
    fn narrow<S: Simd>(&self, s: S, [rows, columns]: &[Range<usize>; 2], channel: usize, out: &mut [i8]) {
        let mut max = s.splat_bytes(i8::MIN);
        for y in rows.clone() {
            for x in columns.clone() {
                let pixel = &self.input[(y * self.width + x) * self.channels + channel..][..out.len()];
                max = s.max_bytes(max, s.load_bytes_part(pixel));
            }
        }
        s.store_bytes_part(out, max);
    }
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests {
    use super::*;
    use crate::ops::max_pool::max_pool;
    use crate::testing::Rng;

    fn args(
        input: &[i8],
        [height, width, channels]: [usize; 3],
        [kernel, stride, padding]: [usize; 3],
    ) -> MaxPool<'_, i8> {
        MaxPool { input, height, width, channels, kernel, stride, padding }
    }

    fn all(isa: Isa, args: &MaxPool<'_, i8>) -> Vec<i8> {
        let [height, width] = args.output();
        let mut out = vec![55; height * width * args.channels];
        let (top, bottom) = out.split_at_mut(height / 2 * width * args.channels);
        max_pool_i8(isa, args, 0..height / 2, top);
        max_pool_i8(isa, args, height / 2..height, bottom);
        out
    }

    #[test]
    fn by_hand() {
        #[rustfmt::skip]
        let input = [
            -1, -2, -3, -4,
            -50, -60, -5, -80,
            -128, -120, -70, -60,
        ];
        for isa in Isa::available() {
            assert_eq!(all(isa, &args(&input, [3, 4, 1], [3, 2, 1])), [-1, -2, -50, -5]);
            assert_eq!(all(isa, &args(&input, [3, 4, 1], [2, 1, 0])), [-1, -2, -3, -50, -5, -5]);
            assert_eq!(all(isa, &args(&[-128; 4], [2, 2, 1], [2, 2, 0])), [-128]);
        }
    }

    /// A scale of 1 makes the values' maximum the integers'. Channels around pieces of 16 and of 64.
    #[test]
    fn every_isa_agrees_with_floating_point() {
        for channels in [1, 3, 15, 16, 17, 47, 63, 64, 65, 80, 128, 143] {
            for window in [[3, 2, 1], [2, 2, 0], [4, 1, 3], [1, 1, 0]] {
                let shape = [5, 6, channels];
                let mut rng = Rng::new(channels as u64);
                let input: Vec<i8> = (0..30 * channels).map(|_| rng.bits() as i8).collect();
                let real: Vec<f32> = input.iter().copied().map(f32::from).collect();
                let [kernel, stride, padding] = window;
                let real = MaxPool { input: &real[..], height: 5, width: 6, channels, kernel, stride, padding };
                let mut want = vec![f32::NAN; real.output().iter().product::<usize>() * channels];
                max_pool(Isa::Scalar, &real, 0..real.output()[0], &mut want);
                let want: Vec<i8> = want.into_iter().map(|x| x as i8).collect();
                for isa in Isa::available() {
                    assert_eq!(all(isa, &args(&input, shape, window)), want, "{} {shape:?} {window:?}", isa.name());
                }
            }
        }
    }

    #[test]
    #[should_panic(expected = "a window may lie in the padding alone")]
    fn padding_as_large_as_the_kernel() {
        all(Isa::best(), &args(&[0; 4], [2, 2, 1], [2, 2, 2]));
    }

    #[test]
    #[should_panic(expected = "the input has another shape")]
    fn short_input() {
        all(Isa::best(), &args(&[0; 3], [2, 2, 1], [2, 2, 0]));
    }

    #[test]
    #[should_panic(expected = "the output is not the size of its rows")]
    fn short_output() {
        max_pool_i8(Isa::best(), &args(&[0; 4], [2, 2, 1], [1, 1, 0]), 0..2, &mut [0; 3]);
    }
}

//! Two-dimensional max pooling.
//!
//! ```text
//! out[y][x][c] = max over (ky, kx), in that order, of in[y * stride + ky - pad][x * stride + kx - pad][c]
//! max: start at -inf; if value > acc { acc = value }
//! ```
//!
//! Taps outside are left out, so padding never wins. Neither does NaN: a comparison with it is false, hence NaN is
//! skipped, and a window of nothing but NaN gives -inf. Of zeros of both signs the first stays.
//!
//! The body runs sixteen channels at a time with the same comparisons.

use crate::isa::Isa;
use crate::simd::{Kernel, LANES, Simd, dispatch};
use core::ops::Range;

/// A max pooling's arguments.
#[derive(Clone, Copy, Debug)]
pub struct MaxPool<'a, T = f32> {
    /// `[height, width, channels]`.
    pub input: &'a [T],
    /// Rows of the input.
    pub height: usize,
    /// Columns of the input.
    pub width: usize,
    /// Channels.
    pub channels: usize,
    /// Side of the window.
    pub kernel: usize,
    /// Input steps per output step, on both axes.
    pub stride: usize,
    /// Padding before and after both axes, less than the kernel so that every window meets the input.
    pub padding: usize,
}

impl<T> MaxPool<'_, T> {
    /// Rows and columns of the output. Needs a stride and a kernel that fits into the padded input.
    pub fn output(&self) -> [usize; 2] {
        [self.height, self.width].map(|extent| (extent + 2 * self.padding - self.kernel) / self.stride + 1)
    }

    pub(super) fn check(&self, rows: &Range<usize>, out: &[T]) {
        let extents = [self.height, self.width, self.channels, self.kernel, self.stride];
        assert!(extents.iter().all(|&v| v > 0), "an extent is zero");
        assert!(self.padding < self.kernel, "a window may lie in the padding alone");
        assert!(self.height.min(self.width) + 2 * self.padding >= self.kernel, "the kernel exceeds the padded input");
        assert_eq!(self.input.len(), self.height * self.width * self.channels, "the input has another shape");
        let [height, width] = self.output();
        assert!(rows.start <= rows.end && rows.end <= height, "rows {rows:?} of {height}");
        assert_eq!(out.len(), rows.len() * width * self.channels, "the output is not the size of its rows");
    }

    /// The input positions on an axis of `extent` that output position `at` sees.
    #[inline(always)]
    pub(super) fn window(&self, at: usize, extent: usize) -> Range<usize> {
        let start = at * self.stride;
        start.saturating_sub(self.padding)..extent.min(start + self.kernel - self.padding)
    }
}

/// Computes the output rows `rows` into `out`, `[rows, output width, channels]`.
///
/// # Panics
/// If an extent is zero, the padding is not less than the kernel, `rows` leaves the output, or a slice does not have the
/// size that the shapes ask for.
///
/// # Determinism
/// The same bits on every instruction set and for every division into rows.
pub fn max_pool(isa: Isa, args: &MaxPool<'_>, rows: Range<usize>, out: &mut [f32]) {
    args.check(&rows, out);
    dispatch(isa, Run { args, rows, out });
}

struct Run<'a> {
    args: &'a MaxPool<'a>,
    rows: Range<usize>,
    out: &'a mut [f32],
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
            let mut max = f32::NEG_INFINITY;
            for iy in a.window(y, a.height) {
                for ix in a.window(x, a.width) {
                    let value = a.input[(iy * a.width + ix) * a.channels + c];
                    max = if value > max { value } else { max };
                }
            }
            *out = max;
        }
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let a = self.args;
        let [_, width] = a.output();
        for (y, row) in self.rows.zip(self.out.chunks_exact_mut(width * a.channels)) {
            for (x, out) in row.chunks_exact_mut(a.channels).enumerate() {
                for (panel, out) in out.chunks_mut(LANES).enumerate() {
                    let mut max = s.splat(f32::NEG_INFINITY);
                    for iy in a.window(y, a.height) {
                        for ix in a.window(x, a.width) {
                            let at = (iy * a.width + ix) * a.channels + panel * LANES;
                            max = s.max(s.load_part(&a.input[at..][..out.len()]), max);
                        }
                    }
                    s.store_part(out, max);
                }
            }
        }
    }
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{Fill, Rng, assert_lively, assert_same_bits};

    fn args(
        input: &[f32],
        [height, width, channels]: [usize; 3],
        [kernel, stride, padding]: [usize; 3],
    ) -> MaxPool<'_> {
        MaxPool { input, height, width, channels, kernel, stride, padding }
    }

    fn rows(isa: Isa, args: &MaxPool<'_>, rows: Range<usize>) -> Vec<f32> {
        let mut out = vec![f32::NAN; rows.len() * args.output()[1] * args.channels];
        max_pool(isa, args, rows, &mut out);
        out
    }

    fn all(isa: Isa, args: &MaxPool<'_>) -> Vec<f32> {
        rows(isa, args, 0..args.output()[0])
    }

    #[test]
    fn by_hand() {
        #[rustfmt::skip]
        let input = [
            -1.0, -2.0, -3.0, -4.0,
            -5.0, -6.0, -0.5, -8.0,
            -9.0, -8.0, -7.0, -6.0,
        ];
        for isa in Isa::available() {
            assert_eq!(all(isa, &args(&input, [3, 4, 1], [3, 2, 1])), [-1.0, -0.5, -5.0, -0.5]);
            assert_eq!(all(isa, &args(&input, [3, 4, 1], [2, 1, 0])), [-1.0, -0.5, -0.5, -5.0, -0.5, -0.5]);
        }
    }

    #[test]
    fn nan_never_wins_and_the_first_zero_stays() {
        let (nan, inf) = (f32::NAN, f32::NEG_INFINITY);
        for isa in Isa::available() {
            let out = all(isa, &args(&[nan, 1.0, nan, nan, -0.0, 0.0, 0.0, -0.0], [4, 2, 1], [2, 2, 0]));
            assert_eq!(out.iter().map(|v| v.to_bits()).collect::<Vec<_>>(), [1.0f32.to_bits(), (-0.0f32).to_bits()]);
            assert_eq!(all(isa, &args(&[nan; 4], [2, 2, 1], [2, 2, 0])), [inf]);
        }
    }

    /// Channels around 16; the stem's window first.
    const SHAPES: [([usize; 3], [usize; 3]); 9] = [
        ([9, 12, 64], [3, 2, 1]),
        ([2, 3, 16], [3, 2, 1]),
        ([8, 8, 1], [3, 2, 1]),
        ([5, 6, 5], [2, 2, 0]),
        ([4, 5, 15], [3, 1, 1]),
        ([7, 7, 16], [5, 3, 4]),
        ([5, 4, 17], [4, 2, 1]),
        ([3, 9, 33], [1, 1, 0]),
        ([2, 2, 16], [5, 1, 2]),
    ];

    #[test]
    fn every_isa_gives_the_scalar_bits() {
        for (shape, window) in SHAPES {
            for fill in [Rng::wide as Fill, Rng::special] {
                let input = fill(&mut Rng::new(2), shape.iter().product());
                let args = args(&input, shape, window);
                let want = all(Isa::Scalar, &args);
                assert_lively(&want, &format!("{shape:?} {window:?}"));
                for isa in Isa::available() {
                    assert_same_bits(&all(isa, &args), &want, &format!("{isa:?} {shape:?} {window:?}"));
                }
            }
        }
    }

    #[test]
    #[should_panic(expected = "an extent is zero")]
    fn no_stride() {
        let input = [0.0; 4];
        max_pool(Isa::Scalar, &args(&input, [2, 2, 1], [2, 0, 0]), 0..0, &mut []);
    }

    #[test]
    #[should_panic(expected = "a window may lie in the padding alone")]
    fn padding_as_large_as_the_kernel() {
        all(Isa::Scalar, &args(&[0.0; 4], [2, 2, 1], [2, 2, 2]));
    }

    #[test]
    #[should_panic(expected = "the kernel exceeds the padded input")]
    fn kernel_too_large() {
        max_pool(Isa::Scalar, &args(&[0.0; 4], [2, 2, 1], [5, 1, 1]), 0..0, &mut []);
    }

    #[test]
    #[should_panic(expected = "the input has another shape")]
    fn short_input() {
        all(Isa::Scalar, &args(&[0.0; 3], [2, 2, 1], [2, 2, 0]));
    }

    #[test]
    #[should_panic(expected = "rows 1..2 of 1")]
    fn rows_outside() {
        rows(Isa::Scalar, &args(&[0.0; 4], [2, 2, 1], [2, 2, 0]), 1..2);
    }

    #[test]
    #[should_panic(expected = "the output is not the size of its rows")]
    fn short_output() {
        max_pool(Isa::Scalar, &args(&[0.0; 4], [2, 2, 1], [1, 1, 0]), 0..2, &mut [0.0; 3]);
    }
}

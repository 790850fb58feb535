//! Nearest-neighbour enlargement of a small image, added to a large one in place.
//!
//! ```text
//! out[y][x][c] += low[y * low_height / height][x * low_width / width][c]        integer division
//! ```
//!
//! One addition per output; the body does sixteen channels at a time.

use crate::isa::Isa;
use crate::simd::{Kernel, LANES, Simd, dispatch};
use core::ops::Range;

/// The arguments of an addition of an enlarged image.
#[derive(Clone, Copy, Debug)]
pub struct UpsampleAdd<'a, T = f32> {
    /// The small image, `[low_height, low_width, channels]`.
    pub low: &'a [T],
    /// Rows of the small image.
    pub low_height: usize,
    /// Columns of the small image.
    pub low_width: usize,
    /// Rows of the large image.
    pub height: usize,
    /// Columns of the large image.
    pub width: usize,
    /// Channels of both.
    pub channels: usize,
}

impl<T> UpsampleAdd<'_, T> {
    pub(super) fn check(&self, rows: &Range<usize>, out: &[T]) {
        let extents = [self.low_height, self.low_width, self.height, self.width, self.channels];
        assert!(extents.iter().all(|&v| v > 0), "an extent is zero");
        assert_eq!(self.low.len(), self.low_height * self.low_width * self.channels, "the input has another shape");
        assert!(rows.start <= rows.end && rows.end <= self.height, "rows {rows:?} of {}", self.height);
        assert_eq!(out.len(), rows.len() * self.width * self.channels, "the output is not the size of its rows");
    }

    /// Where the small image's pixel for (`y`, `x`) starts.
    #[inline(always)]
    pub(super) fn offset(&self, y: usize, x: usize) -> usize {
        (y * self.low_height / self.height * self.low_width + x * self.low_width / self.width) * self.channels
    }
}

/// Adds to the rows `rows` of the large image, which `out` holds as `[rows, width, channels]`.
///
/// # Panics
/// If an extent is zero, `rows` leaves the image, or a slice does not have the size that the shapes ask for.
///
/// # Determinism
/// The same bits on every instruction set and for every division into rows.
pub fn upsample_add(isa: Isa, args: &UpsampleAdd<'_>, rows: Range<usize>, out: &mut [f32]) {
    args.check(&rows, out);
    dispatch(isa, Run { args, rows, out });
}

struct Run<'a> {
    args: &'a UpsampleAdd<'a>,
    rows: Range<usize>,
    out: &'a mut [f32],
}

impl Kernel for Run<'_> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        let a = self.args;
        for (i, out) in self.out.iter_mut().enumerate() {
            let y = self.rows.start + i / (a.channels * a.width);
            *out += a.low[a.offset(y, i / a.channels % a.width) + i % a.channels];
        }
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let a = self.args;
        for (y, row) in self.rows.zip(self.out.chunks_exact_mut(a.width * a.channels)) {
            for (x, out) in row.chunks_exact_mut(a.channels).enumerate() {
                let low = &a.low[a.offset(y, x)..][..a.channels];
                for (out, low) in out.chunks_mut(LANES).zip(low.chunks(LANES)) {
                    let sum = s.add(s.load_part(out), s.load_part(low));
                    s.store_part(out, sum);
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
        low: &[f32],
        [low_height, low_width]: [usize; 2],
        [height, width, channels]: [usize; 3],
    ) -> UpsampleAdd<'_> {
        UpsampleAdd { low, low_height, low_width, height, width, channels }
    }

    fn all(isa: Isa, args: &UpsampleAdd<'_>, high: &[f32]) -> Vec<f32> {
        let mut out = high.to_vec();
        upsample_add(isa, args, 0..args.height, &mut out);
        out
    }

    #[test]
    fn by_hand() {
        let low = [1.0, 2.0, 3.0, 4.0];
        for isa in Isa::available() {
            let twice = all(isa, &args(&low, [2, 2], [4, 4, 1]), &[10.0; 16]);
            let (top, bottom) = ([11.0, 11.0, 12.0, 12.0], [13.0, 13.0, 14.0, 14.0]);
            assert_eq!(twice, [top, top, bottom, bottom].concat());
            // Three columns from two: floor(x * 2 / 3) = 0, 0, 1.
            assert_eq!(all(isa, &args(&low, [2, 2], [1, 3, 1]), &[0.0; 3]), [1.0, 1.0, 2.0]);
        }
    }

    /// Channels around 16, exact and odd ratios.
    const SHAPES: [([usize; 2], [usize; 3]); 7] = [
        ([2, 3], [4, 6, 64]),
        ([1, 1], [3, 2, 5]),
        ([4, 5], [7, 9, 1]),
        ([3, 3], [6, 5, 15]),
        ([2, 2], [2, 2, 16]),
        ([5, 4], [3, 8, 17]),
        ([3, 2], [4, 3, 33]),
    ];

    #[test]
    fn every_isa_gives_the_scalar_bits() {
        for (low, high) in SHAPES {
            for fill in [Rng::wide as Fill, Rng::special] {
                let mut rng = Rng::new(8);
                let small = fill(&mut rng, low[0] * low[1] * high[2]);
                let large = fill(&mut rng, high.iter().product());
                let args = args(&small, low, high);
                let want = all(Isa::Scalar, &args, &large);
                assert_lively(&want, &format!("{low:?} {high:?}"));
                for isa in Isa::available() {
                    assert_same_bits(&all(isa, &args, &large), &want, &format!("{isa:?} {low:?} {high:?}"));
                }
            }
        }
    }

    #[test]
    #[should_panic(expected = "an extent is zero")]
    fn no_width() {
        upsample_add(Isa::Scalar, &args(&[0.0], [1, 1], [1, 0, 1]), 0..1, &mut []);
    }

    #[test]
    #[should_panic(expected = "the input has another shape")]
    fn short_input() {
        all(Isa::Scalar, &args(&[0.0; 3], [2, 2], [4, 4, 1]), &[0.0; 16]);
    }

    #[test]
    #[should_panic(expected = "rows 3..5 of 4")]
    fn rows_outside() {
        upsample_add(Isa::Scalar, &args(&[0.0; 4], [2, 2], [4, 4, 1]), 3..5, &mut [0.0; 8]);
    }

    #[test]
    #[should_panic(expected = "the output is not the size of its rows")]
    fn short_output() {
        upsample_add(Isa::Scalar, &args(&[0.0; 4], [2, 2], [4, 4, 1]), 0..2, &mut [0.0; 7]);
    }
}

//! Global mean of an image, and its way back: one row repeated over a channel slice of a wider image.
//!
//! ```text
//! mean:       out[c] = (((0 + in[0][c]) + in[1][c]) + ...) / rows
//! broadcast:  out[row * stride + offset + c] = in[c]
//! ```
//!
//! The sum of a channel is one chain over the rows, so the mean is not divided among threads; its body runs sixteen
//! channels at a time. The broadcast only copies, which needs no instruction set.

use crate::isa::Isa;
use crate::simd::{Kernel, LANES, Simd, dispatch};

/// A global mean's arguments.
#[derive(Clone, Copy, Debug)]
pub struct Mean<'a, T = f32> {
    /// `[rows, channels]`, at least one row and at most 2^24, so that their number is exact in f32.
    pub input: &'a [T],
    /// Channels.
    pub channels: usize,
}

impl<T> Mean<'_, T> {
    pub(super) fn check(&self, out: &[T]) {
        assert!(self.channels > 0, "an extent is zero");
        assert!(self.input.len().is_multiple_of(self.channels), "the input is not whole rows");
        let rows = self.rows();
        assert!((1..=1 << 24).contains(&rows), "the mean of {rows} rows");
        assert_eq!(out.len(), self.channels, "the output is not one row");
    }

    pub(super) fn rows(&self) -> usize {
        self.input.len() / self.channels
    }
}

/// The mean over all rows into `out`, one value per channel.
///
/// # Panics
/// If there are no rows or more than 2^24, or a slice does not have the size that the shapes ask for.
///
/// # Determinism
/// The same bits on every instruction set.
pub fn mean(isa: Isa, args: &Mean<'_>, out: &mut [f32]) {
    args.check(out);
    dispatch(isa, Run { args, out });
}

struct Run<'a> {
    args: &'a Mean<'a>,
    out: &'a mut [f32],
}

impl Kernel for Run<'_> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        for (c, out) in self.out.iter_mut().enumerate() {
            let mut sum = 0.0;
            for row in self.args.input.chunks_exact(self.args.channels) {
                sum += row[c];
            }
            *out = sum / self.args.rows() as f32;
        }
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        for (panel, out) in self.out.chunks_mut(LANES).enumerate() {
            let mut sum = s.splat(0.0);
            for row in self.args.input.chunks_exact(self.args.channels) {
                sum = s.add(sum, s.load_part(&row[panel * LANES..][..out.len()]));
            }
            s.store_part(out, s.div(sum, s.splat(self.args.rows() as f32)));
        }
    }
}

/// Copies `row`, of any element, into channels `offset..offset + row.len()` of every row of `out`, `[rows, stride]`. The other channels
/// stay. Threads may divide the rows of `out`.
///
/// # Panics
/// If `row` does not fit into a row of `out`, or `out` is not whole rows.
pub fn broadcast<T: Copy>(row: &[T], stride: usize, offset: usize, out: &mut [T]) {
    assert!(stride > 0, "an extent is zero");
    assert!(offset <= stride && row.len() <= stride - offset, "the channels leave the row");
    assert!(out.len().is_multiple_of(stride), "the output is not whole rows");
    for out in out.chunks_exact_mut(stride) {
        out[offset..offset + row.len()].copy_from_slice(row);
    }
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{Fill, Rng, assert_lively, assert_order_shows, assert_same_bits, reverse_rows};
    use proptest::prelude::*;

    fn run(isa: Isa, input: &[f32], channels: usize) -> Vec<f32> {
        let mut out = vec![f32::NAN; channels];
        mean(isa, &Mean { input, channels }, &mut out);
        out
    }

    #[test]
    fn by_hand() {
        for isa in Isa::available() {
            assert_eq!(run(isa, &[1.0, 10.0, 2.0, 20.0, 6.0, 0.0], 2), [3.0, 10.0]);
            // In this order the 1 is lost: 1e8 + 1 = 1e8 in f32.
            assert_eq!(run(isa, &[1e8, 1.0, -1e8, 0.0], 1), [0.0]);
        }
        let mut out = [0.0; 8];
        broadcast(&[1.0, 2.0], 4, 1, &mut out);
        assert_eq!(out, [0.0, 1.0, 2.0, 0.0, 0.0, 1.0, 2.0, 0.0]);
    }

    const SHAPES: [[usize; 2]; 8] = [[1, 2], [7, 5], [20, 15], [9, 16], [4, 17], [33, 33], [25, 64], [3, 100]];

    #[test]
    fn every_isa_gives_the_scalar_bits() {
        for [rows, channels] in SHAPES {
            for fill in [Rng::wide as Fill, Rng::special] {
                let input = fill(&mut Rng::new(3), rows * channels);
                let want = run(Isa::Scalar, &input, channels);
                assert_lively(&want, &format!("{rows} x {channels}"));
                for isa in Isa::available() {
                    assert_same_bits(&run(isa, &input, channels), &want, &format!("{isa:?} {rows} x {channels}"));
                }
            }
        }
    }

    proptest! {
        #[test]
        fn broadcast_writes_its_channels_only(
            rows in 0usize..9, before in 0usize..20, channels in 0usize..20, after in 0usize..20, seed: u64,
        ) {
            prop_assume!(before + channels + after > 0);
            let stride = before + channels + after;
            let mut rng = Rng::new(seed);
            let (row, old) = (rng.ordinary(channels), rng.ordinary(rows * stride));
            let mut out = old.clone();
            broadcast(&row, stride, before, &mut out);
            for (i, (&new, &old)) in out.iter().zip(&old).enumerate() {
                let want = (i % stride).checked_sub(before).and_then(|c| row.get(c));
                prop_assert_eq!(new, *want.unwrap_or(&old));
            }
        }
    }

    #[test]
    fn the_order_of_a_sum_shows() {
        let input = Rng::new(7).ordinary(50 * 33);
        let reversed = reverse_rows(&input, 33);
        assert_order_shows(&run(Isa::Scalar, &reversed, 33), &run(Isa::Scalar, &input, 33), "rows");
    }

    #[test]
    #[should_panic(expected = "an extent is zero")]
    fn no_channels() {
        run(Isa::Scalar, &[], 0);
    }

    #[test]
    #[should_panic(expected = "the mean of 0 rows")]
    fn no_rows() {
        run(Isa::Scalar, &[], 3);
    }

    #[test]
    #[should_panic(expected = "the input is not whole rows")]
    fn part_of_a_row() {
        run(Isa::Scalar, &[0.0; 7], 3);
    }

    #[test]
    #[should_panic(expected = "the output is not one row")]
    fn short_output() {
        mean(Isa::Scalar, &Mean { input: &[0.0; 6], channels: 3 }, &mut [0.0; 2]);
    }

    #[test]
    #[should_panic(expected = "the channels leave the row")]
    fn broadcast_too_wide() {
        broadcast(&[0.0; 3], 4, 2, &mut [0.0; 8]);
    }

    #[test]
    #[should_panic(expected = "the output is not whole rows")]
    fn broadcast_into_part_of_a_row() {
        broadcast(&[0.0; 3], 4, 1, &mut [0.0; 7]);
    }
}

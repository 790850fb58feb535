//! The layout of packed 8-bit weights, and what is proved of them before they are used.
//!
//! As in f32 ([`crate::panels`]) a matrix of `depth` rows (k) and `columns` columns is cut into panels of [`LANES`] columns.
//! In a panel four k of a column lie side by side, so that 32 bits hold what one lane of a register multiplies at once:
//!
//! ```text
//! packed[((n / 16 * depth / 4 + k / 4) * 16 + n % 16) * 4 + k % 4] = w[k][n]          depth is a multiple of 4
//! ```
//!
//! Beside the weights two things are stored which follow from them, [`sums`] and [`pairs`]. Kernels rely on both for their
//! speed and, where they are wrong, give wrong results, so whoever opens a model compares. The same goes for [`fits`].

pub use crate::simd::bytes::GROUP;

use crate::matmul::layout::packed_len;
use crate::simd::{LANES, Simd};

/// The largest magnitude of an 8-bit element or weight.
const MOST: i64 = 127;
/// Weights whose products with any elements can be added in 16 bits have at most this sum of magnitudes.
const PAIR: i32 = i16::MAX as i32 / MOST as i32;

/// Where element (`k`, `n`) of a matrix of `depth` rows is stored. The packed matrix has
/// [`crate::panels::packed_len`] weights.
#[inline]
pub const fn packed_index(depth: usize, k: usize, n: usize) -> usize {
    ((n / LANES * (depth / GROUP) + k / GROUP) * LANES + n % LANES) * GROUP + k % GROUP
}

/// Packs the matrix whose element (k, n) is `w(k, n)`.
///
/// # Panics
/// If `depth` is no multiple of 4, or `out` is not [`crate::panels::packed_len`] long.
pub fn pack(depth: usize, columns: usize, w: impl Fn(usize, usize) -> i8, out: &mut [i8]) {
    assert!(depth.is_multiple_of(GROUP), "the depth is no multiple of 4");
    assert_eq!(out.len(), packed_len(depth, columns), "packed weights have another size");
    out.fill(0);
    for n in 0..columns {
        for k in 0..depth {
            out[packed_index(depth, k, n)] = w(k, n);
        }
    }
}

/// The groups of four k of each panel, each 16 columns of four weights.
fn panels(weights: &[i8], depth: usize) -> impl Iterator<Item = &[[[i8; GROUP]; LANES]]> {
    let groups = weights.as_chunks().0.as_chunks().0;
    groups.chunks_exact((depth / GROUP).max(1))
}

/// The sum of every column's weights, modulo 2^32, zero columns included. Instructions whose left operand is unsigned read a
/// signed element 128 too large, and take 128 times this away.
pub fn sums(weights: &[i8], depth: usize) -> impl Iterator<Item = i32> {
    panels(weights, depth).flat_map(|groups| {
        let mut sums = [0i32; LANES];
        for (sum, w) in groups.iter().flat_map(sums_of).enumerate() {
            sums[sum % LANES] = sums[sum % LANES].wrapping_add(w);
        }
        sums
    })
}

/// The sum of each column's four weights.
fn sums_of(group: &[[i8; GROUP]; LANES]) -> impl Iterator<Item = i32> {
    group.iter().map(|four| four.iter().map(|w| i32::from(*w)).sum())
}

/// For every panel 1 if the products of any two neighbouring groups can be added in 16 bits, else 0: if in each of its
/// columns the magnitudes of the first two weights of both groups, and of the last two, sum up to at most 258.
pub fn pairs(weights: &[i8], depth: usize) -> impl Iterator<Item = u8> {
    panels(weights, depth)
        .map(|groups| u8::from(groups.windows(2).all(|two| (0..LANES).all(|n| joins(two[0][n], two[1][n])))))
}

/// Whether the products of a column's weights in two neighbouring groups can be added in 16 bits.
fn joins(a: [i8; GROUP], b: [i8; GROUP]) -> bool {
    let magnitude = |w: i8| i32::from(w.unsigned_abs());
    (0..GROUP).step_by(2).all(|i| [a[i], a[i + 1], b[i], b[i + 1]].map(magnitude).iter().sum::<i32>() <= PAIR)
}

/// A column whose sum may leave i32.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Overflow {
    /// The column.
    pub column: usize,
    /// The magnitude that its sum may have.
    pub bound: i64,
}

/// Proves that no column's sum, with its bias and residual, can leave i32, whatever the left matrix holds. `residual` are the
/// multipliers of a residual, if there is one.
///
/// # Errors
/// The first column for which it cannot be proved.
///
/// # Panics
/// If the slices are shorter than the columns.
pub fn fits(
    weights: &[i8],
    depth: usize,
    columns: usize,
    bias: &[i32],
    residual: Option<&[i32]>,
) -> Result<(), Overflow> {
    assert_eq!(weights.len(), packed_len(depth, columns), "packed weights have another size");
    let magnitude = |w: &i8| i64::from(w.unsigned_abs());
    for column in 0..columns {
        let rows = (0..depth).step_by(GROUP).map(|k| packed_index(depth, k, column));
        let weights: i64 = rows.flat_map(|i| &weights[i..i + GROUP]).map(magnitude).sum();
        let joining = residual.map_or(0, |r| i64::from(r[column].unsigned_abs()));
        let bound = i64::from(bias[column].unsigned_abs()) + MOST * (weights + joining);
        if bound > i64::from(i32::MAX) {
            return Err(Overflow { column, bound });
        }
    }
    Ok(())
}

/// Packed weights as a tile reads them.
pub(super) struct Panels<'a>(pub(super) &'a [i8]);

impl<S: Simd> crate::matmul::layout::Packed<S> for Panels<'_> {
    type Element = i8;

    #[inline(always)]
    fn read<'a>(&'a self, _: S, i: usize, len: usize, _: &'a mut [i8]) -> &'a [i8] {
        &self.0[i..][..len]
    }

    #[inline(always)]
    fn address(&self, i: usize) -> *const i8 {
        self.0[i..].as_ptr()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_element_has_its_own_place_and_the_rest_is_zero() {
        for (depth, columns) in [(4, 1), (12, 16), (8, 17), (20, 5)] {
            let mut out = vec![9; packed_len(depth, columns)];
            let w = |k: usize, n: usize| (k * 7 + n * 11) as i8 | 1;
            pack(depth, columns, w, &mut out);
            for (k, n) in (0..depth).flat_map(|k| (0..columns).map(move |n| (k, n))) {
                assert_eq!(out[packed_index(depth, k, n)], w(k, n));
            }
            assert_eq!(out.iter().filter(|&&v| v != 0).count(), depth * columns);
        }
    }

    #[test]
    fn four_k_of_a_column_lie_side_by_side() {
        let mut out = [0; 8 * 32];
        pack(8, 17, |k, n| (k * 17 + n) as i8, &mut out);
        assert_eq!(out[..8], [0, 17, 34, 51, 1, 18, 35, 52]);
        assert_eq!(out[64..68], [68, 85, 102, 119]);
        assert_eq!(out[128..136], [16, 33, 50, 67, 0, 0, 0, 0]);
    }

    #[test]
    fn sums_by_hand() {
        let mut out = [0; 8 * 32];
        pack(8, 17, |k, n| if n == 16 { -127 } else { (k + n) as i8 }, &mut out);
        let got: Vec<i32> = sums(&out, 8).collect();
        assert_eq!((got.len(), got[0], got[5], got[16], got[17]), (32, 28, 68, -1016, 0));
        assert_eq!(sums(&[], 0).count(), 0);
    }

    #[test]
    fn pairs_by_hand() {
        let of = |w: &[[i8; 12]]| {
            let mut out = vec![0; packed_len(12, w.len())];
            pack(12, w.len(), |k, n| w[n][k], &mut out);
            pairs(&out, 12).collect::<Vec<u8>>()
        };
        let calm = [64; 12];
        assert_eq!(of(&[calm]), [1]);
        // 127 + 2 + 127 + 2 is 258, in the first two weights of two groups and in the last two.
        assert_eq!(of(&[[127, 2, -127, -2, 2, -127, 2, 127, 0, 0, 0, 0]]), [1]);
        assert_eq!(of(&[[127, 3, -127, -2, 2, -127, 2, 127, 0, 0, 0, 0]]), [0]);
        assert_eq!(of(&[[0, 0, 0, 0, 0, 0, 127, 127, 0, 0, -3, 2]]), [0]);
        assert_eq!(of(&[[0, 0, 0, 0, 0, 0, 127, 127, 0, 0, -2, 2]]), [1]);
        // Groups that are no neighbours never meet.
        assert_eq!(of(&[[127, 127, 127, 127, 0, 0, 0, 0, 127, 127, 127, 127]]), [1]);
        let mut wide = [calm; 17];
        wide[16] = [127; 12];
        assert_eq!(of(&wide), [1, 0]);
        assert_eq!(pairs(&[127; 64], 4).collect::<Vec<u8>>(), [1], "a single group has no neighbour");
    }

    #[test]
    fn the_bound_is_the_largest_sum() {
        let mut w = vec![0; packed_len(8, 2)];
        pack(8, 2, |_, n| [1, -127][n], &mut w);
        // 127 * 8 * 127 of the second column.
        let room = i32::MAX - 127 * 8 * 127;
        assert_eq!(fits(&w, 8, 2, &[0, room], None), Ok(()));
        assert_eq!(fits(&w, 8, 2, &[0, -room - 1], None), Err(Overflow { column: 1, bound: 1 << 31 }));
        assert_eq!(fits(&w, 8, 2, &[i32::MIN, 0], None), Err(Overflow { column: 0, bound: (1 << 31) + 127 * 8 }));
        assert_eq!(fits(&w, 8, 2, &[0, room - 127 * 5], Some(&[0, -5])), Ok(()));
        assert_eq!(
            fits(&w, 8, 2, &[0, room - 127 * 5], Some(&[0, 6])),
            Err(Overflow { column: 1, bound: (1 << 31) + 126 })
        );
    }

    #[test]
    #[should_panic(expected = "the depth is no multiple of 4")]
    fn a_depth_that_is_no_group() {
        pack(6, 1, |_, _| 1, &mut [0; 96]);
    }
}

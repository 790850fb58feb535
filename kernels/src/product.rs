//! The matrix product that every convolution becomes, on a virtual left matrix.
//!
//! ```text
//! out[row][n] = end(start(n) + a[row][0] * w[0][n] + a[row][1] * w[1][n] + ...)      one fma chain, k ascending
//! ```
//!
//! The left matrix `a` is not stored: a `Source` copies (or samples) a piece of one row at a time into a block that
//! stays in the second-level cache. The right matrix is packed ([`crate::panels`]).
//!
//! What the body changes relative to the formula, none of which can change a bit:
//! 1. Rows go in blocks of `ROWS`, k in blocks of `DEPTH`. Between k blocks the partial sums wait in `out`, and the
//!    next block's chain starts from them.
//! 2. Inside, tiles of `TILE` rows by 16 columns live in registers: 12 accumulators of 8 lanes, 2 registers of
//!    weights and broadcasts of `a`. That is the largest tile that AVX2's 16 registers hold without spilling.
//! 3. One packed panel of a k block (16 KiB) stays in the first-level cache while all tiles of the row block use it.
//! 4. Half-precision weights are widened once per panel, k block and row block.

use crate::panels::Panels;
use crate::simd::{LANES, Simd, relu};
use half::f16;
use std::ops::Range;

/// Rows of a tile.
const TILE: usize = 6;
/// Rows of a block: with `DEPTH` numbers each they take about a fifth of a 512 KiB second-level cache.
pub(crate) const ROWS: usize = 96;
/// Numbers of k per block.
const DEPTH: usize = 256;
/// Distance between the rows of a block. The extra 16 keep rows from falling into the same cache set.
const STRIDE: usize = DEPTH + LANES;

/// f32 of scratch that one call needs.
pub const SCRATCH: usize = ROWS * STRIDE + DEPTH * LANES;

/// What is added to the sum, and when.
#[derive(Clone, Copy, Debug)]
pub enum Residual<'a> {
    /// Nothing.
    None,
    /// What `out` holds before the call joins the bias as the start of the chain. Outputs are in the same place.
    InPlace,
    /// As `InPlace`, read from a tensor of the shape of the output, rows `stride` apart.
    Before {
        /// The tensor, from its first row on.
        rows: &'a [f32],
        /// Distance between its rows.
        stride: usize,
    },
    /// Added after the rectifier.
    After {
        /// The tensor, from its first row on.
        rows: &'a [f32],
        /// Distance between its rows.
        stride: usize,
    },
}

/// The right matrix and what happens at both ends of each chain.
#[derive(Clone, Copy, Debug)]
pub struct Product<'a> {
    /// Packed weights of `depth` x `columns`.
    pub weights: Panels<'a>,
    /// One number per column, padded with anything to a multiple of 16.
    pub bias: &'a [f32],
    /// Length of every chain.
    pub depth: usize,
    /// Output columns.
    pub columns: usize,
    /// Whether negative results become 0.
    pub relu: bool,
    /// What is added.
    pub residual: Residual<'a>,
}

impl Product<'_> {
    /// # Panics
    /// If a slice does not fit a product of `rows` rows, or the scratch is smaller than [`SCRATCH`].
    pub(crate) fn check(&self, rows: usize, scratch: &[f32]) {
        let padded = self.columns.checked_next_multiple_of(LANES).expect("the columns overflow");
        assert_eq!(Some(self.weights.len()), padded.checked_mul(self.depth), "packed weights do not match the shape");
        assert!(self.bias.len() >= padded, "the bias is shorter than the columns");
        if let Residual::Before { rows: added, stride } | Residual::After { rows: added, stride } = self.residual {
            assert!(added.len() >= span(rows, stride, self.columns), "the residual is shorter than the rows");
        }
        assert!(scratch.len() >= SCRATCH, "the scratch is too small");
    }

    /// [`Product::check`] for the rows `rows` of `total` that go to `out`, `stride` apart.
    ///
    /// # Panics
    /// As [`Product::check`], and if `out` does not hold the rows.
    pub(crate) fn check_rows(&self, rows: &Range<usize>, total: usize, stride: usize, out: &[f32], scratch: &[f32]) {
        self.check(rows.end, scratch);
        assert!(rows.start <= rows.end && rows.end <= total, "rows {rows:?} of {total}");
        assert!(stride >= self.columns, "output rows overlap");
        assert!(out.len() >= span(rows.len(), stride, self.columns), "the output is shorter than its rows");
    }

    /// The specification of one output: `a(k)` is the left row, `out` the number there before the call, `row` the row
    /// in the residual's tensor.
    pub(crate) fn reference(&self, row: usize, n: usize, out: f32, a: impl Fn(usize) -> f32) -> f32 {
        let mut sum = self.bias[n];
        match self.residual {
            Residual::InPlace => sum += out,
            Residual::Before { rows, stride } => sum += rows[row * stride + n],
            _ => {}
        }
        for k in 0..self.depth {
            sum = a(k).mul_add(self.weights.get(crate::panels::packed_index(self.depth, k, n)), sum);
        }
        if self.relu {
            sum = relu(sum);
        }
        if let Residual::After { rows, stride } = self.residual {
            sum += rows[row * stride + n];
        }
        sum
    }
}

/// Numbers from the first of `rows` rows, `stride` apart, to the last one's end.
fn span(rows: usize, stride: usize, columns: usize) -> usize {
    rows.checked_sub(1).map_or(0, |before| before.saturating_mul(stride).saturating_add(columns))
}

/// The left matrix.
pub(crate) trait Source {
    /// Writes the elements `k..k + piece.len()` of row `row` to `piece`.
    fn fill<S: Simd>(&self, s: S, row: usize, k: usize, piece: &mut [f32]);

    /// The same elements where they lie in memory already, or `None` if they must be filled: for all rows or for none.
    #[inline(always)]
    fn stored(&self, row: usize, k: usize, len: usize) -> Option<&[f32]> {
        let _ = (row, k, len);
        None
    }
}

/// Where output rows go.
pub(crate) trait Target {
    /// Offset in `out` of row `row`'s first column.
    fn offset(&self, row: usize) -> usize;
    /// The row in the residual's tensor.
    fn residual_row(&self, row: usize) -> usize;
}

/// Rows one after the other, `stride` apart, the first of them being `first`.
pub(crate) struct Linear {
    pub(crate) first: usize,
    pub(crate) stride: usize,
}

impl Target for Linear {
    #[inline(always)]
    fn offset(&self, row: usize) -> usize {
        (row - self.first) * self.stride
    }
    #[inline(always)]
    fn residual_row(&self, row: usize) -> usize {
        row
    }
}

/// Computes `rows` of the product. `scratch` must hold [`SCRATCH`] numbers.
#[inline(always)]
pub(crate) fn product<S: Simd, A: Source, T: Target>(
    s: S,
    p: &Product<'_>,
    source: &A,
    target: &T,
    rows: Range<usize>,
    out: &mut [f32],
    scratch: &mut [f32],
) {
    let (block, widened) = scratch[..SCRATCH].split_at_mut(ROWS * STRIDE);
    let mut first = rows.start;
    while first < rows.end {
        let count = ROWS.min(rows.end - first);
        let mut k = 0;
        loop {
            let depth = DEPTH.min(p.depth - k);
            let ends = Ends { first: k == 0, last: k + depth == p.depth };
            let stored = source.stored(first, k, depth).is_some();
            if !stored {
                for (i, piece) in block.chunks_exact_mut(STRIDE).take(count).enumerate() {
                    source.fill(s, first + i, k, &mut piece[..depth]);
                }
            }
            for panel in 0..p.columns.div_ceil(LANES) {
                let at = (panel * p.depth + k) * LANES;
                let weights = match p.weights {
                    Panels::F32(w) => &w[at..at + depth * LANES],
                    Panels::F16(w) => widen(s, &w[at..at + depth * LANES], widened),
                };
                let mut i = 0;
                while i < count {
                    let tile = Tile { p, ends, row: first + i, panel, depth, weights };
                    macro_rules! rows {
                        ($n:literal) => {{
                            let a: [&[f32]; $n] = std::array::from_fn(|r| {
                                if stored {
                                    source.stored(first + i + r, k, depth).unwrap_or_default()
                                } else {
                                    &block[(i + r) * STRIDE..(i + r) * STRIDE + depth]
                                }
                            });
                            tile.run(s, a, target, out);
                        }};
                    }
                    match count - i {
                        1 => rows!(1),
                        2 => rows!(2),
                        3 => rows!(3),
                        4 => rows!(4),
                        5 => rows!(5),
                        _ => rows!(6),
                    }
                    i += TILE;
                }
            }
            k += depth;
            if ends.last {
                break;
            }
        }
        first += count;
    }
}

/// Widens a block of half-precision weights.
#[inline(always)]
fn widen<'a, S: Simd>(s: S, narrow: &[f16], wide: &'a mut [f32]) -> &'a [f32] {
    let (narrow, _) = narrow.as_chunks::<LANES>();
    let (wide_chunks, _) = wide.as_chunks_mut::<LANES>();
    for (n, w) in narrow.iter().zip(wide_chunks) {
        s.store(w, s.widen(n));
    }
    wide
}

/// Whether a k block is the first and the last of its chains.
#[derive(Clone, Copy)]
struct Ends {
    first: bool,
    last: bool,
}

/// Up to six rows of one panel in one k block.
struct Tile<'a, 'p> {
    p: &'a Product<'p>,
    ends: Ends,
    row: usize,
    panel: usize,
    depth: usize,
    weights: &'a [f32],
}

impl Tile<'_, '_> {
    #[inline(always)]
    fn run<S: Simd, T: Target, const N: usize>(self, s: S, a: [&[f32]; N], target: &T, out: &mut [f32]) {
        let column = self.panel * LANES;
        let width = LANES.min(self.p.columns - column);
        let mut sums = [s.splat(0.0); N];
        for r in 0..N {
            let at = target.offset(self.row + r) + column;
            sums[r] = if self.ends.first {
                let bias = s.load_part(&self.p.bias[column..column + LANES]);
                match self.p.residual {
                    Residual::InPlace => s.add(bias, s.load_part(&out[at..at + width])),
                    Residual::Before { rows, stride } => {
                        let at = target.residual_row(self.row + r) * stride + column;
                        s.add(bias, s.load_part(&rows[at..at + width]))
                    }
                    _ => bias,
                }
            } else {
                s.load_part(&out[at..at + width])
            };
        }
        sums = multiply(s, self.depth, a, self.weights, sums);
        for r in 0..N {
            let at = target.offset(self.row + r) + column;
            let mut sum = sums[r];
            if self.ends.last {
                if self.p.relu {
                    sum = s.relu(sum);
                }
                if let Residual::After { rows, stride } = self.p.residual {
                    let at = target.residual_row(self.row + r) * stride + column;
                    sum = s.add(sum, s.load_part(&rows[at..at + width]));
                }
            }
            s.store_part(&mut out[at..at + width], sum);
        }
    }
}

/// `sums[r] += a[r][k] * weights[k]` for k ascending: the loop that the whole library spends its time in.
#[inline(always)]
fn multiply<S: Simd, const N: usize>(
    s: S,
    depth: usize,
    a: [&[f32]; N],
    weights: &[f32],
    mut sums: [S::V; N],
) -> [S::V; N] {
    assert!(a.iter().all(|a| a.len() >= depth), "a row piece is shorter than the k block");
    assert!(weights.len() >= depth * LANES, "the panel is shorter than the k block");
    let a = a.map(<[f32]>::as_ptr);
    let weights = weights.as_ptr();
    for k in 0..depth {
        // SAFETY: k < depth, and both lengths were asserted above.
        unsafe {
            let w = s.load_ptr(weights.add(k * LANES));
            for r in 0..N {
                sums[r] = s.mul_add(s.splat(*a[r].add(k)), w, sums[r]);
            }
        }
    }
    sums
}

#[cfg(test)]
mod tests;

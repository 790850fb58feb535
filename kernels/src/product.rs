//! The matrix product that every convolution becomes, on a virtual left matrix.
//!
//! ```text
//! out[row][n] = end(start(n) + a[row][0] * w[0][n] + a[row][1] * w[1][n] + ...)      one fma chain, k ascending
//! ```
//!
//! The left matrix `a` is not stored: a `Source` names, piece by piece, where the elements of a row lie, and copies (or
//! samples) only those that lie nowhere in this order. The right matrix is packed ([`crate::panels`]).
//!
//! What the body changes relative to the formula, none of which can change a bit:
//! 1. Rows go in blocks of `ROWS`, k in blocks of `DEPTH`. Between k blocks the partial sums wait in `out`, and the
//!    next block's chain starts from them.
//! 2. Inside, tiles of `TILE` rows by 16 columns live in registers: 12 accumulators of 8 lanes, 2 registers of
//!    weights and broadcasts of `a`. That is the largest tile that AVX2's 16 registers hold without spilling.
//! 3. One packed panel of a k block (at most 24 KiB) stays in the first-level cache while all tiles of the row block use it;
//!    they fetch the next one, a share each, and the outputs of the tile that follows.
//! 4. Half-precision weights are widened once per panel, k block and row block.

use crate::panels::Panels;
use crate::simd::{LANES, Simd, relu};
use half::f16;
use std::ops::Range;

/// Rows of a tile.
const TILE: usize = 6;
/// Rows of a block: with `DEPTH` numbers each they take under a third of a 512 KiB second-level cache.
pub(crate) const ROWS: usize = 96;
/// Most numbers of k per block: a packed panel of them takes three quarters of a 32 KiB first-level cache.
pub(crate) const DEPTH: usize = 384;
/// Distance between the rows of a block. The extra 16 keep rows from falling into the same cache set.
const STRIDE: usize = DEPTH + LANES;

/// Pieces of a k block. Shorter pieces than an eighth of it are better copied together.
pub(crate) const PIECES: usize = 8;
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
    /// What is known of a row before its elements are asked for.
    type At: Copy;
    /// What is known of a piece of k before its elements are asked for.
    type Part: Copy;

    /// Row `row`.
    fn at(&self, row: usize) -> Self::At;
    /// The row after `at`.
    fn next(&self, at: Self::At) -> Self::At;
    /// The piece that starts at `k`, and how many elements it may have at most.
    fn part(&self, k: usize) -> (Self::Part, usize);
    /// As many elements as `spare` has: where they lie in memory, or in `spare` once they are written there.
    fn piece<'a, S: Simd>(&'a self, s: S, at: Self::At, part: Self::Part, spare: &'a mut [f32]) -> &'a [f32];
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

/// Where the pieces of a block of rows lie in one k block.
struct Pieces {
    /// Length of each piece.
    len: [usize; PIECES],
    count: usize,
    /// First element of each piece of each row.
    start: [[*const f32; ROWS]; PIECES],
}

impl Pieces {
    fn new() -> Self {
        Self { len: [0; PIECES], count: 0, start: [[std::ptr::null(); ROWS]; PIECES] }
    }

    /// Finds or makes the pieces of the k block at `k` for `rows` rows from `at` on. Returns the block's depth.
    ///
    /// The pointers are good while `source` and `block` are not written.
    #[inline(always)]
    fn find<S: Simd, A: Source>(
        &mut self,
        s: S,
        source: &A,
        mut at: A::At,
        rows: usize,
        k: Range<usize>,
        block: &mut [f32],
    ) -> usize {
        let mut parts = [None; PIECES];
        let mut depth = 0;
        self.count = 0;
        while self.count < PIECES && depth < k.len() {
            let (part, len) = source.part(k.start + depth);
            parts[self.count] = Some(part);
            self.len[self.count] = len.min(k.len() - depth);
            depth += self.len[self.count];
            self.count += 1;
        }
        for (row, mut spare) in block.chunks_exact_mut(STRIDE).take(rows).enumerate() {
            for (i, part) in parts[..self.count].iter().flatten().enumerate() {
                let (here, rest) = spare.split_at_mut(self.len[i]);
                spare = rest;
                let piece = source.piece(s, at, *part, here);
                assert!(piece.len() == self.len[i], "a piece is not as long as asked");
                self.start[i][row] = piece.as_ptr();
            }
            at = source.next(at);
        }
        depth
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
    // Equal k blocks, as few as possible.
    let step = p.depth.div_ceil(p.depth.div_ceil(DEPTH).max(1)).next_multiple_of(LANES);
    let mut pieces = Pieces::new();
    let mut offsets = [0; ROWS];
    let mut first = rows.start;
    while first < rows.end {
        let count = ROWS.min(rows.end - first);
        for (i, offset) in offsets[..count].iter_mut().enumerate() {
            *offset = target.offset(first + i);
        }
        let at = source.at(first);
        let mut k = 0;
        loop {
            let depth = pieces.find(s, source, at, count, k..p.depth.min(k + step), block);
            let ends = Ends { first: k == 0, last: k + depth == p.depth };
            let panels = p.columns.div_ceil(LANES);
            for panel in 0..panels {
                let start = (panel * p.depth + k) * LANES;
                let weights = match p.weights {
                    Panels::F32(w) => &w[start..start + depth * LANES],
                    Panels::F16(w) => widen(s, &w[start..start + depth * LANES], widened),
                };
                // The panel that is needed next, as far as there is one, in equal shares per tile.
                let share = (depth * LANES).div_ceil(count.div_ceil(TILE)).next_multiple_of(LANES);
                let mut ahead = match p.weights {
                    Panels::F32(w) if panel + 1 < panels => w[start + p.depth * LANES..].as_ptr(),
                    _ => std::ptr::null(),
                };
                let mut i = 0;
                while i < count {
                    if !ahead.is_null() {
                        for line in (0..share).step_by(LANES) {
                            s.prefetch(ahead.wrapping_add(line));
                        }
                        ahead = ahead.wrapping_add(share);
                    }
                    for &offset in &offsets[(i + TILE).min(count)..(i + 2 * TILE).min(count)] {
                        s.prefetch(out.as_ptr().wrapping_add(offset + panel * LANES));
                    }
                    let tile = Tile { p, ends, row: first + i, panel, weights, pieces: &pieces, i };
                    macro_rules! rows {
                        ($n:literal) => {
                            if p.columns - panel * LANES >= LANES {
                                tile.run::<S, T, $n, true>(s, target, &offsets, out)
                            } else {
                                tile.run::<S, T, $n, false>(s, target, &offsets, out)
                            }
                        };
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
    /// First row, in the whole product and in the block.
    row: usize,
    i: usize,
    panel: usize,
    weights: &'a [f32],
    pieces: &'a Pieces,
}

impl Tile<'_, '_> {
    /// `WHOLE` says that all 16 columns exist.
    #[inline(always)]
    fn run<S: Simd, T: Target, const N: usize, const WHOLE: bool>(
        self,
        s: S,
        target: &T,
        offsets: &[usize; ROWS],
        out: &mut [f32],
    ) {
        let column = self.panel * LANES;
        let width = if WHOLE { LANES } else { self.p.columns - column };
        let offset = |r: usize| offsets[self.i + r] + column;
        let mut sums = [s.splat(0.0); N];
        for r in 0..N {
            sums[r] = if self.ends.first {
                let bias = s.load_part(&self.p.bias[column..column + LANES]);
                match self.p.residual {
                    Residual::InPlace => s.add(bias, load::<S, WHOLE>(s, &out[offset(r)..][..width])),
                    Residual::Before { rows, stride } => {
                        let at = target.residual_row(self.row + r) * stride + column;
                        s.add(bias, load::<S, WHOLE>(s, &rows[at..][..width]))
                    }
                    _ => bias,
                }
            } else {
                load::<S, WHOLE>(s, &out[offset(r)..][..width])
            };
        }
        let mut weights = self.weights;
        for piece in 0..self.pieces.count {
            let len = self.pieces.len[piece];
            let a = std::array::from_fn(|r| self.pieces.start[piece][self.i + r]);
            let (now, rest) = weights.split_at(len * LANES);
            // SAFETY: `Pieces::find` set these pointers to pieces of `len` numbers each, in this k block, and nothing
            // has written there since.
            sums = unsafe { multiply(s, a, now, sums) };
            weights = rest;
        }
        for r in 0..N {
            let mut sum = sums[r];
            if self.ends.last {
                if self.p.relu {
                    sum = s.relu(sum);
                }
                if let Residual::After { rows, stride } = self.p.residual {
                    let at = target.residual_row(self.row + r) * stride + column;
                    sum = s.add(sum, load::<S, WHOLE>(s, &rows[at..][..width]));
                }
            }
            let out = &mut out[offset(r)..][..width];
            if WHOLE {
                s.store(out.first_chunk_mut().expect("16 columns"), sum);
            } else {
                s.store_part(out, sum);
            }
        }
    }
}

/// Up to 16 numbers; exactly 16 if `WHOLE`.
#[inline(always)]
fn load<S: Simd, const WHOLE: bool>(s: S, x: &[f32]) -> S::V {
    if WHOLE { s.load(x.first_chunk().expect("16 columns")) } else { s.load_part(x) }
}

/// `sums[r] += a[r][k] * weights[k]` for k ascending: the loop that the whole library spends its time in.
///
/// # Safety
/// Each pointer must be valid for reading as many numbers as `weights` has rows of 16.
#[inline(always)]
unsafe fn multiply<S: Simd, const N: usize>(
    s: S,
    a: [*const f32; N],
    weights: &[f32],
    mut sums: [S::V; N],
) -> [S::V; N] {
    let depth = weights.len() / LANES;
    let weights = weights.as_ptr();
    for k in 0..depth {
        // SAFETY: k < depth, within the weights and, as the caller promises, within every row's piece.
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

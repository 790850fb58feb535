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
//! 1. Rows go in blocks of `BLOCK_ROWS`, k in blocks of at most `DEPTH`. Between k blocks the partial sums wait in `out`, and
//!    the next block's chain starts from them.
//! 2. Inside, a tile lives in registers: as large a one as the instruction set holds without spilling
//!    ([`crate::Isa::tile`]).
//! 3. The packed panels of a tile and k block (at most 24 KiB) stay in the first-level cache while all tiles of the row
//!    block use them; they fetch the next ones, a share each, and the outputs of the tile that follows.
//! 4. Half-precision weights are widened once per panel, k block and row block.

use super::layout::{Panels, packed_index};
use crate::isa::Isa;
#[cfg(not(feature = "std"))]
use crate::math::Float as _;
use crate::simd::{Kernel, LANES, Simd, TileRows, dispatch, relu};
use core::ops::Range;
use half::f16;

/// Rows of a block: with `DEPTH` values each they take under a third of a 512 KiB second-level cache. A multiple of every
/// tile's rows, so that whole blocks are whole tiles.
pub const BLOCK_ROWS: usize = 96;
/// Most numbers of k per block, for all panels of a tile together: a packed panel of them takes three quarters of a 32 KiB first-level cache.
pub(crate) const DEPTH: usize = 384;
/// Distance between the rows of a block. The extra 16 keep rows from falling into the same cache set.
const STRIDE: usize = DEPTH + LANES;

/// Pieces of a k block. Shorter pieces than an eighth of it are better copied together.
pub(crate) const PIECES: usize = 8;
/// f32 of scratch that one call needs.
pub const SCRATCH: usize = BLOCK_ROWS * STRIDE + DEPTH * LANES;

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

    /// The specification of row `row`: `a(k)` is the left row, `out` holds the outputs and before that whatever was
    /// there, `residual_row` is the row in the residual's tensor.
    ///
    /// Sixteen chains advance side by side, so that an element of the left row is looked up once for all.
    #[inline(always)]
    pub(crate) fn reference(&self, residual_row: usize, out: &mut [f32], a: impl Fn(usize) -> f32) {
        let added = |rows: &[f32], stride: usize, n: usize| rows[residual_row * stride + n];
        for (panel, out) in out.chunks_mut(LANES).enumerate() {
            let column = panel * LANES;
            let mut sums = [0.0; LANES];
            for (i, out) in out.iter().enumerate() {
                sums[i] = self.bias[column + i];
                match self.residual {
                    Residual::InPlace => sums[i] += out,
                    Residual::Before { rows, stride } => sums[i] += added(rows, stride, column + i),
                    _ => {}
                }
            }
            for k in 0..self.depth {
                let (x, weights) = (a(k), self.weights.lanes(packed_index(self.depth, k, column)));
                for (sum, weight) in sums.iter_mut().zip(weights) {
                    *sum = x.mul_add(weight, *sum);
                }
            }
            for (i, out) in out.iter_mut().enumerate() {
                *out = if self.relu { relu(sums[i]) } else { sums[i] };
                if let Residual::After { rows, stride } = self.residual {
                    *out += added(rows, stride, column + i);
                }
            }
        }
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

    /// Element `k` of row `row`, for the specification.
    fn element(&self, row: usize, k: usize) -> f32;
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
    start: [[*const f32; BLOCK_ROWS]; PIECES],
}

impl Pieces {
    fn new() -> Self {
        Self { len: [0; PIECES], count: 0, start: [[core::ptr::null(); BLOCK_ROWS]; PIECES] }
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

/// A product whose output rows go one after the other: what a convolution is.
pub(crate) struct Rows<'a, A> {
    pub(crate) product: &'a Product<'a>,
    pub(crate) source: &'a A,
    pub(crate) rows: Range<usize>,
    /// Distance between rows of `out`, which starts at the first of them.
    pub(crate) stride: usize,
    pub(crate) out: &'a mut [f32],
    pub(crate) scratch: &'a mut [f32],
}

impl<A: Source> Rows<'_, A> {
    /// Computes the rows, of `total`, on `isa`.
    ///
    /// # Panics
    /// As [`Product::check_rows`].
    #[inline]
    pub(crate) fn compute(self, isa: Isa, total: usize) {
        self.product.check_rows(&self.rows, total, self.stride, self.out, self.scratch);
        dispatch(isa, self);
    }
}

impl<A: Source> Kernel for Rows<'_, A> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        let first = self.rows.start;
        for row in self.rows {
            let out = &mut self.out[(row - first) * self.stride..][..self.product.columns];
            self.product.reference(
                row,
                out,
                #[inline(always)]
                |k| self.source.element(row, k),
            );
        }
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let target = Linear { first: self.rows.start, stride: self.stride };
        product(s, self.product, self.source, &target, self.rows, self.out, self.scratch);
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
    let (block, widened) = scratch[..SCRATCH].split_at_mut(BLOCK_ROWS * STRIDE);
    let panels = p.columns.div_ceil(LANES);
    // Equal k blocks, as few as possible.
    let most = DEPTH / S::TILE.panels.min(panels.max(1));
    let step = p.depth.div_ceil(p.depth.div_ceil(most).max(1)).next_multiple_of(LANES);
    let mut pieces = Pieces::new();
    let mut offsets = [0; BLOCK_ROWS];
    let mut first = rows.start;
    while first < rows.end {
        let count = BLOCK_ROWS.min(rows.end - first);
        for (i, offset) in offsets[..count].iter_mut().enumerate() {
            *offset = target.offset(first + i);
        }
        let at = source.at(first);
        let mut k = 0;
        loop {
            let depth = pieces.find(s, source, at, count, k..p.depth.min(k + step), block);
            let block = Block {
                p,
                ends: Ends { first: k == 0, last: k + depth == p.depth },
                row: first,
                offsets: &offsets[..count],
                k,
                depth,
                pieces: &pieces,
            };
            let mut panel = 0;
            while panel < panels {
                if S::TILE.panels == 2 && panels - panel >= 2 {
                    block.panels::<S, T, 2>(s, target, panel, widened, out);
                    panel += 2;
                } else {
                    block.panels::<S, T, 1>(s, target, panel, widened, out);
                    panel += 1;
                }
            }
            k += depth;
            if k == p.depth {
                break;
            }
        }
        first += count;
    }
}

/// A block of rows in a k block.
struct Block<'a, 'p> {
    p: &'a Product<'p>,
    ends: Ends,
    /// The first row in the whole product.
    row: usize,
    /// Where the rows are in `out`.
    offsets: &'a [usize],
    k: usize,
    depth: usize,
    pieces: &'a Pieces,
}

impl Block<'_, '_> {
    /// All rows of `P` panels from `panel` on.
    #[inline(always)]
    fn panels<S: Simd, T: Target, const P: usize>(
        &self,
        s: S,
        target: &T,
        panel: usize,
        widened: &mut [f32],
        out: &mut [f32],
    ) {
        let (p, len, count) = (self.p, self.depth * LANES, self.offsets.len());
        let start = |panel: usize| (panel * p.depth + self.k) * LANES;
        let mut weights = [&[][..]; P];
        for (j, widened) in widened.chunks_exact_mut(DEPTH / P * LANES).take(P).enumerate() {
            weights[j] = match p.weights {
                Panels::F32(w) => &w[start(panel + j)..][..len],
                Panels::F16(w) => widen(s, &w[start(panel + j)..][..len], widened),
            };
        }
        // The panels that are needed next, as far as there are any, in equal shares per tile.
        let most = S::TILE.rows;
        let share = len.div_ceil(count.div_ceil(most)).next_multiple_of(LANES);
        let mut ahead = [core::ptr::null(); P];
        for (j, ahead) in ahead.iter_mut().enumerate() {
            if let Panels::F32(w) = p.weights
                && (panel + P + j) * LANES < p.columns
            {
                *ahead = w[start(panel + P + j)..].as_ptr();
            }
        }
        let mut i = 0;
        while i < count {
            for ahead in ahead.iter_mut().filter(|ahead| !ahead.is_null()) {
                for line in (0..share).step_by(LANES) {
                    s.prefetch(ahead.wrapping_add(line));
                }
                *ahead = ahead.wrapping_add(share);
            }
            for &offset in &self.offsets[(i + most).min(count)..(i + 2 * most).min(count)] {
                for j in 0..P {
                    s.prefetch(out.as_ptr().wrapping_add(offset + (panel + j) * LANES));
                }
            }
            let whole = p.columns - panel * LANES >= P * LANES;
            i += s.rows(count - i, Tile { block: self, target, panel, weights, whole, i, out: &mut *out });
        }
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

/// Some rows of `P` panels.
struct Tile<'a, 'p, T, const P: usize> {
    block: &'a Block<'a, 'p>,
    target: &'a T,
    panel: usize,
    weights: [&'a [f32]; P],
    /// Whether all columns exist; else only the last panel lacks some.
    whole: bool,
    /// First row in the block.
    i: usize,
    out: &'a mut [f32],
}

impl<S: Simd, T: Target, const P: usize> TileRows<S> for Tile<'_, '_, T, P> {
    #[inline(always)]
    fn run<const N: usize>(self, s: S) {
        // A mask that lets everything pass costs nothing, so where there are masks whole columns need no code of their own.
        if S::MASKED || !self.whole {
            self.columns::<S, N, false>(s);
        } else {
            self.columns::<S, N, true>(s);
        }
    }
}

impl<T: Target, const P: usize> Tile<'_, '_, T, P> {
    #[inline(always)]
    fn columns<S: Simd, const N: usize, const WHOLE: bool>(self, s: S) {
        let Block { p, ends, row, offsets, pieces, .. } = *self.block;
        let Self { target, out, .. } = self;
        let column = |j: usize| (self.panel + j) * LANES;
        let width = |j: usize| if WHOLE { LANES } else { LANES.min(p.columns - column(j)) };
        let offset = |r: usize, j: usize| offsets[self.i + r] + column(j);
        let residual_row = |r: usize| target.residual_row(row + self.i + r);
        let mut sums = [[s.splat(0.0); P]; N];
        for r in 0..N {
            for j in 0..P {
                sums[r][j] = if ends.first {
                    let bias = s.load_part(&p.bias[column(j)..column(j) + LANES]);
                    match p.residual {
                        Residual::InPlace => s.add(bias, load::<S, WHOLE>(s, &out[offset(r, j)..][..width(j)])),
                        Residual::Before { rows, stride } => {
                            let at = residual_row(r) * stride + column(j);
                            s.add(bias, load::<S, WHOLE>(s, &rows[at..][..width(j)]))
                        }
                        _ => bias,
                    }
                } else {
                    load::<S, WHOLE>(s, &out[offset(r, j)..][..width(j)])
                };
            }
        }
        let mut k = 0;
        for piece in 0..pieces.count {
            let len = pieces.len[piece];
            let a = core::array::from_fn(|r| pieces.start[piece][self.i + r]);
            let weights = self.weights.map(|w| w[k * LANES..(k + len) * LANES].as_ptr());
            // SAFETY: `Pieces::find` set the pointers of `a` to pieces of `len` numbers each, in this k block, and nothing
            // has written there since; the slices of weights are as deep.
            sums = unsafe { s.multiply(a, weights, len, sums) };
            k += len;
        }
        for r in 0..N {
            for j in 0..P {
                let mut sum = sums[r][j];
                if ends.last {
                    if p.relu {
                        sum = s.relu(sum);
                    }
                    if let Residual::After { rows, stride } = p.residual {
                        let at = residual_row(r) * stride + column(j);
                        sum = s.add(sum, load::<S, WHOLE>(s, &rows[at..][..width(j)]));
                    }
                }
                let out = &mut out[offset(r, j)..][..width(j)];
                if WHOLE {
                    s.store(out.first_chunk_mut().expect("16 columns"), sum);
                } else {
                    s.store_part(out, sum);
                }
            }
        }
    }
}

/// Up to 16 numbers; exactly 16 if `WHOLE`.
#[inline(always)]
fn load<S: Simd, const WHOLE: bool>(s: S, x: &[f32]) -> S::V {
    if WHOLE { s.load(x.first_chunk().expect("16 columns")) } else { s.load_part(x) }
}

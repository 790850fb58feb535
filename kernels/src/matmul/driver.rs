//! How a product is cut into blocks of rows, of k and of columns, and those into tiles.
//!
//! What this changes relative to the formula, none of which can change a bit:
//! 1. Rows go in blocks of [`BLOCK_ROWS`], k in blocks of at most [`depth`]. Between k blocks the sums wait where the
//!    epilogue keeps them, and the next block's chain starts from them.
//! 2. Inside, a tile lives in registers: as large a one as the instruction set holds without spilling
//!    ([`crate::Isa::tile`]).
//! 3. The packed panels of a tile and k block (at most 24 KiB) stay in the first-level cache while all tiles of the row
//!    block use them; they fetch the next ones, a share each, and the outputs of the tile that follows.
//! 4. Where the panels of two tiles fit beside each other into the first-level cache, such tiles take turns. Rows of the output are
//!    often a multiple of a page apart, and a tile that starts from what its columns hold would wait for the stores of the
//!    tile above it, whose addresses look the same to the processor. So there is another tile in between.
//! 5. Half-precision weights are widened once per panel, k block and row block.

use super::epilogue::Epilogue;
use super::layout::Packed;
use super::tile::{Arithmetic, Block, Left, Tile};
use crate::simd::{LANES, Simd};
use core::marker::PhantomData;
use core::ops::Range;

/// Rows of a block: with `depth` values each they take under a third of a 512 KiB second-level cache. A multiple of every
/// tile's rows, so that whole blocks are whole tiles.
pub const BLOCK_ROWS: usize = 96;
/// Bytes of the panels that a tile reads in one k block: three quarters of a 32 KiB first-level cache.
const PANEL_BYTES: usize = 24 << 10;
/// Bytes of a cache line.
const LINE: usize = 64;
/// Bytes between the end of a row of a block and the start of the next, which keep rows from falling into the same cache
/// set.
const GAP_BYTES: usize = LINE;
/// Pieces of a k block, at most: the runs of taps of a 3x3x3 kernel.
const PIECES: usize = 9;

/// Most values of k per block, for all panels of a tile together, where an element of the left matrix and of the panels is
/// an `E`.
pub(crate) const fn depth<E>() -> usize {
    PANEL_BYTES / (LANES * size_of::<E>())
}

/// Distance between the rows of a block of `E`.
pub(crate) const fn stride<E>() -> usize {
    depth::<E>() + GAP_BYTES / size_of::<E>()
}

/// [`depth`] of f32.
pub(crate) const DEPTH: usize = depth::<f32>();
/// f32 of a block of rows.
pub(crate) const BLOCK_LEN: usize = BLOCK_ROWS * stride::<f32>();
/// f32 of the panels of a tile in one k block.
pub(crate) const PANEL_LEN: usize = LANES * if DEPTH > TURNS * TURNS_DEPTH { DEPTH } else { TURNS * TURNS_DEPTH };

/// Tiles that take turns.
const TURNS: usize = 2;
/// Depth of a k block up to which they do, at most 16 KiB a panel.
const TURNS_DEPTH: usize = 256;

/// The left matrix. It is not stored: a source names, piece by piece, where the elements of a row lie, and copies (or
/// samples) only those that lie nowhere in this order.
pub(crate) trait Source {
    /// What the matrix is made of.
    type Element: Copy;
    /// What is known of a row before its elements are asked for.
    type At: Copy;
    /// What is known of a piece of k before its elements are asked for.
    type Part: Copy;

    /// Element `k` of row `row`, for the specification.
    fn element(&self, row: usize, k: usize) -> Self::Element;
    /// Row `row`.
    fn at(&self, row: usize) -> Self::At;
    /// The row after `at`.
    fn next(&self, at: Self::At) -> Self::At;
    /// The piece that starts at `k`, and how many elements it may have at most.
    fn part(&self, k: usize) -> (Self::Part, usize);
    /// As many elements as `spare` has: where they lie in memory, or in `spare` once they are written there.
    fn piece<'a, S: Simd>(
        &'a self,
        s: S,
        at: Self::At,
        part: Self::Part,
        spare: &'a mut [Self::Element],
    ) -> &'a [Self::Element];
}

/// Where output rows go.
pub(crate) trait Target {
    /// Offset in the output of row `row`'s first column.
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
struct Pieces<E> {
    /// Length of each piece.
    len: [usize; PIECES],
    count: usize,
    /// First element of each piece of each row.
    start: [[*const E; BLOCK_ROWS]; PIECES],
}

/// [`Pieces`] that were found, and a borrow of what they point into.
struct Found<'a, E> {
    pieces: &'a Pieces<E>,
    borrowed: PhantomData<&'a [E]>,
}

impl<E: Copy> Pieces<E> {
    fn new() -> Self {
        Self { len: [0; PIECES], count: 0, start: [[core::ptr::null(); BLOCK_ROWS]; PIECES] }
    }

    /// Finds or makes the pieces of the k block at `k` for `rows` rows from `at` on. Also returns the block's depth.
    #[inline(always)]
    fn find<'a, S: Simd, A: Source<Element = E>>(
        &'a mut self,
        s: S,
        source: &'a A,
        mut at: A::At,
        rows: usize,
        k: Range<usize>,
        block: &'a mut [E],
    ) -> (Found<'a, E>, usize) {
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
        for (row, mut spare) in block.chunks_exact_mut(stride::<E>()).take(rows).enumerate() {
            for (i, part) in parts[..self.count].iter().flatten().enumerate() {
                let (here, rest) = spare.split_at_mut(self.len[i]);
                spare = rest;
                let piece = source.piece(s, at, *part, here);
                assert!(piece.len() == self.len[i], "a piece is not as long as asked");
                self.start[i][row] = piece.as_ptr();
            }
            at = source.next(at);
        }
        (Found { pieces: self, borrowed: PhantomData }, depth)
    }
}

// SAFETY: `Pieces::find` set these pointers to pieces of as many elements, and what they point into is borrowed.
unsafe impl<E> Left<E> for Found<'_, E> {
    #[inline(always)]
    fn pieces(&self) -> usize {
        self.pieces.count
    }
    #[inline(always)]
    fn len(&self, piece: usize) -> usize {
        self.pieces.len[piece]
    }
    #[inline(always)]
    fn row(&self, piece: usize, row: usize) -> *const E {
        self.pieces.start[piece][row]
    }
}

/// A product of a virtual left matrix with packed weights.
pub(crate) struct Product<'a, A, W, T> {
    pub(crate) left: &'a A,
    pub(crate) weights: &'a W,
    pub(crate) target: &'a T,
    /// Length of every chain.
    pub(crate) depth: usize,
    /// Output columns.
    pub(crate) columns: usize,
}

impl<L: Source, W, T: Target> Product<'_, L, W, T> {
    /// Computes `rows` into `out`. `block` has room for [`BLOCK_ROWS`] rows of [`depth`] elements and the gaps behind them,
    /// `spare` for the panels of a tile in one k block, if the weights are stored in another form. Both hold anything.
    #[inline(always)]
    #[allow(clippy::too_many_arguments, reason = "what is computed, where to, and in which memory")]
    pub(crate) fn compute<A, S, E>(
        &self,
        s: S,
        arithmetic: A,
        epilogue: &mut E,
        rows: Range<usize>,
        out: &mut [E::Out],
        block: &mut [A::Left],
        spare: &mut [A::Right],
    ) where
        S: Simd,
        A: Arithmetic<S, Left = L::Element>,
        W: Packed<S, Element = A::Right>,
        E: Epilogue<S, A>,
    {
        const { assert!(1 <= A::PANELS && A::PANELS <= 2) }
        debug_assert!(BLOCK_ROWS.is_multiple_of(arithmetic.tile_rows(s)));
        let panels = self.columns.div_ceil(LANES);
        // Equal k blocks, as few as possible.
        let most = depth::<A::Right>() / A::PANELS.min(panels.max(1));
        let step = self.depth.div_ceil(self.depth.div_ceil(most).max(1)).next_multiple_of(LANES);
        let mut pieces = Pieces::new();
        let mut offsets = [0; BLOCK_ROWS];
        let mut first = rows.start;
        while first < rows.end {
            let count = BLOCK_ROWS.min(rows.end - first);
            for (i, offset) in offsets[..count].iter_mut().enumerate() {
                *offset = self.target.offset(first + i);
            }
            let at = self.left.at(first);
            let mut k = 0;
            loop {
                let (left, depth) = pieces.find(s, self.left, at, count, k..self.depth.min(k + step), block);
                let block = Block {
                    left: &left,
                    target: self.target,
                    row: first,
                    columns: self.columns,
                    first: k == 0,
                    last: k + depth == self.depth,
                };
                self.block(s, arithmetic, &block, epilogue, k..k + depth, &offsets[..count], out, spare);
                k += depth;
                if k == self.depth {
                    break;
                }
            }
            first += count;
        }
    }

    /// All panels of a block of rows and k.
    #[inline(always)]
    #[allow(clippy::too_many_arguments, reason = "the state of the loops around it")]
    pub(crate) fn block<A, S, E, B>(
        &self,
        s: S,
        arithmetic: A,
        block: &Block<'_, B, T>,
        epilogue: &mut E,
        k: Range<usize>,
        offsets: &[usize],
        out: &mut [E::Out],
        spare: &mut [A::Right],
    ) where
        S: Simd,
        A: Arithmetic<S, Left = L::Element>,
        W: Packed<S, Element = A::Right>,
        E: Epilogue<S, A>,
        B: Left<A::Left>,
    {
        let panels = self.columns.div_ceil(LANES);
        let mut panel = 0;
        while panel < panels {
            let (k, left) = (k.clone(), panels - panel);
            if A::PANELS == 2 && left >= 2 {
                self.panels::<A, S, E, B, 2>(s, arithmetic, block, epilogue, panel, 1, k, offsets, out, spare);
                panel += 2;
            } else {
                let turns = if A::PANELS == 1 && k.len() <= TURNS_DEPTH { left.min(TURNS) } else { 1 };
                self.panels::<A, S, E, B, 1>(s, arithmetic, block, epilogue, panel, turns, k, offsets, out, spare);
                panel += turns;
            }
        }
    }

    /// All rows of the panels from `panel` on that tiles of `P` have which take `turns`, in one k block.
    #[inline(always)]
    #[allow(clippy::too_many_arguments, reason = "the state of the loops around it")]
    fn panels<A, S, E, B, const P: usize>(
        &self,
        s: S,
        arithmetic: A,
        block: &Block<'_, B, T>,
        epilogue: &mut E,
        panel: usize,
        turns: usize,
        k: Range<usize>,
        offsets: &[usize],
        out: &mut [E::Out],
        spare: &mut [A::Right],
    ) where
        S: Simd,
        A: Arithmetic<S, Left = L::Element>,
        W: Packed<S, Element = A::Right>,
        E: Epilogue<S, A>,
        B: Left<A::Left>,
    {
        let (len, count) = (k.len() * LANES, offsets.len());
        let start = |panel: usize| (panel * self.depth + k.start) * LANES;
        let mut weights = [[&[][..]; P]; TURNS];
        let used = P * turns;
        let share = spare.len() / used;
        let mut spare = spare;
        for (j, weights) in weights.as_flattened_mut()[..used].iter_mut().enumerate() {
            let (here, rest) = spare.split_at_mut(share);
            spare = rest;
            *weights = self.weights.read(s, start(panel + j), len, here);
        }
        // The panels that are needed next, as far as there are any, in equal shares per tile.
        let tile_rows = arithmetic.tile_rows(s);
        let line = LINE / size_of::<A::Right>();
        let share = len.div_ceil(count.div_ceil(tile_rows)).next_multiple_of(line);
        let mut ahead = [[core::ptr::null(); P]; TURNS];
        for (j, ahead) in ahead.as_flattened_mut()[..used].iter_mut().enumerate() {
            if (panel + used + j) * LANES < self.columns {
                *ahead = self.weights.address(start(panel + used + j));
            }
        }
        let mut i = 0;
        while i < count {
            for ahead in ahead.as_flattened_mut().iter_mut().filter(|ahead| !ahead.is_null()) {
                for at in (0..share).step_by(line) {
                    s.prefetch(ahead.wrapping_add(at));
                }
                *ahead = ahead.wrapping_add(share);
            }
            for &offset in &offsets[(i + tile_rows).min(count)..(i + 2 * tile_rows).min(count)] {
                for j in 0..used {
                    s.prefetch(out.as_ptr().wrapping_add(offset + (panel + j) * LANES));
                }
            }
            let mut rows = 0;
            for (turn, &panels) in weights[..turns].iter().enumerate() {
                let column = (panel + turn * P) * LANES;
                // A mask that lets everything pass costs nothing, so where there are masks whole columns need no code of their
                // own.
                macro_rules! tile {
                    ($whole:literal) => {
                        Tile::<A, S, B, T, E, P, $whole> {
                            block,
                            arithmetic,
                            epilogue: &mut *epilogue,
                            panels,
                            column,
                            first: i,
                            offsets,
                            out: &mut *out,
                        }
                    };
                }
                rows = if S::MASKED || self.columns - column < P * LANES {
                    arithmetic.rows(s, count - i, tile!(false))
                } else {
                    arithmetic.rows(s, count - i, tile!(true))
                };
            }
            i += rows;
        }
    }
}

/// A left matrix that lies in memory: rows `stride` apart, the first one at the start.
pub(crate) struct Dense<'a, E> {
    values: &'a [E],
    stride: usize,
    depth: usize,
}

// SAFETY: `row` returns a slice's pointer.
unsafe impl<E> Left<E> for Dense<'_, E> {
    #[inline(always)]
    fn pieces(&self) -> usize {
        1
    }
    #[inline(always)]
    fn len(&self, _: usize) -> usize {
        self.depth
    }
    #[inline(always)]
    fn row(&self, _: usize, row: usize) -> *const E {
        self.values[row * self.stride..][..self.depth].as_ptr()
    }
}

impl<'a, E> Dense<'a, E> {
    /// Rows of `depth` elements.
    pub(crate) fn new(values: &'a [E], stride: usize, depth: usize) -> Self {
        Self { values, stride, depth }
    }

    /// The product with whole panels that a tile can read where they are stored, without blocks: for matrices that fit into
    /// the first-level cache. A row of `out`, which holds at most [`BLOCK_ROWS`], has `columns` elements, a multiple of 16.
    #[inline(always)]
    pub(crate) fn product<A, S, P>(
        &self,
        s: S,
        arithmetic: A,
        panels: &[A::Right],
        epilogue: &mut P,
        out: &mut [P::Out],
        columns: usize,
    ) where
        S: Simd,
        A: Arithmetic<S, Left = E>,
        P: Epilogue<S, A>,
    {
        let rows = out.len() / columns;
        let mut offsets = [0; BLOCK_ROWS];
        let offsets = &mut offsets[..rows];
        for (row, offset) in offsets.iter_mut().enumerate() {
            *offset = row * columns;
        }
        let target = Linear { first: 0, stride: columns };
        let block = Block { left: self, target: &target, row: 0, columns, first: true, last: true };
        for (i, panel) in panels.chunks_exact((self.depth * LANES).max(1)).enumerate() {
            let mut first = 0;
            while first < rows {
                first += arithmetic.rows(
                    s,
                    rows - first,
                    Tile::<A, S, Self, Linear, P, 1, true> {
                        block: &block,
                        arithmetic,
                        epilogue: &mut *epilogue,
                        panels: [panel],
                        column: i * LANES,
                        first,
                        offsets,
                        out: &mut *out,
                    },
                );
            }
        }
    }
}

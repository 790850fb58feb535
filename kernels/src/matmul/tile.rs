//! The register tile: some rows by one or two vectors of columns, all of whose sums stay in registers.

use super::driver::Target;
use super::epilogue::{Epilogue, Place};
use crate::simd::{LANES, Simd, TileRows};

/// Which values a product multiplies and sums, and how an instruction set does it.
pub(crate) trait Arithmetic<S: Simd>: Copy {
    /// Element of the left matrix.
    type Left: Copy;
    /// Element of a packed panel.
    type Right: Copy;
    /// Sixteen sums in registers.
    type Sums: Copy;

    /// Panels of the largest tile: one or two.
    const PANELS: usize;

    /// Rows of the largest tile.
    fn tile_rows(self, s: S) -> usize;

    /// Calls `body` for as many rows as a tile can have and `left`, which is not 0, allow. Returns how many those were.
    fn rows<B: TileRows<S>>(self, s: S, left: usize, body: B) -> usize;

    /// `sums[r][j] += left[r][k] * panels[j][k]` for k ascending: the loop that the whole library spends its time in.
    /// `column` is that of the first panel. Must be `#[inline(always)]`.
    ///
    /// # Panics
    /// If a panel is not `depth` rows of 16.
    ///
    /// # Safety
    /// Each pointer must be valid for reading `depth` elements.
    unsafe fn multiply<const N: usize, const P: usize>(
        self,
        s: S,
        column: usize,
        left: [*const Self::Left; N],
        panels: [&[Self::Right]; P],
        depth: usize,
        sums: [[Self::Sums; P]; N],
    ) -> [[Self::Sums; P]; N];
}

/// f32 times f32, summed in f32: one chain of fused multiply-adds per output.
#[derive(Clone, Copy)]
pub(crate) struct Single;

impl<S: Simd> Arithmetic<S> for Single {
    type Left = f32;
    type Right = f32;
    type Sums = S::V;

    const PANELS: usize = S::TILE.panels;

    #[inline(always)]
    fn tile_rows(self, _: S) -> usize {
        S::TILE.rows
    }

    #[inline(always)]
    fn rows<B: TileRows<S>>(self, s: S, left: usize, body: B) -> usize {
        s.rows(left, body)
    }

    #[inline(always)]
    unsafe fn multiply<const N: usize, const P: usize>(
        self,
        s: S,
        _: usize,
        left: [*const f32; N],
        panels: [&[f32]; P],
        depth: usize,
        sums: [[S::V; P]; N],
    ) -> [[S::V; P]; N] {
        assert!(panels.iter().all(|w| w.len() == depth * LANES), "the weights are not as deep as the piece");
        // SAFETY: the caller promises the rows; the panels are `depth` rows of 16.
        unsafe { s.multiply(left, panels.map(<[f32]>::as_ptr), depth, sums) }
    }
}

/// Rows of a left matrix that lie in memory, in one or more pieces of k.
///
/// # Safety
/// [`Left::row`] must be valid for reading [`Left::len`] elements, for every piece and row that exist.
pub(crate) unsafe trait Left<E> {
    /// Pieces of each row.
    fn pieces(&self) -> usize;
    /// Elements of a piece.
    fn len(&self, piece: usize) -> usize;
    /// Where a piece of row `row` of the block starts.
    fn row(&self, piece: usize, row: usize) -> *const E;
}

/// What all tiles of a block of rows and k share.
pub(crate) struct Block<'a, L, T> {
    pub(crate) left: &'a L,
    pub(crate) target: &'a T,
    /// The first row in the whole product.
    pub(crate) row: usize,
    /// Output columns of the whole product.
    pub(crate) columns: usize,
    /// Whether the chains start in this block of k.
    pub(crate) first: bool,
    /// Whether they end in it.
    pub(crate) last: bool,
}

/// Some rows of `P` panels. `WHOLE` says that all columns exist; else only the last panel lacks some.
pub(crate) struct Tile<'a, A, S, L, T, E, const P: usize, const WHOLE: bool>
where
    S: Simd,
    A: Arithmetic<S>,
    E: Epilogue<S, A>,
{
    pub(crate) block: &'a Block<'a, L, T>,
    pub(crate) arithmetic: A,
    pub(crate) epilogue: &'a mut E,
    /// The panels, as deep as all pieces together.
    pub(crate) panels: [&'a [A::Right]; P],
    /// Column of the first panel.
    pub(crate) column: usize,
    /// First row in the block.
    pub(crate) first: usize,
    /// Where the outputs of each row of the block start in `out`.
    pub(crate) offsets: &'a [usize],
    pub(crate) out: &'a mut [E::Out],
}

impl<A, S, L, T, E, const P: usize, const WHOLE: bool> TileRows<S> for Tile<'_, A, S, L, T, E, P, WHOLE>
where
    S: Simd,
    A: Arithmetic<S>,
    L: Left<A::Left>,
    T: Target,
    E: Epilogue<S, A>,
{
    #[inline(always)]
    fn run<const N: usize>(self, s: S) {
        let Self { block, arithmetic, epilogue, panels, column, first, offsets, out } = self;
        let offsets: &[usize; N] = offsets[first..].first_chunk().expect("the block has these rows");
        let place = Place { column, columns: block.columns, row: block.row + first, target: block.target, offsets };
        let mut sums = if block.first {
            epilogue.start::<T, N, P, WHOLE>(s, &place, out)
        } else {
            epilogue.resume::<T, N, P, WHOLE>(s, &place, out)
        };
        let mut k = 0;
        for piece in 0..block.left.pieces() {
            let len = block.left.len(piece);
            let mut left = [core::ptr::null(); N];
            for (r, left) in left.iter_mut().enumerate() {
                *left = block.left.row(piece, first + r);
            }
            let panels = panels.map(|w| &w[k * LANES..(k + len) * LANES]);
            // SAFETY: `Left` promises that these pointers are good for `len` elements each.
            sums = unsafe { arithmetic.multiply(s, column, left, panels, len, sums) };
            k += len;
        }
        if block.last {
            epilogue.finish::<T, N, P, WHOLE>(s, &place, sums, out);
        } else {
            epilogue.pause::<T, N, P, WHOLE>(s, &place, sums, out);
        }
    }
}

//! Convolutions of images with few channels, such as a network's first one.
//!
//! What [`super::Walk`] would copy for one position has most of what it would copy for the next. So the lines of input that a run
//! of positions in one line of output needs are copied once, with the zeros before and behind them. Then the rows of the
//! left matrix lie a constant distance apart in each of these copies, which a tile reads off one pointer; `Walk`'s rows may
//! lie anywhere, and a pointer for each takes more registers than x86-64 has beside all else.

use super::{Geometry, Walk};
use crate::matmul::Product;
use crate::matmul::SCRATCH;
use crate::matmul::driver::{self, BLOCK_LEN, BLOCK_ROWS, DEPTH, Linear};
use crate::matmul::product::Rows;
use crate::matmul::tile::{Block, Left, Single};
use crate::simd::{Kernel, LANES, Simd};

/// Elements between neighbouring positions: three channels at stride 2.
const STEP: usize = 6;
/// Elements that may stand between the copies of two lines, so that all of them start at a cache line.
const ALIGNED: usize = LANES;

/// Elements of a line that `positions` neighbouring positions read.
fn reach(geometry: &Geometry, positions: usize) -> usize {
    (positions - 1) * STEP + geometry.kernel[2] * geometry.channels
}

/// Lines of taps.
fn taps(geometry: &Geometry) -> usize {
    geometry.kernel[0] * geometry.kernel[1]
}

/// Whether a convolution is computed here.
pub(super) fn suit(geometry: &Geometry) -> bool {
    geometry.stride[2].saturating_mul(geometry.channels) == STEP
        && geometry.dilation[2] == 1
        && geometry.depth() <= DEPTH
        && reach(geometry, BLOCK_ROWS).next_multiple_of(ALIGNED) * taps(geometry) <= BLOCK_LEN
}

/// The copies of lines of which some positions are the convolution of.
struct Copied<'a> {
    lines: &'a [f32],
    /// Distance between lines.
    pitch: usize,
    /// How many.
    taps: usize,
    /// Elements of a line that a position reads.
    len: usize,
}

impl<'a> Copied<'a> {
    /// Copies the lines that the positions `at` and the `count - 1` behind it in its line of output read, into `block`.
    #[inline(always)]
    fn new(walk: &Walk<'_, f32>, at: [usize; 3], count: usize, block: &'a mut [f32]) -> Self {
        let g = &walk.geometry;
        let reach = reach(g, count);
        let pitch = reach.next_multiple_of(ALIGNED);
        let line = g.input[2] * g.channels;
        // Where the first position's first tap is, in elements before or behind the start of its line.
        let start = (at[2] * STEP) as isize - (g.padding[2] * g.channels) as isize;
        let before = (-start).clamp(0, reach as isize) as usize;
        let end = (line as isize - start).clamp(before as isize, reach as isize) as usize;
        for (tap, to) in block.chunks_exact_mut(pitch).take(taps(g)).enumerate() {
            let tap = [tap / g.kernel[1], tap % g.kernel[1]];
            let to = &mut to[..reach];
            let [y, x] = [0, 1]
                .map(|axis| (at[axis] * g.stride[axis] + tap[axis] * g.dilation[axis]).wrapping_sub(g.padding[axis]));
            if y >= g.input[0] || x >= g.input[1] || before == end {
                to.fill(0.0);
                continue;
            }
            let from = (y * g.input[1] + x) * line + start.max(0) as usize;
            to[..before].fill(0.0);
            to[before..end].copy_from_slice(&walk.input[from..from + (end - before)]);
            to[end..].fill(0.0);
        }
        let (taps, len) = (taps(g), g.kernel[2] * g.channels);
        let lines = &block[..taps * pitch];
        assert!((count - 1) * STEP + len <= pitch, "positions reach beyond the copies of their lines");
        Self { lines, pitch, taps, len }
    }
}

// SAFETY: `Copied::new` asserts that a line is long enough for the row of each of the positions that it was made for, and there
// are `taps` of them.
unsafe impl Left<f32> for Copied<'_> {
    #[inline(always)]
    fn pieces(&self) -> usize {
        self.taps
    }
    #[inline(always)]
    fn len(&self, _: usize) -> usize {
        self.len
    }
    #[inline(always)]
    fn row(&self, piece: usize, row: usize) -> *const f32 {
        self.lines.as_ptr().wrapping_add(piece * self.pitch + row * STEP)
    }
}

/// The rows of a convolution that [`suit`]s.
pub(super) struct Lines<'a>(pub(super) Rows<'a, Product<'a>, Walk<'a, f32>>);

impl Kernel for Lines<'_> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        self.0.reference();
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Rows { product, source, rows, stride, out, scratch } = self.0;
        let (block, spare) = scratch[..SCRATCH].split_at_mut(BLOCK_LEN);
        let target = Linear { first: rows.start, stride };
        let Product { weights, depth, columns, .. } = *product;
        let whole = driver::Product { left: source, weights: &weights, target: &target, depth, columns };
        let mut end = product.end();
        let mut first = rows.start;
        while first < rows.end {
            let at = source.geometry.position(first);
            let count = (source.geometry.output[2] - at[2]).min(BLOCK_ROWS).min(rows.end - first);
            let mut offsets = [0; BLOCK_ROWS];
            for (i, offset) in offsets[..count].iter_mut().enumerate() {
                *offset = (first + i - rows.start) * stride;
            }
            let left = Copied::new(source, at, count, block);
            let block = Block { left: &left, target: &target, row: first, columns, first: true, last: true };
            whole.block(s, Single, &block, &mut end, 0..depth, &offsets[..count], out, spare);
            first += count;
        }
    }
}

//! How convolutions walk their input, whatever it is made of.

use super::lines;
use crate::matmul::driver::{Source, depth};
use crate::simd::bytes::GROUP;
use crate::simd::{LANES, Simd};
use core::ops::Range;

/// Elements that are better copied together with those that follow than given a pointer of their own.
const SHORT: usize = 3 * LANES;
/// Runs of taps that are each given a pointer even where copied together they would be few elements.
const FEW_RUNS: usize = 3;
/// Where a block of the depth holds more runs than this, a run is not long.
const RUNS_OF_BLOCK: usize = 8;

/// Ways of a first-level cache, at least.
const WAYS: usize = 8;
/// Distance of the addresses that share a set of it: a page, as long as sets are found before addresses are translated.
const SET_BYTES: usize = 4096;

/// How a convolution walks its input. The axes are depth, height, width.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Geometry {
    /// Input extent.
    pub input: [usize; 3],
    /// Input channels.
    pub channels: usize,
    /// Taps.
    pub kernel: [usize; 3],
    /// Input steps per output step.
    pub stride: [usize; 3],
    /// Input steps per tap.
    pub dilation: [usize; 3],
    /// Zeros before the input; those after it follow from `output`.
    pub padding: [usize; 3],
    /// Output extent.
    pub output: [usize; 3],
}

impl Geometry {
    /// Output positions.
    pub fn rows(&self) -> usize {
        self.output.iter().product()
    }

    /// Products per output: taps times channels.
    pub fn depth(&self) -> usize {
        self.kernel.iter().product::<usize>() * self.channels
    }

    /// Rows of a line of output, where a convolution in f32 goes line by line: it is faster with whole lines.
    pub fn line(&self) -> Option<usize> {
        lines::suit(self).then_some(self.output[2])
    }

    /// Output position of row `row`.
    #[inline(always)]
    pub(crate) fn position(&self, row: usize) -> [usize; 3] {
        let [_, h, w] = self.output;
        [row / (h * w), row / w % h, row % w]
    }

    /// [`Geometry::depth`] of bytes, which are multiplied in fours: rounded up, with weights of 0.
    pub fn depth_i8(&self) -> usize {
        self.depth().next_multiple_of(GROUP)
    }

    /// Taps that lie side by side in memory.
    #[inline(always)]
    fn run_taps(&self) -> usize {
        if self.dilation[2] == 1 { self.kernel[2] } else { 1 }
    }

    /// # Panics
    /// If the channels are no multiple of 4, which products of bytes take at once.
    pub(crate) fn check_groups(&self) {
        assert!(self.channels.is_multiple_of(GROUP), "the channels are no multiple of 4");
    }

    /// # Panics
    /// If fours of bytes would reach from a run of taps into the next one where the two are not copied side by side.
    pub(crate) fn check_runs(&self) {
        if self.run_taps() * self.channels >= SHORT {
            self.check_groups();
        }
    }

    /// # Panics
    /// If there is a third dimension.
    pub(crate) fn check_flat(&self) {
        let flat = [self.input[0], self.output[0], self.kernel[0]] == [1; 3] && self.padding[0] == 0;
        assert!(flat, "a deformable convolution is two-dimensional");
    }

    /// # Panics
    /// If an extent is zero, a position cannot be counted, or `input` has another size.
    pub(crate) fn check<E>(&self, input: &[E]) {
        let extents = [self.input, self.kernel, self.stride, self.dilation];
        assert!(extents.as_flattened().iter().all(|&v| v > 0), "an extent is zero");
        let product = |of: [usize; 3], by: usize| of.iter().try_fold(by, |a, &b| a.checked_mul(b));
        let reach = |axis: usize| {
            let last = self.output[axis].saturating_sub(1).checked_mul(self.stride[axis])?;
            let tap = (self.kernel[axis] - 1).checked_mul(self.dilation[axis])?;
            let reach = last.checked_add(tap)?.checked_add(self.padding[axis])?.checked_add(self.input[axis])?;
            isize::try_from(reach.checked_mul(self.channels.max(1))?).ok()
        };
        assert!(
            (0..3).all(|axis| reach(axis).is_some())
                && product(self.output, 1).is_some()
                && product(self.kernel, self.channels).is_some(),
            "the geometry overflows"
        );
        assert_eq!(Some(input.len()), product(self.input, self.channels), "the input has another shape");
    }
}

/// A stretch of k: taps of the last axis, as far as they are contiguous in memory, or more than one such stretch where
/// they are too short to be worth a pointer each.
#[derive(Clone, Copy)]
pub(crate) struct Stretch {
    /// First tap.
    tap: [usize; 3],
    /// Elements of its run that come before the stretch.
    skip: usize,
}

/// An input and how a convolution walks it: the left matrix of its product.
#[derive(Clone, Copy)]
pub(crate) struct Walk<'a, E> {
    pub(crate) geometry: Geometry,
    pub(crate) input: &'a [E],
}

impl<E: Copy + Default> Walk<'_, E> {
    /// Whether runs of taps are copied side by side: where they are short, or where they are many and not long.
    #[inline(always)]
    fn copies(&self) -> bool {
        let g = &self.geometry;
        let (len, count) = (g.run_taps() * g.channels, g.kernel.iter().product::<usize>() / g.run_taps());
        len < SHORT || count > FEW_RUNS && len * RUNS_OF_BLOCK < depth::<E>()
    }

    /// Whether a tile's rows lie so far apart that they fall into one set of the first-level cache, which has fewer ways than
    /// the tile has rows: then they are copied to where they do not.
    #[inline(always)]
    fn collides<S: Simd>(&self) -> bool {
        let distance = self.geometry.stride[2] * self.geometry.channels * size_of::<E>();
        S::TILE.rows > WAYS && distance.is_multiple_of(SET_BYTES)
    }

    /// The `len` elements from `stretch` on within one run: where they start in the input, if all of them are in it,
    /// else which of them are, and where those start.
    #[inline(always)]
    fn locate(&self, at: [usize; 3], stretch: Stretch, len: usize) -> Result<usize, (Range<usize>, usize)> {
        let g = &self.geometry;
        let y = (at[0] * g.stride[0] + stretch.tap[0] * g.dilation[0]).wrapping_sub(g.padding[0]);
        let x = (at[1] * g.stride[1] + stretch.tap[1] * g.dilation[1]).wrapping_sub(g.padding[1]);
        if y >= g.input[0] || x >= g.input[1] {
            return Err((0..0, 0));
        }
        let line = (g.input[2] * g.channels) as isize;
        let column = (at[2] * g.stride[2] + stretch.tap[2] * g.dilation[2]) as isize - g.padding[2] as isize;
        let start = column * g.channels as isize + stretch.skip as isize;
        let base = (y * g.input[1] + x) * line as usize;
        if start >= 0 && start + len as isize <= line {
            return Ok(base + start as usize);
        }
        let before = (-start).clamp(0, len as isize);
        let end = (line - start).clamp(before, len as isize);
        Err((before as usize..end as usize, base.wrapping_add_signed(start + before)))
    }

    /// Where the first tap of position `at` lies, if all of them are in the input.
    #[inline(always)]
    fn inside(&self, at: [usize; 3]) -> Option<usize> {
        let g = &self.geometry;
        let mut origin = 0;
        for axis in 0..3 {
            let first = (at[axis] * g.stride[axis]).wrapping_sub(g.padding[axis]);
            let last = first.wrapping_add((g.kernel[axis] - 1) * g.dilation[axis]);
            if first >= g.input[axis] || last >= g.input[axis] {
                return None;
            }
            origin = origin * g.input[axis] + first;
        }
        Some(origin * g.channels)
    }

    /// Writes the elements from `stretch` on, over as many runs as it takes; zeros behind the last one.
    #[inline(always)]
    fn write(&self, at: [usize; 3], mut stretch: Stretch, mut out: &mut [E]) {
        let g = &self.geometry;
        let taps = g.run_taps();
        let line = g.input[2] * g.channels;
        let steps = [g.dilation[0] * g.input[1] * line, g.dilation[1] * line, g.dilation[2] * g.channels];
        let inside = self.inside(at);
        while !out.is_empty() {
            if stretch.tap[0] == g.kernel[0] {
                out.fill(E::default());
                return;
            }
            let len = (taps * g.channels - stretch.skip).min(out.len());
            let (part, rest) = out.split_at_mut(len);
            out = rest;
            let found = match inside {
                Some(first) => {
                    let [a, b, c] = stretch.tap;
                    Ok(first + a * steps[0] + b * steps[1] + c * steps[2] + stretch.skip)
                }
                None => self.locate(at, stretch, len),
            };
            match found {
                Ok(start) => copy(&self.input[start..start + len], part),
                Err((inside, start)) => {
                    part[..inside.start].fill(E::default());
                    part[inside.end..].fill(E::default());
                    let len = inside.len();
                    part[inside].copy_from_slice(&self.input[if len == 0 { 0..0 } else { start..start + len }]);
                }
            }
            stretch.skip = 0;
            stretch.tap[2] += taps;
            if stretch.tap[2] >= g.kernel[2] {
                stretch.tap = [stretch.tap[0], stretch.tap[1] + 1, 0];
            }
            if stretch.tap[1] == g.kernel[1] {
                stretch.tap = [stretch.tap[0] + 1, 0, 0];
            }
        }
    }
}

impl<E: Copy + Default> Source for Walk<'_, E> {
    type Element = E;
    type At = [usize; 3];
    type Part = Stretch;

    #[inline(always)]
    fn element(&self, row: usize, k: usize) -> E {
        let g = &self.geometry;
        if k >= g.depth() {
            return E::default();
        }
        let (tap, c) = (k / g.channels, k % g.channels);
        let tap = [tap / (g.kernel[1] * g.kernel[2]), tap / g.kernel[2] % g.kernel[1], tap % g.kernel[2]];
        let position = g.position(row);
        let mut at = 0;
        for axis in 0..3 {
            let x = position[axis] * g.stride[axis] + tap[axis] * g.dilation[axis];
            if x < g.padding[axis] || x - g.padding[axis] >= g.input[axis] {
                return E::default();
            }
            at = at * g.input[axis] + x - g.padding[axis];
        }
        self.input[at * g.channels + c]
    }

    #[inline(always)]
    fn at(&self, row: usize) -> [usize; 3] {
        self.geometry.position(row)
    }

    #[inline(always)]
    fn next(&self, [d, h, w]: [usize; 3]) -> [usize; 3] {
        let [_, height, width] = self.geometry.output;
        match (h + 1 == height, w + 1 == width) {
            (_, false) => [d, h, w + 1],
            (false, true) => [d, h + 1, 0],
            (true, true) => [d + 1, 0, 0],
        }
    }

    #[inline(always)]
    fn part(&self, k: usize) -> (Stretch, usize) {
        let g = &self.geometry;
        let taps = g.run_taps();
        let run = taps * g.channels;
        let (index, skip) = (k / run, k % run);
        let across = g.kernel[2] / taps;
        let tap = [index / (across * g.kernel[1]), index / across % g.kernel[1], index % across * taps];
        let most = if self.copies() { depth::<E>() } else { run - skip };
        (Stretch { tap, skip }, most)
    }

    #[inline(always)]
    fn piece<'a, S: Simd>(&'a self, _: S, at: [usize; 3], stretch: Stretch, spare: &'a mut [E]) -> &'a [E] {
        let len = spare.len();
        if !self.collides::<S>()
            && stretch.skip + len <= self.geometry.run_taps() * self.geometry.channels
            && let Ok(start) = self.locate(at, stretch, len)
        {
            return &self.input[start..start + len];
        }
        self.write(at, stretch, spare);
        spare
    }
}

/// Copies equal lengths in pieces of known size: the runs are short, and a call per run would cost as much as the copy.
#[inline(always)]
fn copy<E: Copy>(from: &[E], to: &mut [E]) {
    let rest = chunks::<E, LANES>(from, to);
    if rest == 0 {
        return;
    }
    // The last piece, once more where it overlaps.
    if let (Some(from), Some(to)) = (from.last_chunk::<LANES>(), to.last_chunk_mut()) {
        *to = *from;
        return;
    }
    let rest = chunks::<E, GROUP>(from, to);
    let start = from.len() - rest;
    for (from, to) in from[start..].iter().zip(&mut to[start..]) {
        *to = *from;
    }
}

/// Copies what makes whole pieces of `N`. Returns how many elements are left.
#[inline(always)]
fn chunks<E: Copy, const N: usize>(from: &[E], to: &mut [E]) -> usize {
    let (from, rest) = from.as_chunks::<N>();
    for (from, to) in from.iter().zip(to.as_chunks_mut().0) {
        *to = *from;
    }
    rest.len()
}

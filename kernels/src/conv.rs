//! Convolution in two and three dimensions, any kernel, stride and dilation, channels last.
//!
//! ```text
//! out[d, h, w][n] = end(bias[n] + sum over (kd, kh, kw, c), in that order, of
//!                       x[d*sd + kd*dd - pd, h*sh + kh*dh - ph, w*sw + kw*dw - pw][c] * weight[kd, kh, kw, c][n])
//! ```
//!
//! A two-dimensional image is a volume of depth 1. Taps outside the input count as x = 0 and stay in the chain. The sum
//! is a [`crate::product`]: k runs over (kd, kh, kw, c), and with an undilated last axis the taps kw and their channels
//! are one contiguous run of memory, so a row of the virtual left matrix is a handful of copies. A 1x1 convolution
//! needs none: its rows lie in memory already.

use crate::isa::Isa;
use crate::product::{Linear, Product, Source, product};
use crate::simd::{Kernel, Simd, dispatch};
use std::ops::Range;

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

    /// Output position of row `row`.
    #[inline(always)]
    pub(crate) fn position(&self, row: usize) -> [usize; 3] {
        let [_, h, w] = self.output;
        [row / (h * w), row / w % h, row % w]
    }

    /// # Panics
    /// If an extent is zero, a position cannot be counted, or `input` has another size.
    pub(crate) fn check(&self, input: &[f32]) {
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

    /// Whether no window starts behind the input, where there is no padding before it either.
    #[inline(always)]
    fn starts_inside(&self) -> bool {
        (0..3).all(|axis| self.padding[axis] == 0 && (self.output[axis] - 1) * self.stride[axis] < self.input[axis])
    }
}

/// A convolution's arguments.
#[derive(Clone, Copy, Debug)]
pub struct Conv<'a> {
    /// How the input is walked.
    pub geometry: Geometry,
    /// `[depth, height, width, channels]`.
    pub input: &'a [f32],
    /// Weights, bias and what happens at the ends of the chains.
    pub product: Product<'a>,
}

/// Convolves the output rows `rows` (positions in depth, height, width order) into `out`, which holds exactly those rows,
/// `stride` numbers apart. `scratch` holds [`crate::product::SCRATCH`] numbers of any value.
///
/// # Panics
/// If a slice does not have the size that the shapes ask for.
///
/// # Determinism
/// The same bits on every instruction set and for every division into rows.
pub fn conv(isa: Isa, args: &Conv<'_>, rows: Range<usize>, stride: usize, out: &mut [f32], scratch: &mut [f32]) {
    args.geometry.check(args.input);
    assert_eq!(args.product.depth, args.geometry.depth(), "the weights belong to another kernel");
    args.product.check_rows(&rows, args.geometry.rows(), stride, out, scratch);
    dispatch(isa, Run { args, rows, stride, out, scratch });
}

struct Run<'a> {
    args: &'a Conv<'a>,
    rows: Range<usize>,
    stride: usize,
    out: &'a mut [f32],
    scratch: &'a mut [f32],
}

impl Kernel for Run<'_> {
    type Output = ();

    fn reference(self) {
        let first = self.rows.start;
        for row in self.rows {
            for n in 0..self.args.product.columns {
                let out = &mut self.out[(row - first) * self.stride + n];
                *out = self.args.product.reference(row, n, *out, |k| self.args.element(row, k));
            }
        }
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let target = Linear { first: self.rows.start, stride: self.stride };
        product(s, &self.args.product, self.args, &target, self.rows, self.out, self.scratch);
    }
}

impl Conv<'_> {
    /// Element `k` of the virtual left matrix's row `row`.
    pub(crate) fn element(&self, row: usize, k: usize) -> f32 {
        let g = &self.geometry;
        let (tap, c) = (k / g.channels, k % g.channels);
        let tap = [tap / (g.kernel[1] * g.kernel[2]), tap / g.kernel[2] % g.kernel[1], tap % g.kernel[2]];
        let mut at = 0;
        for axis in 0..3 {
            let x = g.position(row)[axis] * g.stride[axis] + tap[axis] * g.dilation[axis];
            if x < g.padding[axis] || x - g.padding[axis] >= g.input[axis] {
                return 0.0;
            }
            at = at * g.input[axis] + x - g.padding[axis];
        }
        self.input[at * g.channels + c]
    }
}

impl Source for Conv<'_> {
    #[inline(always)]
    fn fill<S: Simd>(&self, s: S, row: usize, mut k: usize, mut piece: &mut [f32]) {
        let g = &self.geometry;
        let [d, h, w] = g.position(row);
        // A run is what is contiguous in memory: all kw taps, or one tap where dilation pulls them apart.
        let taps = if g.dilation[2] == 1 { g.kernel[2] } else { 1 };
        let run = taps * g.channels;
        let line = (g.input[2] * g.channels) as isize;
        while !piece.is_empty() {
            let (outer, skip) = (k / run, k % run);
            let len = (run - skip).min(piece.len());
            let (part, rest) = piece.split_at_mut(len);
            piece = rest;
            k += len;
            let across = g.kernel[2] / taps;
            let (kd, kh, kw) = (outer / (across * g.kernel[1]), outer / across % g.kernel[1], outer % across);
            let y = (d * g.stride[0] + kd * g.dilation[0]).wrapping_sub(g.padding[0]);
            let x = (h * g.stride[1] + kh * g.dilation[1]).wrapping_sub(g.padding[1]);
            if y >= g.input[0] || x >= g.input[1] {
                part.fill(0.0);
                continue;
            }
            let column = (w * g.stride[2] + kw * g.dilation[2]) as isize - g.padding[2] as isize;
            let start = column * g.channels as isize + skip as isize;
            let base = (y * g.input[1] + x) * line as usize;
            if start >= 0 && start + len as isize <= line {
                copy(s, &self.input[base + start as usize..][..len], part);
                continue;
            }
            let before = (-start).clamp(0, len as isize) as usize;
            let after = (start + len as isize - line).clamp(0, len as isize) as usize;
            part.fill(0.0);
            if before + after < len {
                let from = base + (start + before as isize) as usize;
                part[before..len - after].copy_from_slice(&self.input[from..from + len - after - before]);
            }
        }
    }

    #[inline(always)]
    fn stored(&self, row: usize, k: usize, len: usize) -> Option<&[f32]> {
        let g = &self.geometry;
        if g.kernel != [1; 3] || !g.starts_inside() {
            return None;
        }
        let row = if g.output == g.input && g.stride == [1; 3] {
            row
        } else {
            let [d, h, w] = g.position(row);
            ((d * g.stride[0]) * g.input[1] + h * g.stride[1]) * g.input[2] + w * g.stride[2]
        };
        Some(&self.input[row * g.channels + k..][..len])
    }
}

/// Copies equal lengths by vectors: the runs are short, and a call per run would cost as much as the copy.
#[inline(always)]
fn copy<S: Simd>(s: S, from: &[f32], to: &mut [f32]) {
    let (from_chunks, from_rest) = from.as_chunks();
    let (to_chunks, to_rest) = to.as_chunks_mut();
    for (from, to) in from_chunks.iter().zip(to_chunks) {
        s.store(to, s.load(from));
    }
    for (from, to) in from_rest.iter().zip(to_rest) {
        *to = *from;
    }
}

#[cfg(test)]
mod tests;

//! Modulated deformable convolution (DCNv2, Zhu et al., arXiv 1811.11168), one group, one offset group.
//!
//! ```text
//! y = h*sh - ph + kh*dh + offset[2*tap],   x = w*sw - pw + kw*dw + offset[2*tap + 1],   tap = kh * KW + kw
//! sample[c] = 0                                                       unless -1 < y < H and -1 < x < W
//!           = m00*in[y0][x0][c] + m01*in[y0][x1][c] + m10*in[y1][x0][c] + m11*in[y1][x1][c]
//! out[h, w][n] = end(bias[n] + sum over (kh, kw, c), in that order, of sample[c] * weight[kh, kw, c][n])
//! ```
//!
//! y0 = floor(y), y1 = y0 + 1, likewise x. The four weights m are bilinear times sigmoid(offset[2*taps + tap]). A corner
//! outside the image has weight 0 (its index is clamped). The first product of a sample is rounded, the other three are
//! fused onto it in the order written.
//!
//! The samples go straight into the row block of [`crate::product`]; a column matrix of all taps never exists.

use crate::isa::Isa;
#[cfg(not(feature = "std"))]
use crate::math::Float as _;
use crate::math::sigmoid;
use crate::matmul::Product;
use crate::matmul::driver::{DEPTH, Source};
use crate::matmul::product::Rows;
use crate::ops::conv::Geometry;
use crate::simd::{LANES, Simd};
use core::ops::Range;

/// A deformable convolution's arguments.
#[derive(Clone, Copy, Debug)]
pub struct DeformConv2d<'a> {
    /// How the undeformed convolution walks its input; extents of the depth axis are 1, its padding 0.
    pub geometry: Geometry,
    /// `[height, width, channels]`.
    pub input: &'a [f32],
    /// `[output height, output width, 3 * taps]`: (dy, dx) per tap in pixels, then one mask logit per tap.
    pub offsets: &'a [f32],
    /// Weights, bias and what happens at the ends of the chains.
    pub product: Product<'a>,
}

/// Convolves the output rows `rows` into `out`, which holds exactly those rows, `stride` values apart. `scratch` holds
/// [`crate::matmul::SCRATCH`] values of any value.
///
/// Offsets may be anything; a sample whose position is NaN is 0.
///
/// # Panics
/// If a slice does not have the size that the shapes ask for.
///
/// # Determinism
/// The same bits on every instruction set and for every division into rows.
pub fn deform_conv2d(
    isa: Isa,
    args: &DeformConv2d<'_>,
    rows: Range<usize>,
    stride: usize,
    out: &mut [f32],
    scratch: &mut [f32],
) {
    let g = &args.geometry;
    g.check(args.input);
    g.check_flat();
    assert_eq!(args.product.depth, g.depth(), "the weights belong to another kernel");
    assert_eq!(args.offsets.len(), g.rows() * 3 * args.taps(), "the offsets belong to another kernel");
    Rows { product: &args.product, source: args, rows, stride, out, scratch }.compute(isa, g.rows());
}

/// Where one tap of one output samples: the first channel of each corner, and its weight.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Sample {
    corners: [usize; 4],
    weights: [f32; 4],
}

impl DeformConv2d<'_> {
    fn taps(&self) -> usize {
        self.geometry.kernel[1] * self.geometry.kernel[2]
    }

    /// `None` where the sample is 0.
    #[inline(always)]
    fn sample(&self, (row, [_, h, w]): (usize, [usize; 3]), tap: usize) -> Option<Sample> {
        let g = &self.geometry;
        let [_, height, width] = g.input;
        let taps = self.taps();
        let offsets = &self.offsets[row * 3 * taps..][..3 * taps];
        let at = |axis: usize, out: usize, tap: usize| {
            (out * g.stride[axis] + tap * g.dilation[axis]) as isize - g.padding[axis] as isize
        };
        let y = at(1, h, tap / g.kernel[2]) as f32 + offsets[2 * tap];
        let x = at(2, w, tap % g.kernel[2]) as f32 + offsets[2 * tap + 1];
        if !(y > -1.0 && y < height as f32 && x > -1.0 && x < width as f32) {
            return None;
        }
        let mask = sigmoid(offsets[2 * taps + tap]);
        let (y0, x0) = (y.floor(), x.floor());
        let (ly, lx) = (y - y0, x - x0);
        let (hy, hx) = (1.0 - ly, 1.0 - lx);
        let (y0, x0) = (y0 as isize, x0 as isize);
        let corner = |y: isize, x: isize, weight: f32| {
            let inside = y >= 0 && y < height as isize && x >= 0 && x < width as isize;
            let (y, x) = (y.clamp(0, height as isize - 1) as usize, x.clamp(0, width as isize - 1) as usize);
            ((y * width + x) * g.channels, if inside { weight * mask } else { 0.0 })
        };
        let corners = [
            corner(y0, x0, hy * hx),
            corner(y0, x0 + 1, hy * lx),
            corner(y0 + 1, x0, ly * hx),
            corner(y0 + 1, x0 + 1, ly * lx),
        ];
        Some(Sample { corners: corners.map(|c| c.0), weights: corners.map(|c| c.1) })
    }
}

impl Source for DeformConv2d<'_> {
    type Element = f32;
    /// The row and its position in the output.
    type At = (usize, [usize; 3]);
    type Part = usize;

    #[inline(always)]
    fn element(&self, row: usize, k: usize) -> f32 {
        let c = k % self.geometry.channels;
        let Some(Sample { corners, weights }) = self.sample(self.at(row), k / self.geometry.channels) else {
            return 0.0;
        };
        let mut value = weights[0] * self.input[corners[0] + c];
        for i in 1..4 {
            value = weights[i].mul_add(self.input[corners[i] + c], value);
        }
        value
    }

    #[inline(always)]
    fn at(&self, row: usize) -> Self::At {
        (row, self.geometry.position(row))
    }

    #[inline(always)]
    fn next(&self, (row, [_, h, w]): Self::At) -> Self::At {
        (row + 1, if w + 1 == self.geometry.output[2] { [0, h + 1, 0] } else { [0, h, w + 1] })
    }

    #[inline(always)]
    fn part(&self, k: usize) -> (usize, usize) {
        (k, DEPTH)
    }

    #[inline(always)]
    fn piece<'a, S: Simd>(&'a self, s: S, at: Self::At, mut k: usize, spare: &'a mut [f32]) -> &'a [f32] {
        let channels = self.geometry.channels;
        let mut piece = &mut *spare;
        while !piece.is_empty() {
            let (tap, c) = (k / channels, k % channels);
            let len = (channels - c).min(piece.len());
            let (part, rest) = piece.split_at_mut(len);
            piece = rest;
            k += len;
            match self.sample(at, tap) {
                None => part.fill(0.0),
                Some(Sample { corners, weights }) => {
                    blend(s, corners.map(|at| &self.input[at + c..][..len]), weights, part);
                }
            }
        }
        spare
    }
}

/// `out = weights[0] * corners[0] + ...`, the first product rounded, the others fused.
#[inline(always)]
fn blend<S: Simd>(s: S, corners: [&[f32]; 4], weights: [f32; 4], out: &mut [f32]) {
    let weights = weights.map(|w| s.splat(w));
    let (chunks, tail) = out.as_chunks_mut::<LANES>();
    let whole = chunks.len();
    let wide = corners.map(|x| x.as_chunks::<LANES>().0);
    for (i, out) in chunks.iter_mut().enumerate() {
        s.store(out, mix(s, wide.map(|x| s.load(&x[i])), weights));
    }
    if !tail.is_empty() {
        let corners = corners.map(|x| s.load_part(&x[whole * LANES..][..tail.len()]));
        s.store_part(tail, mix(s, corners, weights));
    }
}

#[inline(always)]
fn mix<S: Simd>(s: S, [a, b, c, d]: [S::V; 4], weights: [S::V; 4]) -> S::V {
    let value = s.mul_add(weights[1], b, s.mul(weights[0], a));
    s.mul_add(weights[3], d, s.mul_add(weights[2], c, value))
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests;

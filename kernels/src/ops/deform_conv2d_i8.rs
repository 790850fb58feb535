//! [Modulated deformable convolution](mod@crate::deform_conv2d) of an 8-bit tensor: sampling in fixed point, then the product
//! of [`crate::product::int8`].
//!
//! ```text
//! y = 256 * (h*sh - ph + kh*dh) + offset[2*tap]                 units of 1/256 pixel, x likewise, tap = kh * KW + kw
//! y0 = floor(y / 256), fy = y - 256 * y0                        x0 and fx likewise
//! mask = sigmoid_q10(offset[2*taps + tap])                      logits in units of 1/64
//! m00 = ((256 - fy) * (256 - fx) * mask + 2^11) >> 12           in units of 2^-14; m01, m10, m11 likewise
//! sample[c] = 0                                                 unless -256 < y < 256 * H and -256 < x < 256 * W
//!           = clamp((m00*in[y0][x0][c] + m01*in[y0][x1][c] + m10*in[y1][x0][c] + m11*in[y1][x1][c] + 2^13) >> 14)
//! sum[h, w][n] = bias[n] + sum over (kh, kw, c) of sample[c] * weight[kh, kw, c][n]
//! ```
//!
//! A corner outside the image has weight 0. The weights of a sample are at most 2^14 + 2 together, so its sum stays far inside
//! i32. Positions are computed in 64 bits, so any offset will do. Against exact arithmetic on the same integers the weights are
//! off by 8 together for the table's rounding, and by 1/2 each for their own, so a sample by at most
//! `127 * (8 + 4 / 2) / 2^14 + 1/2 < 0.58`.

use crate::isa::Isa;
use crate::matmul::ProductI8;
use crate::matmul::driver::{Source, depth};
use crate::matmul::int8::Narrow;
use crate::matmul::product::Rows;
use crate::ops::conv::Geometry;
use crate::quantised::{clamp, sigmoid_q10};
use crate::simd::{LANES, Simd};
use core::ops::Range;

/// Bits of a position behind the binary point.
const POSITION: u32 = 8;
/// A whole pixel.
const PIXEL: i32 = 1 << POSITION;
/// Bits of a corner's weight behind the binary point.
const WEIGHT: u32 = 14;
/// Bits that a corner's exact weight has more: those of two fractions and of the mask.
const EXCESS: u32 = 2 * POSITION + 10 - WEIGHT;

/// A deformable convolution's arguments.
#[derive(Clone, Copy, Debug)]
pub struct DeformConv2dI8<'a> {
    /// How the undeformed convolution walks its input; extents of the depth axis are 1, its padding 0.
    pub geometry: Geometry,
    /// `[height, width, channels]`, -127..=127.
    pub input: &'a [i8],
    /// `[output height, output width, 3 * taps]`: (dy, dx) per tap in units of 1/256 pixel, then one mask logit per tap in
    /// units of 1/64.
    pub offsets: &'a [i32],
    /// Weights, bias and what becomes of the sums.
    pub product: ProductI8<'a>,
}

/// Convolves the output rows `rows` into `out`, which holds exactly those rows, `stride` values apart. `scratch` holds
/// [`crate::product::int8::scratch_len`] values of any value.
///
/// # Panics
/// If a slice does not have the size that the shapes ask for, or the channels are no multiple of 4.
///
/// # Determinism
/// The same bits on every instruction set and for every division into rows.
pub fn deform_conv2d_i8(
    isa: Isa,
    args: &DeformConv2dI8<'_>,
    rows: Range<usize>,
    stride: usize,
    out: &mut [i8],
    scratch: &mut [i32],
) {
    let g = &args.geometry;
    g.check(args.input);
    g.check_groups();
    g.check_flat();
    assert_eq!(args.product.depth, g.depth(), "the weights belong to another kernel");
    assert_eq!(args.offsets.len(), g.rows() * 3 * args.taps(), "the offsets belong to another kernel");
    Rows { product: &args.product.to::<Narrow>(), source: args, rows, stride, out, scratch }.compute(isa, g.rows());
}

/// Where one tap of one output samples: the first channel of each corner, and its weight.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Sample {
    corners: [usize; 4],
    weights: [i32; 4],
}

impl DeformConv2dI8<'_> {
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
        // The first of two pixels, which may be -1, and what of the way to the second, unless neither is in the image.
        let at = |axis: usize, out: usize, tap: usize, offset: i32| {
            let whole = (out * g.stride[axis] + tap * g.dilation[axis]) as i64 - g.padding[axis] as i64;
            // What saturates is far outside.
            let position = whole.saturating_mul(PIXEL.into()).saturating_add(offset.into());
            let end = (g.input[axis] as i64).saturating_mul(PIXEL.into());
            let inside = position > i64::from(-PIXEL) && position < end;
            inside.then_some(((position >> POSITION) as isize, (position & i64::from(PIXEL - 1)) as i32))
        };
        let (y, fy) = at(1, h, tap / g.kernel[2], offsets[2 * tap])?;
        let (x, fx) = at(2, w, tap % g.kernel[2], offsets[2 * tap + 1])?;
        let mask = sigmoid_q10(offsets[2 * taps + tap]);
        let corner = |y: isize, x: isize, part: i32| {
            let inside = y >= 0 && y < height as isize && x >= 0 && x < width as isize;
            let (y, x) = (y.clamp(0, height as isize - 1) as usize, x.clamp(0, width as isize - 1) as usize);
            let weight = (part * mask + (1 << (EXCESS - 1))) >> EXCESS;
            ((y * width + x) * g.channels, if inside { weight } else { 0 })
        };
        let (gy, gx) = (PIXEL - fy, PIXEL - fx);
        let corners = [
            corner(y, x, gy * gx),
            corner(y, x + 1, gy * fx),
            corner(y + 1, x, fy * gx),
            corner(y + 1, x + 1, fy * fx),
        ];
        Some(Sample { corners: corners.map(|c| c.0), weights: corners.map(|c| c.1) })
    }
}

impl Source for DeformConv2dI8<'_> {
    type Element = i8;
    /// The row and its position in the output.
    type At = (usize, [usize; 3]);
    type Part = usize;

    #[inline(always)]
    fn element(&self, row: usize, k: usize) -> i8 {
        let c = k % self.geometry.channels;
        let Some(Sample { corners, weights }) = self.sample(self.at(row), k / self.geometry.channels) else {
            return 0;
        };
        let sum: i32 = (0..4).map(|i| weights[i] * i32::from(self.input[corners[i] + c])).sum();
        clamp((sum + (1 << (WEIGHT - 1))) >> WEIGHT, false)
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
        (k, depth::<i8>())
    }

    #[inline(always)]
    fn piece<'a, S: Simd>(&'a self, s: S, at: Self::At, mut k: usize, spare: &'a mut [i8]) -> &'a [i8] {
        let channels = self.geometry.channels;
        let mut piece = &mut *spare;
        while !piece.is_empty() {
            let (tap, c) = (k / channels, k % channels);
            let len = (channels - c).min(piece.len());
            let (part, rest) = piece.split_at_mut(len);
            piece = rest;
            k += len;
            match self.sample(at, tap) {
                None => part.fill(0),
                Some(Sample { corners, weights }) => {
                    blend(s, corners.map(|at| &self.input[at + c..][..len]), weights, part);
                }
            }
        }
        spare
    }
}

/// The sample's channels from those of its corners.
#[inline(always)]
fn blend<S: Simd>(s: S, corners: [&[i8]; 4], weights: [i32; 4], out: &mut [i8]) {
    let half = s.splat_int(1 << (WEIGHT - 1));
    let mut factors = [half; 4];
    for i in 0..4 {
        factors[i] = s.splat_int(weights[i].cast_unsigned());
    }
    for (at, out) in out.chunks_mut(LANES).enumerate() {
        let here = at * LANES..at * LANES + out.len();
        let mut sum = half;
        for i in 0..4 {
            let x = s.bytes_to_int(s.load_bytes_part(&corners[i][here.clone()]));
            sum = s.add_int(sum, s.mul_short(x, factors[i]));
        }
        s.store_bytes_part(out, s.quantised(s.shift_right_signed(sum, WEIGHT), false));
    }
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests;

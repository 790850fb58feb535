//! [Convolution](mod@crate::conv) of an 8-bit tensor: the same walk over the input, sums that are exact.
//!
//! ```text
//! sum[d, h, w][n] = bias[n] + sum over (kd, kh, kw, c) of
//!                   x[d*sd + kd*dd - pd, h*sh + kh*dh - ph, w*sw + kw*dw - pw][c] * weight[kd, kh, kw, c][n]
//! out[d, h, w][n] = clamp(requantise(end(sum), multiplier[n]))                 i8, or i32 without the clamp
//! ```
//!
//! Taps outside the input count as x = 0. Channels are a multiple of 4, or there are so few that the channels of all taps along
//! the last axis are less than 48: an image's three. The depth is rounded up to a multiple of 4. The rest is the product's:
//! [`crate::product::int8`].

use crate::isa::Isa;
use crate::matmul::ProductI8;
use crate::matmul::int8::{Narrow, Outcome, Wide};
use crate::matmul::product::Rows;
use crate::ops::conv::{Geometry, Walk};
use core::ops::Range;

/// A convolution's arguments.
#[derive(Clone, Copy, Debug)]
pub struct ConvI8<'a> {
    /// How the input is walked.
    pub geometry: Geometry,
    /// `[depth, height, width, channels]`, -127..=127.
    pub input: &'a [i8],
    /// Weights, of [`Geometry::depth_i8`] and 0 from [`Geometry::depth`] on, bias and what becomes of the sums.
    pub product: ProductI8<'a>,
}

/// Convolves the output rows `rows` (positions in depth, height, width order) into `out`, which holds exactly those rows,
/// `stride` values apart. `scratch` holds [`crate::product::int8::scratch_len`] values of any value.
///
/// # Panics
/// If a slice does not have the size that the shapes ask for, or the channels are many and no multiple of 4.
///
/// # Determinism
/// The same bits on every instruction set and for every division into rows.
pub fn conv_i8(isa: Isa, args: &ConvI8<'_>, rows: Range<usize>, stride: usize, out: &mut [i8], scratch: &mut [i32]) {
    args.compute::<Narrow>(isa, rows, stride, out, scratch);
}

/// [`conv_i8()`] whose outputs are not clamped: 32-bit integers in the output's scale.
///
/// # Panics
/// As [`conv_i8()`].
///
/// # Determinism
/// As [`conv_i8()`].
pub fn conv_i8_wide(
    isa: Isa,
    args: &ConvI8<'_>,
    rows: Range<usize>,
    stride: usize,
    out: &mut [i32],
    scratch: &mut [i32],
) {
    args.compute::<Wide>(isa, rows, stride, out, scratch);
}

impl ConvI8<'_> {
    #[inline(always)]
    fn compute<O: Outcome>(
        &self,
        isa: Isa,
        rows: Range<usize>,
        stride: usize,
        out: &mut [O::Out],
        scratch: &mut [i32],
    ) {
        let Self { geometry, input, product } = *self;
        geometry.check(input);
        geometry.check_runs();
        assert_eq!(product.depth, geometry.depth_i8(), "the weights belong to another kernel");
        let (product, source) = (product.to::<O>(), Walk { geometry, input });
        Rows { product: &product, source: &source, rows, stride, out, scratch }.compute(isa, geometry.rows());
    }
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests;

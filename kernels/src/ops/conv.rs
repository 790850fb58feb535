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
//! needs none: its rows lie in memory already. Where an image has few channels, the runs of neighbouring positions overlap:
//! lines are copied once with the zeros at both their ends, and rows of the matrix are read out of them (`lines.rs`).

use crate::isa::Isa;
use crate::matmul::Product;
use crate::matmul::product::Rows;
use crate::simd::dispatch;
use core::ops::Range;
use lines::Lines;

pub use walk::Geometry;
pub(crate) use walk::Walk;

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
/// `stride` values apart. `scratch` holds [`crate::matmul::SCRATCH`] values of any value.
///
/// # Panics
/// If a slice does not have the size that the shapes ask for.
///
/// # Determinism
/// The same bits on every instruction set and for every division into rows.
pub fn conv(isa: Isa, args: &Conv<'_>, rows: Range<usize>, stride: usize, out: &mut [f32], scratch: &mut [f32]) {
    args.geometry.check(args.input);
    assert_eq!(args.product.depth, args.geometry.depth(), "the weights belong to another kernel");
    let walk = args.walk();
    let rows = Rows { product: &args.product, source: &walk, rows, stride, out, scratch };
    if lines::suit(&args.geometry) {
        rows.check(args.geometry.rows());
        dispatch(isa, Lines(rows));
    } else {
        rows.compute(isa, args.geometry.rows());
    }
}

impl<'a> Conv<'a> {
    pub(crate) fn walk(&self) -> Walk<'a, f32> {
        Walk { geometry: self.geometry, input: self.input }
    }
}

mod lines;
mod walk;

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
pub(crate) mod tests;

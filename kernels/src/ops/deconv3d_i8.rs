//! [Transposed convolution](mod@crate::deconv3d) of an 8-bit tensor: kernel 4, stride 2, padding 1, eight plain convolutions.
//!
//! ```text
//! sum[2i + p] = bias + sum over taps t in {0, 1} per axis and c of x[i + t - 1 + p][c] * weight[3 - p - 2t][c]
//! if relu: sum = max(sum, 0);  sum += added * r;  out = clamp(requantise(sum, multiplier))
//! ```
//!
//! Weights are eight packed matrices as in f32, in the layout of [`crate::product::int8`], whose rules hold for the rest.
//! Channels are a multiple of 4. Bias and multipliers are the same for all eight.

use crate::isa::Isa;
use crate::matmul::int8::{Ending, Narrow};
use crate::matmul::layout::packed_len;
use crate::matmul::{ProductI8, ResidualI8};
use crate::ops::conv::Walk;
use crate::ops::deconv3d::{Parts, Run, geometry};
use crate::simd::{LANES, dispatch};
use core::ops::Range;

/// A transposed convolution's arguments.
#[derive(Clone, Copy, Debug)]
pub struct Deconv3dI8<'a> {
    /// Input extent; the output's is twice that on every axis.
    pub extent: [usize; 3],
    /// Input channels.
    pub channels: usize,
    /// Output channels.
    pub columns: usize,
    /// `[extent, channels]`, -127..=127.
    pub input: &'a [i8],
    /// Whether elements of the input may be negative; else they are 0..=127.
    pub signed: bool,
    /// The eight packed matrices.
    pub weights: &'a [i8],
    /// What [`crate::product::int8::layout::sums`] gives for all of them.
    pub sums: &'a [i32],
    /// What [`crate::product::int8::layout::pairs`] gives for all of them.
    pub pairs: &'a [u8],
    /// One value per output channel in units of the sums, padded to a multiple of 16.
    pub bias: &'a [i32],
    /// Whether negative sums become 0.
    pub relu: bool,
    /// `[2 * extent, columns]`, added after ReLU, and what a step of it is in units of the sums, one multiplier per output
    /// channel, padded to a multiple of 16.
    pub add: Option<(&'a [i8], &'a [i32])>,
    /// One multiplier per output channel, padded to a multiple of 16.
    pub multiplier: &'a [i32],
}

/// Computes the planes `planes` of the output's first axis into `out`, which holds exactly those, densely. `scratch`
/// holds [`crate::product::int8::scratch_len`] values for a depth of `8 * channels`, of any value.
///
/// # Panics
/// If a slice does not have the size that the shapes ask for, or the channels are no multiple of 4.
///
/// # Determinism
/// The same bits on every instruction set and for every division into planes.
pub fn deconv3d_i8(isa: Isa, args: &Deconv3dI8<'_>, planes: Range<usize>, out: &mut [i8], scratch: &mut [i32]) {
    let [len, padded] = args.parity_len();
    assert_eq!(args.weights.len(), 8 * len, "packed weights do not match the shape");
    let known = args.sums.len() == 8 * padded && args.pairs.len() == 8 * padded / LANES;
    assert!(known, "what is known of the weights has another length");
    let plane = args.check(&planes, out, scratch);
    assert!(args.add.is_none_or(|(a, _)| a.len() == 2 * args.extent[0] * plane), "the added tensor has another shape");
    dispatch(isa, Run { args, planes, out, scratch });
}

impl Deconv3dI8<'_> {
    /// Weights of a parity, and its columns with the zero columns.
    fn parity_len(&self) -> [usize; 2] {
        [packed_len(8 * self.channels, self.columns), self.columns.next_multiple_of(LANES)]
    }
}

impl<'a> Parts for Deconv3dI8<'a> {
    type Product = Ending<'a, Narrow>;

    fn extent(&self) -> [usize; 3] {
        self.extent
    }

    fn part(&self, parity: usize) -> (Walk<'a, i8>, Ending<'a, Narrow>) {
        let [len, padded] = self.parity_len();
        let product = ProductI8 {
            weights: &self.weights[parity * len..][..len],
            sums: &self.sums[parity * padded..][..padded],
            pairs: &self.pairs[parity * padded / LANES..][..padded / LANES],
            bias: self.bias,
            depth: 8 * self.channels,
            columns: self.columns,
            signed: self.signed,
            relu: self.relu,
            residual: match self.add {
                Some((rows, multiplier)) => ResidualI8::Apart { rows, stride: self.columns, multiplier, after: true },
                None => ResidualI8::None,
            },
            multiplier: self.multiplier,
        };
        let geometry = geometry(self.extent, self.channels, parity);
        geometry.check_groups();
        (Walk { geometry, input: self.input }, product.to())
    }
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests;

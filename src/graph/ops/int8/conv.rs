//! Convolution of 8-bit tensors, and the offsets of a deformable one.

use super::columns::Steps;
use super::product;
use crate::base::error::Result;
use crate::graph::call::{Call, Tile};
use crate::graph::element::{Element, Elements};
use crate::graph::ops::deform_conv::DeformConv;
use crate::graph::ops::description::{Description, Machine, wide};
use crate::graph::ops::product as floating;
use crate::graph::parts::Part;
use crate::graph::site::Site;
use crate::graph::weights::{Span, Values, Weights};
use voxcast_kernels::conv::Geometry;
use voxcast_kernels::conv_i8::{ConvI8 as Kernel, conv_i8, conv_i8_wide};

/// Steps of an offset: positions in units of 1/256 pixel, the logits of masks in units of 1/64.
const POSITION: f64 = 1.0 / 256.0;
const LOGIT: f64 = 1.0 / 64.0;

/// [`voxcast_kernels::conv_i8`]: x. With an output of `i32` it computes the offsets of a deformable convolution, in its units.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ConvI8 {
    /// How x is walked.
    pub geometry: Geometry,
    /// Whether x may be negative.
    pub signed: bool,
}

impl ConvI8 {
    /// Whether it computes the offsets of a deformable convolution.
    fn has_offsets(&self, site: &Site<'_>) -> bool {
        site.output().element == Element::I32
    }

    /// What output `n` counts in, of a tensor without scale.
    fn offset_step(&self, site: &Site<'_>, n: usize) -> f64 {
        let taps = self.geometry.kernel.iter().product();
        debug_assert_eq!(site.channels, DeformConv::offset_channels(taps));
        if n < 2 * taps { POSITION } else { LOGIT }
    }
}

impl Description for ConvI8 {
    fn kind(&self) -> &'static str {
        match self.geometry.kernel {
            [1, 1, 1] => "conv 1x1 i8",
            [1, ..] => "conv2d i8",
            _ => "conv3d i8",
        }
    }

    fn overwrites_residual(&self) -> bool {
        true
    }

    fn parts(&self, site: &Site<'_>) -> Vec<Part> {
        product::parts(1, self.geometry.depth_i8(), site.channels, site.residual.is_some())
    }

    fn evaluate(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Values>> {
        let dense = floating::dense(&self.geometry, self.geometry.channels, site, weights)?;
        let steps = |n| match self.has_offsets(site) {
            true => Steps { output: self.offset_step(site, n), ..Steps::of(site) },
            false => Steps::of(site),
        };
        let inputs = self.geometry.channels;
        let columns =
            product::columns(&dense.weight, &dense.bias, inputs, |n, weight, bias| steps(n).column(weight, bias))?;
        Ok(product::values(1, &columns, site.residual.is_some()))
    }

    fn spans(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Span>> {
        Ok(floating::dense(&self.geometry, self.geometry.channels, site, weights)?.spans())
    }

    fn finest(&self, site: &Site<'_>, spans: &[Span]) -> f64 {
        if !self.has_offsets(site) {
            return product::finest(Steps::of(site), spans);
        }
        let each = spans.iter().enumerate().map(|(n, &span)| Steps::of(site).finest(span) / self.offset_step(site, n));
        each.fold(0.0, f64::max)
    }

    fn verify(&self, site: &Site<'_>, parts: &[Elements<'_>]) -> std::result::Result<(), String> {
        product::verify(self.geometry.depth_i8(), site.channels, parts)
    }

    fn scratch(&self, site: &Site<'_>) -> usize {
        product::scratch(self.geometry.depth_i8(), site.channels)
    }

    fn multiply_adds(&self, site: &Site<'_>) -> u128 {
        floating::multiply_adds(&self.geometry, site)
    }

    fn executed_multiply_adds(&self, site: &Site<'_>) -> u128 {
        wide(site.rows()) * wide(self.geometry.depth_i8()) * wide(site.channels)
    }

    fn tile(&self, site: &Site<'_>, machine: Machine) -> usize {
        floating::rows_per_tile(site, machine)
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let product = product::product(call, self.geometry.depth_i8(), self.signed);
        let args = Kernel { geometry: self.geometry, input: call.input(0), product };
        if call.site.output().element == Element::I32 {
            let (rows, stride, out) = floating::rows(call, &mut tile);
            conv_i8_wide(call.isa, &args, rows, stride, out, tile.scratch());
        } else {
            let (rows, stride, out) = floating::rows(call, &mut tile);
            conv_i8(call.isa, &args, rows, stride, out, tile.scratch());
        }
    }
}

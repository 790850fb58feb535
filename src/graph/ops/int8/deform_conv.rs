//! Modulated deformable convolution of an 8-bit image.

use super::columns::Steps;
use super::product;
use crate::base::error::Result;
use crate::graph::call::{Call, Tile};
use crate::graph::element::Elements;
use crate::graph::ops::description::{Description, Machine};
use crate::graph::ops::product as floating;
use crate::graph::parts::Part;
use crate::graph::site::Site;
use crate::graph::weights::{Span, Values, Weights};
use voxcast_kernels::conv::Geometry;
use voxcast_kernels::deform_conv2d_i8::{DeformConv2dI8 as Kernel, deform_conv2d_i8};

/// [`voxcast_kernels::deform_conv2d_i8`]: x, offsets in units of 1/256 pixel and, for masks, of 1/64.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeformConvI8 {
    /// How x is walked, undeformed.
    pub geometry: Geometry,
    /// Whether x may be negative.
    pub signed: bool,
}

impl Description for DeformConvI8 {
    fn kind(&self) -> &'static str {
        "deform_conv2d i8"
    }

    fn overwrites_residual(&self) -> bool {
        true
    }

    fn parts(&self, site: &Site<'_>) -> Vec<Part> {
        product::parts(1, self.geometry.depth(), site.channels, site.residual.is_some())
    }

    fn evaluate(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Values>> {
        let channels = self.geometry.channels;
        let dense = floating::dense(&self.geometry, channels, site, weights)?;
        let steps = Steps::of(site);
        let column = |_, weight: &[f64], bias| steps.column(weight, bias);
        let columns = product::columns(&dense.weight, &dense.bias, channels, column)?;
        Ok(product::values(1, &columns, site.residual.is_some()))
    }

    fn spans(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Span>> {
        Ok(floating::dense(&self.geometry, self.geometry.channels, site, weights)?.spans())
    }

    fn finest(&self, site: &Site<'_>, spans: &[Span]) -> f64 {
        product::finest(Steps::of(site), spans)
    }

    fn verify(&self, site: &Site<'_>, parts: &[Elements<'_>]) -> std::result::Result<(), String> {
        product::verify(self.geometry.depth(), site.channels, parts)
    }

    fn scratch(&self, site: &Site<'_>) -> usize {
        product::scratch(self.geometry.depth(), site.channels)
    }

    fn multiply_adds(&self, site: &Site<'_>) -> u128 {
        floating::multiply_adds(&self.geometry, site)
    }

    fn tile(&self, site: &Site<'_>, machine: Machine) -> usize {
        floating::rows_per_tile(site, machine)
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let product = product::product(call, self.geometry.depth(), self.signed);
        let args = Kernel { geometry: self.geometry, input: call.input(0), offsets: call.input(1), product };
        let (rows, stride, out) = floating::rows(call, &mut tile);
        deform_conv2d_i8(call.isa, &args, rows, stride, out, tile.scratch());
    }
}

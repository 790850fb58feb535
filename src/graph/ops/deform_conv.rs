//! Modulated deformable convolution.

use super::description::{Description, Machine, Shader};
use super::product;
use crate::base::error::Result;
use crate::graph::call::{Call, Tile};
use crate::graph::parts::Part;
use crate::graph::recipe::Recipe;
use crate::graph::site::Site;
use crate::graph::weights::{Values, Weights};
use voxcast_kernels::conv::Geometry;
use voxcast_kernels::deform_conv2d::{DeformConv2d, deform_conv2d};

/// [`voxcast_kernels::deform_conv2d`]: x, offsets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeformConv {
    /// How x is walked, undeformed.
    pub geometry: Geometry,
}

impl DeformConv {
    /// Channels of the offsets of a kernel of `taps` taps: (dy, dx) of each, then a mask logit of each.
    pub const fn offset_channels(taps: usize) -> usize {
        3 * taps
    }
}

impl Description for DeformConv {
    fn kind(&self) -> &'static str {
        "deform_conv2d"
    }

    fn overwrites_residual(&self) -> bool {
        true
    }

    fn parts(&self, site: &Site<'_>) -> Vec<Part> {
        product::parts(&self.geometry, site.channels)
    }

    fn evaluate(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Values>> {
        product::evaluate(&self.geometry, site, weights)
    }

    fn scratch(&self, _: &Site<'_>) -> usize {
        product::SCRATCH_BYTES
    }

    fn multiply_adds(&self, site: &Site<'_>) -> u128 {
        product::multiply_adds(&self.geometry, site)
    }

    fn tile(&self, site: &Site<'_>, machine: Machine) -> usize {
        product::rows_per_tile(site, machine)
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let product = product::product(call, self.geometry.depth());
        let args = DeformConv2d { geometry: self.geometry, input: call.input(0), offsets: call.input(1), product };
        let (rows, stride, out) = product::rows(call, &mut tile);
        deform_conv2d(call.isa, &args, rows, stride, out, tile.scratch());
    }

    fn shader(&self, site: &Site<'_>) -> Option<Shader> {
        let Recipe::Conv(names) = site.recipe else { return None };
        let [_, height, width] = self.geometry.output;
        let shape = vec![self.geometry.channels, site.channels, height, width];
        let weight = (Some(format!("{}.weight", names.prefix)), product::checkpoint_shape(&self.geometry, site));
        Some(Shader { name: "deform_conv", shape, weights: vec![weight] })
    }
}

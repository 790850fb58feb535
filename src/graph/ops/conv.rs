//! Convolution in two and three dimensions.

use super::description::{Description, Machine, Shader};
use super::product;
use crate::base::error::Result;
use crate::graph::call::{Call, Tile};
use crate::graph::parts::Part;
use crate::graph::recipe::Recipe;
use crate::graph::site::Site;
use crate::graph::weights::{Values, Weights};
use voxcast_kernels::conv::{Conv as Kernel, Geometry, conv};

/// [`voxcast_kernels::conv`]: x.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Conv {
    /// How x is walked.
    pub geometry: Geometry,
}

impl Description for Conv {
    fn kind(&self) -> &'static str {
        match self.geometry.kernel {
            [1, 1, 1] => "conv 1x1",
            [1, ..] => "conv2d",
            _ => "conv3d",
        }
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
        match self.geometry.line() {
            Some(line) => product::rows_in_units(site, machine, line),
            None => product::rows_per_tile(site, machine),
        }
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let product = product::product(call, self.geometry.depth());
        let args = Kernel { geometry: self.geometry, input: call.input(0), product };
        let (rows, stride, out) = product::rows(call, &mut tile);
        conv(call.isa, &args, rows, stride, out, tile.scratch());
    }

    fn shader(&self, site: &Site<'_>) -> Option<Shader> {
        let Recipe::Conv(names) = site.recipe else { return None };
        let Geometry { input, channels, kernel, stride, dilation, padding, output } = self.geometry;
        let mut shape = vec![channels, site.channels, usize::from(names.bias), 0];
        for [a, b, c] in [input, output, kernel, stride, dilation, padding] {
            shape.extend([a, b, c, 0]);
        }
        let weight = (Some(format!("{}.weight", names.prefix)), product::checkpoint_shape(&self.geometry, site));
        let bias = (names.bias.then(|| format!("{}.bias", names.prefix)), vec![site.channels]);
        Some(Shader { name: "conv", shape, weights: vec![weight, bias] })
    }
}

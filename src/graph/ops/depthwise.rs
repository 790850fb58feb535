//! Depthwise convolution of a plane.

use super::description::{Description, Machine, Shader, whole_lines, wide};
use crate::base::error::Result;
use crate::graph::call::{Call, Tile};
use crate::graph::parts::Part;
use crate::graph::recipe::Recipe;
use crate::graph::site::Site;
use crate::graph::weights::{Values, Weights, packed_taps, padded};
use voxcast_kernels::LANES;
use voxcast_kernels::depthwise::{Depthwise as Kernel, depthwise};

/// [`voxcast_kernels::depthwise`]: x, which is also the residual where there is one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Depthwise {
    /// Taps along height and width.
    pub side: usize,
}

impl Description for Depthwise {
    fn kind(&self) -> &'static str {
        "depthwise"
    }

    fn parts(&self, site: &Site<'_>) -> Vec<Part> {
        let padded = site.channels.next_multiple_of(LANES);
        vec![Part::plain("weight", self.side * self.side * padded), Part::plain("bias", padded)]
    }

    fn evaluate(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Values>> {
        let Recipe::Conv(names) = site.recipe else { unreachable!("one convolution, not {:?}", site.recipe) };
        let (side, channels) = (self.side, site.channels);
        let dense = weights.dense(names, &[channels, 1, side, side], channels)?;
        Ok(vec![packed_taps(&dense.weight, side * side, channels), padded(dense.bias)])
    }

    fn multiply_adds(&self, site: &Site<'_>) -> u128 {
        wide(site.rows()) * wide(self.side * self.side) * wide(site.channels)
    }

    fn tile(&self, site: &Site<'_>, machine: Machine) -> usize {
        whole_lines(site, site.output().extent[1], machine)
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let [_, height, width] = call.site.output().extent;
        let args = Kernel {
            input: call.input(0),
            height,
            width,
            channels: call.site.channels,
            kernel: self.side,
            weights: call.part(0),
            bias: call.part(1),
            residual: call.site.residual.is_some(),
        };
        let rows = tile.positions.start / width..tile.positions.end / width;
        depthwise(call.isa, &args, rows, tile.output(0));
    }

    fn shader(&self, site: &Site<'_>) -> Option<Shader> {
        let Recipe::Conv(names) = site.recipe else { return None };
        let [_, height, width] = site.output().extent;
        let (side, channels) = (self.side, site.channels);
        // The plane is one window.
        let shape = vec![channels, height, width, side, height, width];
        let weight = (Some(format!("{}.weight", names.prefix)), vec![channels, 1, side, side]);
        Some(Shader { name: "depthwise", shape, weights: vec![weight] })
    }
}

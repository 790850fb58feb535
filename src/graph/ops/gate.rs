//! Fusion of a volume with its bird's-eye view.

use super::description::{Description, Machine, ROWS, Shader, wide};
use crate::base::error::Result;
use crate::graph::call::{Call, Tile};
use crate::graph::parts::Part;
use crate::graph::recipe::Recipe;
use crate::graph::site::Site;
use crate::graph::weights::{Values, Weights, padded};
use voxcast_kernels::LANES;
use voxcast_kernels::gate::{Gate as Kernel, gate};

/// [`voxcast_kernels::gate`]: volume (in place), bird's-eye view.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Gate;

impl Description for Gate {
    fn kind(&self) -> &'static str {
        "gate"
    }

    fn in_place(&self) -> Option<usize> {
        Some(0)
    }

    fn parts(&self, site: &Site<'_>) -> Vec<Part> {
        vec![Part::plain("weight", site.channels.next_multiple_of(LANES)), Part::plain("bias", LANES)]
    }

    fn evaluate(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Values>> {
        let Recipe::Conv(names) = site.recipe else { unreachable!("one convolution, not {:?}", site.recipe) };
        let dense = weights.dense(names, &[1, site.channels, 1, 1, 1], 1)?;
        Ok(vec![padded(dense.weight), padded(dense.bias)])
    }

    fn multiply_adds(&self, site: &Site<'_>) -> u128 {
        wide(site.rows()) * wide(site.channels)
    }

    /// Whole columns.
    fn tile(&self, site: &Site<'_>, _: Machine) -> usize {
        let depth = site.output().extent[2];
        ROWS.div_ceil(depth) * depth
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let (depth, channels) = (call.site.output().extent[2], call.site.channels);
        let [start, end] = [tile.positions.start, tile.positions.end].map(|p| p / depth * channels);
        let args = Kernel {
            bev: &call.input(1)[start..end],
            depth,
            channels,
            weights: call.part(0),
            bias: call.part::<f32>(1)[0],
        };
        gate(call.isa, &args, tile.output(0));
    }

    fn shader(&self, site: &Site<'_>) -> Option<Shader> {
        let Recipe::Conv(names) = site.recipe else { return None };
        let [x, y, depth] = site.output().extent;
        let weight = (Some(format!("{}.weight", names.prefix)), vec![1, site.channels, 1, 1, 1]);
        let bias = (Some(format!("{}.bias", names.prefix)), vec![1]);
        Some(Shader { name: "gate", shape: vec![site.channels, x * y, depth], weights: vec![weight, bias] })
    }
}

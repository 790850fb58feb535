//! A batch norm that was not folded into the convolution before it.

use super::description::{Description, Machine, ROWS, Shader, wide};
use crate::base::error::Result;
use crate::graph::call::{Added, Call, Tile};
use crate::graph::parts::Part;
use crate::graph::recipe::Recipe;
use crate::graph::site::Site;
use crate::graph::weights::{Values, Weights, padded};
use voxcast_kernels::LANES;
use voxcast_kernels::scale_shift::{ScaleShift, scale_shift};

/// [`voxcast_kernels::scale_shift`]: x, in place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BatchNorm;

impl Description for BatchNorm {
    fn kind(&self) -> &'static str {
        "scale_shift"
    }

    fn in_place(&self) -> Option<usize> {
        Some(0)
    }

    fn parts(&self, site: &Site<'_>) -> Vec<Part> {
        let padded = site.channels.next_multiple_of(LANES);
        vec![Part::plain("scale", padded), Part::plain("shift", padded)]
    }

    fn evaluate(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Values>> {
        let Recipe::Module(prefix) = site.recipe else { unreachable!("a norm, not {:?}", site.recipe) };
        Ok(weights.norm(prefix, site.channels)?.map(padded).into())
    }

    fn multiply_adds(&self, site: &Site<'_>) -> u128 {
        wide(site.rows()) * wide(site.channels)
    }

    fn tile(&self, _: &Site<'_>, _: Machine) -> usize {
        ROWS
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let stride = call.site.output().channels;
        let (residual, residual_after) = match call.added {
            Added::Nothing => (None, false),
            Added::Apart { elements, after } => (Some(elements.of::<f32>()), after),
            Added::InPlace => unreachable!("a norm works in place of what it scales"),
        };
        let args = ScaleShift {
            scale: call.part(0),
            shift: call.part(1),
            channels: call.site.channels,
            first_channel: call.site.first_channel,
            stride,
            residual: residual.map(|rows| &rows[tile.positions.start * stride..tile.positions.end * stride]),
            residual_after,
            relu: call.site.relu,
        };
        scale_shift(call.isa, &args, tile.output(0));
    }

    fn shader(&self, site: &Site<'_>) -> Option<Shader> {
        let Recipe::Module(prefix) = site.recipe else { return None };
        let tensors = ["weight", "bias", "running_mean", "running_var"];
        let weights = tensors.map(|name| (Some(format!("{prefix}.{name}")), vec![site.channels])).into();
        Some(Shader { name: "batch_norm", shape: vec![site.channels, site.rows()], weights })
    }
}

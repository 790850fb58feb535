//! Mean over all positions of a plane.

use super::description::{Description, Machine, Shader};
use crate::graph::call::{Call, Tile};
use crate::graph::site::Site;
use voxcast_kernels::pool::{Mean, mean};

/// [`voxcast_kernels::pool`]: x, mean over all positions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GlobalMean;

impl Description for GlobalMean {
    fn kind(&self) -> &'static str {
        "pool"
    }

    /// A sum is one chain, which is not divided.
    fn tile(&self, _: &Site<'_>, _: Machine) -> usize {
        1
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        mean(call.isa, &Mean { input: call.input(0), channels: call.site.channels }, tile.output(0));
    }

    fn shader(&self, site: &Site<'_>) -> Option<Shader> {
        Some(Shader { name: "mean", shape: vec![site.channels, site.input(0).rows()], weights: vec![] })
    }
}

//! One position repeated over a plane.

use super::description::{Description, Machine, ROWS, Shader};
use crate::graph::call::{Call, Tile};
use crate::graph::site::Site;
use voxcast_kernels::pool::broadcast;

/// [`voxcast_kernels::pool`]: one row, written to every position.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Broadcast;

impl Description for Broadcast {
    fn kind(&self) -> &'static str {
        "pool"
    }

    fn tile(&self, _: &Site<'_>, _: Machine) -> usize {
        ROWS
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        broadcast(call.input::<f32>(0), call.site.output().channels, call.site.first_channel, tile.output(0));
    }

    fn shader(&self, site: &Site<'_>) -> Option<Shader> {
        Some(Shader { name: "broadcast", shape: vec![site.channels, site.rows()], weights: vec![] })
    }
}

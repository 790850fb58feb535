//! One 8-bit position repeated over a plane.

use crate::graph::call::{Call, Tile};
use crate::graph::ops::description::{Description, Machine, ROWS};
use crate::graph::site::Site;
use voxcast_kernels::pool::broadcast;

/// [`voxcast_kernels::pool`]: one row, written to every position. The output has its scale.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BroadcastI8;

impl Description for BroadcastI8 {
    fn kind(&self) -> &'static str {
        "pool i8"
    }

    fn tile(&self, _: &Site<'_>, _: Machine) -> usize {
        ROWS
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let (stride, first) = (call.site.output().channels, call.site.first_channel);
        broadcast(call.input::<i8>(0), stride, first, tile.output(0));
    }
}

//! Max pooling of an 8-bit image.

use crate::graph::call::{Call, Tile};
use crate::graph::ops::description::{Description, Machine, whole_lines};
use crate::graph::site::Site;
use voxcast_kernels::max_pool::MaxPool as Kernel;
use voxcast_kernels::max_pool_i8::max_pool_i8;

/// [`voxcast_kernels::max_pool_i8`]: x, whose scale the output has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MaxPoolI8 {
    /// Taps along height and width.
    pub side: usize,
    /// Input steps per output step.
    pub stride: usize,
    /// Border on each side that never wins.
    pub padding: usize,
}

impl Description for MaxPoolI8 {
    fn kind(&self) -> &'static str {
        "max_pool i8"
    }

    fn tile(&self, site: &Site<'_>, machine: Machine) -> usize {
        whole_lines(site, site.output().extent[1], machine)
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let [_, height, width] = call.site.input(0).extent;
        let args = Kernel {
            input: call.input(0),
            height,
            width,
            channels: call.site.channels,
            kernel: self.side,
            stride: self.stride,
            padding: self.padding,
        };
        let line = call.site.output().extent[2];
        max_pool_i8(call.isa, &args, tile.positions.start / line..tile.positions.end / line, tile.output(0));
    }
}

//! Max pooling of an image.

use super::description::{Description, Machine, Shader, whole_lines};
use crate::graph::call::{Call, Tile};
use crate::graph::site::Site;
use voxcast_kernels::max_pool::{MaxPool as Kernel, max_pool};

/// [`voxcast_kernels::max_pool`]: x.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MaxPool {
    /// Taps along height and width.
    pub side: usize,
    /// Input steps per output step.
    pub stride: usize,
    /// Border on each side that never wins.
    pub padding: usize,
}

impl Description for MaxPool {
    fn kind(&self) -> &'static str {
        "max_pool"
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
        max_pool(call.isa, &args, tile.positions.start / line..tile.positions.end / line, tile.output(0));
    }

    fn shader(&self, site: &Site<'_>) -> Option<Shader> {
        let ([_, height, width], [_, out_height, out_width]) = (site.input(0).extent, site.output().extent);
        let Self { side, stride, padding } = *self;
        let shape = vec![site.channels, height, width, out_height, out_width, side, stride, padding];
        Some(Shader { name: "max_pool", shape, weights: vec![] })
    }
}

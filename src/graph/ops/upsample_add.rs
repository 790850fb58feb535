//! A coarser map enlarged and added.

use super::description::{Description, Machine, Shader, whole_lines};
use crate::graph::call::{Call, Tile};
use crate::graph::site::Site;
use voxcast_kernels::upsample_add::{UpsampleAdd as Kernel, upsample_add};

/// [`voxcast_kernels::upsample_add`]: x (in place), the coarser map.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UpsampleAdd;

impl Description for UpsampleAdd {
    fn kind(&self) -> &'static str {
        "upsample_add"
    }

    fn in_place(&self) -> Option<usize> {
        Some(0)
    }

    fn tile(&self, site: &Site<'_>, machine: Machine) -> usize {
        whole_lines(site, site.output().extent[1], machine)
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let [_, height, width] = call.site.output().extent;
        let [_, low_height, low_width] = call.site.input(1).extent;
        let args = Kernel { low: call.input(1), low_height, low_width, height, width, channels: call.site.channels };
        upsample_add(call.isa, &args, tile.positions.start / width..tile.positions.end / width, tile.output(0));
    }

    fn shader(&self, site: &Site<'_>) -> Option<Shader> {
        let ([_, height, width], [_, low_height, low_width]) = (site.output().extent, site.input(1).extent);
        let shape = vec![site.channels, low_height, low_width, height, width];
        Some(Shader { name: "upsample_add", shape, weights: vec![] })
    }
}

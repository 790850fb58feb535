//! Camera bytes to normalised, padded image.

use super::description::{Description, Machine, Shader, whole_lines};
use crate::graph::call::{Call, Tile};
use crate::graph::site::Site;
use voxcast_kernels::normalise::normalise;

/// [`voxcast_kernels::normalise`]: the camera's bytes, blue first, dense and at most as large as the tensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Normalise;

impl Description for Normalise {
    fn kind(&self) -> &'static str {
        "normalise"
    }

    fn tile(&self, site: &Site<'_>, machine: Machine) -> usize {
        whole_lines(site, site.output().extent[1], machine)
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let [height, width] = call.moment.image;
        let padded = call.site.output().extent[2];
        let bgr = &call.input::<u8>(0)[..height * width * 3];
        normalise(bgr, height, width, padded, tile.positions.start / padded, tile.output(0));
    }

    fn shader(&self, _: &Site<'_>) -> Option<Shader> {
        // The size of the image is the scene's.
        None
    }
}

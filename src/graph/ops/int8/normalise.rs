//! Camera bytes to an 8-bit image, normalised and padded.

use super::{integers, power, step, within};
use crate::base::error::Result;
use crate::graph::call::{Call, Tile};
use crate::graph::element::Elements;
use crate::graph::ops::description::{Description, Machine, whole_lines};
use crate::graph::parts::Part;
use crate::graph::site::Site;
use crate::graph::weights::{Values, Weights};
use voxcast_kernels::normalise::BGR_MEAN;
use voxcast_kernels::normalise_i8::{FRACTION, MAX_FACTOR, MAX_OFFSET, NormaliseI8 as Kernel, normalise_i8};

/// [`voxcast_kernels::normalise_i8`]: the camera's bytes, blue first, dense and at most as large as the tensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NormaliseI8;

impl NormaliseI8 {
    /// The finest step of the output: a quarter of a byte's.
    pub const LEAST_STEP: f32 = 0.25;
}

impl Description for NormaliseI8 {
    fn kind(&self) -> &'static str {
        "normalise i8"
    }

    fn parts(&self, _: &Site<'_>) -> Vec<Part> {
        vec![integers("factors", 3), integers("offsets", 3)]
    }

    fn evaluate(&self, site: &Site<'_>, _: &Weights<'_>) -> Result<Vec<Values>> {
        let unit = power(FRACTION) / step(site.output());
        let offsets = BGR_MEAN.map(|mean| (-unit * f64::from(mean)).round());
        Ok(vec![vec![unit.round(); 3], offsets.into()])
    }

    fn verify(&self, _: &Site<'_>, parts: &[Elements<'_>]) -> std::result::Result<(), String> {
        within(&parts[0], "factor", 0..=MAX_FACTOR)?;
        within(&parts[1], "offset", -MAX_OFFSET..=MAX_OFFSET)
    }

    fn tile(&self, site: &Site<'_>, machine: Machine) -> usize {
        whole_lines(site, site.output().extent[1], machine)
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let size @ [height, width] = call.moment.image;
        let padded = call.site.output().extent[2];
        let bgr = &call.input::<u8>(0)[..height * width * 3];
        let three = |part| *call.part::<i32>(part).first_chunk().expect("three channels");
        let args = Kernel { factors: three(0), offsets: three(1) };
        normalise_i8(&args, bgr, size, padded, tile.positions.start / padded, tile.output(0));
    }
}

//! A coarser 8-bit map enlarged and added.

use super::{factor, integers, within};
use crate::base::error::Result;
use crate::graph::call::{Call, Tile};
use crate::graph::element::Elements;
use crate::graph::ops::description::{Description, Machine, whole_lines};
use crate::graph::parts::Part;
use crate::graph::site::Site;
use crate::graph::weights::{Values, Weights};
use voxcast_kernels::upsample_add::UpsampleAdd as Kernel;
use voxcast_kernels::upsample_add_i8::{FRACTION, upsample_add_i8};

/// [`voxcast_kernels::upsample_add_i8`]: x (in place), the coarser map.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UpsampleAddI8;

impl UpsampleAddI8 {
    /// By how much the step of what is read may exceed that of the output: a factor has 15 bits.
    pub const MOST_RATIO: f64 = 3.9;
}

impl Description for UpsampleAddI8 {
    fn kind(&self) -> &'static str {
        "upsample_add i8"
    }

    fn in_place(&self) -> Option<usize> {
        Some(0)
    }

    fn parts(&self, _: &Site<'_>) -> Vec<Part> {
        vec![integers("factors", 2)]
    }

    fn evaluate(&self, site: &Site<'_>, _: &Weights<'_>) -> Result<Vec<Values>> {
        Ok(vec![[0, 1].map(|input| factor(site.input(input), site.output(), FRACTION)).into()])
    }

    fn verify(&self, _: &Site<'_>, parts: &[Elements<'_>]) -> std::result::Result<(), String> {
        within(&parts[0], "factor", 0..=i16::MAX.into())
    }

    fn tile(&self, site: &Site<'_>, machine: Machine) -> usize {
        whole_lines(site, site.output().extent[1], machine)
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let [_, height, width] = call.site.output().extent;
        let [_, low_height, low_width] = call.site.input(1).extent;
        let args = Kernel { low: call.input(1), low_height, low_width, height, width, channels: call.site.channels };
        let factors = call.part::<i32>(0);
        // Opening the model has checked that they fit.
        let factors = [factors[0] as i16, factors[1] as i16];
        let rows = tile.positions.start / width..tile.positions.end / width;
        upsample_add_i8(call.isa, &args, factors, rows, tile.output(0));
    }
}

//! Mean over all positions of an 8-bit plane.

use super::{factor, integers, within};
use crate::base::error::Result;
use crate::graph::call::{Call, Tile};
use crate::graph::element::Elements;
use crate::graph::ops::description::{Description, Machine};
use crate::graph::parts::Part;
use crate::graph::site::Site;
use crate::graph::weights::{Values, Weights};
use voxcast_kernels::mean_i8::{FRACTION, MAX_FACTOR, mean_i8};
use voxcast_kernels::pool::Mean;

/// [`voxcast_kernels::mean_i8`]: x, mean over all positions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GlobalMeanI8;

impl GlobalMeanI8 {
    /// By how much the step of what is read may exceed that of the output.
    pub const MOST_RATIO: f64 = 4.0;
}

impl Description for GlobalMeanI8 {
    fn kind(&self) -> &'static str {
        "pool i8"
    }

    fn parts(&self, _: &Site<'_>) -> Vec<Part> {
        vec![integers("factor", 1)]
    }

    fn evaluate(&self, site: &Site<'_>, _: &Weights<'_>) -> Result<Vec<Values>> {
        Ok(vec![vec![factor(site.input(0), site.output(), FRACTION)]])
    }

    fn verify(&self, _: &Site<'_>, parts: &[Elements<'_>]) -> std::result::Result<(), String> {
        within(&parts[0], "factor", 0..=MAX_FACTOR)
    }

    /// The mean is one position.
    fn tile(&self, _: &Site<'_>, _: Machine) -> usize {
        1
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let args = Mean { input: call.input(0), channels: call.site.channels };
        mean_i8(call.isa, &args, call.part::<i32>(0)[0], tile.output(0));
    }
}

//! The sparse mean of 8-bit features.

use super::{factor, integers, power, step, within};
use crate::base::error::Result;
use crate::graph::call::{Call, Tile};
use crate::graph::element::Elements;
use crate::graph::matrices::{Csr, Level, Matrix};
use crate::graph::ops::description::{Description, Machine, ROWS};
use crate::graph::ops::product::pointwise;
use crate::graph::parts::Part;
use crate::graph::recipe::Recipe;
use crate::graph::site::Site;
use crate::graph::weights::{Values, Weights, padded};
use voxcast_kernels::LANES;
use voxcast_kernels::gather::{Gather as Kernel, Mask};
use voxcast_kernels::gather_i8::{FRACTION, MAX_BIAS, MAX_FACTOR, gather_i8};

/// [`voxcast_kernels::gather_i8`]: features of all cameras. With the recipe [`Recipe::Bias`] the branch's bias follows the
/// mean.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GatherI8 {
    /// Level index 0..3 (levels 1 to 3).
    pub level: usize,
    /// Which matrix.
    pub matrix: Matrix,
    /// First feature channel.
    pub first_channel: usize,
}

impl GatherI8 {
    /// By how much the step of the features may exceed that of the output.
    pub const MOST_RATIO: f64 = 2.0;
}

impl Description for GatherI8 {
    fn kind(&self) -> &'static str {
        "gather i8"
    }

    fn parts(&self, site: &Site<'_>) -> Vec<Part> {
        let factor = integers("factor", 1);
        match site.recipe {
            Recipe::None => vec![factor],
            _ => vec![factor, integers("bias", site.channels.next_multiple_of(LANES))],
        }
    }

    /// A bias beyond the kernel's range is put at its end: with it, too, a result is at the end of an 8-bit tensor, for a
    /// mean moves it by less than half of that range.
    fn evaluate(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Values>> {
        let mut values = vec![vec![factor(site.input(0), site.output(), FRACTION)]];
        if let Recipe::Bias { names, inputs } = site.recipe {
            let dense = pointwise(weights, names, site.output().space, site.channels, *inputs)?;
            let (unit, most) = (power(FRACTION) / step(site.output()), f64::from(MAX_BIAS));
            values.push(padded(dense.bias.iter().map(|bias| (bias * unit).round().clamp(-most, most)).collect()));
        }
        Ok(values)
    }

    fn verify(&self, _: &Site<'_>, parts: &[Elements<'_>]) -> std::result::Result<(), String> {
        within(&parts[0], "factor", 0..=MAX_FACTOR)?;
        parts.get(1).map_or(Ok(()), |bias| within(bias, "bias", -MAX_BIAS..=MAX_BIAS))
    }

    fn moved(&self, site: &Site<'_>, levels: &[Level<'_>; 3]) -> usize {
        let entries = levels[self.level].matrix(self.matrix).col.len();
        entries.saturating_mul(site.channels).saturating_add(site.rows().saturating_mul(site.channels))
    }

    fn tile(&self, _: &Site<'_>, _: Machine) -> usize {
        ROWS
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let Csr { ptr, col } = call.moment.levels[self.level].matrix(self.matrix);
        let features = call.site.input(0);
        let masked = call.moment.masked;
        let args = Kernel {
            ptr,
            col,
            mask: masked.contains(&true).then_some(Mask { pixels: features.rows(), masked }),
            features: call.input(0),
            stride: features.channels,
            first_channel: self.first_channel,
            channels: call.site.channels,
            bias: call.parts.get(1).map(|bias| bias.of()),
            relu: call.site.relu,
        };
        gather_i8(call.isa, &args, call.part::<i32>(0)[0], tile.positions.clone(), tile.output(0));
    }
}

//! The sparse mean: from pixels of all cameras to voxels and cells.

use super::description::{Description, Machine, ROWS};
use super::product::pointwise;
use crate::base::error::Result;
use crate::graph::call::{Call, Tile};
use crate::graph::matrices::{Csr, Level, Matrix};
use crate::graph::parts::Part;
use crate::graph::recipe::Recipe;
use crate::graph::site::Site;
use crate::graph::weights::{Values, Weights, padded};
use voxcast_kernels::LANES;
use voxcast_kernels::gather::{Gather as Kernel, Mask, gather};

/// [`voxcast_kernels::gather`]: features of all cameras. With the recipe [`Recipe::Bias`], which the projection fold
/// gives it, the branch's bias follows the mean.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Gather {
    /// Level index 0..3 (levels 1 to 3).
    pub level: usize,
    /// Which matrix.
    pub matrix: Matrix,
    /// First feature channel.
    pub first_channel: usize,
}

impl Description for Gather {
    fn kind(&self) -> &'static str {
        "gather"
    }

    fn parts(&self, site: &Site<'_>) -> Vec<Part> {
        match site.recipe {
            Recipe::None => vec![],
            _ => vec![Part::plain("bias", site.channels.next_multiple_of(LANES))],
        }
    }

    fn evaluate(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Values>> {
        match site.recipe {
            Recipe::Bias { names, inputs } => {
                let dense = pointwise(weights, names, site.output().space, site.channels, *inputs)?;
                Ok(vec![padded(dense.bias)])
            }
            _ => Ok(vec![]),
        }
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
            bias: call.parts.first().map(|bias| bias.of()),
            relu: call.site.relu,
        };
        gather(call.isa, &args, tile.positions.clone(), tile.output(0));
    }
}

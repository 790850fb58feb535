//! The occupancy head: three linear layers and the largest class.

use super::description::{Description, Machine, wide};
use crate::base::error::Result;
use crate::graph::call::{Call, Tile};
use crate::graph::parts::Part;
use crate::graph::recipe::{ConvNames, Recipe};
use crate::graph::site::Site;
use crate::graph::temperature::Temperature;
use crate::graph::weights::{Dense, Values, Weights, packed, padded};
use voxcast_kernels::LANES;
use voxcast_kernels::head::{Confidence, Head as Kernel, Results, head, scratch_len};
use voxcast_kernels::panels::packed_len;

/// Voxels that one worker classifies at a time.
pub(super) const VOXELS: usize = 960;

/// [`voxcast_kernels::head`]: x. Writes, where it is asked how sure it is, the codes of "occupied" and of the class; then a
/// class per voxel; and logits where the graph has a tensor for them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Head {
    /// Classes.
    pub classes: usize,
    /// The temperature at which it is asked how sure it is.
    pub confidence: Option<Temperature>,
}

/// Where a head of this confidence writes a tile.
pub(super) fn results<'a>(confidence: Option<Temperature>, site: &Site<'_>, tile: &mut Tile<'a>) -> Results<'a> {
    let first = if confidence.is_some() { 2 } else { 0 };
    Results {
        classes: tile.output(first),
        logits: (site.outputs.len() > first + 1).then(|| tile.output(first + 1)),
        confidence: confidence.map(|temperature| Confidence {
            scale: temperature.inverse(),
            occupied: tile.output(0),
            class: tile.output(1),
        }),
    }
}

impl Head {
    /// Columns of the three layers.
    fn columns(&self, site: &Site<'_>) -> [usize; 3] {
        let channels = site.input(0).channels;
        [channels, channels, self.classes]
    }
}

/// The three layers of a head, which have so many columns.
pub(super) fn layers(site: &Site<'_>, columns: [usize; 3], weights: &Weights<'_>) -> Result<Vec<Dense>> {
    let Recipe::Module(prefix) = site.recipe else { unreachable!("a head, not {:?}", site.recipe) };
    let channels = site.input(0).channels;
    // ReLUs stand between the layers.
    let layers = [0, 2, 4].into_iter().zip(columns).map(|(layer, columns)| {
        let names = ConvNames { prefix: format!("{prefix}.{layer}"), bias: true, norm: None };
        weights.dense(&names, &[columns, channels], columns)
    });
    layers.collect()
}

impl Description for Head {
    fn kind(&self) -> &'static str {
        "head"
    }

    fn parts(&self, site: &Site<'_>) -> Vec<Part> {
        let channels = site.input(0).channels;
        let suffixes = [["0.weight", "0.bias"], ["1.weight", "1.bias"], ["2.weight", "2.bias"]];
        let layers = suffixes.into_iter().zip(self.columns(site));
        layers
            .flat_map(|([weight, bias], columns)| {
                let padded = columns.next_multiple_of(LANES);
                [Part::panels(weight, packed_len(channels, columns)), Part::plain(bias, padded)]
            })
            .collect()
    }

    fn evaluate(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Values>> {
        let mut values = vec![];
        for (dense, columns) in layers(site, self.columns(site), weights)?.into_iter().zip(self.columns(site)) {
            values.extend([packed(&dense.weight, site.input(0).channels, columns), padded(dense.bias)]);
        }
        Ok(values)
    }

    fn scratch(&self, site: &Site<'_>) -> usize {
        scratch_len(site.input(0).channels, self.classes) * size_of::<f32>()
    }

    fn multiply_adds(&self, site: &Site<'_>) -> u128 {
        let channels = site.input(0).channels;
        wide(site.rows()) * wide(channels) * wide(2 * channels + self.classes)
    }

    /// Sums have few products.
    fn pace(&self) -> u64 {
        4
    }

    fn tile(&self, _: &Site<'_>, _: Machine) -> usize {
        VOXELS
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let args = Kernel {
            input: call.input(0),
            channels: call.site.input(0).channels,
            classes: self.classes,
            weights: [0, 2, 4].map(|i| call.parts[i].panels()),
            biases: [1, 3, 5].map(|i| call.part(i)),
        };
        let results = results(self.confidence, &call.site, &mut tile);
        head(call.isa, &args, tile.positions.clone(), results, tile.scratch());
    }
}

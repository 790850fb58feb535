//! The occupancy head in 8 bits.

use super::columns::Steps;
use super::product::{self, BIAS, MULTIPLIER, PAIRS, PARTS, SUMS, WEIGHTS};
use super::step;
use crate::base::error::Result;
use crate::graph::call::{Call, Tile};
use crate::graph::element::{Element, Elements};
use crate::graph::ops::description::{Description, Machine, wide};
use crate::graph::ops::head::{VOXELS, layers, results};
use crate::graph::parts::Part;
use crate::graph::scale::Scale;
use crate::graph::site::Site;
use crate::graph::temperature::Temperature;
use crate::graph::weights::{Values, Weights};
use voxcast_kernels::head_i8::{HeadI8 as Kernel, LayerI8, head_i8, scratch_len};

/// Names of the parts of the layers, each as [`product::parts`] has them.
const SUFFIXES: [[&str; PARTS]; 3] = [
    ["0.weight", "0.sums", "0.pairs", "0.bias", "0.multiplier"],
    ["1.weight", "1.sums", "1.pairs", "1.bias", "1.multiplier"],
    ["2.weight", "2.sums", "2.pairs", "2.bias", "2.scale"],
];
/// Where the parts of a layer begin.
const LAYER: [usize; 3] = [0, PARTS, 2 * PARTS];
/// The step of the last layer's sums, in the place of its multipliers.
const SCALE: usize = LAYER[2] + MULTIPLIER;

/// [`voxcast_kernels::head_i8`]: x. Writes what [`Head`](crate::graph::ops::Head) does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HeadI8 {
    /// Classes.
    pub classes: usize,
    /// Whether x may be negative.
    pub signed: bool,
    /// Of the two hidden layers.
    pub hidden: [Scale; 2],
    /// The temperature at which it is asked how sure it is.
    pub confidence: Option<Temperature>,
}

impl HeadI8 {
    /// Columns of the three layers.
    fn columns(&self, site: &Site<'_>) -> [usize; 3] {
        let channels = site.input(0).channels;
        [channels, channels, self.classes]
    }
}

impl Description for HeadI8 {
    fn kind(&self) -> &'static str {
        "head i8"
    }

    fn parts(&self, site: &Site<'_>) -> Vec<Part> {
        let channels = site.input(0).channels;
        let layers = SUFFIXES.into_iter().zip(self.columns(site)).flat_map(|(suffixes, columns)| {
            let parts = product::parts(1, channels, columns, false).into_iter();
            parts.zip(suffixes).map(|(part, suffix)| Part { suffix, ..part })
        });
        let mut parts: Vec<Part> = layers.collect();
        parts[SCALE] = Part::of(Element::F32, SUFFIXES[2][MULTIPLIER], 1);
        parts
    }

    /// The last layer's columns have one scale, that of the largest weight and bias of all, so that the largest sum is the
    /// largest logit.
    fn evaluate(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Values>> {
        let channels = site.input(0).channels;
        let inputs = [step(site.input(0)), self.hidden[0].wide(), self.hidden[1].wide()];
        let mut values = vec![];
        for (layer, dense) in layers(site, self.columns(site), weights)?.into_iter().enumerate() {
            let output = self.hidden.get(layer).map(|scale| scale.wide());
            let most = dense.weight.iter().fold(0.0f64, |most, w| most.max(w.abs()));
            let common = Steps::common(inputs[layer], most, &dense.bias);
            let columns = product::columns(&dense.weight, &dense.bias, channels, |_, weight, bias| match output {
                Some(output) => Steps { input: inputs[layer], output, residual: None }.column(weight, bias),
                None => Ok(common.column(weight, bias)),
            })?;
            values.extend(product::values(1, &columns, false));
            if output.is_none() {
                values[SCALE] = vec![common.unit()];
            }
        }
        Ok(values)
    }

    fn verify(&self, site: &Site<'_>, parts: &[Elements<'_>]) -> std::result::Result<(), String> {
        let channels = site.input(0).channels;
        for (layer, columns) in LAYER.into_iter().zip(self.columns(site)) {
            let in_layer = |e| format!("layer {}: {e}", layer / PARTS);
            product::verify_weights(channels, columns, &parts[layer..layer + PARTS]).map_err(in_layer)?;
            if layer != LAYER[2] {
                product::verify_multipliers(&parts[layer + MULTIPLIER]).map_err(in_layer)?;
            }
        }
        let scale = parts[SCALE].of::<f32>()[0];
        let sound = scale.is_normal() && scale > 0.0;
        sound.then_some(()).ok_or_else(|| format!("2.scale is {scale:e}, expected a positive normal number"))
    }

    fn scratch(&self, site: &Site<'_>) -> usize {
        scratch_len(site.input(0).channels, self.classes) * size_of::<i32>()
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
            signed: self.signed,
            channels: call.site.input(0).channels,
            classes: self.classes,
            layers: LAYER.map(|layer| LayerI8 {
                weights: call.part(layer + WEIGHTS),
                sums: call.part(layer + SUMS),
                pairs: call.part(layer + PAIRS),
                bias: call.part(layer + BIAS),
            }),
            multipliers: [LAYER[0], LAYER[1]].map(|layer| call.part(layer + MULTIPLIER)),
            scale: call.part::<f32>(SCALE)[0],
        };
        let results = results(self.confidence, &call.site, &mut tile);
        head_i8(call.isa, &args, tile.positions.clone(), results, tile.scratch());
    }
}

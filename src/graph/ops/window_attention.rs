//! Cascaded group attention within windows of a plane.

use super::description::{Description, Machine, wide};
use crate::base::error::Result;
use crate::graph::call::{Call, Tile};
use crate::graph::parts::Part;
use crate::graph::recipe::{ConvNames, Recipe};
use crate::graph::site::Site;
use crate::graph::weights::{Values, Weights, packed, packed_taps, padded};
use voxcast_kernels::LANES;
use voxcast_kernels::panels::packed_len;
use voxcast_kernels::window_attention::{QUERY_KERNEL, Shape, WindowAttention as Kernel, window_attention};

/// Taps of the depthwise kernel on the queries.
const QUERY_TAPS: usize = QUERY_KERNEL * QUERY_KERNEL;

/// [`voxcast_kernels::window_attention`]: x, which is also added to the result.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WindowAttention {
    /// Plane, heads and windows.
    pub shape: Shape,
}

impl Description for WindowAttention {
    fn kind(&self) -> &'static str {
        "window_attention"
    }

    fn parts(&self, _: &Site<'_>) -> Vec<Part> {
        let Shape { channels, heads, key_dim, .. } = self.shape;
        let lanes = |v: usize| v.next_multiple_of(LANES);
        vec![
            Part::plain("qkv.weight", heads * packed_len(channels / heads, 3 * key_dim)),
            Part::plain("qkv.bias", heads * lanes(3 * key_dim)),
            Part::plain("query.weight", heads * QUERY_TAPS * lanes(key_dim)),
            Part::plain("query.bias", heads * lanes(key_dim)),
            Part::plain("offsets", heads * self.shape.side() * self.shape.side()),
            Part::plain("proj.weight", packed_len(heads * key_dim, channels)),
            Part::plain("proj.bias", lanes(channels)),
        ]
    }

    fn evaluate(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Values>> {
        let Recipe::Module(prefix) = site.recipe else { unreachable!("attention, not {:?}", site.recipe) };
        let Shape { channels, heads, key_dim, .. } = self.shape;
        let share = self.shape.part();
        let (mut qkv, mut qkv_bias, mut query, mut query_bias) = (vec![], vec![], vec![], vec![]);
        let conv_bn = |name: &str| ConvNames {
            prefix: format!("{prefix}.{name}.c"),
            bias: false,
            norm: Some(format!("{prefix}.{name}.bn")),
        };
        for head in 0..heads {
            let shape = [3 * key_dim, share, 1, 1];
            let dense = weights.dense(&conv_bn(&format!("qkvs.{head}")), &shape, 3 * key_dim)?;
            qkv.extend(packed(&dense.weight, share, 3 * key_dim));
            qkv_bias.extend(padded(dense.bias));
            let shape = [key_dim, 1, QUERY_KERNEL, QUERY_KERNEL];
            let dense = weights.dense(&conv_bn(&format!("dws.{head}")), &shape, key_dim)?;
            query.extend(packed_taps(&dense.weight, QUERY_TAPS, key_dim));
            query_bias.extend(padded(dense.bias));
        }
        let places = self.shape.side() * self.shape.side();
        let offsets = weights.tensor(&format!("{prefix}.attention_biases"), &[heads, places])?;
        let proj = weights.dense(&conv_bn("proj.1"), &[channels, heads * key_dim, 1, 1], channels)?;
        let proj_weight = packed(&proj.weight, heads * key_dim, channels);
        Ok(vec![qkv, qkv_bias, query, query_bias, offsets, proj_weight, padded(proj.bias)])
    }

    fn scratch(&self, _: &Site<'_>) -> usize {
        self.shape.scratch_len() * size_of::<f32>()
    }

    fn multiply_adds(&self, site: &Site<'_>) -> u128 {
        let (shape, window) = (self.shape, self.shape.window());
        let plane: usize = (0..2).map(|a| shape.extent[a].next_multiple_of(window[a])).product();
        let tokens = window[0] * window[1];
        let per_key = 3 * shape.part() + QUERY_TAPS + 2 * tokens + site.input(0).channels;
        wide(plane * shape.heads * shape.key_dim) * wide(per_key)
    }

    /// Windows have few keys, of few channels, and each pair of tokens an exponential.
    fn pace(&self) -> u64 {
        12
    }

    fn tile(&self, _: &Site<'_>, _: Machine) -> usize {
        self.shape.window()[0] * self.shape.extent[1]
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let args = Kernel {
            shape: self.shape,
            input: call.input(0),
            qkv: call.part(0),
            qkv_bias: call.part(1),
            query: call.part(2),
            query_bias: call.part(3),
            offsets: call.part(4),
            proj: call.part(5),
            proj_bias: call.part(6),
        };
        let window_row = tile.positions.start / (self.shape.window()[0] * self.shape.extent[1]);
        window_attention(call.isa, &args, window_row, tile.output(0), tile.scratch());
    }
}

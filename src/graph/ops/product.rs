//! What convolutions have in common: the matrix product, its tiles, and where its weights come from.

use super::description::{Machine, wide};
use crate::base::error::Result;
use crate::graph::call::{Added, Call, Tile};
use crate::graph::element::Scalar;
use crate::graph::parts::Part;
use crate::graph::recipe::{ConvNames, Recipe};
use crate::graph::site::Site;
use crate::graph::tensor::Space;
use crate::graph::weights::{Dense, Values, Weights, matmul, packed, padded};
use std::ops::Range;
use voxcast_kernels::LANES;
use voxcast_kernels::conv::Geometry;
use voxcast_kernels::matmul::layout::packed_len;
use voxcast_kernels::matmul::{BLOCK_ROWS, Product, Residual, SCRATCH};

/// Bytes of scratch of the product kernel.
pub(super) const SCRATCH_BYTES: usize = SCRATCH * size_of::<f32>();

/// Rows of a tile: about as many tiles as blocks of rows, cut so that the busiest worker has as few rows as can be.
pub(super) fn rows_per_tile(site: &Site<'_>, machine: Machine) -> usize {
    rows_in_units(site, machine, machine.isa.tile().rows)
}

/// As [`rows_per_tile`], a multiple of `unit`.
pub(super) fn rows_in_units(site: &Site<'_>, machine: Machine, unit: usize) -> usize {
    let (rows, workers) = (site.rows(), machine.workers);
    let fewest = rows.div_ceil(BLOCK_ROWS).next_multiple_of(workers);
    let most = rows.div_ceil(unit).min(fewest.saturating_mul(2)).max(fewest);
    let cuts = (fewest..=most).step_by(workers).take(CUTS).map(|tiles| rows.div_ceil(tiles).next_multiple_of(unit));
    let busiest = |per_tile: &usize| rows.div_ceil(*per_tile).div_ceil(workers) * per_tile;
    cuts.min_by_key(busiest).unwrap_or(unit)
}

/// Numbers of tiles that are compared.
const CUTS: usize = 8;

/// Weight and bias.
pub(super) fn parts(geometry: &Geometry, columns: usize) -> Vec<Part> {
    let bias = columns.next_multiple_of(LANES);
    vec![Part::panels("weight", packed_len(geometry.depth(), columns)), Part::plain("bias", bias)]
}

pub(super) fn multiply_adds(geometry: &Geometry, site: &Site<'_>) -> u128 {
    wide(site.rows()) * wide(geometry.depth()) * wide(site.channels)
}

/// The right matrix, and what is added.
pub(super) fn product<'a>(call: &Call<'a>, depth: usize) -> Product<'a> {
    Product {
        weights: call.parts[0].panels(),
        bias: call.part(1),
        depth,
        columns: call.site.channels,
        relu: call.site.relu,
        residual: residual(call),
    }
}

/// What is added, as the kernels take it.
pub(super) fn residual<'a>(call: &Call<'a>) -> Residual<'a> {
    match call.added {
        Added::Nothing => Residual::None,
        Added::InPlace => Residual::InPlace,
        Added::Apart { elements, after } => {
            // A residual has the shape of the output.
            let (rows, stride) = (elements.of(), call.site.output().channels);
            if after { Residual::After { rows, stride } } else { Residual::Before { rows, stride } }
        }
    }
}

/// Rows, their distance and where they go: some channels of the tile's, from the first that the operation writes on.
pub(super) fn rows<'a, T: Scalar>(call: &Call<'_>, tile: &mut Tile<'a>) -> (Range<usize>, usize, &'a mut [T]) {
    let stride = call.site.output().channels;
    let out = tile.output::<T>(0);
    let after = stride - call.site.first_channel - call.site.channels;
    let end = out.len() - after;
    (tile.positions.clone(), stride, &mut out[call.site.first_channel..end])
}

pub(super) fn evaluate(geometry: &Geometry, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Values>> {
    let (inputs, outputs) = (site.input(0).channels, site.channels);
    let Dense { weight, bias } = dense(geometry, inputs, site, weights)?;
    Ok(vec![packed(&weight, inputs, outputs), padded(bias)])
}

/// Weights and bias of a convolution whose checkpoint has `inputs` input channels.
pub(super) fn dense(geometry: &Geometry, inputs: usize, site: &Site<'_>, weights: &Weights<'_>) -> Result<Dense> {
    let outputs = site.channels;
    let [d, h, w] = geometry.kernel;
    match site.recipe {
        Recipe::Conv(names) => weights.dense(names, &shape_of(geometry, inputs, site), outputs),
        Recipe::Projection { pixel, volume, bev } => {
            let (fpn, branch) = (inputs, outputs / 2);
            let taps = d * h * w;
            let pixel = weights.dense(pixel, &[fpn, inputs, h, w], fpn)?;
            let mut weight = Vec::with_capacity(outputs * inputs * taps);
            let mut bias = Vec::with_capacity(outputs);
            for (names, space) in [(volume, Space::Volume), (bev, Space::Plane)] {
                let one = pointwise(weights, names, space, branch, fpn)?.weight;
                weight.extend(matmul(&one, &pixel.weight, branch, fpn, inputs * taps));
                bias.extend(matmul(&one, &pixel.bias, branch, fpn, 1));
            }
            Ok(Dense { weight, bias })
        }
        recipe @ (Recipe::None | Recipe::Module(_) | Recipe::Bias { .. }) => {
            unreachable!("a convolution never has the recipe {recipe:?}")
        }
    }
}

/// Shape of a convolution's weights in a checkpoint: the published modules are Conv3d over volumes, else Conv2d.
pub(super) fn checkpoint_shape(geometry: &Geometry, site: &Site<'_>) -> Vec<usize> {
    shape_of(geometry, site.input(0).channels, site)
}

fn shape_of(geometry: &Geometry, inputs: usize, site: &Site<'_>) -> Vec<usize> {
    let [d, h, w] = geometry.kernel;
    let outputs = site.channels;
    match site.output().space {
        Space::Volume => vec![outputs, inputs, d, h, w],
        Space::Image | Space::Plane => vec![outputs, inputs, h, w],
    }
}

/// The first 1x1 convolution of a branch.
pub(super) fn pointwise(
    weights: &Weights<'_>,
    names: &ConvNames,
    space: Space,
    outputs: usize,
    inputs: usize,
) -> Result<Dense> {
    match space {
        Space::Volume => weights.dense(names, &[outputs, inputs, 1, 1, 1], outputs),
        Space::Image | Space::Plane => weights.dense(names, &[outputs, inputs, 1, 1], outputs),
    }
}

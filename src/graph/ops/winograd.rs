//! Convolutions by Winograd's minimal filtering, which [`Graph::use_winograd`](crate::graph::Graph::use_winograd) puts where
//! [`Conv`](super::Conv) and [`Deconv`](super::Deconv) stood.

use super::description::{Description, Machine};
use super::{Deconv, deconv, product};
use crate::base::error::Result;
use crate::graph::call::{Call, Tile};
use crate::graph::parts::Part;
use crate::graph::site::Site;
use crate::graph::weights::{Dense, Values, Weights, padded};
use voxcast_kernels::LANES;
use voxcast_kernels::conv::Geometry;
use voxcast_kernels::matmul::BLOCK_ROWS;
use voxcast_kernels::winograd::{Scheme, Shape, Winograd as Kernel, winograd};

/// [`voxcast_kernels::winograd`]: x.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Winograd {
    /// How x is walked.
    pub geometry: Geometry,
    /// The same as the kernel takes it, and the size of its tiles.
    pub shape: Shape,
}

/// [`voxcast_kernels::winograd`] as a transposed convolution that doubles a volume: x. A residual is added after the ReLU.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WinogradDeconv {
    /// How x is walked.
    pub shape: Shape,
}

/// The transforms take as long as the products where there are few channels.
const PACE: u64 = 2;

impl Description for Winograd {
    fn kind(&self) -> &'static str {
        match (self.shape.layer_taps, self.shape.scheme) {
            (1, Scheme::Four) => "conv2d F(4,3)",
            (1, _) => "conv2d F(2,3)",
            (_, Scheme::Four) => "conv3d F(4,3)",
            (_, _) => "conv3d F(2,3)",
        }
    }

    fn overwrites_residual(&self) -> bool {
        true
    }

    fn parts(&self, site: &Site<'_>) -> Vec<Part> {
        parts(&self.shape, site)
    }

    fn evaluate(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Values>> {
        let Dense { weight, bias } = product::dense(&self.geometry, site.input(0).channels, site, weights)?;
        let (inputs, depth) = (self.geometry.channels, self.geometry.depth());
        let taps = depth / inputs;
        let at = |_, k, n| weight[n * depth + k % inputs * taps + k / inputs];
        Ok(vec![transformed(&self.shape, at), padded(bias)])
    }

    fn scratch(&self, _: &Site<'_>) -> usize {
        scratch(&self.shape)
    }

    fn multiply_adds(&self, site: &Site<'_>) -> u128 {
        product::multiply_adds(&self.geometry, site)
    }

    fn executed_multiply_adds(&self, _: &Site<'_>) -> u128 {
        self.shape.multiply_adds().into()
    }

    fn pace(&self) -> u64 {
        PACE
    }

    fn tile(&self, _: &Site<'_>, machine: Machine) -> usize {
        tile(&self.shape, machine)
    }

    fn execute(&self, call: &Call<'_>, tile: Tile<'_>) {
        execute(&self.shape, call, tile);
    }
}

impl Description for WinogradDeconv {
    fn kind(&self) -> &'static str {
        "deconv3d F(3,2)"
    }

    fn parts(&self, site: &Site<'_>) -> Vec<Part> {
        parts(&self.shape, site)
    }

    fn evaluate(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Values>> {
        let (folded, bias) = deconv::folded(site, weights)?;
        Ok(vec![transformed(&self.shape, folded), padded(bias)])
    }

    fn scratch(&self, _: &Site<'_>) -> usize {
        scratch(&self.shape)
    }

    fn multiply_adds(&self, site: &Site<'_>) -> u128 {
        Deconv.multiply_adds(site)
    }

    fn executed_multiply_adds(&self, _: &Site<'_>) -> u128 {
        self.shape.multiply_adds().into()
    }

    fn pace(&self) -> u64 {
        PACE
    }

    fn tile(&self, _: &Site<'_>, machine: Machine) -> usize {
        tile(&self.shape, machine)
    }

    fn execute(&self, call: &Call<'_>, tile: Tile<'_>) {
        execute(&self.shape, call, tile);
    }
}

/// Transformed weights are f32 in every model: half precision has too few digits for the sums that the transform back takes
/// of them.
fn parts(shape: &Shape, site: &Site<'_>) -> Vec<Part> {
    let bias = site.channels.next_multiple_of(LANES);
    vec![Part::plain("transformed", shape.weights_len()), Part::plain("bias", bias)]
}

/// The transformed weights, rounded to f32, of what has the weight `weight(part, k, n)` for output `n` at k over (tap, input)
/// of a part.
pub(crate) fn transformed(shape: &Shape, weight: impl Fn(usize, usize, usize) -> f64) -> Values {
    let mut packed = vec![0.0; shape.weights_len()];
    shape.pack(weight, &mut packed);
    packed.into_iter().map(f64::from).collect()
}

fn scratch(shape: &Shape) -> usize {
    shape.scratch_len() * size_of::<f32>()
}

/// Positions of the output that a row of the kernel's tiles has; the last row may have fewer.
fn row(shape: &Shape) -> usize {
    shape.positions(&(0..1)).len()
}

/// As many rows of the kernel's tiles as fill a block, but the same number for every worker.
fn tile(shape: &Shape, machine: Machine) -> usize {
    let [down, across] = shape.tiles();
    let blocks = (down * across * shape.layers * shape.parts()).div_ceil(BLOCK_ROWS).next_multiple_of(machine.workers);
    down.div_ceil(blocks) * row(shape)
}

fn execute(shape: &Shape, call: &Call<'_>, mut tile: Tile<'_>) {
    let args = Kernel {
        shape: *shape,
        input: call.input(0),
        weights: call.part(0),
        bias: call.part(1),
        relu: call.site.relu,
        residual: product::residual(call),
    };
    let (positions, stride, out) = product::rows(call, &mut tile);
    let tile_rows = positions.start / row(shape)..positions.end.div_ceil(row(shape));
    winograd(call.isa, &args, tile_rows, stride, out, tile.scratch());
}

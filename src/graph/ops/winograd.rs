//! Convolution by Winograd's minimal filtering, which [`Graph::use_winograd`](crate::graph::Graph::use_winograd) puts where
//! [`Conv`](super::Conv) stood.

use super::description::{Description, Machine};
use super::product;
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

impl Winograd {
    /// The transformed weights of a convolution whose weight for output `n` at k over (tap, input) is `weight(k, n)`, rounded
    /// to f32.
    pub(crate) fn transformed(&self, weight: impl Fn(usize, usize) -> f64) -> Values {
        let mut packed = vec![0.0; self.shape.weights_len()];
        self.shape.pack(weight, &mut packed);
        packed.into_iter().map(f64::from).collect()
    }

    /// Positions of the output that a row of the kernel's tiles has; the last row may have fewer.
    fn row(&self) -> usize {
        self.shape.scheme.outputs() * self.shape.plane[1] * self.shape.layers
    }
}

impl Description for Winograd {
    fn kind(&self) -> &'static str {
        match (self.shape.layer_taps, self.shape.scheme) {
            (1, Scheme::Two) => "conv2d F(2,3)",
            (1, Scheme::Four) => "conv2d F(4,3)",
            (_, Scheme::Two) => "conv3d F(2,3)",
            (_, Scheme::Four) => "conv3d F(4,3)",
        }
    }

    fn overwrites_residual(&self) -> bool {
        true
    }

    /// Transformed weights are f32 in every model: half precision has too few digits for the sums that the transform back
    /// takes of them.
    fn parts(&self, site: &Site<'_>) -> Vec<Part> {
        let bias = site.channels.next_multiple_of(LANES);
        vec![Part::plain("transformed", self.shape.weights_len()), Part::plain("bias", bias)]
    }

    fn evaluate(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Values>> {
        let Dense { weight, bias } = product::dense(&self.geometry, site.input(0).channels, site, weights)?;
        let (inputs, depth) = (self.geometry.channels, self.geometry.depth());
        let taps = depth / inputs;
        Ok(vec![self.transformed(|k, n| weight[n * depth + k % inputs * taps + k / inputs]), padded(bias)])
    }

    fn scratch(&self, _: &Site<'_>) -> usize {
        self.shape.scratch_len() * size_of::<f32>()
    }

    fn multiply_adds(&self, site: &Site<'_>) -> u128 {
        product::multiply_adds(&self.geometry, site)
    }

    fn executed_multiply_adds(&self, _: &Site<'_>) -> u128 {
        self.shape.multiply_adds().into()
    }

    /// As many rows of the kernel's tiles as fill a block, but the same number for every worker.
    fn tile(&self, _: &Site<'_>, machine: Machine) -> usize {
        let [down, across] = self.shape.tiles();
        let blocks = (down * across * self.shape.layers).div_ceil(BLOCK_ROWS).next_multiple_of(machine.workers);
        down.div_ceil(blocks) * self.row()
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let args = Kernel {
            shape: self.shape,
            input: call.input(0),
            weights: call.part(0),
            bias: call.part(1),
            relu: call.site.relu,
            residual: product::residual(call),
        };
        let (positions, stride, out) = product::rows(call, &mut tile);
        let tile_rows = positions.start / self.row()..positions.end.div_ceil(self.row());
        winograd(call.isa, &args, tile_rows, stride, out, tile.scratch());
    }
}

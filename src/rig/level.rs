//! What is fixed about a level: its sample points and the images that they may fall into.

use super::axis::axis;
use crate::network::Network;
use voxcast_kernels::LANES;

/// What is fixed about a level.
pub(super) struct LevelGrid {
    pub(super) grid: [usize; 3],
    /// Sample points per voxel and axis.
    pub(super) samples: usize,
    /// Sample coordinates along x, y and z; z padded to a multiple of [`LANES`], which the kernel takes at once, with NaN,
    /// which hits nothing.
    pub(super) axes: [Vec<f32>; 3],
    /// Smallest and largest z coordinate.
    pub(super) z_range: [f64; 2],
    /// Height and width of the padded image.
    pub(super) image: [usize; 2],
    pub(super) stride_log2: u32,
    /// Feature pixels of one camera.
    pub(super) pixels: usize,
}

impl LevelGrid {
    pub(super) fn new(network: &Network, level: usize) -> Self {
        let (grid, samples) = (network.grids[level], network.samples[level]);
        let mut axes = [0, 1, 2].map(|a| axis(network.sampling, network.bounds[a], grid[a] * samples));
        let z_range = range(&axes[2]);
        let padded = axes[2].len().next_multiple_of(LANES);
        axes[2].resize(padded, f32::NAN);
        Self {
            grid,
            samples,
            axes,
            z_range,
            image: network.image,
            stride_log2: network.strides[level].ilog2(),
            pixels: network.feature_pixels(level),
        }
    }

    /// Sample points of a column in one camera, padding included.
    pub(super) fn points(&self) -> usize {
        self.samples * self.samples * self.axes[2].len()
    }
}

/// Smallest and largest of `values`.
pub(super) fn range(values: &[f32]) -> [f64; 2] {
    values.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |[lo, hi], &v| [lo.min(v.into()), hi.max(v.into())])
}

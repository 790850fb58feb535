//! Where the voxels are.

use super::Network;

/// Where voxels lie: how many along each axis, and their metres in some frame of reference.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grid {
    /// Voxels along x, y, z.
    pub size: [usize; 3],
    /// [min, max] of x, of y, of z in metres.
    pub bounds: [[f32; 2]; 3],
    /// In whose frame these are.
    pub axes: Axes,
}

impl Grid {
    /// So many voxels within these bounds, in the lidar's frame.
    pub fn new(size: [usize; 3], bounds: [[f32; 2]; 3]) -> Self {
        Self { size, bounds, axes: Axes::Lidar }
    }

    /// The output grid of a network.
    pub fn of(network: &Network) -> Self {
        Self::new(network.output_grid(), network.bounds)
    }

    /// Voxels in all.
    pub fn voxels(&self) -> usize {
        self.size.iter().product()
    }

    /// The ego vehicle's direction, as [`forward_of`] judges it.
    pub fn forward(&self) -> [f32; 2] {
        forward_of(&self.bounds)
    }

    /// Edge of a voxel along `axis` in metres.
    pub fn edge(&self, axis: usize) -> f64 {
        let [low, high] = self.bounds[axis].map(f64::from);
        (high - low) / self.size[axis] as f64
    }

    /// Centre of the voxels at `index` along `axis`, in metres.
    pub fn centre(&self, axis: usize, index: usize) -> f64 {
        f64::from(self.bounds[axis][0]) + (index as f64 + 0.5) * self.edge(axis)
    }

    /// Index along `axis` of the voxels that contain `metres`; none outside.
    pub fn index(&self, axis: usize, metres: f64) -> Option<usize> {
        let index = ((metres - f64::from(self.bounds[axis][0])) / self.edge(axis)).floor();
        (index >= 0.0 && index < self.size[axis] as f64).then_some(index as usize)
    }
}

/// The frame of reference of a grid.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Axes {
    /// The lidar's, in which networks see.
    #[default]
    Lidar,
    /// The vehicle's, in which the lidar is mounted somewhere.
    Ego,
}

/// The ego vehicle's forward direction in the lidar frame, as (x, y), judged by the bounds of the grid.
///
/// A grid that starts at x = 0 and is symmetric in y lies ahead of a vehicle that drives along +x (SemanticKITTI). Any other
/// is taken to lie around a vehicle that drives along +y, as nuScenes mounts its lidar. `bounds` are [min, max] metres of
/// x, y and z.
pub fn forward_of(bounds: &[[f32; 2]; 3]) -> [f32; 2] {
    let [x, y] = [bounds[0], bounds[1]];
    let slack = 1e-3 * (y[1] - y[0]).abs();
    if x[0].abs() <= slack && x[1] > slack && (y[0] + y[1]).abs() <= slack { [1.0, 0.0] } else { [0.0, 1.0] }
}

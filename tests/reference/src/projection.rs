//! The matrices: sample points projected by a shader, their pixels sorted into rows here.

use crate::gpu::Gpu;
use crate::network::Matrices;
use crate::ops::{self, Matrix};
use std::collections::BTreeSet;
use voxcast::Network;
use voxcast::network::Sampling;

/// Both matrices of the three levels for `lidar2img`.
pub fn matrices(gpu: &Gpu, network: &Network, lidar2img: &[[f32; 16]]) -> Matrices {
    [0, 1, 2].map(|level| {
        let (grid, n) = (network.grids[level], network.samples[level]);
        let axes = [0, 1, 2].map(|a| axis(network.sampling, network.bounds[a], grid[a] * n));
        let hits = ops::project(gpu, &axes, lidar2img, network.image, network.strides[level]);
        let [px, py, pz] = [0, 1, 2].map(|a| axes[a].len());
        let mut voxels = vec![BTreeSet::new(); grid.iter().product()];
        let mut cells = vec![BTreeSet::new(); grid[0] * grid[1]];
        for (i, &hit) in hits.iter().enumerate().filter(|(_, hit)| **hit > 0) {
            let [x, y, z] = [i / (pz * py) % px / n, i / pz % py / n, i % pz / n];
            voxels[(x * grid[1] + y) * grid[2] + z].insert(hit);
            cells[x * grid[1] + y].insert(hit);
        }
        [csr(&voxels), csr(&cells)]
    })
}

fn csr(rows: &[BTreeSet<u32>]) -> Matrix {
    let mut matrix = Matrix { ptr: vec![0], col: vec![] };
    for row in rows {
        matrix.col.extend(row);
        matrix.ptr.push(matrix.col.len() as u32);
    }
    matrix
}

/// Sample coordinates, rounded once to f32: as `torch.linspace` counts, from both ends with a step that is rounded; or the
/// centres of equal cells.
fn axis(sampling: Sampling, [low, high]: [f32; 2], points: usize) -> Vec<f32> {
    let (lo, hi) = (f64::from(low), f64::from(high));
    let step = f64::from((high - low) / points.saturating_sub(1).max(1) as f32);
    (0..points)
        .map(|i| match sampling {
            Sampling::Centres => (lo + (hi - lo) * (i as f64 + 0.5) / points as f64) as f32,
            Sampling::Linspace if points == 1 || i < points / 2 => (lo + step * i as f64) as f32,
            Sampling::Linspace => (hi - step * (points - 1 - i) as f64) as f32,
        })
        .collect()
}

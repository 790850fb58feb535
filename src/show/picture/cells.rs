//! The voxels as both views need them: which are drawn, where they lie, and what stands between a point and the sun.

use super::{Occupancy, Palette};
use glam::Vec3;

/// Lidar height above the road where the grid does not show one: that of nuScenes and KITTI within a few centimetres.
const LIDAR_HEIGHT: f32 = 1.8;

/// Drawn voxels of an occupancy, in its own row-major order.
pub(crate) struct Cells {
    /// Class of each voxel; 0 where nothing is drawn.
    pub(crate) cells: Vec<u8>,
    /// Whether no camera sees a voxel; empty if that is not known.
    unseen: Vec<bool>,
    pub(crate) size: [usize; 3],
    /// Corner of voxel (0, 0, 0) in metres.
    pub(crate) low: Vec3,
    /// Edge lengths of a voxel in metres.
    pub(crate) step: Vec3,
    /// Unit vector ahead in the plane.
    pub(crate) ahead: Vec3,
    /// Layers from 0 in which some voxel is drawn.
    pub(crate) top: usize,
    /// Direction to the sun: from behind and the left of the vehicle.
    pub(crate) sun: Vec3,
    /// Per column, x slowest: layers above which no ray to the sun meets a voxel; empty where that takes too long to find.
    sunlit: Vec<f32>,
}

/// How far rays to the sun may lean away from [`Cells::sun`], in each direction of the plane.
pub(crate) const SUN_DISC: f32 = 0.045;

/// Most steps that the search for sunlit layers may take.
const MAX_SEARCH: usize = 1 << 26;

impl Cells {
    pub(crate) fn new(occupancy: &Occupancy<'_>, palette: &Palette) -> Self {
        let size = occupancy.grid.size;
        let cells: Vec<u8> = occupancy.classes.iter().map(|&c| if palette.is_drawn(c) { c } else { 0 }).collect();
        let unseen = (0..occupancy.support.len()).map(|i| occupancy.is_unseen(i)).collect();
        let layers = cells.chunks_exact(size[2]);
        let top = layers.filter_map(|column| column.iter().rposition(|&c| c != 0)).max().map_or(0, |z| z + 1);
        let bounds = occupancy.grid.bounds;
        let axis = |k: usize| Vec3::from_array(bounds.map(|b| b[k]));
        let low = axis(0);
        let step = (axis(1) - low) / Vec3::from_array(size.map(|n| n as f32));
        let ahead = Vec3::new(occupancy.forward[0], occupancy.forward[1], 0.0);
        let sun = (left_of(ahead) * 0.52 - ahead * 0.40 + Vec3::Z * 0.82).normalize();
        let mut grid = Self { cells, unseen, size, low, step, ahead, top, sun, sunlit: Vec::new() };
        grid.sunlit = grid.find_sunlit();
        grid
    }

    /// The highest layer that shades each column, whatever the exact ray: the top of every column that a ray can cross, less
    /// what the ray has climbed at least by then.
    fn find_sunlit(&self) -> Vec<f32> {
        let [nx, ny, nz] = self.size;
        // Cells per layer that a ray crosses along x and y, and the least and most of it over the sun's disc.
        let cells = |k: usize, sun: f32| sun / self.step[k] * self.step.z / self.sun.z;
        let range = |k: usize| [cells(k, self.sun[k] - 1.5 * SUN_DISC), cells(k, self.sun[k] + 1.5 * SUN_DISC)];
        let reach = |k: usize| range(k).map(|c| (c * self.top as f32 + c.signum()).round() as i32);
        let (x, y) = (reach(0), reach(1));
        let count = (x[1].abs_diff(x[0]) as usize + x[0].unsigned_abs() as usize + 2)
            * (y[1].abs_diff(y[0]) as usize + y[0].unsigned_abs() as usize + 2);
        if count.saturating_mul(nx * ny) > MAX_SEARCH {
            return Vec::new();
        }
        // Layers climbed when the ray can first be in a cell `i` away, and when it must have left it.
        let span = |k: usize, i: i32| {
            let [a, b] = range(k);
            let (near, far) = ((i.abs() - 1).max(0) as f32, (i.abs() + 1) as f32);
            let towards = if i < 0 { -a.min(b) } else { a.max(b) };
            let slowest = if i < 0 { -a.max(b) } else { a.min(b) };
            match i {
                0 => [0.0, if a * b > 0.0 { 1.0 / a.abs().min(b.abs()) } else { f32::INFINITY }],
                _ if towards <= 0.0 => [f32::INFINITY, 0.0],
                _ => [near / towards, if slowest > 0.0 { far / slowest } else { f32::INFINITY }],
            }
        };
        let mut steps = Vec::new();
        for i in x[0].min(0) - 1..=x[1].max(0) + 1 {
            for j in y[0].min(0) - 1..=y[1].max(0) + 1 {
                let ([a, b], [c, d]) = (span(0, i), span(1, j));
                let first = a.max(c);
                if first <= b.min(d) && first < self.top as f32 {
                    steps.push((i, j, first * 0.999 - 1e-3));
                }
            }
        }
        let tops: Vec<f32> = self
            .cells
            .chunks_exact(nz)
            .map(|c| c.iter().rposition(|&v| v != 0).map_or(0.0, |z| (z + 1) as f32))
            .collect();
        let mut sunlit = Vec::with_capacity(nx * ny);
        for x in 0..nx as i32 {
            for y in 0..ny as i32 {
                let inside = |i: i32, j: i32| (0..nx as i32).contains(&i) && (0..ny as i32).contains(&j);
                let shade = steps.iter().filter(|s| inside(x + s.0, y + s.1));
                let shade = shade.map(|s| tops[(x + s.0) as usize * ny + (y + s.1) as usize] - s.2);
                sunlit.push(shade.fold(0.0, f32::max));
            }
        }
        sunlit
    }

    /// Whether it is known that no camera sees voxel `index`.
    pub(crate) fn is_unseen(&self, index: usize) -> bool {
        self.unseen.get(index) == Some(&true)
    }

    pub(crate) fn high(&self) -> Vec3 {
        self.low + self.step * Vec3::from_array(self.size.map(|n| n as f32))
    }

    /// Unit vector to the left in the plane.
    pub(crate) fn left(&self) -> Vec3 {
        left_of(self.ahead)
    }

    /// Class at signed coordinates, 0 outside.
    pub(crate) fn at(&self, v: [i32; 3]) -> u8 {
        if (0..3).any(|k| v[k] < 0 || v[k] as usize >= self.size[k]) {
            return 0;
        }
        self.cells[(v[0] as usize * self.size[1] + v[1] as usize) * self.size[2] + v[2] as usize]
    }

    /// Whether a drawn voxel lies between `point` (metres) and the sun; the voxel that holds `point` does not count.
    pub(crate) fn is_shaded(&self, point: Vec3, sun: Vec3) -> bool {
        let start = (point - self.low) / self.step;
        let along = sun / self.step;
        if start.x >= 0.0 && start.y >= 0.0 && (start.x as usize) < self.size[0] && (start.y as usize) < self.size[1] {
            let column = start.x as usize * self.size[1] + start.y as usize;
            if self.sunlit.get(column).is_some_and(|&z| start.z >= z) {
                return false;
            }
        }
        let mut cell = start.floor().to_array().map(|v| v as i32);
        let (mut next, mut delta, mut go) = ([f32::INFINITY; 3], [f32::INFINITY; 3], [0i32; 3]);
        for k in 0..3 {
            if along[k] != 0.0 {
                go[k] = if along[k] > 0.0 { 1 } else { -1 };
                delta[k] = 1.0 / along[k].abs();
                let border = if along[k] > 0.0 { cell[k] as f32 + 1.0 - start[k] } else { start[k] - cell[k] as f32 };
                next[k] = border * delta[k];
            }
        }
        loop {
            let k = if next[0] < next[1] && next[0] < next[2] { 0 } else { 1 + usize::from(next[2] <= next[1]) };
            cell[k] += go[k];
            next[k] += delta[k];
            let limit = if k == 2 { self.top as i32 } else { self.size[k] as i32 };
            // The sun stands above: a ray that has left the drawn layers, or a side that it moves away from, is free.
            if go[k] == 0 || (go[k] > 0 && cell[k] >= limit) || (go[k] < 0 && cell[k] < 0) {
                return false;
            }
            if self.at(cell) != 0 {
                return true;
            }
        }
    }

    /// Height in metres of the plate on which the voxels stand: under all but stray ones.
    pub(crate) fn floor(&self) -> f32 {
        let mut layers = vec![0usize; self.size[2]];
        for column in self.cells.chunks_exact(self.size[2]) {
            for (count, &cell) in layers.iter_mut().zip(column) {
                *count += usize::from(cell != 0);
            }
        }
        let total: usize = layers.iter().sum();
        let mut below = 0;
        for (z, count) in layers.iter().enumerate() {
            below += count;
            if below * 200 > total {
                return self.low.z + self.step.z * z as f32;
            }
        }
        self.road()
    }

    /// Whether the vehicle, at the origin of the frame, stands in the grid or close to it.
    pub(crate) fn holds_vehicle(&self) -> bool {
        let (low, high) = (self.low - 6.0, self.high() + 6.0);
        low.x < 0.0 && low.y < 0.0 && high.x > 0.0 && high.y > 0.0
    }

    /// Height of the road under the vehicle in metres: the median top of the lowest voxels of the columns around it.
    pub(crate) fn road(&self) -> f32 {
        let mut tops = Vec::new();
        for (index, column) in self.cells.chunks_exact(self.size[2]).enumerate() {
            let (x, y) = (index / self.size[1], index % self.size[1]);
            let middle = self.low + self.step * Vec3::new(x as f32 + 0.5, y as f32 + 0.5, 0.0);
            if middle.x * middle.x + middle.y * middle.y < 36.0 {
                tops.extend(column.iter().position(|&c| c != 0).map(|z| z + 1));
            }
        }
        tops.sort_unstable();
        match tops.get(tops.len() / 2) {
            Some(&z) => self.low.z + self.step.z * z as f32,
            None => (-LIDAR_HEIGHT).clamp(self.low.z, self.high().z),
        }
    }
}

fn left_of(ahead: Vec3) -> Vec3 {
    Vec3::new(-ahead.y, ahead.x, 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::random::Random;
    use crate::network::Grid;

    #[test]
    fn the_search_for_sunlit_layers_changes_no_shadow() {
        let mut random = Random::new(5);
        for (forward, size) in [([0.0, 1.0], [12, 9, 6]), ([1.0, 0.0], [9, 14, 8]), ([0.6, -0.8], [10, 10, 7])] {
            let classes: Vec<u8> =
                (0..size.iter().product::<usize>()).map(|_| u8::from(random.below(9) == 0)).collect();
            let bounds = [[-3.0, 3.0], [-2.0, 4.0], [-1.0, 2.0]];
            let occupancy = Occupancy::new("", &classes, Grid::new(size, bounds), forward).unwrap();
            let mut grid = Cells::new(&occupancy, &Palette::of(2));
            let found = std::mem::take(&mut grid.sunlit);
            let mut shaded = 0;
            for _ in 0..20_000 {
                let at = |k: usize, random: &mut Random| random.range(bounds[k][0], bounds[k][1]);
                let point = Vec3::new(at(0, &mut random), at(1, &mut random), at(2, &mut random));
                let lean = [0; 2].map(|_| random.range(-SUN_DISC, SUN_DISC));
                let sun = grid.sun + grid.ahead * lean[0] + grid.left() * lean[1];
                let expected = grid.is_shaded(point, sun);
                grid.sunlit.clone_from(&found);
                assert_eq!(grid.is_shaded(point, sun), expected, "{point} towards {sun}");
                grid.sunlit.clear();
                shaded += usize::from(expected);
            }
            assert!((1000..19_000).contains(&shaded), "{shaded} of 20000 points are shaded");
            assert!(found.iter().any(|&z| z < grid.top as f32), "the search tells nothing");
        }
    }
}

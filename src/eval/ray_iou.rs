//! RayIoU: agreement of what rays of a lidar would hit (SparseOcc, arXiv 2312.17118).
//!
//! From each origin a ray goes out in each of the directions of [`directions`], through the labels and through the
//! prediction, to the first voxel that is not empty. A ray whose label says nothing, because it hits no labelled voxel or
//! meets an ignored one first, does not count. Of the others, a hit is one of the same class whose distance differs by less
//! than a threshold; RayIoU of a class is hits / (labelled + predicted - hits). Misses of the prediction are no class.

use crate::eval::dataset::{Grid, is_class};

/// Thresholds in metres.
pub const THRESHOLDS: [f64; 3] = [1.0, 2.0, 4.0];

/// Counts of rays by class; sums of frames are those of the set.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RayCounts {
    /// Rays that hit the class in the labels.
    pub labelled: Vec<u64>,
    /// Rays that hit the class in the prediction.
    pub predicted: Vec<u64>,
    /// For each threshold, rays that hit the class in both, less than that apart.
    pub hits: [Vec<u64>; 3],
}

impl RayCounts {
    /// Zeros.
    pub fn new(classes: usize) -> Self {
        let zeros = || vec![0; classes];
        Self { labelled: zeros(), predicted: zeros(), hits: [zeros(), zeros(), zeros()] }
    }

    /// Adds other counts of as many classes.
    pub fn merge(&mut self, other: &RayCounts) {
        let add = |own: &mut Vec<u64>, other: &[u64]| own.iter_mut().zip(other).for_each(|(own, n)| *own += n);
        add(&mut self.labelled, &other.labelled);
        add(&mut self.predicted, &other.predicted);
        self.hits.iter_mut().zip(&other.hits).for_each(|(own, other)| add(own, other));
    }

    /// RayIoU of a class at threshold `index`; none where no ray hits the class.
    pub fn class_iou(&self, index: usize, class: usize) -> Option<f64> {
        let hits = self.hits[index][class];
        let union = self.labelled[class] + self.predicted[class] - hits;
        (union > 0).then(|| hits as f64 / union as f64)
    }

    /// The mean at threshold `index` over the classes from 1 on that have one.
    pub fn mean(&self, index: usize) -> Option<f64> {
        let ious: Vec<f64> = (1..self.labelled.len()).filter_map(|class| self.class_iou(index, class)).collect();
        (!ious.is_empty()).then(|| ious.iter().sum::<f64>() / ious.len() as f64)
    }

    /// RayIoU: the mean over thresholds of the mean over classes. A class has one at all thresholds or at none.
    pub fn ray_iou(&self) -> Option<f64> {
        let means: Option<Vec<f64>> = (0..THRESHOLDS.len()).map(|index| self.mean(index)).collect();
        means.map(|means| means.iter().sum::<f64>() / means.len() as f64)
    }
}

/// Unit vectors of the rays: 360 azimuths one degree apart at each pitch. Pitches look down on the ground 1 to 10 heights
/// ahead, then up in the last of these steps until they pass 0.21 rad, the upper edge of nuScenes' lidar.
pub fn directions() -> Vec<[f64; 3]> {
    let mut pitches: Vec<f64> = (1..=10).map(|k| f64::from(k).atan() - std::f64::consts::FRAC_PI_2).collect();
    let step = pitches[9] - pitches[8];
    while pitches[pitches.len() - 1] < 0.21 {
        pitches.push(pitches[pitches.len() - 1] + step);
    }
    let ray = |pitch: f64, degrees: u32| {
        let azimuth = f64::from(degrees).to_radians();
        [pitch.cos() * azimuth.cos(), pitch.cos() * azimuth.sin(), pitch.sin()]
    };
    pitches.into_iter().flat_map(|pitch| (0..360).map(move |degrees| ray(pitch, degrees))).collect()
}

/// Counts the rays of a frame. `labels` and `prediction` lie on `grid`; `origins` are places in its metres, and those
/// outside see the grid from outside.
///
/// # Panics
/// If labels or prediction have not the grid's voxels, or a class that is not below `classes`.
pub fn count_rays(
    grid: &Grid,
    classes: usize,
    labels: &[u8],
    prediction: &[u8],
    origins: &[[f64; 3]],
    directions: &[[f64; 3]],
) -> RayCounts {
    assert!(labels.len() == grid.voxels() && prediction.len() == grid.voxels(), "voxels of the grid");
    let mut counts = RayCounts::new(classes);
    for origin in origins {
        for direction in directions {
            let Some((truth, distance)) = first_hit(grid, labels, origin, direction) else { continue };
            if !is_class(truth) {
                continue;
            }
            counts.labelled[usize::from(truth)] += 1;
            let Some((class, at)) = first_hit(grid, prediction, origin, direction) else { continue };
            counts.predicted[usize::from(class)] += 1;
            if class == truth {
                for (hits, threshold) in counts.hits.iter_mut().zip(THRESHOLDS) {
                    hits[usize::from(class)] += u64::from((at - distance).abs() < threshold);
                }
            }
        }
    }
    counts
}

/// The first voxel along a ray that is not empty: its class, and the metres to where the ray enters it (0 inside).
fn first_hit(grid: &Grid, classes: &[u8], origin: &[f64; 3], direction: &[f64; 3]) -> Option<(u8, f64)> {
    let (mut from, mut to) = (0.0f64, f64::INFINITY);
    for axis in 0..3 {
        let [low, high] = grid.bounds[axis].map(|bound| f64::from(bound) - origin[axis]);
        if direction[axis] == 0.0 {
            if low > 0.0 || high <= 0.0 {
                return None;
            }
            continue;
        }
        let (a, b) = (low / direction[axis], high / direction[axis]);
        from = from.max(a.min(b));
        to = to.min(a.max(b));
    }
    if from >= to {
        return None;
    }
    // Amanatides and Woo: from border to border, always across the nearest one.
    let mut index = [0usize; 3];
    let mut next = [f64::INFINITY; 3];
    let mut step = [f64::INFINITY; 3];
    for axis in 0..3 {
        let low = f64::from(grid.bounds[axis][0]);
        let edge = grid.edge(axis);
        let place = (origin[axis] + from * direction[axis] - low) / edge;
        index[axis] = (place.floor().max(0.0) as usize).min(grid.size[axis] - 1);
        if direction[axis] != 0.0 {
            let border = index[axis] + usize::from(direction[axis] > 0.0);
            next[axis] = (low + border as f64 * edge - origin[axis]) / direction[axis];
            step[axis] = edge / direction[axis].abs();
        }
    }
    let mut distance = from;
    loop {
        let class = classes[(index[0] * grid.size[1] + index[1]) * grid.size[2] + index[2]];
        if class != 0 {
            return Some((class, distance));
        }
        let axis = (0..3).min_by(|&a, &b| next[a].total_cmp(&next[b])).unwrap_or(0);
        distance = distance.max(next[axis]);
        next[axis] += step[axis];
        let moved = index[axis].checked_add_signed(if direction[axis] > 0.0 { 1 } else { -1 });
        index[axis] = moved.filter(|&i| i < grid.size[axis])?;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::dataset::Axes;
    use crate::eval::dataset::IGNORED;

    const GRID: Grid = Grid { size: [8, 4, 2], bounds: [[0.0, 8.0], [-2.0, 2.0], [-1.0, 1.0]], axes: Axes::Lidar };

    fn at([x, y, z]: [usize; 3]) -> usize {
        (x * 4 + y) * 2 + z
    }

    #[test]
    fn rays_of_the_lidar() {
        let rays = directions();
        assert_eq!(rays.len() % 360, 0);
        assert!(rays.iter().all(|[x, y, z]| (x * x + y * y + z * z - 1.0).abs() < 1e-12));
        // The first looks down at 45 degrees, the tenth row reaches the ground ten heights ahead.
        let slope = |row: usize| -rays[row * 360][0] / rays[row * 360][2];
        assert!((slope(0) - 1.0).abs() < 1e-12 && (slope(9) - 10.0).abs() < 1e-12);
        let last = rays[rays.len() - 1][2].asin();
        assert!((0.21..0.22).contains(&last), "{last}");
    }

    #[test]
    fn distances_by_hand() {
        let mut classes = vec![0; GRID.voxels()];
        classes[at([5, 2, 1])] = 3;
        let hit = |origin, direction| first_hit(&GRID, &classes, &origin, &direction);
        assert_eq!(hit([0.5, 0.5, 0.5], [1.0, 0.0, 0.0]), Some((3, 4.5)));
        assert_eq!(hit([-2.0, 0.5, 0.5], [1.0, 0.0, 0.0]), Some((3, 7.0)), "from outside");
        assert_eq!(hit([7.5, 0.5, 0.5], [-1.0, 0.0, 0.0]), Some((3, 1.5)), "backwards");
        assert_eq!(hit([5.5, 0.5, 0.5], [0.0, 1.0, 0.0]), Some((3, 0.0)), "from inside");
        assert_eq!(hit([0.5, -0.5, 0.5], [1.0, 0.0, 0.0]), None);
        assert_eq!(hit([-2.0, 0.5, 0.5], [-1.0, 0.0, 0.0]), None, "away");
        let diagonal = [0.5f64.sqrt(), 0.5f64.sqrt(), 0.0];
        let (class, distance) = hit([3.5, -1.0, 0.5], diagonal).expect("a hit");
        // It crosses y = 0 at x = 4.5 and x = 5 at y = 0.5.
        assert!(class == 3 && (distance - 1.5 * 2f64.sqrt()).abs() < 1e-12, "{distance}");
    }

    #[test]
    fn walking_meets_what_small_steps_meet() {
        let mut random = crate::base::random::Random::new(5);
        let classes: Vec<u8> = (0..GRID.voxels()).map(|_| u8::from(random.range(0.0, 1.0) < 0.1)).collect();
        for ray in directions().iter().step_by(37) {
            let origin = [4.2, 0.3, 0.1];
            let slow = (0..20_000).map(|i| f64::from(i) * 5e-4).find(|t| {
                let index: [f64; 3] = std::array::from_fn(|a| {
                    ((origin[a] + t * ray[a] - f64::from(GRID.bounds[a][0])) / GRID.edge(a)).floor()
                });
                let inside = (0..3).all(|a| index[a] >= 0.0 && index[a] < GRID.size[a] as f64);
                inside && classes[at(index.map(|i| i as usize))] != 0
            });
            let fast = first_hit(&GRID, &classes, &origin, ray).map(|(_, distance)| distance);
            match (fast, slow) {
                (None, None) => {}
                (Some(fast), Some(slow)) => assert!((fast - slow).abs() < 1e-3, "{ray:?}: {fast} {slow}"),
                // Steps may miss a corner.
                (fast, slow) => panic!("{ray:?}: {fast:?}, by small steps {slow:?}"),
            }
        }
    }

    #[test]
    fn counts_by_hand() {
        let (mut labels, mut prediction) = (vec![0; GRID.voxels()], vec![0; GRID.voxels()]);
        let ray = [[1.0, 0.0, 0.0]];
        let count =
            |labels: &[u8], prediction: &[u8]| count_rays(&GRID, 4, labels, prediction, &[[0.5, 0.5, 0.5]], &ray);
        labels[at([5, 2, 1])] = 3;
        assert_eq!(count(&labels, &labels).ray_iou(), Some(1.0));
        // Two metres too near.
        prediction[at([3, 2, 1])] = 3;
        let near = count(&labels, &prediction);
        assert_eq!([0, 1, 2].map(|i| near.mean(i)), [Some(0.0), Some(0.0), Some(1.0)], "2 m is not less than 2 m");
        assert_eq!(near.ray_iou(), Some(1.0 / 3.0));
        prediction[at([3, 2, 1])] = 2;
        let wrong = count(&labels, &prediction);
        assert_eq!((wrong.labelled[3], wrong.predicted[2], wrong.ray_iou()), (1, 1, Some(0.0)));
        // Nothing is known about what lies behind an ignored voxel.
        labels[at([2, 2, 1])] = IGNORED;
        assert_eq!(count(&labels, &prediction), RayCounts::new(4));
    }
}

//! What fills the voxels of a grid, and which of them the cameras see.

use super::camera::Pinhole;
use super::objects::class;
use super::render::CameraView;
use super::solid::{Object, Part};
use super::world::World;
use crate::network::Network;
use glam::{Vec2, Vec3};

/// Points per axis that are asked in every voxel.
const POINTS: usize = 4;

/// Points of a voxel that vehicles, buildings and plants must fill: a sixth of it.
const SOLID: u16 = 11;

/// Points that people, cones and other small things must fill: one upright of them.
const SMALL: u16 = 4;

/// Classes of which a voxel is rarely full.
const SMALL_CLASSES: [u8; 5] =
    [class::BARRIER, class::BICYCLE, class::MOTORCYCLE, class::PEDESTRIAN, class::TRAFFIC_CONE];

/// The output grid of a network, in vehicle coordinates.
pub(super) struct VehicleGrid {
    size: [usize; 3],
    low: Vec3,
    edge: Vec3,
    /// The vehicle's direction in the lidar frame.
    forward: Vec2,
}

impl VehicleGrid {
    pub(super) fn new(network: &Network, forward: [f32; 2]) -> Self {
        let low = Vec3::from_array(std::array::from_fn(|a| network.bounds[a][0]));
        let edge = Vec3::from_array(network.voxel_size());
        Self { size: network.output_grid(), low, edge, forward: Vec2::from_array(forward) }
    }

    fn voxels(&self) -> usize {
        self.size.iter().product()
    }

    /// From the lidar frame to vehicle coordinates.
    fn vehicle(&self, v: Vec3) -> Vec3 {
        let Vec2 { x, y } = self.forward;
        Vec3::new(v.x * x + v.y * y, v.y * x - v.x * y, v.z)
    }

    /// From vehicle coordinates to the lidar frame.
    fn lidar(&self, v: Vec3) -> Vec3 {
        let Vec2 { x, y } = self.forward;
        Vec3::new(v.x * x - v.y * y, v.x * y + v.y * x, v.z)
    }
}

/// Points of one voxel that things of a class fill.
struct Fill {
    voxel: u32,
    class: u8,
    points: u16,
}

/// Class of every voxel, `[x, y, z]`: of what fills enough of it, else of the ground that passes through it, else 0.
///
/// In each voxel `POINTS`^3 points are asked. Solids are filled. Thin things are taken to be as thick as the points are
/// apart, so that none slips through.
pub(super) fn voxels(world: &World, grid: &VehicleGrid) -> Vec<u8> {
    let mut classes = vec![0u8; grid.voxels()];
    ground(world, grid, &mut classes);
    let mut fills = Vec::new();
    for object in &world.objects {
        fill(world, grid, object, &mut fills);
    }
    // Of several classes in a voxel the one with most points wins, of equal ones the lower.
    fills.sort_unstable_by_key(|f| (f.voxel, f.class));
    let mut best = (0, 0u16);
    for same in fills.chunk_by(|a, b| (a.voxel, a.class) == (b.voxel, b.class)) {
        let (voxel, class) = (same[0].voxel, same[0].class);
        let points = same.iter().map(|f| f.points).sum();
        let enough = if SMALL_CLASSES.contains(&class) { SMALL } else { SOLID };
        if best.0 != voxel {
            best = (voxel, 0);
        }
        if points >= enough && points > best.1 {
            best.1 = points;
            classes[voxel as usize] = class;
        }
    }
    classes
}

/// The surface of the ground: in every column of points the voxel that it passes through, by majority.
fn ground(world: &World, grid: &VehicleGrid, classes: &mut [u8]) {
    let [nx, ny, nz] = grid.size;
    let step = grid.edge / POINTS as f32;
    for x in 0..nx {
        for y in 0..ny {
            let mut votes = [(0usize, 0u8); POINTS * POINTS];
            for (n, vote) in votes.iter_mut().enumerate() {
                let at = Vec3::new((x * POINTS + n / POINTS) as f32 + 0.5, (y * POINTS + n % POINTS) as f32 + 0.5, 0.0);
                let lidar = grid.low.with_z(0.0) + at * step;
                let at = world.placed(grid.vehicle(lidar));
                let height = world.street.height(at.truncate()) - at.z;
                let z = ((height - grid.low.z) / grid.edge.z).floor();
                *vote = if z >= 0.0 && z < nz as f32 { (z as usize, world.ground(at.truncate())) } else { (nz, 0) };
            }
            votes.sort_unstable();
            let mut most = [0usize; 1];
            let mut last = nz;
            for same in votes.chunk_by(|a, b| a == b) {
                let (z, class) = same[0];
                if z != last {
                    (most, last) = ([0], z);
                }
                if z < nz && same.len() > most[0] {
                    most[0] = same.len();
                    classes[(x * ny + y) * nz + z] = class;
                }
            }
        }
    }
}

/// Appends the points that an object fills.
fn fill(world: &World, grid: &VehicleGrid, object: &Object, fills: &mut Vec<Fill>) {
    let step = grid.edge / POINTS as f32;
    let thick = step.max_element();
    let [nx, ny, nz] = grid.size;
    let points = [nx * POINTS, ny * POINTS, nz * POINTS];
    // The object's box, turned into the grid.
    let [low, high] = object.bounds();
    let origin = world.placed(Vec3::ZERO);
    let Vec2 { x: c, y: s } = world.ego.1;
    let corner = |n: usize| {
        let at = Vec3::new([low.x, high.x][n & 1], [low.y, high.y][n >> 1 & 1], low.z) - origin;
        grid.lidar(Vec3::new(c * at.x + s * at.y, c * at.y - s * at.x, at.z))
    };
    let corners = [0, 1, 2, 3].map(corner);
    let near = corners.iter().fold(Vec3::INFINITY, |m, &v| m.min(v)) - Vec3::splat(thick);
    let far = corners.iter().fold(Vec3::NEG_INFINITY, |m, &v| m.max(v))
        + Vec3::new(0.0, 0.0, high.z - low.z)
        + Vec3::splat(thick);
    let range = |axis: usize| {
        let at = |v: f32| ((v - grid.low[axis]) / step[axis]).clamp(0.0, points[axis] as f32) as usize;
        at(near[axis])..at(far[axis])
    };
    let mut here: Vec<&Part> = Vec::with_capacity(object.parts.len());
    for x in range(0) {
        for y in range(1) {
            let at = |z: usize| grid.low + (Vec3::new(x as f32, y as f32, z as f32) + 0.5) * step;
            // Along a column only the height changes.
            let base = object.inwards(world.placed(grid.vehicle(at(0))) - object.at);
            let beside = |p: &Part| ((base - p.centre).abs() - p.half).truncate().max_element() > thick;
            here.clear();
            here.extend(object.parts.iter().filter(|p| !beside(p)));
            if here.is_empty() {
                continue;
            }
            let (mut last, mut count) = (nz, 0);
            let mut close = |z: usize, count: u16| {
                if count > 0 {
                    let voxel = ((x / POINTS * ny + y / POINTS) * nz + z) as u32;
                    fills.push(Fill { voxel, class: object.class, points: count });
                }
            };
            for z in range(2) {
                if z / POINTS != last {
                    close(last, count);
                    (last, count) = (z / POINTS, 0);
                }
                let point = base + Vec3::Z * (z as f32 * step.z);
                count += u16::from(here.iter().any(|p| p.contains(point, thick)));
            }
            close(last, count);
        }
    }
}

/// Rays that are followed together: two vectors' worth, since each step waits for the one before.
const LANES: usize = 16;

/// Per voxel whether a camera sees it: whether the ray of one of its pixels goes through it or ends on it.
pub(super) fn visible(grid: &VehicleGrid, cameras: &[Pinhole], views: &[CameraView]) -> Vec<u8> {
    let mut seen = vec![0u8; grid.voxels()];
    for (camera, view) in cameras.iter().zip(views) {
        let [height, width] = camera.size;
        let origin = grid.lidar(camera.at.as_vec3());
        // Large images need not be asked pixel by pixel.
        let stride = (width / 352).max(1);
        for v in (0..height).step_by(stride) {
            let mut walks = Walks::new(grid, origin);
            for u in (0..width).step_by(stride) {
                let ray = grid.lidar(camera.ray(u as f64, v as f64).as_vec3());
                // A little farther than the surface, which may lie on the border of two voxels.
                let depth = view.depths[v * width + u] + 0.02;
                walks.add(ray, depth, &mut seen);
            }
            walks.finish(&mut seen);
        }
    }
    seen
}

/// Rays from one place on their way through a grid, lane by lane.
struct Walks<'a> {
    grid: &'a VehicleGrid,
    /// In voxels, as everything here.
    origin: Vec3,
    count: usize,
    far: [f32; LANES],
    voxel: [i32; LANES],
    axes: [Lanes; 3],
}

/// What the rays do along one axis.
#[derive(Clone, Copy, Default)]
struct Lanes {
    inverse: [f32; LANES],
    /// The border through which each ray leaves its voxel, the next one from there, and how many there are until the grid ends.
    border: [f32; LANES],
    step: [f32; LANES],
    left: [i32; LANES],
    stride: [i32; LANES],
}

impl<'a> Walks<'a> {
    fn new(grid: &'a VehicleGrid, origin: Vec3) -> Self {
        let origin = (origin - grid.low) / grid.edge;
        Self { grid, origin, count: 0, far: [0.0; LANES], voxel: [0; LANES], axes: [Lanes::default(); 3] }
    }

    /// Adds a ray, which goes on for `limit` times its length, and follows all once there are enough.
    fn add(&mut self, ray: Vec3, limit: f32, seen: &mut [u8]) {
        let size = Vec3::from_array(self.grid.size.map(|n| n as f32));
        let ray = ray / self.grid.edge;
        let inverse = ray.recip();
        let Some((near, far)) = super::solid::slab(Vec3::ZERO, size, self.origin, inverse) else { return };
        let far = far.min(limit);
        if near > far {
            return;
        }
        let start = (self.origin + ray * near).floor().clamp(Vec3::ZERO, size - 1.0);
        let lane = self.count;
        self.far[lane] = far;
        self.voxel[lane] = 0;
        let mut stride = self.grid.voxels() as i32;
        for (axis, lanes) in self.axes.iter_mut().enumerate() {
            let back = ray[axis] < 0.0;
            let (here, count) = (start[axis] as i32, self.grid.size[axis] as i32);
            stride /= count;
            self.voxel[lane] += here * stride;
            lanes.inverse[lane] = inverse[axis];
            lanes.border[lane] = start[axis] + if back { 0.0 } else { 1.0 };
            lanes.step[lane] = if back { -1.0 } else { 1.0 };
            lanes.left[lane] = if back { here } else { count - 1 - here };
            lanes.stride[lane] = if back { -stride } else { stride };
        }
        self.count += 1;
        if self.count == LANES {
            self.finish(seen);
        }
    }

    /// Marks the voxels that the rays pass through, and forgets the rays.
    fn finish(&mut self, seen: &mut [u8]) {
        if self.count == 0 {
            return;
        }
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            #[target_feature(enable = "avx2")]
            fn wide(walks: &mut Walks, seen: &mut [u8]) {
                walks.follow(seen);
            }
            // SAFETY: the processor has AVX2.
            return unsafe { wide(self, seen) };
        }
        self.follow(seen);
    }

    /// What `finish` does, compiled for the instructions of its caller; there is no sum whose order they could change.
    #[inline(always)]
    fn follow(&mut self, seen: &mut [u8]) {
        // Lanes without a ray stay at a voxel that is marked anyway.
        for lane in self.count..LANES {
            (self.voxel[lane], self.far[lane]) = (self.voxel[0], f32::NEG_INFINITY);
        }
        self.count = 0;
        let origin = self.origin.to_array();
        loop {
            self.voxel.iter().for_each(|&voxel| seen[voxel as usize] = 1);
            let mut on = 0;
            for lane in 0..LANES {
                let exit = |axis: usize| {
                    let lanes = &self.axes[axis];
                    let distance = (lanes.border[lane] - origin[axis]) * lanes.inverse[lane];
                    // A ray along a border never leaves across it.
                    if distance.is_nan() { f32::INFINITY } else { distance }
                };
                let (x, y, z) = (exit(0), exit(1), exit(2));
                let first = x <= y && x <= z;
                let third = !first && z < y;
                let along = [first, !first && !third, third];
                let exit = if first {
                    x
                } else if third {
                    z
                } else {
                    y
                };
                let before_end = exit < self.far[lane];
                for (lanes, along) in self.axes.iter_mut().zip(along) {
                    let goes = i32::from(before_end && along && lanes.left[lane] != 0);
                    lanes.border[lane] += lanes.step[lane] * goes as f32;
                    lanes.left[lane] -= goes;
                    self.voxel[lane] += lanes.stride[lane] * goes;
                    on |= goes;
                }
            }
            if on == 0 {
                return;
            }
        }
    }
}

//! A small drawn street, seen by the ring of cameras that a network expects: something to run before there is any data.
//!
//! Only additions, multiplications, divisions and square roots take part, in a fixed order per pixel, so that a seed gives
//! the same bytes on every machine and thread count.

use crate::base::random::Random;
use crate::network::Network;
use crate::scene::{Image, Scene, forward_of};
use glam::{DVec3, Vec3};
use std::collections::BTreeMap;

/// The six cameras of nuScenes in its order: name, yaw in degrees (left is positive), place in metres ahead of, left of and
/// above the lidar, focal length over image width.
const RING: [(&str, f64, [f64; 3], f64); 6] = [
    ("CAM_FRONT", 0.0, [0.76, 0.0, -0.33], 0.79),
    ("CAM_FRONT_RIGHT", -56.0, [0.61, -0.49, -0.34], 0.79),
    ("CAM_FRONT_LEFT", 56.0, [0.58, 0.49, -0.33], 0.79),
    ("CAM_BACK", 180.0, [-0.91, 0.0, -0.26], 0.506),
    ("CAM_BACK_LEFT", 108.0, [0.09, 0.48, -0.25], 0.79),
    ("CAM_BACK_RIGHT", -108.0, [0.07, -0.48, -0.28], 0.79),
];

/// Metres from the ground to the lidar, the origin of its frame.
const LIDAR_HEIGHT: f32 = 1.84;

/// Metres from the ego vehicle to the middle of the street, which lies to its left.
const LANE: f32 = 1.75;

/// Half widths in metres: of the road, and out to the house side of the pavement.
const ROAD: f32 = 5.7;
const PAVEMENT: f32 = 9.0;

/// Metres ahead to the middle of the crossing street, and half its width.
const CROSSING: (f32, f32) = (27.0, 4.5);

/// Direction to the sun, nearly a unit vector, in street coordinates.
const SUN: Vec3 = Vec3::new(-0.60, 0.26, 0.755);

/// A seeded street scene: `network.cameras` images of exactly `network.image` pixels, with matching calibration.
///
/// Six cameras are mounted and named as in nuScenes, any other number looks around evenly, the first one ahead. The frame is
/// that of `network.bounds` (see [`forward_of`]). Equal arguments give equal bytes.
pub fn demo_scene(network: &Network, seed: u64) -> Scene {
    let street = Street::new(seed);
    let forward = forward_of(&network.bounds);
    let mut scene = Scene { names: Vec::new(), images: Vec::new(), lidar2img: Vec::new() };
    for index in 0..network.cameras {
        let camera = Pinhole::new(index, network);
        scene.names.push(camera.name.clone());
        scene.lidar2img.push(camera.lidar2img(forward));
        scene.images.push(camera.draw(&street));
    }
    scene
}

/// Sine and cosine of `degrees` from -360 to 360, to about 1e-15: Taylor series of an eighth of the angle, doubled thrice.
fn sin_cos(degrees: f64) -> (f64, f64) {
    let x = degrees * (std::f64::consts::PI / 180.0 / 8.0);
    let (mut sin, mut cos, mut term) = (0.0, 0.0, 1.0);
    for k in 0..24 {
        match k % 4 {
            0 => cos += term,
            1 => sin += term,
            2 => cos -= term,
            _ => sin -= term,
        }
        term *= x / f64::from(k + 1);
    }
    for _ in 0..3 {
        (sin, cos) = (2.0 * sin * cos, cos * cos - sin * sin);
    }
    (sin, cos)
}

/// A camera in vehicle coordinates: x ahead, y left, z up, the lidar at the origin.
struct Pinhole {
    name: String,
    at: DVec3,
    right: DVec3,
    ahead: DVec3,
    focal: f64,
    centre: [f64; 2],
    size: [usize; 2],
}

impl Pinhole {
    fn new(index: usize, network: &Network) -> Self {
        let [height, width] = network.image;
        let cameras = network.cameras;
        let (name, yaw, at, focal) = if cameras == RING.len() {
            let (name, yaw, at, focal) = RING[index];
            (name.to_owned(), yaw, at, focal)
        } else {
            // Neighbours overlap by a seventh; a single camera sees what KITTI's does.
            let half = if cameras == 1 { 41.0 } else { (180.0 / cameras as f64 * 1.15).min(60.0) };
            let (sin, cos) = sin_cos(half);
            (format!("CAM_{index}"), -360.0 * index as f64 / cameras as f64, [0.5, 0.0, -0.25], 0.5 * cos / sin)
        };
        let (sin, cos) = sin_cos(yaw);
        Self {
            name,
            at: DVec3::from_array(at),
            right: DVec3::new(sin, -cos, 0.0),
            ahead: DVec3::new(cos, sin, 0.0),
            focal: focal * width as f64,
            centre: [0.5 * width as f64, 0.53 * height as f64],
            size: [height, width],
        }
    }

    /// Row-major 4x4 from the lidar frame, in which the vehicle drives along `forward`.
    fn lidar2img(&self, forward: [f32; 2]) -> [f32; 16] {
        let [fx, fy] = forward.map(f64::from);
        let lidar = |v: DVec3| DVec3::new(v.x * fx - v.y * fy, v.x * fy + v.y * fx, v.z);
        let (right, ahead, at) = (lidar(self.right), lidar(self.ahead), lidar(self.at));
        let rows = [right * self.focal + ahead * self.centre[0], ahead * self.centre[1] - DVec3::Z * self.focal, ahead];
        std::array::from_fn(|i| match (i / 4, i % 4) {
            (3, c) => f32::from(c == 3),
            (r, 3) => -rows[r].dot(at) as f32,
            (r, c) => rows[r][c] as f32,
        })
    }

    fn draw(&self, street: &Street) -> Image {
        let [height, width] = self.size;
        let origin = self.at.as_vec3() + Vec3::new(0.0, -LANE, LIDAR_HEIGHT);
        // Small images show every jagged edge.
        let samples = (900 / width).clamp(1, 3);
        let mut bgr = vec![0u8; height * width * 3];
        bgr.chunks_mut(width * 3).enumerate().for_each(|(v, row)| {
            for (u, pixel) in row.chunks_exact_mut(3).enumerate() {
                let mut sum = Vec3::ZERO;
                for s in 0..samples * samples {
                    let at = |i: usize, k: usize| i as f64 + (k as f64 + 0.5) / samples as f64;
                    let x = (at(u, s % samples) - self.centre[0]) / self.focal;
                    let y = (at(v, s / samples) - self.centre[1]) / self.focal;
                    let ray = (self.ahead + self.right * x - DVec3::Z * y).normalize().as_vec3();
                    sum += street.colour(origin, ray);
                }
                let colour = (sum / (samples * samples) as f32).clamp(Vec3::ZERO, Vec3::ONE) * 255.0 + 0.5;
                pixel.copy_from_slice(&[colour.z as u8, colour.y as u8, colour.x as u8]);
            }
        });
        Image { height, width, bgr }
    }
}

/// What a surface looks like.
#[derive(Clone, Copy, PartialEq)]
enum Finish {
    Plain,
    /// Plain, and an ellipsoid.
    Round,
    /// Rows of windows, the ground floor taller.
    Windows,
    /// Mottled, and an ellipsoid.
    Leaves,
}

/// A box from `low` to `high`, or the ellipsoid that fits into it.
struct Solid {
    low: Vec3,
    high: Vec3,
    colour: Vec3,
    finish: Finish,
}

/// Solids that stand together, with their common bounds.
struct Group {
    low: Vec3,
    high: Vec3,
    solids: Vec<Solid>,
}

/// The world: x along the street, y to the left of its middle, z above the ground, in metres.
struct Street {
    groups: Vec<Group>,
}

/// Where a ray meets a solid.
struct Hit<'a> {
    distance: f32,
    normal: Vec3,
    solid: &'a Solid,
}

impl Street {
    fn new(seed: u64) -> Self {
        let mut random = Random::new(seed);
        let mut solids = Vec::new();
        for side in [-1.0f32, 1.0] {
            houses(&mut solids, &mut random, side);
            verge(&mut solids, &mut random, side);
            parked(&mut solids, &mut random, side);
        }
        let x = random.range(11.0, 17.0);
        car(&mut solids, &mut random, x, -LANE, 1.0);
        for x in [random.range(-38.0, -14.0), random.range(4.0, 19.0), random.range(36.0, 60.0)] {
            car(&mut solids, &mut random, x, LANE, -1.0);
        }
        let mut cells: BTreeMap<(i32, bool), Vec<Solid>> = BTreeMap::new();
        for solid in solids {
            let middle = (solid.low + solid.high) * 0.5;
            cells.entry(((middle.x / 12.0).floor() as i32, middle.y > 0.0)).or_default().push(solid);
        }
        let group = |solids: Vec<Solid>| Group {
            low: solids.iter().fold(Vec3::INFINITY, |low, s| low.min(s.low)),
            high: solids.iter().fold(Vec3::NEG_INFINITY, |high, s| high.max(s.high)),
            solids,
        };
        Self { groups: cells.into_values().map(group).collect() }
    }

    fn hit(&self, origin: Vec3, ray: Vec3) -> Option<Hit<'_>> {
        let inverse = ray.recip();
        let mut best: Option<Hit<'_>> = None;
        for group in &self.groups {
            let limit = best.as_ref().map_or(f32::INFINITY, |h| h.distance);
            if slab(group.low, group.high, origin, inverse).is_none_or(|d| d > limit) {
                continue;
            }
            for solid in &group.solids {
                let limit = best.as_ref().map_or(f32::INFINITY, |h| h.distance);
                best = solid.hit(origin, ray, inverse).filter(|h| h.distance < limit).or(best);
            }
        }
        best
    }

    fn colour(&self, origin: Vec3, ray: Vec3) -> Vec3 {
        let ground = if ray.z < -1e-4 { origin.z / -ray.z } else { f32::INFINITY };
        let (distance, normal, base) = match self.hit(origin, ray) {
            Some(hit) if hit.distance < ground => {
                (hit.distance, hit.normal, hit.solid.texture(origin + ray * hit.distance, hit.normal))
            }
            _ if ground < 400.0 => (ground, Vec3::Z, paving(origin + ray * ground, ground)),
            _ => return sky(ray),
        };
        let at = origin + ray * distance + normal * 1e-3 * (1.0 + distance);
        let facing = normal.dot(SUN).max(0.0);
        let sun = if facing > 0.0 && self.hit(at, SUN).is_none() { facing } else { 0.0 };
        let light = Vec3::new(0.58, 0.62, 0.67) * (0.86 + 0.14 * normal.z) + Vec3::new(0.64, 0.59, 0.50) * sun;
        let haze = distance * distance / (distance * distance + 130.0 * 130.0);
        (base * light).lerp(sky(Vec3::new(ray.x, ray.y, ray.z.abs() * 0.3)), haze)
    }
}

impl Solid {
    fn hit(&self, origin: Vec3, ray: Vec3, inverse: Vec3) -> Option<Hit<'_>> {
        let distance = slab(self.low, self.high, origin, inverse)?;
        let (middle, half) = ((self.low + self.high) * 0.5, (self.high - self.low) * 0.5);
        if self.finish == Finish::Plain || self.finish == Finish::Windows {
            let local = (origin + ray * distance - middle) / half;
            let size = local.abs();
            let axis = if size.x >= size.y && size.x >= size.z { 0 } else { 1 + usize::from(size.z > size.y) };
            let mut normal = Vec3::ZERO;
            normal[axis] = if local[axis] < 0.0 { -1.0 } else { 1.0 };
            return (distance > 0.0).then_some(Hit { distance, normal, solid: self });
        }
        let (from, along) = ((origin - middle) / half, ray / half);
        let (a, b, c) = (along.dot(along), from.dot(along), from.dot(from) - 1.0);
        let root = b * b - a * c;
        let distance = (-b - root.max(0.0).sqrt()) / a;
        let normal = ((from + along * distance) / half).normalize_or(Vec3::Z);
        (root > 0.0 && distance > 0.0).then_some(Hit { distance, normal, solid: self })
    }

    fn texture(&self, at: Vec3, normal: Vec3) -> Vec3 {
        match self.finish {
            Finish::Plain | Finish::Round => self.colour,
            Finish::Leaves => self.colour * (0.75 + 0.3 * speckle(at * 8.0) + 0.25 * speckle(at * 2.5)),
            Finish::Windows if normal.z == 0.0 => {
                let along = if normal.x == 0.0 { at.x } else { at.y };
                let (column, row) = (along / 2.4, at.z / 3.1);
                let pane = Vec3::new(column.floor(), row.floor(), self.low.x.floor());
                let (u, v) = ((fraction(column) - 0.5).abs(), (fraction(row) - 0.55).abs());
                match (u < 0.23 && v < 0.25, u < 0.28 && v < 0.295) {
                    (true, _) => Vec3::new(0.30, 0.38, 0.46) * (0.6 + 0.5 * speckle(pane)),
                    (_, true) => Vec3::splat(0.86),
                    _ => self.colour,
                }
            }
            Finish::Windows => self.colour * 0.7,
        }
    }
}

/// Distance at which the ray enters the box; 0 for a start inside.
fn slab(low: Vec3, high: Vec3, origin: Vec3, inverse: Vec3) -> Option<f32> {
    let (a, b) = ((low - origin) * inverse, (high - origin) * inverse);
    let (near, far) = (a.min(b).max_element().max(0.0), a.max(b).min_element());
    (near <= far).then_some(near)
}

fn fraction(x: f32) -> f32 {
    x - x.floor()
}

/// A number in [0, 1) that depends on the lattice cell of `at`.
fn speckle(at: Vec3) -> f32 {
    let [x, y, z] = at.floor().to_array().map(|v| u64::from(v as i32 as u32));
    Random::new(x ^ (y << 21) ^ (z << 42)).next_f32()
}

fn sky(ray: Vec3) -> Vec3 {
    let up = ray.z.max(0.0);
    let blue = Vec3::new(0.84, 0.90, 0.95).lerp(Vec3::new(0.36, 0.58, 0.86), up * (1.7 - 0.7 * up));
    let glow = ray.dot(SUN).max(0.0);
    let glow = glow * glow * glow * glow;
    blue + Vec3::new(0.20, 0.16, 0.08) * (glow * glow)
}

/// The ground at `at`, seen from `distance` metres: road with markings, kerbs, pavement, grass.
fn paving(at: Vec3, distance: f32) -> Vec3 {
    let (x, y) = (at.x, at.y.abs());
    let across = (x - CROSSING.0).abs();
    let grain = (speckle(at * 9.0) - 0.5) * 0.05 / (1.0 + distance * 0.06);
    let asphalt = Vec3::splat(0.33 + grain);
    let paint = Vec3::splat(0.88);
    if y < ROAD {
        let zebra =
            (CROSSING.1 + 0.8..CROSSING.1 + 3.8).contains(&across) && fraction(at.y / 1.1) < 0.5 && y < ROAD - 0.4;
        let dashes = y < 0.08 && fraction(x / 6.0) < 0.5 && across > CROSSING.1 + 4.5;
        let parking = (3.42..3.54).contains(&y) && across > CROSSING.1 + 4.5;
        return if zebra || dashes || parking { paint } else { asphalt };
    }
    if across < CROSSING.1 {
        let dashes = across < 0.08 && fraction(at.y / 6.0) < 0.5;
        return if dashes { paint } else { asphalt };
    }
    if y < ROAD + 0.25 {
        return Vec3::splat(0.74);
    }
    if y < PAVEMENT {
        let joint = fraction(x / 1.5) < 0.03 || fraction(y / 1.5) < 0.03;
        return Vec3::new(0.60, 0.57, 0.54) * if joint && distance < 30.0 { 0.88 } else { 1.0 } + grain;
    }
    Vec3::new(0.36, 0.52, 0.24) * (0.92 + 3.0 * grain)
}

/// A colour written as 0xRRGGBB.
fn hex(colour: u32) -> Vec3 {
    Vec3::new((colour >> 16) as f32, (colour >> 8 & 255) as f32, (colour & 255) as f32) * (1.0 / 255.0)
}

/// Adds a solid on `x`, `y` and `z`, each given as two limits in either order.
fn put(solids: &mut Vec<Solid>, x: [f32; 2], y: [f32; 2], z: [f32; 2], colour: Vec3, finish: Finish) {
    let (a, b) = (Vec3::new(x[0], y[0], z[0]), Vec3::new(x[1], y[1], z[1]));
    solids.push(Solid { low: a.min(b), high: a.max(b), colour, finish });
}

fn houses(solids: &mut Vec<Solid>, random: &mut Random, side: f32) {
    const WALLS: [u32; 6] = [0xc7b394, 0xb37861, 0xd1ccc2, 0x9ea8ad, 0xcc9e7a, 0xa89985];
    let mut x = random.range(-78.0, -70.0);
    while x < 95.0 {
        let (length, set_back) = (random.range(9.0, 17.0), random.range(0.0, 2.5));
        let height = random.range(2.0, 6.0).floor() * 3.1 + 0.7;
        let wall = hex(WALLS[random.below(WALLS.len())]);
        let gap = CROSSING.1 + 3.0;
        if x + length < CROSSING.0 - gap || x > CROSSING.0 + gap {
            let (near, far) = (side * (PAVEMENT + 1.5 + set_back), side * (PAVEMENT + 14.0));
            put(solids, [x, x + length], [near, far], [0.0, height], wall, Finish::Windows);
            let roof = [height, height + 0.35];
            put(solids, [x - 0.2, x + length + 0.2], [near - 0.3 * side, far], roof, wall * 0.7, Finish::Plain);
        }
        x += length + if random.below(3) == 0 { 4.0 } else { 0.4 };
    }
}

/// Trees, lamps and people on the pavement.
fn verge(solids: &mut Vec<Solid>, random: &mut Random, side: f32) {
    let around = |x: f32, half: f32| [x - half, x + half];
    let mut x = -60.0 + random.range(0.0, 6.0);
    while x < 85.0 {
        let clear = (x - CROSSING.0).abs() > CROSSING.1 + 2.5;
        let y = side * (ROAD + 1.0);
        if clear && random.below(3) > 0 {
            let (radius, top) = (random.range(1.3, 2.1), random.range(4.2, 6.0));
            let green = Vec3::new(random.range(0.20, 0.32), random.range(0.42, 0.52), 0.18);
            put(solids, around(x, 0.14), around(y, 0.14), [0.0, top - radius], hex(0x5c422e), Finish::Plain);
            put(solids, around(x, radius), around(y, radius), [top - 1.9 * radius, top], green, Finish::Leaves);
        } else if clear {
            put(solids, around(x, 0.07), around(y, 0.07), [0.0, 6.2], hex(0x6b6b6b), Finish::Plain);
            put(solids, around(x, 0.07), [y, y - 1.6 * side], [6.1, 6.25], hex(0x6b6b6b), Finish::Plain);
        }
        if random.below(2) == 0 {
            let (x, y) = (x + random.range(2.0, 5.0), side * random.range(ROAD + 1.8, PAVEMENT - 0.4));
            let coat = Vec3::new(random.range(0.15, 0.8), random.range(0.15, 0.6), random.range(0.15, 0.7));
            put(solids, around(x, 0.15), around(y, 0.19), [0.0, 0.85], hex(0x2b3042), Finish::Plain);
            put(solids, around(x, 0.19), around(y, 0.25), [0.8, 1.5], coat, Finish::Round);
            put(solids, around(x, 0.13), around(y, 0.13), [1.46, 1.76], hex(0xcc9e80), Finish::Round);
        }
        x += random.range(7.0, 11.0);
    }
}

fn parked(solids: &mut Vec<Solid>, random: &mut Random, side: f32) {
    let mut x = -55.0 + random.range(0.0, 5.0);
    while x < 80.0 {
        // Beside the cameras a car would fill an image.
        let clear = (x - CROSSING.0).abs() > CROSSING.1 + 7.0 && !(side < 0.0 && x.abs() < 6.5);
        if random.below(5) > 1 && clear {
            car(solids, random, x, side * (ROAD - 1.12), -side);
        }
        x += random.range(5.6, 7.5);
    }
}

/// A car with its middle at (x, y), driving along +x (`along` = 1) or -x (-1).
fn car(solids: &mut Vec<Solid>, random: &mut Random, x: f32, y: f32, along: f32) {
    const PAINT: [u32; 7] = [0xccced4, 0x21242b, 0xa81f1f, 0x244d94, 0x858c94, 0xe6e6e0, 0xd99e26];
    let paint = hex(PAINT[random.below(PAINT.len())]);
    let mut part = |ahead: [f32; 2], half: f32, z: [f32; 2], colour: Vec3| {
        put(solids, ahead.map(|a| x + along * a), [y - half, y + half], z, colour, Finish::Plain);
    };
    part([-2.15, 2.15], 0.88, [0.32, 0.86], paint);
    part([-1.35, 0.85], 0.78, [0.86, 1.36], hex(0x1f2630));
    part([-1.30, 0.70], 0.80, [1.34, 1.46], paint);
    part([-1.68, -1.02], 0.92, [0.0, 0.66], hex(0x0f0f12));
    part([0.97, 1.63], 0.92, [0.0, 0.66], hex(0x0f0f12));
    part([2.14, 2.17], 0.82, [0.58, 0.74], hex(0xf2f0db));
    part([-2.17, -2.14], 0.82, [0.60, 0.76], hex(0xb81414));
}

#[cfg(test)]
mod tests;

//! What stands and moves on the ground, each made of a few solids: x ahead, y left, z up from the ground, in metres.

use super::solid::{Part, Shape};
use super::texture::{Finish, any_colour, hex, pick};
use crate::base::random::Random;
use glam::Vec3;

/// Classes of objects, numbered as in SurroundOcc's list for nuScenes.
pub(super) mod class {
    pub(in crate::synth) const BARRIER: u8 = 1;
    pub(in crate::synth) const BICYCLE: u8 = 2;
    pub(in crate::synth) const BUS: u8 = 3;
    pub(in crate::synth) const CAR: u8 = 4;
    pub(in crate::synth) const CONSTRUCTION_VEHICLE: u8 = 5;
    pub(in crate::synth) const MOTORCYCLE: u8 = 6;
    pub(in crate::synth) const PEDESTRIAN: u8 = 7;
    pub(in crate::synth) const TRAFFIC_CONE: u8 = 8;
    pub(in crate::synth) const TRAILER: u8 = 9;
    pub(in crate::synth) const TRUCK: u8 = 10;
    pub(in crate::synth) const MANMADE: u8 = 15;
    pub(in crate::synth) const VEGETATION: u8 = 16;
}

const RUBBER: Vec3 = Vec3::new(0.06, 0.06, 0.07);
const GLASS: Vec3 = Vec3::new(0.12, 0.16, 0.20);
const STEEL: Vec3 = Vec3::new(0.42, 0.43, 0.45);

/// An object before it is put somewhere: its class, its parts, its length along x.
pub(super) struct Model {
    pub(super) class: u8,
    pub(super) parts: Vec<Part>,
    pub(super) length: f32,
}

impl Model {
    fn new(class: u8, length: f32) -> Self {
        Self { class, parts: Vec::new(), length }
    }

    /// Adds a solid between two limits on each axis.
    fn put(&mut self, shape: Shape, [x, y, z]: [[f32; 2]; 3], colour: Vec3, finish: Finish) {
        let (low, high) = (Vec3::new(x[0], y[0], z[0]), Vec3::new(x[1], y[1], z[1]));
        let (centre, half) = ((low + high) * 0.5, ((high - low) * 0.5).abs());
        self.parts.push(Part { shape, centre, half, colour, finish });
    }

    fn block(&mut self, x: [f32; 2], half_width: f32, z: [f32; 2], colour: Vec3) {
        self.put(Shape::Box, [x, [-half_width, half_width], z], colour, Finish::Plain);
    }

    /// A pair of wheels, or rollers, at `x`.
    fn axle(&mut self, x: f32, half_width: f32, radius: f32) {
        let round = [[x - radius, x + radius], [-half_width, half_width], [0.0, 2.0 * radius]];
        self.put(Shape::Cylinder(1), round, RUBBER, Finish::Plain);
    }

    /// Lamps at front and back.
    fn lamps(&mut self, x: [f32; 2], half_width: f32, z: f32) {
        self.block([x[1], x[1] + 0.04], half_width, [z, z + 0.16], Vec3::new(0.95, 0.94, 0.86));
        self.block([x[0] - 0.04, x[0]], half_width, [z, z + 0.16], Vec3::new(0.72, 0.08, 0.08));
    }
}

/// A saloon, hatchback, estate, off-roader or van.
pub(super) fn car(random: &mut Random) -> Model {
    let paint = if random.below(2) == 0 {
        pick(random, &[hex(0xd8d9dc), hex(0x1d1f23), hex(0x8b9097), hex(0x4a4e55), hex(0xece9e0)])
    } else {
        any_colour(random, 0.25, 0.85)
    };
    let kind = random.below(5);
    let length = [4.6, 3.9, 4.7, 4.6, 5.2][kind] * random.range(0.94, 1.06);
    let width = [0.88, 0.84, 0.9, 0.95, 0.98][kind];
    let (body, roof) = ([0.88, 0.92, 0.9, 1.05, 1.1][kind], [1.44, 1.5, 1.5, 1.78, 2.1][kind]);
    // The cabin's ends, as shares of the length from the back.
    let (back, front) = [(0.18, 0.68), (0.03, 0.68), (0.02, 0.68), (0.03, 0.7), (0.01, 0.84)][kind];
    let mut m = Model::new(class::CAR, length);
    let at = |share: f32| (share - 0.5) * length;
    m.block([at(0.0), at(1.0)], width, [0.3, body], paint);
    m.block([at(back), at(front)], width * 0.9, [body, roof - 0.08], GLASS);
    m.block([at(back + 0.03), at(front - 0.08)], width * 0.91, [roof - 0.1, roof], paint);
    if kind == 4 {
        m.block([at(back), at(0.55)], width * 0.93, [body, roof - 0.06], paint);
    } else {
        for share in [back + 0.01, (back + front) * 0.5, front - 0.1] {
            m.block([at(share), at(share) + 0.09], width * 0.92, [body, roof - 0.05], paint);
        }
    }
    m.axle(at(0.19), width + 0.02, 0.33);
    m.axle(at(0.81), width + 0.02, 0.33);
    m.lamps([at(0.0), at(1.0)], width * 0.85, body - 0.28);
    m
}

/// A city bus or coach, sometimes articulated.
pub(super) fn bus(random: &mut Random) -> Model {
    let length = pick(random, &[10.5, 12.0, 12.0, 14.5]);
    let paint = any_colour(random, 0.4, 0.95);
    let trim = any_colour(random, 0.3, 0.95);
    let (half, top) = (1.27, random.range(2.95, 3.3));
    let mut m = Model::new(class::BUS, length);
    let h = length * 0.5;
    m.block([-h, h], half, [0.32, 1.15], trim);
    m.block([-h, h], half - 0.015, [1.15, top - 0.55], GLASS);
    m.block([-h, h], half, [top - 0.55, top], paint);
    let mut x = -h;
    while x < h {
        m.block([x, x + 0.16], half + 0.005, [1.1, top - 0.5], paint);
        x += 1.5;
    }
    m.block([-h * 0.5, h * 0.3], half * 0.7, [top, top + 0.25], Vec3::splat(0.8));
    m.axle(-h + 2.6, half + 0.01, 0.48);
    m.axle(h - 2.5, half + 0.01, 0.48);
    m.lamps([-h, h], half * 0.85, 0.6);
    m
}

/// The front of a lorry, from `x` on, as long as a cab is.
fn cab(m: &mut Model, random: &mut Random, x: f32, paint: Vec3) {
    let top = random.range(2.5, 3.1);
    m.block([x, x + 2.1], 1.2, [0.5, 1.55], paint);
    m.block([x, x + 2.0], 1.18, [1.55, top], paint);
    m.block([x + 0.9, x + 2.03], 1.19, [1.6, top - 0.35], GLASS);
    m.axle(x + 1.2, 1.22, 0.5);
    m.block([x + 2.1, x + 2.14], 1.0, [0.7, 0.88], Vec3::new(0.95, 0.94, 0.86));
}

/// A lorry: box, flatbed, tanker or tipper; or the tractor of a trailer.
pub(super) fn truck(random: &mut Random) -> Model {
    let paint = any_colour(random, 0.3, 0.95);
    let cargo = any_colour(random, 0.4, 1.0);
    let kind = random.below(4);
    let length = random.range(6.5, 9.5);
    let mut m = Model::new(class::TRUCK, length);
    let (back, front) = (-length * 0.5, length * 0.5 - 2.3);
    cab(&mut m, random, front + 0.15, paint);
    m.block([back, front + 0.3], 0.9, [0.6, 0.95], Vec3::splat(0.14));
    let top = random.range(2.8, 3.6);
    match kind {
        0 => {
            let sheet = pick(random, &[Finish::Plain, Finish::Ribs(0.5)]);
            m.put(Shape::Box, [[back, front], [-1.25, 1.25], [0.95, top]], cargo, sheet);
        }
        1 => {
            m.block([back, front], 1.25, [0.95, 1.15], cargo);
            m.block([front - 0.12, front], 1.25, [1.15, 2.1], cargo);
            let load = any_colour(random, 0.3, 0.8);
            m.put(Shape::Box, [[back + 0.6, front - 0.9], [-1.05, 1.05], [1.15, top - 1.0]], load, Finish::Grain);
        }
        2 => {
            let tank = [[back, front], [-1.2, 1.2], [0.95, 3.2]];
            m.put(Shape::Cylinder(0), tank, cargo, Finish::Plain);
        }
        _ => {
            m.put(Shape::Box, [[back, front], [-1.25, 1.25], [1.0, top - 0.7]], cargo, Finish::Ribs(0.8));
            m.put(
                Shape::Ellipsoid,
                [[back + 0.3, front - 0.3], [-1.1, 1.1], [top - 1.4, top - 0.1]],
                hex(0x7a6a55),
                Finish::Grain,
            );
        }
    }
    m.axle(back + 1.4, 1.24, 0.5);
    m.axle(back + 2.6, 1.24, 0.5);
    m.lamps([back, front], 1.1, 0.75);
    m
}

/// The tractor alone, which a trailer follows.
pub(super) fn tractor(random: &mut Random) -> Model {
    let paint = any_colour(random, 0.3, 0.95);
    let mut m = Model::new(class::TRUCK, 5.6);
    cab(&mut m, random, 0.6, paint);
    m.block([-2.8, 0.6], 0.55, [0.6, 1.0], Vec3::splat(0.14));
    m.axle(-1.7, 1.22, 0.5);
    m
}

/// A semi-trailer, container chassis, or a small trailer for a car.
pub(super) fn trailer(random: &mut Random, long: bool) -> Model {
    let cover = any_colour(random, 0.4, 1.0);
    if !long {
        let mut m = Model::new(class::TRAILER, 3.6);
        let (finish, top) = (pick(random, &[Finish::Plain, Finish::Ribs(0.4)]), random.range(1.5, 2.4));
        m.put(Shape::Box, [[-1.8, 1.2], [-0.95, 0.95], [0.5, top]], cover, finish);
        m.block([1.2, 2.2], 0.08, [0.45, 0.6], STEEL);
        m.axle(-0.4, 1.05, 0.32);
        m.lamps([-1.8, 1.2], 0.85, 0.6);
        return m;
    }
    let length = random.range(9.5, 13.0);
    let (back, front) = (-length * 0.5, length * 0.5);
    let mut m = Model::new(class::TRAILER, length);
    m.block([back, front], 0.9, [0.85, 1.15], Vec3::splat(0.14));
    match random.below(3) {
        0 => m.put(Shape::Box, [[back, front], [-1.27, 1.27], [1.15, 3.9]], cover, Finish::Plain),
        1 => {
            let boards = [[back, front], [-1.24, 1.24], [1.15, 3.7]];
            m.put(Shape::Box, boards, cover, Finish::Ribs(0.35));
        }
        _ => {
            m.block([back, front], 1.25, [1.15, 1.3], STEEL);
            m.block([front - 0.15, front], 1.25, [1.3, 2.8], STEEL);
            let load = any_colour(random, 0.25, 0.7);
            m.put(Shape::Box, [[back + 0.5, front - 1.0], [-1.1, 1.1], [1.3, 2.6]], load, Finish::Stripes(0.7, 0.5));
        }
    }
    for n in 0..3 {
        m.axle(back + 1.2 + 1.3 * n as f32, 1.25, 0.48);
    }
    m.block([front - 2.2, front - 1.9], 0.8, [0.1, 0.9], STEEL);
    m.block([back - 0.04, back], 1.1, [0.9, 1.06], Vec3::new(0.72, 0.08, 0.08));
    m
}

/// An excavator, roller, loader or dumper.
pub(super) fn construction_vehicle(random: &mut Random) -> Model {
    let liveries = [hex(0xe0a21a), hex(0xe6c229), hex(0xd9701f), hex(0xb9bcc0), hex(0x5f7f3a)];
    let paint = pick(random, &liveries) * random.range(0.75, 1.05);
    let kind = random.below(4);
    let mut m = Model::new(class::CONSTRUCTION_VEHICLE, [8.5, 5.5, 7.5, 7.0][kind]);
    match kind {
        0 => {
            for y in [[-1.4, -0.8], [0.8, 1.4]] {
                m.put(Shape::Box, [[-2.2, 2.2], y, [0.0, 0.95]], RUBBER * 2.0, Finish::Ribs(0.3));
            }
            m.block([-2.3, 1.5], 1.25, [1.0, 2.1], paint);
            m.put(Shape::Box, [[0.0, 1.5], [0.1, 1.25], [2.1, 3.0]], GLASS, Finish::Plain);
            m.put(Shape::Box, [[0.0, 1.4], [0.1, 1.25], [2.95, 3.1]], paint, Finish::Plain);
            m.put(Shape::Box, [[1.2, 2.0], [-0.6, 0.0], [1.8, 3.4]], paint, Finish::Plain);
            m.put(Shape::Box, [[1.8, 3.6], [-0.55, -0.05], [3.1, 3.8]], paint, Finish::Plain);
            m.put(Shape::Box, [[3.4, 4.1], [-0.5, -0.1], [1.3, 3.6]], paint, Finish::Plain);
            m.put(Shape::Box, [[3.2, 4.2], [-0.9, 0.3], [0.4, 1.4]], STEEL * 0.8, Finish::Grain);
        }
        1 => {
            for x in [-1.7, 1.7] {
                m.put(Shape::Cylinder(1), [[x - 0.75, x + 0.75], [-1.1, 1.1], [0.0, 1.5]], STEEL, Finish::Plain);
            }
            m.block([-2.3, 2.3], 0.95, [1.0, 1.75], paint);
            m.block([-0.8, 0.6], 0.85, [1.75, 2.7], GLASS);
            m.block([-0.9, 0.7], 1.0, [2.7, 2.85], paint);
        }
        2 => {
            for x in [-1.6, 1.5] {
                m.axle(x, 1.3, 0.75);
            }
            m.block([-2.8, 1.2], 1.05, [0.9, 2.0], paint);
            m.block([-0.6, 0.8], 0.95, [2.0, 3.2], GLASS);
            m.block([-0.7, 0.9], 1.0, [3.15, 3.3], paint);
            m.block([1.2, 3.0], 0.2, [0.9, 1.4], paint);
            m.put(Shape::Box, [[2.7, 3.7], [-1.4, 1.4], [0.2, 1.3]], STEEL * 0.9, Finish::Grain);
        }
        _ => {
            for x in [-2.2, -0.9, 2.2] {
                m.axle(x, 1.35, 0.7);
            }
            m.block([-3.3, 3.3], 1.0, [0.8, 1.3], Vec3::splat(0.16));
            m.put(Shape::Box, [[-3.4, 1.1], [-1.4, 1.4], [1.3, 2.7]], paint, Finish::Ribs(0.7));
            m.block([1.4, 3.4], 1.25, [1.0, 2.9], paint);
            m.block([2.2, 3.45], 1.2, [1.9, 2.7], GLASS);
        }
    }
    m
}

/// A person: standing or walking.
fn person(m: &mut Model, random: &mut Random, x: f32, base: f32, seated: bool) {
    let coat = any_colour(random, 0.15, 0.95);
    let trousers = any_colour(random, 0.1, 0.5);
    let skin = pick(random, &[hex(0xd9ab8a), hex(0xb98561), hex(0x7d5238), hex(0xe6c3a5)]);
    let scale = if seated { 0.9 } else { random.range(0.82, 1.08) };
    let legs = if seated { 0.45 } else { 0.85 };
    let up = |z: f32| base + z * scale;
    let stride = if seated { 0.1 } else { random.range(0.02, 0.22) };
    for (side, step) in [(0.1, stride), (-0.1, -stride)] {
        let y = [side - 0.085, side + 0.085];
        m.put(Shape::Box, [[x + step - 0.1, x + step + 0.1], y, [up(0.0), up(legs)]], trousers, Finish::Plain);
    }
    let torso = [[x - 0.18, x + 0.18], [-0.27, 0.27], [up(legs - 0.08), up(legs + 0.62)]];
    m.put(Shape::Ellipsoid, torso, coat, Finish::Plain);
    m.put(Shape::Box, [[x - 0.14, x + 0.14], [-0.2, 0.2], [up(legs), up(legs + 0.5)]], coat, Finish::Plain);
    m.put(
        Shape::Ellipsoid,
        [[x - 0.12, x + 0.12], [-0.1, 0.1], [up(legs + 0.6), up(legs + 0.88)]],
        skin,
        Finish::Plain,
    );
}

/// A pedestrian.
pub(super) fn pedestrian(random: &mut Random) -> Model {
    let mut m = Model::new(class::PEDESTRIAN, 0.6);
    person(&mut m, random, 0.0, 0.0, false);
    if random.below(3) == 0 {
        let bag = any_colour(random, 0.2, 0.8);
        m.put(Shape::Box, [[-0.32, -0.14], [-0.17, 0.17], [0.95, 1.4]], bag, Finish::Plain);
    }
    m
}

/// A bicycle, ridden or not.
pub(super) fn bicycle(random: &mut Random, ridden: bool) -> Model {
    let mut m = Model::new(class::BICYCLE, 1.75);
    let paint = any_colour(random, 0.2, 0.95);
    for x in [-0.53, 0.53] {
        m.put(Shape::Cylinder(1), [[x - 0.34, x + 0.34], [-0.03, 0.03], [0.0, 0.68]], RUBBER * 1.5, Finish::Plain);
    }
    m.put(Shape::Box, [[-0.5, 0.45], [-0.035, 0.035], [0.55, 0.66]], paint, Finish::Plain);
    m.put(Shape::Box, [[-0.25, -0.15], [-0.03, 0.03], [0.3, 0.92]], paint, Finish::Plain);
    m.put(Shape::Box, [[0.42, 0.5], [-0.28, 0.28], [0.95, 1.02]], STEEL, Finish::Plain);
    m.put(Shape::Box, [[-0.32, -0.08], [-0.08, 0.08], [0.9, 0.98]], RUBBER, Finish::Plain);
    if ridden {
        person(&mut m, random, -0.12, 0.5, true);
    }
    m
}

/// A motorcycle or scooter, ridden or not.
pub(super) fn motorcycle(random: &mut Random, ridden: bool) -> Model {
    let mut m = Model::new(class::MOTORCYCLE, 2.1);
    let paint = any_colour(random, 0.15, 0.9);
    for x in [-0.7, 0.7] {
        m.put(Shape::Cylinder(1), [[x - 0.32, x + 0.32], [-0.09, 0.09], [0.0, 0.64]], RUBBER, Finish::Plain);
    }
    m.put(Shape::Box, [[-0.45, 0.4], [-0.17, 0.17], [0.3, 0.72]], STEEL * 0.7, Finish::Plain);
    m.put(Shape::Ellipsoid, [[-0.1, 0.55], [-0.2, 0.2], [0.62, 1.02]], paint, Finish::Plain);
    m.put(Shape::Box, [[-0.9, 0.0], [-0.16, 0.16], [0.68, 0.84]], RUBBER * 1.4, Finish::Plain);
    m.put(Shape::Box, [[0.5, 0.62], [-0.36, 0.36], [0.95, 1.05]], STEEL, Finish::Plain);
    m.put(Shape::Box, [[0.6, 0.72], [-0.14, 0.14], [0.7, 1.2]], paint, Finish::Plain);
    if ridden {
        person(&mut m, random, -0.25, 0.6, true);
    }
    m
}

/// A traffic cone.
pub(super) fn traffic_cone(random: &mut Random) -> Model {
    let mut m = Model::new(class::TRAFFIC_CONE, 0.45);
    let paint = pick(random, &[hex(0xe85a1c), hex(0xe85a1c), hex(0xd8341c), hex(0xd9c21f)]);
    let high = random.range(0.65, 1.0);
    m.put(Shape::Box, [[-0.22, 0.22], [-0.22, 0.22], [0.0, 0.06]], RUBBER * 2.0, Finish::Plain);
    for (n, radius) in [0.18, 0.14, 0.105, 0.07, 0.04].into_iter().enumerate() {
        let (from, to) = (n as f32 * 0.2 * high, (n + 1) as f32 * 0.2 * high);
        let colour = if n == 2 { Vec3::splat(0.92) } else { paint };
        m.put(Shape::Cylinder(2), [[-radius, radius], [-radius, radius], [from, to]], colour, Finish::Plain);
    }
    m
}

/// One length of a barrier along x: concrete, filled plastic, boards or a guard rail.
pub(super) fn barrier(random: &mut Random, kind: usize) -> Model {
    let mut m = Model::new(class::BARRIER, 2.0);
    match kind {
        0 => {
            let grey = Vec3::splat(random.range(0.5, 0.68));
            m.put(Shape::Box, [[-1.0, 1.0], [-0.3, 0.3], [0.0, 0.28]], grey, Finish::Grain);
            m.put(Shape::Box, [[-1.0, 1.0], [-0.17, 0.17], [0.28, 0.5]], grey, Finish::Grain);
            m.put(Shape::Box, [[-1.0, 1.0], [-0.1, 0.1], [0.5, 0.95]], grey, Finish::Grain);
        }
        1 => {
            let red = pick(random, &[hex(0xcf2b20), hex(0xe0701f)]);
            let paint = if random.below(2) == 0 { red } else { Vec3::splat(0.9) };
            m.put(Shape::Box, [[-0.98, 0.98], [-0.26, 0.26], [0.0, 0.4]], paint, Finish::Plain);
            m.put(Shape::Box, [[-0.95, 0.95], [-0.16, 0.16], [0.4, 0.95]], paint, Finish::Plain);
        }
        2 => {
            let red = hex(0xcf2b20);
            m.put(Shape::Box, [[-1.0, 1.0], [-0.04, 0.04], [0.75, 1.05]], red, Finish::Stripes(0.3, 0.92));
            m.put(Shape::Box, [[-1.0, 1.0], [-0.04, 0.04], [0.3, 0.5]], red, Finish::Stripes(0.3, 0.92));
            for x in [-0.85, 0.85] {
                m.put(Shape::Box, [[x - 0.06, x + 0.06], [-0.3, 0.3], [0.0, 0.12]], RUBBER, Finish::Plain);
                m.put(Shape::Box, [[x - 0.04, x + 0.04], [-0.05, 0.05], [0.0, 1.1]], STEEL, Finish::Plain);
            }
        }
        _ => {
            m.put(Shape::Box, [[-1.0, 1.0], [-0.06, 0.06], [0.5, 0.82]], Vec3::splat(0.62), Finish::Plain);
            m.put(Shape::Box, [[-0.06, 0.06], [-0.08, 0.08], [0.0, 0.8]], STEEL, Finish::Plain);
        }
    }
    m
}

/// A tree.
pub(super) fn tree(random: &mut Random) -> Model {
    let mut m = Model::new(class::VEGETATION, 3.0);
    let bark = any_colour(random, 0.2, 0.4).lerp(hex(0x54402e), 0.7);
    let leaf =
        pick(random, &[hex(0x4c7a2c), hex(0x3d6a34), hex(0x6a8a30), hex(0x8a8a2c), hex(0xa8702a), hex(0x2f5a3c)]);
    let leaf = leaf * random.range(0.8, 1.15);
    let (top, radius) = (random.range(4.0, 9.0), random.range(1.1, 2.6));
    let girth = random.range(0.12, 0.26);
    let bole = random.range(1.6, 2.6);
    m.put(Shape::Cylinder(2), [[-girth, girth], [-girth, girth], [0.0, bole + 1.0]], bark, Finish::Grain);
    if random.below(4) == 0 {
        // A conifer, in tiers.
        for n in 0..4 {
            let (r, z) = (radius * (1.0 - 0.22 * n as f32), bole * 0.5 + (top - bole * 0.5) * n as f32 * 0.22);
            m.put(Shape::Ellipsoid, [[-r, r], [-r, r], [z, z + (top - bole) * 0.45]], leaf, Finish::Leaves);
        }
        return m;
    }
    m.put(Shape::Ellipsoid, [[-radius, radius], [-radius, radius], [bole, top]], leaf, Finish::Leaves);
    for _ in 0..3 {
        let r = radius * random.range(0.5, 0.75);
        let (x, y) = (random.range(-0.6, 0.6) * radius, random.range(-0.6, 0.6) * radius);
        let z = random.range(bole, top - 1.6 * r);
        m.put(Shape::Ellipsoid, [[x - r, x + r], [y - r, y + r], [z, z + 1.7 * r]], leaf, Finish::Leaves);
    }
    m
}

/// A bush.
pub(super) fn bush(random: &mut Random) -> Model {
    let mut m = Model::new(class::VEGETATION, 1.6);
    let leaf = pick(random, &[hex(0x44702c), hex(0x5c7a34), hex(0x7a7a34), hex(0x38603a)]);
    for _ in 0..3 {
        let (x, y, r) = (random.range(-0.5, 0.5), random.range(-0.5, 0.5), random.range(0.4, 0.8));
        m.put(Shape::Ellipsoid, [[x - r, x + r], [y - r, y + r], [-0.3, 1.3 * r]], leaf, Finish::Leaves);
    }
    m
}

/// A hedge of this length along x.
pub(super) fn hedge(random: &mut Random, length: f32) -> Model {
    let mut m = Model::new(class::VEGETATION, length);
    let leaf = pick(random, &[hex(0x3f6a2c), hex(0x55702f), hex(0x35593a)]);
    let (half, high) = (random.range(0.35, 0.7), random.range(0.9, 2.1));
    m.put(Shape::Box, [[-length * 0.5, length * 0.5], [-half, half], [0.0, high]], leaf, Finish::Leaves);
    m
}

/// A wall or fence of this length along x.
pub(super) fn wall(random: &mut Random, length: f32) -> Model {
    let mut m = Model::new(class::MANMADE, length);
    let colour = any_colour(random, 0.3, 0.8).lerp(Vec3::splat(0.55), 0.5);
    let (h, high) = (length * 0.5, random.range(1.2, 2.3));
    if random.below(2) == 0 {
        m.put(Shape::Box, [[-h, h], [-0.15, 0.15], [0.0, high]], colour, Finish::Bricks(0.25));
        return m;
    }
    // Rails before and behind narrow boards.
    m.put(Shape::Box, [[-h, h], [-0.04, 0.04], [0.1, high]], colour, Finish::Ribs(0.3));
    let mut x = -h;
    while x < h {
        m.put(Shape::Box, [[x, x + 0.12], [-0.08, 0.08], [0.0, high + 0.1]], colour * 0.7, Finish::Plain);
        x += 2.0;
    }
    m
}

/// A building of this length along x and depth along y, its front at y = 0, its back at `depth`.
pub(super) fn building(random: &mut Random, length: f32, depth: f32) -> Model {
    let mut m = Model::new(class::MANMADE, length);
    let colour = any_colour(random, 0.35, 0.9).lerp(Vec3::splat(random.range(0.3, 0.8)), 0.4);
    let storey = random.range(2.8, 3.6);
    let high = (1 + random.below(7)) as f32 * storey + random.range(0.3, 1.5);
    let finish = match random.below(6) {
        0 => Finish::Bricks(0.4),
        1 => Finish::Ribs(random.range(0.4, 1.2)),
        _ => Finish::Windows(random.range(1.6, 3.2), storey),
    };
    let h = length * 0.5;
    m.put(Shape::Box, [[-h, h], [0.0, depth], [-0.5, high]], colour, finish);
    let eaves = [[-h - 0.25, h + 0.25], [-0.3, depth], [high, high + 0.35]];
    m.put(Shape::Box, eaves, colour * 0.65, Finish::Plain);
    if random.below(2) == 0 {
        // A ground floor of another colour, with a door and an awning.
        let plinth = any_colour(random, 0.25, 0.8);
        m.put(Shape::Box, [[-h, h], [-0.06, 0.0], [0.0, 0.9]], plinth, Finish::Grain);
        let x = random.range(-h + 1.0, h - 1.0);
        m.put(Shape::Box, [[x - 0.6, x + 0.6], [-0.1, 0.0], [0.0, 2.2]], plinth * 0.5, Finish::Plain);
        let awning = any_colour(random, 0.3, 0.9);
        m.put(Shape::Box, [[x - 1.6, x + 1.6], [-1.2, 0.0], [2.6, 2.8]], awning, Finish::Stripes(0.4, 0.9));
    }
    m
}

/// A street lamp, a mast with a sign, or traffic lights; its arm reaches to +y.
pub(super) fn pole(random: &mut Random) -> Model {
    let mut m = Model::new(class::MANMADE, 0.4);
    let colour = Vec3::splat(random.range(0.18, 0.6));
    let (kind, r) = (random.below(4), random.range(0.06, 0.13));
    let high = [7.0, 3.0, 4.2, 8.5][kind];
    m.put(Shape::Cylinder(2), [[-r, r], [-r, r], [0.0, high]], colour, Finish::Plain);
    match kind {
        0 => m.put(Shape::Box, [[-0.1, 0.1], [0.0, 2.0], [high - 0.12, high]], colour, Finish::Plain),
        1 => {
            let plate = any_colour(random, 0.4, 0.95);
            m.put(Shape::Box, [[-0.05, 0.05], [-0.4, 0.4], [2.1, 2.9]], plate, Finish::Stripes(0.2, 0.9));
        }
        2 => {
            m.put(Shape::Box, [[-0.16, 0.16], [-0.16, 0.16], [2.4, 3.4]], Vec3::splat(0.08), Finish::Plain);
            let lit = pick(random, &[hex(0xe8281c), hex(0x2fd05a), hex(0xe8b01c)]);
            m.put(Shape::Ellipsoid, [[-0.2, 0.2], [-0.09, 0.09], [2.8, 3.0]], lit, Finish::Plain);
        }
        _ => m.put(Shape::Box, [[-0.6, 0.6], [-0.08, 0.08], [high - 0.5, high - 0.35]], colour, Finish::Plain),
    }
    m
}

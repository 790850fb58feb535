//! The ground: a road with its lanes, what lies beside it, and how high it is.
//!
//! Places are told in street coordinates, `s` along the middle of the road and `d` to its left, in metres, or in those of
//! the world, in which the road starts out along x.

use super::texture::{fraction, pick, smooth, speckle};
use crate::base::random::Random;
use glam::{Vec2, Vec3};

/// Classes of the ground, numbered as in SurroundOcc's list for nuScenes.
pub(super) mod class {
    pub(in crate::synth) const DRIVEABLE: u8 = 11;
    pub(in crate::synth) const OTHER_FLAT: u8 = 12;
    pub(in crate::synth) const SIDEWALK: u8 = 13;
    pub(in crate::synth) const TERRAIN: u8 = 14;
}

/// Metres of a lane across.
pub(super) const LANE: f32 = 3.4;

/// Metres of a lane for parking across.
pub(super) const PARKING: f32 = 2.5;

/// What is done with a stretch of land beside the road.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Use {
    Building,
    Park,
    /// Paved, for people.
    Plaza,
    /// Paved, for parked vehicles.
    Lot,
    /// Soil, where something is being built.
    Site,
    /// Grass behind a wall, a fence or a hedge.
    Yard,
}

/// A stretch of land beside the road.
#[derive(Clone, Copy, Debug)]
pub(super) struct Plot {
    pub(super) from: f32,
    pub(super) to: f32,
    /// Metres from the sidewalk to its back.
    pub(super) depth: f32,
    pub(super) r#use: Use,
}

/// A street that crosses.
#[derive(Clone, Copy, Debug)]
pub(super) struct Crossing {
    pub(super) at: f32,
    /// Half of its width.
    pub(super) half: f32,
    /// Whether it goes on to the left and to the right.
    pub(super) sides: [bool; 2],
}

/// Half of the road and what follows, in metres from its middle.
#[derive(Clone, Debug)]
pub(super) struct Side {
    /// Outer edge of the lanes.
    pub(super) lanes: f32,
    /// Outer edge of the road, with the lane for parking if there is one.
    pub(super) road: f32,
    /// Outer edge of a strip of grass, which may have no width.
    pub(super) verge: f32,
    /// Outer edge of the sidewalk.
    pub(super) sidewalk: f32,
    /// Ascending, without gaps.
    pub(super) plots: Vec<Plot>,
}

/// What lies in the middle of the road.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Median {
    Line,
    Island,
    Rails,
}

/// The ground of a world.
#[derive(Clone, Debug)]
pub(super) struct Street {
    /// y of the road's middle is `bend.x * x^2 + bend.y * x^3`.
    bend: Vec2,
    /// Height is `tilt . (x, y) + curve . (x^2, y^2)`.
    tilt: Vec2,
    curve: Vec2,
    median: Median,
    pub(super) median_half: f32,
    pub(super) lanes: usize,
    pub(super) crossings: Vec<Crossing>,
    /// Left and right.
    pub(super) sides: [Side; 2],
    salt: u32,
    asphalt: Vec3,
    paving: Vec3,
    grass: Vec3,
    soil: Vec3,
    tiles: [Vec3; 2],
}

impl Street {
    /// A street from `extent.0` to `extent.1` along x.
    pub(super) fn new(random: &mut Random, extent: (f32, f32)) -> Self {
        let reach = extent.1.max(-extent.0);
        // The slope of a bend stays below a half at the ends.
        let bent = if random.below(5) < 2 { 0.0 } else { random.range(-0.5, 0.5) / (2.0 * reach) };
        let winding = if random.below(4) == 0 { random.range(-0.3, 0.3) / (3.0 * reach * reach) } else { 0.0 };
        let hilly = if random.below(3) == 0 { 0.0 } else { random.next_f32() };
        let mut slope = || hilly * random.range(-0.009, 0.009);
        let tilt = Vec2::new(slope(), slope());
        let curve = Vec2::new(slope(), slope()) * 0.006;
        let lanes = pick(random, &[1, 1, 2, 2, 3]);
        let median = pick(random, &[Median::Line, Median::Line, Median::Island, Median::Rails]);
        let median_half = match median {
            Median::Line => 0.0,
            Median::Island => random.range(0.8, 2.2),
            Median::Rails => random.range(2.2, 3.2),
        };
        let mut crossings = Vec::new();
        let mut at = extent.0 + random.range(0.0, 60.0);
        while at < extent.1 {
            if random.below(4) > 0 {
                let sides = pick(random, &[[true, true], [true, true], [true, false], [false, true]]);
                crossings.push(Crossing { at, half: random.range(3.2, 7.5), sides });
            }
            at += random.range(45.0, 110.0);
        }
        let edge = median_half + LANE * lanes as f32;
        let sides = [0, 1].map(|_| Side::new(random, edge, extent));
        let grey = random.range(0.16, 0.44);
        let mut tone = |base: Vec3, spread: f32| {
            let vary = Vec3::new(random.next_f32(), random.next_f32(), random.next_f32()) - Vec3::splat(0.5);
            base * (1.0 + random.range(-0.3, 0.25)) + vary * spread
        };
        Self {
            bend: Vec2::new(bent, winding),
            tilt,
            curve,
            median,
            median_half,
            lanes,
            crossings,
            sides,
            asphalt: tone(Vec3::splat(grey), 0.03),
            paving: tone(Vec3::new(0.56, 0.53, 0.50), 0.12),
            grass: tone(Vec3::new(0.32, 0.42, 0.19), 0.10),
            soil: tone(Vec3::new(0.46, 0.37, 0.27), 0.08),
            tiles: [tone(Vec3::new(0.62, 0.52, 0.44), 0.2), tone(Vec3::new(0.44, 0.42, 0.42), 0.2)],
            salt: random.next_u64() as u32,
        }
    }

    /// Metres above the world's origin.
    pub(super) fn height(&self, at: Vec2) -> f32 {
        self.tilt.dot(at) + self.curve.dot(at * at)
    }

    /// Where a ray meets the ground, within `limit`.
    pub(super) fn hit(&self, origin: Vec3, ray: Vec3, limit: f32) -> Option<f32> {
        let (o, r) = (origin.truncate(), ray.truncate());
        let a = self.curve.dot(r * r);
        let b = self.tilt.dot(r) + 2.0 * self.curve.dot(o * r) - ray.z;
        let c = self.height(o) - origin.z;
        let distance = if a.abs() < 1e-7 {
            -c / b
        } else {
            let root = b * b - 4.0 * a * c;
            if root < 0.0 {
                return None;
            }
            // The form that does not cancel; of the two, the nearer ahead.
            let q = -0.5 * (b + root.sqrt() * if b < 0.0 { -1.0 } else { 1.0 });
            let (first, second) = (q / a, c / q);
            let (near, far) = (first.min(second), first.max(second));
            if near > 0.0 { near } else { far }
        };
        (distance > 0.0 && distance < limit).then_some(distance)
    }

    /// The ground's normal.
    pub(super) fn normal(&self, at: Vec2) -> Vec3 {
        let slope = self.tilt + 2.0 * self.curve * at;
        Vec3::new(-slope.x, -slope.y, 1.0).normalize()
    }

    /// The road's direction at `s`, a unit vector.
    pub(super) fn along(&self, s: f32) -> Vec2 {
        Vec2::new(1.0, 2.0 * self.bend.x * s + 3.0 * self.bend.y * s * s).normalize()
    }

    /// From street coordinates to the world's.
    pub(super) fn place(&self, s: f32, d: f32) -> Vec2 {
        Vec2::new(s, self.bend.x * s * s + self.bend.y * s * s * s) + self.along(s).perp() * d
    }

    /// From the world's coordinates to the street's.
    pub(super) fn locate(&self, at: Vec2) -> (f32, f32) {
        let mut s = at.x;
        for _ in 0..2 {
            s += (at - self.place(s, 0.0)).dot(self.along(s));
        }
        (s, (at - self.place(s, 0.0)).dot(self.along(s).perp()))
    }

    /// The street that crosses at (`s`, `d`), if that is within `margin` of its edge, and the distance from its middle.
    pub(super) fn crossing(&self, s: f32, d: f32, margin: f32) -> Option<(&Crossing, f32)> {
        let goes_on = |c: &Crossing| c.sides[usize::from(d < 0.0)];
        let mut here = self.crossings.iter().map(|c| (c, (s - c.at).abs()));
        here.find(|(c, across)| *across < c.half + margin && goes_on(c))
    }

    /// The plot at (`s`, `d`) beside the road, if `d` lies within its depth.
    pub(super) fn plot(&self, s: f32, d: f32) -> Option<&Plot> {
        let side = &self.sides[usize::from(d < 0.0)];
        let after = side.plots.partition_point(|p| p.to <= s);
        side.plots.get(after).filter(|p| d.abs() < side.sidewalk + p.depth)
    }

    /// Class and colour of the ground, seen from `distance` metres: farther away patterns fade.
    pub(super) fn surface(&self, at: Vec2, distance: f32) -> (u8, Vec3) {
        let (s, d) = self.locate(at);
        let side = &self.sides[usize::from(d < 0.0)];
        let (across, sharp) = (d.abs(), 1.0 / (1.0 + 0.0016 * distance * distance));
        let cross = self.crossing(s, d, 3.2).filter(|_| across > side.road);
        if across < side.road {
            return self.road(s, d, side, sharp);
        }
        if let Some((crossing, from_middle)) = cross {
            if from_middle < crossing.half {
                let dash = from_middle < 0.08 && fraction(across / 6.0) < 0.5;
                return (class::DRIVEABLE, if dash { Vec3::splat(0.85) } else { self.asphalt_at(at, sharp) });
            }
            return (class::SIDEWALK, self.paving_at(s, d, from_middle - crossing.half, sharp));
        }
        if across < side.verge {
            return (class::TERRAIN, self.grass_at(at, sharp));
        }
        if across < side.sidewalk {
            return (class::SIDEWALK, self.paving_at(s, d, across - side.verge, sharp));
        }
        match self.plot(s, d).map(|p| p.r#use) {
            Some(Use::Plaza) => (class::OTHER_FLAT, self.tiles_at(s, d, 0.9, sharp)),
            Some(Use::Lot) => {
                let bay = fraction(s / 2.6) < 0.05 && fraction(across / 11.0) < 0.9;
                (class::OTHER_FLAT, if bay { Vec3::splat(0.82) } else { self.tiles_at(s, d, 0.35, sharp) })
            }
            Some(Use::Site) => (class::TERRAIN, self.soil_at(at, sharp)),
            Some(Use::Building) => (class::SIDEWALK, self.paving_at(s, d, 1.0, sharp)),
            _ => (class::TERRAIN, self.grass_at(at, sharp)),
        }
    }

    fn road(&self, s: f32, d: f32, side: &Side, sharp: f32) -> (u8, Vec3) {
        let across = d.abs();
        let junction = self.crossings.iter().map(|c| (s - c.at).abs() - c.half).fold(f32::INFINITY, f32::min);
        let asphalt = self.asphalt_at(Vec2::new(s, d), sharp);
        let paint = Vec3::splat(0.86);
        if junction > 1.0 && across < self.median_half {
            return match self.median {
                Median::Rails => {
                    let rail = (across - 0.72).abs() < 0.09 || (across - 2.0).abs() < 0.09;
                    let bed = self.tiles_at(s, d, 0.6, sharp) * 0.8;
                    (class::OTHER_FLAT, if rail { Vec3::splat(0.28) } else { bed })
                }
                _ => (class::OTHER_FLAT, self.tiles_at(s, d, 0.5, sharp)),
            };
        }
        let lane = (across - self.median_half) / LANE;
        let zebra = (1.0..4.2).contains(&junction) && fraction(d / 1.1) < 0.5 && across < side.lanes;
        let stop = d < 0.0 && (4.8..5.2).contains(&junction) && across < side.lanes;
        let middle = self.median == Median::Line && across < 0.09;
        let edge = (across - side.lanes).abs() < 0.08 || (self.median != Median::Line && lane.abs() * LANE < 0.12);
        let between = (1..self.lanes).any(|n| (lane - n as f32).abs() < 0.024) && fraction(s / 7.0) < 0.45;
        let marked = junction > 4.8 && (middle || edge || between);
        (class::DRIVEABLE, if zebra || stop || marked { paint } else { asphalt })
    }

    fn asphalt_at(&self, at: Vec2, sharp: f32) -> Vec3 {
        let grain = speckle((at.x * 12.0).floor(), (at.y * 12.0).floor(), self.salt) - 0.5;
        let patch = smooth(at.x * 0.25, at.y * 0.25, self.salt) - 0.5;
        self.asphalt * (1.0 + 0.25 * grain * sharp + 0.22 * patch)
    }

    /// Sidewalk, `inwards` metres from its kerb.
    fn paving_at(&self, s: f32, d: f32, inwards: f32, sharp: f32) -> Vec3 {
        if inwards < 0.22 {
            return Vec3::splat(0.72) * (1.0 - 0.1 * speckle(s.floor(), 0.0, self.salt));
        }
        let joint = fraction(s / 0.8) < 0.06 || fraction(d / 0.8) < 0.06;
        let tone = speckle((s / 0.8).floor(), (d / 0.8).floor(), self.salt) - 0.5;
        self.paving * (1.0 + sharp * (0.18 * tone - if joint { 0.2 } else { 0.0 }))
    }

    /// Tiles of two colours in a pattern of this size.
    fn tiles_at(&self, s: f32, d: f32, size: f32, sharp: f32) -> Vec3 {
        let odd = ((s / size).floor() as i32 + (d / size).floor() as i32) & 1 == 0;
        let middle = (self.tiles[0] + self.tiles[1]) * 0.5;
        middle.lerp(self.tiles[usize::from(odd)], sharp.max(0.25))
    }

    fn grass_at(&self, at: Vec2, sharp: f32) -> Vec3 {
        let fine = speckle((at.x * 14.0).floor(), (at.y * 14.0).floor(), self.salt ^ 2) - 0.5;
        let coarse = smooth(at.x * 0.6, at.y * 0.6, self.salt ^ 3) - 0.5;
        let bare = smooth(at.x * 0.13, at.y * 0.13, self.salt ^ 4);
        let tuft = self.grass * (1.0 + 0.6 * fine * sharp + 0.5 * coarse);
        if bare > 0.78 { tuft.lerp(self.soil, 0.7) } else { tuft }
    }

    fn soil_at(&self, at: Vec2, sharp: f32) -> Vec3 {
        let fine = speckle((at.x * 8.0).floor(), (at.y * 8.0).floor(), self.salt ^ 5) - 0.5;
        let coarse = smooth(at.x * 0.5, at.y * 0.5, self.salt ^ 6) - 0.5;
        self.soil * (1.0 + 0.35 * fine * sharp + 0.4 * coarse)
    }
}

impl Side {
    fn new(random: &mut Random, lanes: f32, extent: (f32, f32)) -> Self {
        let road = lanes + if random.below(3) > 0 { PARKING } else { 0.0 };
        let verge = road + if random.below(3) == 0 { random.range(1.2, 3.5) } else { 0.0 };
        let sidewalk = verge + random.range(2.0, 4.8);
        let mut plots = Vec::new();
        let mut from = extent.0;
        // Towns and open country differ in what is common.
        let built = random.below(4) + 1;
        while from < extent.1 {
            let to = from + random.range(14.0, 34.0);
            let r#use = match random.below(8 + built) {
                0 | 1 => Use::Park,
                2 | 3 => Use::Plaza,
                4 => Use::Lot,
                5 => Use::Site,
                6 => Use::Yard,
                _ => Use::Building,
            };
            plots.push(Plot { from, to, depth: random.range(16.0, 40.0), r#use });
            from = to;
        }
        Self { lanes, road, verge, sidewalk, plots }
    }
}

//! A world of one seed at one moment: the street, and everything that stands or drives on it.

use super::objects::{self, Model, class};
use super::solid::{Object, slab};
use super::street::{LANE, PARKING, Street, Use};
use super::texture::pick;
use crate::base::random::Random;
use glam::{Vec2, Vec3};

/// Metres of street behind the first and before the last place of the ego vehicle.
const REACH: f32 = 95.0;

/// Metres of street that are kept clear before and behind the ego vehicle.
const CLEAR: f32 = 7.5;

/// Metres of a cell of the index.
const CELL: f32 = 6.0;

/// A world at one moment.
pub(super) struct World {
    pub(super) street: Street,
    pub(super) objects: Vec<Object>,
    pub(super) index: Index,
    /// Where the ego vehicle stands: a point on the ground and its direction.
    pub(super) ego: (Vec3, Vec2),
}

/// Which objects reach into which cell of a lattice.
pub(super) struct Index {
    low: Vec2,
    size: [usize; 2],
    /// For each cell the end of its objects in `objects`; the first cell's begin at 0.
    ends: Vec<u32>,
    objects: Vec<u32>,
    /// Of all objects.
    bounds: [Vec3; 2],
}

/// Puts things into a world. What is drawn from `random` does not depend on the time.
struct Builder<'a> {
    street: &'a Street,
    random: Random,
    objects: Vec<Object>,
    /// Where the ego vehicle stands, along and across the street, and the way that it drives there.
    ego: (f32, f32),
    travelled: f32,
    extent: (f32, f32),
}

impl World {
    /// The world of `seed` after the ego vehicle has driven `travelled` of `journey` metres.
    pub(super) fn new(seed: u64, journey: f32, travelled: f32) -> Self {
        let mut random = Random::new(seed ^ 0x005e_ed0f_0f57_7ee7);
        let extent = (-REACH, REACH + journey);
        let street = Street::new(&mut random, extent);
        let lane = street.median_half + LANE * (random.below(street.lanes) as f32 + 0.5);
        let d = -lane + random.range(-0.35, 0.35);
        let heading = random.range(-0.05, 0.05);
        let s = travelled;
        let mut builder = Builder { street: &street, random, objects: Vec::new(), ego: (s, d), travelled, extent };
        builder.fill();
        let objects = builder.objects;
        let at = street.place(s, d);
        let along = street.along(s).rotate(Vec2::new(1.0, heading).normalize());
        let ego = (at.extend(street.height(at)), along);
        Self { index: Index::new(&objects), street, objects, ego }
    }
}

impl Index {
    fn new(objects: &[Object]) -> Self {
        let boxes: Vec<[Vec3; 2]> = objects.iter().map(Object::bounds).collect();
        let low = boxes.iter().fold(Vec3::INFINITY, |low, b| low.min(b[0]));
        let high = boxes.iter().fold(Vec3::NEG_INFINITY, |high, b| high.max(b[1]));
        let (low, high) = if objects.is_empty() { (Vec3::ZERO, Vec3::ONE) } else { (low, high) };
        let cells = |v: f32| (v / CELL).floor() as usize + 1;
        let size = [cells(high.x - low.x), cells(high.y - low.y)];
        let range = |a: f32, b: f32| ((a / CELL).floor().max(0.0) as usize)..=((b / CELL).floor() as usize);
        let mut cells = vec![Vec::new(); size[0] * size[1]];
        for (object, b) in boxes.iter().enumerate() {
            let (from, to) = (b[0] - low, b[1] - low);
            for x in range(from.x, to.x) {
                for y in range(from.y, to.y) {
                    cells[x.min(size[0] - 1) * size[1] + y.min(size[1] - 1)].push(object as u32);
                }
            }
        }
        let mut ends = Vec::with_capacity(cells.len());
        let mut all = Vec::new();
        for cell in cells {
            all.extend(cell);
            ends.push(all.len() as u32);
        }
        Self { low: low.truncate(), size, ends, objects: all, bounds: [low, high] }
    }

    /// Calls `visit` with the objects of each cell on a ray's way before `limit`, nearest first, and the distance at
    /// which the ray leaves the cell, until it returns false.
    pub(super) fn walk(&self, origin: Vec3, ray: Vec3, limit: f32, mut visit: impl FnMut(&[u32], f32) -> bool) {
        let inverse = ray.recip();
        let Some((near, far)) = slab(self.bounds[0], self.bounds[1], origin, inverse) else { return };
        let far = far.min(limit);
        let start = (origin.truncate() + ray.truncate() * near - self.low) / CELL;
        let last = Vec2::new(self.size[0] as f32 - 1.0, self.size[1] as f32 - 1.0);
        let mut cell = start.floor().clamp(Vec2::ZERO, last).to_array();
        let last = last.to_array();
        let step = [ray.x, ray.y].map(|v| if v < 0.0 { -1.0 } else { 1.0 });
        // Distance at which the ray leaves the cell along an axis.
        let exit = |cell: f32, axis: usize| {
            let edge = self.low[axis] + (cell + if step[axis] > 0.0 { 1.0 } else { 0.0 }) * CELL;
            let distance = (edge - origin[axis]) * inverse[axis];
            if distance.is_nan() { f32::INFINITY } else { distance }
        };
        let mut exits = [exit(cell[0], 0), exit(cell[1], 1)];
        loop {
            let at = cell[0] as usize * self.size[1] + cell[1] as usize;
            let from = at.checked_sub(1).map_or(0, |before| self.ends[before]);
            let leaves_at = exits[0].min(exits[1]);
            if !visit(&self.objects[from as usize..self.ends[at] as usize], leaves_at) || leaves_at >= far {
                return;
            }
            let axis = usize::from(exits[1] < exits[0]);
            cell[axis] += step[axis];
            if cell[axis] < 0.0 || cell[axis] > last[axis] {
                return;
            }
            exits[axis] = exit(cell[axis], axis);
        }
    }
}

impl Builder<'_> {
    fn fill(&mut self) {
        self.traffic();
        for left in [true, false] {
            self.parked(left);
            self.crossings(left);
            self.sidewalk(left);
            self.plots(left);
        }
        self.road_works();
    }

    /// Puts a model at street coordinates, turned from the street's direction by `turn` (cosine and sine).
    fn put(&mut self, model: Model, s: f32, d: f32, turn: Vec2) {
        let at = self.street.place(s, d);
        let along = self.street.along(s).rotate(turn);
        let at = at.extend(self.street.height(at));
        self.objects.push(Object::new(model.class, at, along, model.parts));
    }

    /// A turn by a small random angle, from ahead (`forward`) or from behind.
    fn nearly(&mut self, forward: bool, spread: f32) -> Vec2 {
        let turn = Vec2::new(1.0, self.random.range(-spread, spread)).normalize();
        if forward { turn } else { -turn }
    }

    fn any_turn(&mut self) -> Vec2 {
        let v = Vec2::new(self.random.range(-1.0, 1.0), self.random.range(-1.0, 1.0));
        if v.length_squared() < 0.01 { Vec2::X } else { v.normalize() }
    }

    /// Whether a thing from `from` to `to` along the street, at `d`, would touch the ego vehicle or its cameras.
    fn touches_ego(&self, from: f32, to: f32, d: f32, half: f32) -> bool {
        let (s, across) = self.ego;
        to > s - CLEAR && from < s + CLEAR && (d - across).abs() < half + 1.9
    }

    fn on_crossing(&self, s: f32, margin: f32) -> bool {
        self.street.crossings.iter().any(|c| (s - c.at).abs() < c.half + margin)
    }

    /// What drives: a model, and what it pulls.
    fn vehicle(&mut self) -> (Model, Option<Model>) {
        let random = &mut self.random;
        match random.below(100) {
            0..50 => (objects::car(random), None),
            50..56 => (objects::car(random), Some(objects::trailer(random, false))),
            56..67 => (objects::truck(random), None),
            67..77 => (objects::bus(random), None),
            77..87 => (objects::tractor(random), Some(objects::trailer(random, true))),
            87..93 => (objects::motorcycle(random, true), None),
            93..97 => (objects::bicycle(random, true), None),
            _ => (objects::construction_vehicle(random), None),
        }
    }

    /// Vehicles in the lanes. Those of a lane share a speed, so that none meets another.
    fn traffic(&mut self) {
        for side in [1.0f32, -1.0] {
            for lane in 0..self.street.lanes {
                let d = side * (self.street.median_half + LANE * (lane as f32 + 0.5));
                // On the right side with the ego vehicle, on the left against it.
                let forward = side < 0.0;
                let pace = self.random.range(0.7, 1.3) * if forward { 1.0 } else { -1.0 };
                let dense = self.random.range(6.0, 26.0);
                let reach = self.extent.1 - self.extent.0;
                let mut s = self.extent.0 - reach + self.random.range(0.0, 10.0);
                while s < self.extent.1 + reach {
                    let (model, pulled) = self.vehicle();
                    let length = model.length + pulled.as_ref().map_or(0.0, |t| t.length + 0.8);
                    let (turn, offset) = (self.nearly(forward, 0.03), self.random.range(-0.3, 0.3));
                    let middle = s + length * 0.5 + self.travelled * pace;
                    s += length + 2.0 + self.random.next_f32() * dense;
                    let (from, to) = (middle - length * 0.5, middle + length * 0.5);
                    // Beside the cameras a lorry would fill several images.
                    let half = if length > 6.0 { 2.6 } else { 1.3 };
                    if from < self.extent.0 || to > self.extent.1 || self.touches_ego(from, to, d, half) {
                        continue;
                    }
                    let ahead = if forward { 1.0 } else { -1.0 };
                    let front = middle + ahead * (length - model.length) * 0.5;
                    let back = pulled.as_ref().map(|t| middle - ahead * (length - t.length) * 0.5);
                    self.put(model, front, d + offset, turn);
                    if let (Some(trailer), Some(back)) = (pulled, back) {
                        self.put(trailer, back, d + offset, turn);
                    }
                }
            }
        }
    }

    /// Vehicles in the lane for parking.
    fn parked(&mut self, left: bool) {
        let side = &self.street.sides[usize::from(!left)];
        if side.road <= side.lanes {
            return;
        }
        let sign = if left { 1.0 } else { -1.0 };
        let d = sign * (side.lanes + PARKING * 0.5);
        let mut s = self.extent.0 + self.random.range(0.0, 6.0);
        while s < self.extent.1 {
            let random = &mut self.random;
            let model = match random.below(20) {
                0..12 => objects::car(random),
                12 => objects::truck(random),
                13 => objects::bus(random),
                14 | 15 => objects::trailer(random, false),
                16 => {
                    let long = random.below(2) == 0;
                    objects::trailer(random, long)
                }
                17 => objects::construction_vehicle(random),
                _ => objects::motorcycle(random, false),
            };
            let (length, turn) = (model.length, self.nearly(!left, 0.04));
            let middle = s + length * 0.5;
            let free = !self.on_crossing(middle, length * 0.5 + 5.0) && !self.touches_ego(s, s + length, d, 1.3);
            if free && self.random.below(10) < 7 {
                self.put(model, middle, d, turn);
            }
            s += length + self.random.range(0.5, 5.0);
        }
    }

    /// People on the zebra crossings, traffic that waits in the streets that cross, lights.
    fn crossings(&mut self, left: bool) {
        let sign = if left { 1.0 } else { -1.0 };
        let side = usize::from(!left);
        for n in 0..self.street.crossings.len() {
            let crossing = self.street.crossings[n];
            let edge = self.street.sides[side].road;
            for end in [-1.0, 1.0] {
                let s = crossing.at + end * (crossing.half + 2.6);
                for _ in 0..self.random.below(3) {
                    let (d, turn) = (sign * self.random.range(1.0, edge), self.nearly(true, 0.4).perp());
                    let (model, s) = (objects::pedestrian(&mut self.random), s + self.random.range(-1.2, 1.2));
                    if !self.touches_ego(s, s, d, 0.5) {
                        self.put(model, s, d, turn);
                    }
                }
                let model = objects::pole(&mut self.random);
                self.put(model, s, sign * (self.street.sides[side].verge + 0.5), Vec2::new(0.0, -sign));
            }
            if !crossing.sides[side] {
                continue;
            }
            // They stand on their right.
            let mut d = edge + 4.0;
            while d < edge + 45.0 {
                let (model, pulled) = self.vehicle();
                let gap = self.random.range(2.0, 14.0);
                if pulled.is_none() && self.random.below(3) > 0 {
                    let towards = self.random.below(2) == 0;
                    let turn = Vec2::new(0.0, if towards { -sign } else { sign });
                    let s = crossing.at + crossing.half * 0.5 * sign * if towards { -1.0 } else { 1.0 };
                    let middle = sign * (d + model.length * 0.5);
                    d += model.length;
                    self.put(model, s, middle, turn);
                }
                d += gap;
            }
        }
    }

    /// People, lamps, trees, hedges, parked bicycles and barriers beside the road.
    fn sidewalk(&mut self, left: bool) {
        let sign = if left { 1.0 } else { -1.0 };
        let side = &self.street.sides[usize::from(!left)];
        let (road, verge, sidewalk) = (side.road, side.verge, side.sidewalk);
        let green = self.random.below(3);
        let mut s = self.extent.0 + self.random.range(0.0, 4.0);
        while s < self.extent.1 {
            let kerb = sign * if verge - road > 1.0 { (road + verge) * 0.5 } else { road + 0.55 };
            let clear = !self.on_crossing(s, 3.0);
            let random = &mut self.random;
            let choice = random.below(20);
            match choice {
                _ if !clear => {}
                0..3 => {
                    let model = objects::pole(random);
                    self.put(model, s, kerb, Vec2::new(-sign, 0.0));
                }
                3..6 => {
                    for n in 0..1 + self.random.below(5) {
                        let model = objects::bicycle(&mut self.random, false);
                        let turn = self.nearly(true, 0.3).perp();
                        self.put(model, s + 0.55 * n as f32, sign * (verge + 1.3), turn);
                    }
                }
                6 => {
                    for n in 0..1 + self.random.below(3) {
                        let model = objects::motorcycle(&mut self.random, false);
                        let turn = self.nearly(true, 0.3).perp();
                        self.put(model, s + 1.0 * n as f32, sign * (verge + 1.3), turn);
                    }
                }
                7 => {
                    let kind = pick(random, &[0, 1, 2, 3]);
                    for n in 0..3 + self.random.below(5) {
                        let model = objects::barrier(&mut self.random, kind);
                        let turn = self.nearly(true, 0.02);
                        self.put(model, s + 2.05 * n as f32, sign * (road + 0.4), turn);
                    }
                }
                8..12 if green > 0 => {
                    let model = objects::tree(random);
                    let turn = self.any_turn();
                    self.put(model, s, kerb + sign * 0.4, turn);
                }
                12 if green == 2 => {
                    let length = random.range(3.0, 9.0);
                    let model = objects::hedge(random, length);
                    self.put(model, s, sign * (sidewalk + 0.6), Vec2::X);
                }
                _ => {}
            }
            for _ in 0..pick(&mut self.random, &[0, 0, 1, 1, 2]) {
                let (model, turn) = (objects::pedestrian(&mut self.random), self.any_turn());
                let (s, share) = (s + self.random.range(-2.0, 2.0), self.random.range(0.35, 0.95));
                self.put(model, s, sign * (verge + share * (sidewalk - verge)), turn);
            }
            s += self.random.range(3.0, 7.5);
        }
    }

    /// What stands on the land beside the road.
    fn plots(&mut self, left: bool) {
        let sign = if left { 1.0 } else { -1.0 };
        let edge = self.street.sides[usize::from(!left)].sidewalk;
        for n in 0..self.street.sides[usize::from(!left)].plots.len() {
            let plot = self.street.sides[usize::from(!left)].plots[n];
            let (middle, length) = ((plot.from + plot.to) * 0.5, plot.to - plot.from);
            // A street that crosses leaves no room.
            let street = self.street;
            let crossed = |s: f32| street.crossing(s, sign * (edge + 1.0), 3.5).is_some();
            let blocked = (0..9).any(|i| crossed(plot.from + length * i as f32 * 0.125));
            let inside = |random: &mut Random, margin: f32| {
                let s = random.range(plot.from + margin, (plot.to - margin).max(plot.from + margin));
                (s, sign * (edge + random.range(margin, plot.depth - margin)))
            };
            match plot.r#use {
                Use::Building if !blocked => self.building(sign, edge, middle, length, plot.depth),
                Use::Site => self.site(sign, edge, plot.from, plot.to, plot.depth),
                Use::Lot => self.lot(sign, edge, plot.from, plot.to, plot.depth),
                Use::Yard if !blocked => {
                    let model = if self.random.below(2) == 0 {
                        objects::wall(&mut self.random, length - 0.6)
                    } else {
                        objects::hedge(&mut self.random, length - 0.6)
                    };
                    self.put(model, middle, sign * (edge + 0.7), Vec2::X);
                    if self.random.below(3) > 0 {
                        let edge = edge + self.random.range(4.0, 9.0);
                        self.building(sign, edge, middle, length * 0.7, plot.depth * 0.5);
                    }
                }
                Use::Park => {
                    for _ in 0..4 + self.random.below(8) {
                        let (s, d) = inside(&mut self.random, 1.5);
                        let tree = self.random.below(3) > 0;
                        let model =
                            if tree { objects::tree(&mut self.random) } else { objects::bush(&mut self.random) };
                        let turn = self.any_turn();
                        if !crossed(s) {
                            self.put(model, s, d, turn);
                        }
                    }
                }
                Use::Plaza => {
                    for _ in 0..3 + self.random.below(8) {
                        let (s, d) = inside(&mut self.random, 1.0);
                        let turn = self.any_turn();
                        let model = match self.random.below(10) {
                            0..6 => objects::pedestrian(&mut self.random),
                            6 => objects::bicycle(&mut self.random, true),
                            7 => objects::pole(&mut self.random),
                            _ => objects::tree(&mut self.random),
                        };
                        if !crossed(s) {
                            self.put(model, s, d, turn);
                        }
                    }
                }
                _ => {}
            }
        }
    }

    fn building(&mut self, sign: f32, edge: f32, middle: f32, length: f32, depth: f32) {
        let set_back = pick(&mut self.random, &[0.2, 0.2, 1.0, 3.0]);
        let depth = (depth - set_back).clamp(4.0, 18.0);
        let model = objects::building(&mut self.random, length - 0.4, depth);
        // Its front looks at the road, its depth away from it.
        let turn = Vec2::new(sign, 0.0);
        self.put(model, middle, sign * (edge + set_back), turn);
    }

    /// Vehicles in bays.
    fn lot(&mut self, sign: f32, edge: f32, from: f32, to: f32, depth: f32) {
        let mut row = 3.5;
        while row < depth - 3.0 {
            let mut s = from + 1.3;
            while s < to - 1.3 {
                let model = match self.random.below(12) {
                    0 => objects::trailer(&mut self.random, false),
                    1 => objects::motorcycle(&mut self.random, false),
                    _ => objects::car(&mut self.random),
                };
                let nose_in = self.random.below(3) > 0;
                let turn = self.nearly(nose_in, 0.05).perp();
                let here = self.random.below(10) < 6;
                if here && self.street.crossing(s, sign * (edge + 1.0), 4.0).is_none() {
                    self.put(model, s, sign * (edge + row), turn);
                }
                s += 2.6;
            }
            row += 11.0;
        }
        for _ in 0..self.random.below(3) {
            let (s, d) = (self.random.range(from, to), sign * (edge + self.random.range(7.0, 9.0).min(depth)));
            let (model, turn) = (objects::pedestrian(&mut self.random), self.any_turn());
            self.put(model, s, d, turn);
        }
    }

    /// Machines behind a row of barriers.
    fn site(&mut self, sign: f32, edge: f32, from: f32, to: f32, depth: f32) {
        let kind = pick(&mut self.random, &[0, 1, 2]);
        let mut s = from + 1.0;
        while s < to - 1.0 {
            let (model, turn) = (objects::barrier(&mut self.random, kind), self.nearly(true, 0.05));
            if self.random.below(12) > 0 && self.street.crossing(s, sign * (edge + 1.0), 4.0).is_none() {
                self.put(model, s, sign * (edge + 0.5), turn);
            }
            s += 2.05;
        }
        for n in 0..1 + self.random.below(2) {
            let (s, turn) = (from + (to - from) * (0.3 + 0.4 * n as f32), self.any_turn());
            let d = sign * (edge + self.random.range(5.0, (depth - 4.0).clamp(5.1, 16.0)));
            let model = objects::construction_vehicle(&mut self.random);
            if self.street.crossing(s, d, 5.0).is_none() {
                self.put(model, s, d, turn);
            }
        }
        for _ in 0..2 + self.random.below(5) {
            let s = self.random.range(from + 1.0, to - 1.0);
            let d = sign * (edge + self.random.range(1.5, 7.0));
            let turn = self.any_turn();
            let model = match self.random.below(3) {
                0 => objects::pedestrian(&mut self.random),
                _ => objects::traffic_cone(&mut self.random),
            };
            self.put(model, s, d, turn);
        }
    }

    /// Stretches at the edge of the road that cones or barriers close, with a machine or a lorry behind.
    fn road_works(&mut self) {
        for _ in 0..2 + self.random.below(2) {
            let sign = pick(&mut self.random, &[1.0, -1.0]);
            let from = self.random.range(self.extent.0, self.extent.1 - 15.0);
            let length = self.random.range(10.0, 26.0);
            let lane = self.street.sides[usize::from(sign < 0.0)].lanes;
            let taper = self.random.range(2.0, 6.0);
            let (cones, kind) = (self.random.below(3) > 0, self.random.below(3));
            let mut at = 0.0;
            while at < length {
                // From the edge of the lanes inwards, along, and out again.
                let in_by = (at / taper).min((length - at) / taper).min(1.0) * 2.6;
                let (s, d) = (from + at, sign * (lane - in_by));
                let turn = self.nearly(true, 0.1);
                let model = if cones {
                    objects::traffic_cone(&mut self.random)
                } else {
                    objects::barrier(&mut self.random, kind)
                };
                if !self.touches_ego(s - 1.0, s + 1.0, d, 0.6) {
                    self.put(model, s, d, turn);
                }
                at += if cones { self.random.range(1.2, 2.4) } else { 2.05 };
            }
            let (s, d) = (from + length * 0.5, sign * (lane - 1.1));
            let model = match self.random.below(4) {
                0 => objects::truck(&mut self.random),
                1 => objects::trailer(&mut self.random, false),
                _ => objects::construction_vehicle(&mut self.random),
            };
            let turn = self.nearly(sign < 0.0, 0.1);
            let half = model.length * 0.5;
            let free = !self.touches_ego(s - half, s + half, d, 1.4);
            self.clear(s, d, half + 1.0);
            if free {
                self.put(model, s, d, turn);
            }
            let (worker, turn) = (objects::pedestrian(&mut self.random), self.any_turn());
            self.put(worker, s + half + 1.2, d, turn);
        }
    }

    /// Takes away the vehicles that stand where something else is to stand.
    fn clear(&mut self, s: f32, d: f32, half: f32) {
        let at = self.street.place(s, d);
        let vehicles =
            [class::BUS, class::CAR, class::CONSTRUCTION_VEHICLE, class::TRAILER, class::TRUCK, class::MOTORCYCLE];
        self.objects.retain(|o| {
            let [low, high] = o.bounds();
            let nearest = at.clamp(low.truncate(), high.truncate());
            !vehicles.contains(&o.class) || nearest.distance(at) > half.min(2.6)
        });
    }
}

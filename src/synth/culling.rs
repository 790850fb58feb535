//! What rays can meet, found for many of them at once: the parts behind a tile of an image, and those between a place and
//! the sun.
//!
//! Both leave out only what no such ray can meet. What remains is asked in the order and with the arithmetic of a
//! search through everything, so that the same things are found, to the last bit.

use super::camera::Pinhole;
use super::solid::{Hit, Object, outline};
use super::world::World;
use glam::{DMat3, DVec3, Mat3, Vec2, Vec3};

/// Pixels of a tile along each side.
const TILE: usize = 16;

/// Pixels around a tile from which rays may start too, and some for rounding.
const MARGIN: f32 = 1.5;

/// So many objects behind a tile are asked one by one; among more, the nearest are found by a walk.
const FEW: usize = 8;

/// Depth in metres before which nothing is projected.
const NEAR: f32 = 1e-3;

/// Metres of a cell of the sun's lattice, and the cells at most along a side.
const SUN_CELL: f32 = 1.0;
const SUN_CELLS: f32 = 512.0;

/// Metres by which a part may be farther towards the sun, or aside, than rounding makes it.
const SUN_MARGIN: f32 = 0.01;

/// A part of an object.
#[derive(Clone, Copy)]
struct Candidate {
    object: u32,
    part: u32,
}

/// Lists, one for each cell of a lattice, one after the other.
struct Lists<T> {
    /// The end of each list; the first begins at 0.
    ends: Vec<u32>,
    all: Vec<T>,
}

impl<T: Copy> Lists<T> {
    /// Of things that each belong into a rectangle of cells: columns and rows from the first to the last. The order stays.
    fn new(size: [usize; 2], things: &[([usize; 4], T)]) -> Self {
        let cells =
            |&[x0, x1, y0, y1]: &[usize; 4]| (y0..=y1).flat_map(move |y| (x0..=x1).map(move |x| y * size[0] + x));
        let mut starts = vec![0u32; size[0] * size[1] + 1];
        for (rectangle, _) in things {
            cells(rectangle).for_each(|cell| starts[cell + 1] += 1);
        }
        for cell in 1..starts.len() {
            starts[cell] += starts[cell - 1];
        }
        let Some(&(_, filler)) = things.first() else { return Self { ends: starts, all: Vec::new() } };
        let mut all = vec![filler; starts[size[0] * size[1]] as usize];
        for (rectangle, thing) in things {
            for cell in cells(rectangle) {
                all[starts[cell] as usize] = *thing;
                starts[cell] += 1;
            }
        }
        Self { ends: starts, all }
    }

    fn of(&self, cell: usize) -> &[T] {
        let from = cell.checked_sub(1).map_or(0, |before| self.ends[before]);
        &self.all[from as usize..self.ends[cell] as usize]
    }
}

/// What one camera can see of a world, tile by tile.
pub(super) struct Culling<'a> {
    world: &'a World,
    origin: Vec3,
    /// Columns and rows of tiles.
    tiles: [usize; 2],
    size: [usize; 2],
    candidates: Lists<Candidate>,
    /// Of each object.
    slots: Vec<Slot>,
    tile: u32,
    /// Of which the tile has candidates.
    objects: usize,
    ray: u32,
}

/// Where an object's parts stand among the candidates of the tile `tile`, and the last ray that has asked it.
#[derive(Clone, Copy)]
struct Slot {
    tile: u32,
    ray: u32,
    from: u32,
    to: u32,
}

impl<'a> Culling<'a> {
    pub(super) fn new(world: &'a World, camera: &Pinhole) -> Self {
        let [height, width] = camera.size;
        let tiles = [width.div_ceil(TILE), height.div_ceil(TILE)];
        let origin = world.placed(camera.at.as_vec3());
        let project = Projection::new(world, camera);
        let mut things = Vec::new();
        for (number, object) in world.objects.iter().enumerate() {
            let Some(whole) = project.tiles(object, object.low, object.high, origin, tiles) else { continue };
            let single = whole[0] == whole[1] && whole[2] == whole[3];
            for (part, p) in object.parts.iter().enumerate() {
                let candidate = Candidate { object: number as u32, part: part as u32 };
                if single {
                    things.push((whole, candidate));
                } else if let Some(r) = project.tiles(object, p.centre - p.half, p.centre + p.half, origin, tiles) {
                    things.push((r, candidate));
                }
            }
        }
        let candidates = Lists::new(tiles, &things);
        let slots = vec![Slot { tile: u32::MAX, ray: 0, from: 0, to: 0 }; world.objects.len()];
        Self { world, origin, tiles, size: camera.size, candidates, slots, tile: u32::MAX, objects: 0, ray: 0 }
    }

    /// Calls `visit` with every pixel of every tile, tile by tile: `hit` then knows the rays from within a pixel of it.
    pub(super) fn pixels(&mut self, mut visit: impl FnMut(&mut Self, usize, usize)) {
        let [height, width] = self.size;
        for tile in 0..self.tiles[0] * self.tiles[1] {
            self.enter(tile);
            let (u, v) = (tile % self.tiles[0] * TILE, tile / self.tiles[0] * TILE);
            for v in v..(v + TILE).min(height) {
                for u in u..(u + TILE).min(width) {
                    visit(self, u, v);
                }
            }
        }
    }

    fn enter(&mut self, tile: usize) {
        self.tile = tile as u32;
        self.objects = 0;
        let mut from = 0;
        for parts in self.candidates.of(tile).chunk_by(|a, b| a.object == b.object) {
            let to = from + parts.len() as u32;
            let slot = &mut self.slots[parts[0].object as usize];
            *slot = Slot { tile: self.tile, ray: slot.ray, from, to };
            from = to;
            self.objects += 1;
        }
    }

    /// The nearest object that a ray of the tile meets before `limit`: its number, its part's, and where.
    pub(super) fn hit(&mut self, ray: Vec3, limit: f32) -> Option<(usize, usize, Hit)> {
        let candidates = self.candidates.of(self.tile as usize);
        if candidates.is_empty() {
            return None;
        }
        if self.objects <= FEW {
            let mut best: Option<(usize, usize, Hit)> = None;
            let mut tie = false;
            for parts in candidates.chunk_by(|a, b| a.object == b.object) {
                let number = parts[0].object as usize;
                // Just beyond the best so far, so that another at the same distance shows.
                let limit = best.map_or(limit, |(_, _, hit)| hit.distance.next_up());
                let parts = parts.iter().map(|c| c.part as usize);
                if let Some((part, hit)) = self.world.objects[number].hit(self.origin, ray, limit, parts) {
                    tie |= best.is_some_and(|(_, _, other)| other.distance == hit.distance);
                    best = Some((number, part, hit));
                }
            }
            // Of several at one distance the one counts that a walk comes to first.
            if !tie {
                return best;
            }
        }
        self.ray += 1;
        let mut best: Option<(usize, usize, Hit)> = None;
        self.world.index.walk(self.origin, ray, limit, |cell, leaves_at| {
            for &number in cell {
                // An object that reaches into several cells need not be asked again.
                let slot = &mut self.slots[number as usize];
                if slot.tile != self.tile || slot.ray == self.ray {
                    continue;
                }
                slot.ray = self.ray;
                let limit = best.map_or(limit, |(_, _, hit)| hit.distance);
                let parts = candidates[slot.from as usize..slot.to as usize].iter().map(|c| c.part as usize);
                if let Some((part, hit)) = self.world.objects[number as usize].hit(self.origin, ray, limit, parts) {
                    best = Some((number as usize, part, hit));
                }
            }
            best.is_none_or(|(_, _, hit)| hit.distance > leaves_at)
        });
        best
    }

    /// Where the camera is.
    pub(super) fn origin(&self) -> Vec3 {
        self.origin
    }
}

/// From places of the world, as seen from the camera, to column and row times depth, and depth.
struct Projection(Mat3);

impl Projection {
    fn new(world: &World, camera: &Pinhole) -> Self {
        let [c, s] = world.ego.1.to_array().map(f64::from);
        let turn = DMat3::from_cols(DVec3::new(c, s, 0.0), DVec3::new(-s, c, 0.0), DVec3::Z);
        let camera = DMat3::from_cols(camera.right, camera.down, camera.first);
        Self((camera.inverse() * turn.transpose()).as_mat3())
    }

    /// The tiles that the image of a box of an object touches, if any: columns and rows from the first to the last.
    fn tiles(&self, object: &Object, low: Vec3, high: Vec3, origin: Vec3, tiles: [usize; 2]) -> Option<[usize; 4]> {
        let (middle, half) = ((low + high) * 0.5, (high - low) * 0.5);
        let middle = self.0 * (object.at + object.outwards(middle) - origin);
        let axes = [Vec3::X * half.x, Vec3::Y * half.y, Vec3::Z * half.z].map(|v| self.0 * object.outwards(v));
        let corners: [Vec3; 8] = std::array::from_fn(|n| {
            (0..3).fold(middle, |at, axis| if n >> axis & 1 == 1 { at + axes[axis] } else { at - axes[axis] })
        });
        let (mut near, mut far) = (Vec2::INFINITY, Vec2::NEG_INFINITY);
        let mut include = |at: Vec3| {
            let at = at.truncate() / at.z;
            (near, far) = (near.min(at), far.max(at));
        };
        for (n, &corner) in corners.iter().enumerate() {
            if corner.z >= NEAR {
                include(corner);
            }
            // Edges to the corners after this one, where they come through the plane at NEAR.
            for other in (0..3).filter(|axis| n >> axis & 1 == 0).map(|axis| corners[n | 1 << axis]) {
                if (corner.z >= NEAR) != (other.z >= NEAR) {
                    include(corner.lerp(other, (NEAR - corner.z) / (other.z - corner.z)).with_z(NEAR));
                }
            }
        }
        let range = |near: f32, far: f32, count: usize| {
            let (from, to) = ((near - MARGIN) / TILE as f32, (far + MARGIN) / TILE as f32);
            // Also refuses what has no number, and a box behind the camera, which has no bounds.
            (from < count as f32 && to >= 0.0).then(|| (from.max(0.0) as usize, (to as usize).min(count - 1)))
        };
        let ((x0, x1), (y0, y1)) = (range(near.x, far.x, tiles[0])?, range(near.y, far.y, tiles[1])?);
        Some([x0, x1, y0, y1])
    }
}

/// What keeps the sun from which places.
pub(super) struct Shadows<'a> {
    world: &'a World,
    sun: Vec3,
    /// Metres towards the sun at which nothing casts a shadow any more.
    reach: f32,
    /// Two directions across the sun's.
    across: [Vec3; 2],
    low: Vec2,
    cell: f32,
    size: [usize; 2],
    parts: Lists<Shade>,
    /// Direction to the sun, and its reciprocal, in the coordinates of each object.
    rays: Vec<[Vec3; 2]>,
}

/// A part that casts a shadow, and from where to where it reaches in the direction of the sun.
#[derive(Clone, Copy)]
struct Shade {
    of: Candidate,
    from: f32,
    to: f32,
}

impl<'a> Shadows<'a> {
    /// For the direction to the sun, which never stands overhead.
    pub(super) fn new(world: &'a World, sun: Vec3, reach: f32) -> Self {
        let first = sun.cross(Vec3::Z).normalize();
        let across = [first, first.cross(sun)];
        let mut boxes = Vec::new();
        let (mut low, mut high) = (Vec2::INFINITY, Vec2::NEG_INFINITY);
        for (number, object) in world.objects.iter().enumerate() {
            for (part, p) in object.parts.iter().enumerate() {
                let (middle, half) = outline(object, p.centre, p.half, [across[0], across[1], sun]);
                let half = half + SUN_MARGIN;
                let (from, to) = (middle - half, middle + half);
                (low, high) = (low.min(from.truncate()), high.max(to.truncate()));
                let of = Candidate { object: number as u32, part: part as u32 };
                boxes.push((from.truncate(), to.truncate(), Shade { of, from: from.z, to: to.z }));
            }
        }
        let rays = world.objects.iter().map(|o| o.inwards(sun)).map(|ray| [ray, ray.recip()]).collect();
        let (low, high) = if boxes.is_empty() { (Vec2::ZERO, Vec2::ZERO) } else { (low, high) };
        let cell = SUN_CELL.max((high - low).max_element() / SUN_CELLS);
        let last = ((high - low) / cell).floor();
        let at = |v: f32, low: f32, last: f32| ((v - low) / cell).clamp(0.0, last) as usize;
        let things: Vec<_> = boxes
            .iter()
            .map(|&(from, to, shade)| {
                let columns = [from.x, to.x].map(|v| at(v, low.x, last.x));
                let rows = [from.y, to.y].map(|v| at(v, low.y, last.y));
                ([columns[0], columns[1], rows[0], rows[1]], shade)
            })
            .collect();
        let size = [last.x as usize + 1, last.y as usize + 1];
        Self { world, sun, reach, across, low, cell, size, parts: Lists::new(size, &things), rays }
    }

    /// Whether an object lies between a place and the sun.
    pub(super) fn at(&self, place: Vec3) -> bool {
        let here = (Vec2::from_array(self.across.map(|v| v.dot(place))) - self.low) / self.cell;
        let [columns, rows] = self.size.map(|n| n as f32);
        if !(here.x >= 0.0 && here.y >= 0.0 && here.x < columns && here.y < rows) {
            return false;
        }
        let along = self.sun.dot(place);
        let parts = self.parts.of(here.y as usize * self.size[0] + here.x as usize);
        parts.chunk_by(|a, b| a.of.object == b.of.object).any(|parts| {
            let number = parts[0].of.object as usize;
            let ahead = parts.iter().filter(|s| s.to >= along && s.from <= along + self.reach);
            self.world.objects[number].shades(place, self.rays[number], self.reach, ahead.map(|s| s.of.part as usize))
        })
    }
}

//! Solids that objects are made of: where a ray meets them, and which points lie in them.

use super::texture::Finish;
use glam::{Vec2, Vec3};

/// The shape of a part, filling the box from `centre - half` to `centre + half`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Shape {
    Box,
    Ellipsoid,
    /// A cylinder along the axis 0, 1 or 2; elliptic if the other two half lengths differ.
    Cylinder(usize),
}

/// One solid, in the coordinates of its object.
#[derive(Clone, Copy, Debug)]
pub(super) struct Part {
    pub(super) shape: Shape,
    pub(super) centre: Vec3,
    pub(super) half: Vec3,
    pub(super) colour: Vec3,
    pub(super) finish: Finish,
}

/// Parts that stand together, turned about the vertical and put somewhere.
#[derive(Clone, Debug)]
pub(super) struct Object {
    /// Class of the voxels that it fills.
    pub(super) class: u8,
    /// The origin of its coordinates in the world.
    pub(super) at: Vec3,
    /// Its x axis in the world: a unit vector.
    pub(super) along: Vec2,
    pub(super) parts: Vec<Part>,
    /// Common bounds of the parts.
    pub(super) low: Vec3,
    pub(super) high: Vec3,
}

/// Where a ray meets a part.
#[derive(Clone, Copy, Debug)]
pub(super) struct Hit {
    pub(super) distance: f32,
    /// Outwards, a unit vector.
    pub(super) normal: Vec3,
}

impl Object {
    /// With the parts' common bounds.
    pub(super) fn new(class: u8, at: Vec3, along: Vec2, parts: Vec<Part>) -> Self {
        let low = parts.iter().fold(Vec3::INFINITY, |low, p| low.min(p.centre - p.half));
        let high = parts.iter().fold(Vec3::NEG_INFINITY, |high, p| high.max(p.centre + p.half));
        Self { class, at, along, parts, low, high }
    }

    /// A direction of the world in the object's coordinates.
    pub(super) fn inwards(&self, v: Vec3) -> Vec3 {
        let Vec2 { x: c, y: s } = self.along;
        Vec3::new(c * v.x + s * v.y, c * v.y - s * v.x, v.z)
    }

    /// A direction of the object in the world's coordinates.
    pub(super) fn outwards(&self, v: Vec3) -> Vec3 {
        let Vec2 { x: c, y: s } = self.along;
        Vec3::new(c * v.x - s * v.y, s * v.x + c * v.y, v.z)
    }

    /// Corners of the box, parallel to the world's axes, that holds it.
    pub(super) fn bounds(&self) -> [Vec3; 2] {
        let (middle, half) = ((self.low + self.high) * 0.5, (self.high - self.low) * 0.5);
        let (middle, along) = (self.at + self.outwards(middle), self.along.abs());
        let reach = Vec3::new(along.x * half.x + along.y * half.y, along.y * half.x + along.x * half.y, half.z);
        [middle - reach, middle + reach]
    }

    /// The nearest of some parts, in ascending order, that a ray of the world meets before `limit`, and where.
    pub(super) fn hit(
        &self,
        origin: Vec3,
        ray: Vec3,
        limit: f32,
        parts: impl Iterator<Item = usize>,
    ) -> Option<(usize, Hit)> {
        let (origin, ray) = (self.inwards(origin - self.at), self.inwards(ray));
        let inverse = ray.recip();
        slab(self.low, self.high, origin, inverse).filter(|&(near, _)| near < limit)?;
        let mut best: Option<(usize, Hit)> = None;
        for index in parts {
            let limit = best.map_or(limit, |(_, hit)| hit.distance);
            if let Some(hit) = self.parts[index].hit(origin, ray, inverse).filter(|hit| hit.distance < limit) {
                best = Some((index, hit));
            }
        }
        best.map(|(index, hit)| (index, Hit { normal: self.outwards(hit.normal), ..hit }))
    }

    /// Whether any of some parts lies in a ray's way before `limit`. The place is the world's; the ray and its reciprocal
    /// are in the object's coordinates.
    pub(super) fn shades(
        &self,
        place: Vec3,
        [ray, inverse]: [Vec3; 2],
        limit: f32,
        mut parts: impl Iterator<Item = usize>,
    ) -> bool {
        let origin = self.inwards(place - self.at);
        parts.any(|part| self.parts[part].hit(origin, ray, inverse).is_some_and(|hit| hit.distance < limit))
            && slab(self.low, self.high, origin, inverse).is_some_and(|(near, _)| near < limit)
    }
}

/// Middle and half lengths, along three directions of the world, of a box in an object's coordinates.
pub(super) fn outline(object: &Object, centre: Vec3, half: Vec3, directions: [Vec3; 3]) -> (Vec3, Vec3) {
    let middle = object.at + object.outwards(centre);
    let inwards = directions.map(|d| object.inwards(d).abs().dot(half));
    (Vec3::from_array(directions.map(|d| d.dot(middle))), Vec3::from_array(inwards))
}

impl Part {
    fn hit(&self, origin: Vec3, ray: Vec3, inverse: Vec3) -> Option<Hit> {
        let origin = origin - self.centre;
        let (near, _) = slab(-self.half, self.half, origin, inverse)?;
        match self.shape {
            Shape::Box => {
                if near <= 0.0 {
                    return None;
                }
                let size = ((origin + ray * near) / self.half).abs();
                let axis = if size.x >= size.y && size.x >= size.z { 0 } else { 1 + usize::from(size.z > size.y) };
                let mut normal = Vec3::ZERO;
                normal[axis] = if ray[axis] > 0.0 { -1.0 } else { 1.0 };
                Some(Hit { distance: near, normal })
            }
            Shape::Ellipsoid => self.hit_round(origin, ray, near, None),
            Shape::Cylinder(axis) => self.hit_round(origin, ray, near, Some(axis)),
        }
    }

    /// Meets an ellipsoid, or a cylinder along `axis`. The ray enters the box at `near`: the equation is solved from there,
    /// since from afar a thin pole's would be lost in rounding.
    fn hit_round(&self, origin: Vec3, ray: Vec3, near: f32, axis: Option<usize>) -> Option<Hit> {
        let (mut from, mut along) = ((origin + ray * near) / self.half, ray / self.half);
        let (mut start, mut step) = (0.0, 0.0);
        if let Some(axis) = axis {
            (start, step) = (from[axis], along[axis]);
            (from[axis], along[axis]) = (0.0, 0.0);
        }
        let rounded = round(from, along).filter(|&(distance, _)| near + distance > 0.0);
        if let Some((distance, at)) = rounded.filter(|(d, _)| (start + step * d).abs() <= 1.0) {
            return Some(Hit { distance: near + distance, normal: (at / self.half).normalize_or(Vec3::Z) });
        }
        // A ray that does not come through the mantle comes through the end that faces it. Along an end `step` is 0, the
        // distance not finite, and no comparison with it holds.
        let axis = axis?;
        let facing = if step > 0.0 { -1.0 } else { 1.0 };
        let distance = (facing - start) / step;
        let within = (from + along * distance).length_squared() <= 1.0;
        (near + distance > 0.0 && distance < f32::INFINITY && within).then(|| {
            let mut normal = Vec3::ZERO;
            normal[axis] = facing;
            Hit { distance: near + distance, normal }
        })
    }

    /// Whether a point in the object's coordinates lies inside, the part being at least `thick` thick to every side.
    pub(super) fn contains(&self, at: Vec3, thick: f32) -> bool {
        let at = (at - self.centre) / self.half.max(Vec3::splat(thick * 0.5));
        match self.shape {
            Shape::Box => at.abs().max_element() <= 1.0,
            Shape::Ellipsoid => at.length_squared() <= 1.0,
            Shape::Cylinder(axis) => at[axis].abs() <= 1.0 && at.length_squared() - at[axis] * at[axis] <= 1.0,
        }
    }
}

/// First meeting with the unit sphere of a ray whose direction need not be a unit vector, and the point.
fn round(from: Vec3, along: Vec3) -> Option<(f32, Vec3)> {
    let (a, b, c) = (along.dot(along), from.dot(along), from.dot(from) - 1.0);
    let root = b * b - a * c;
    if root <= 0.0 || a <= 0.0 {
        return None;
    }
    let distance = (-b - root.sqrt()) / a;
    Some((distance, from + along * distance))
}

/// Distances at which a ray enters, 0 for a start inside, and leaves a box.
pub(super) fn slab(low: Vec3, high: Vec3, origin: Vec3, inverse: Vec3) -> Option<(f32, f32)> {
    let (a, b) = ((low - origin) * inverse, (high - origin) * inverse);
    let (near, far) = (a.min(b).max_element().max(0.0), a.max(b).min_element());
    (near <= far).then_some((near, far))
}

//! What surfaces look like: colours and patterns, none of which belongs to one class alone.

use crate::base::random::Random;
use glam::Vec3;

/// The pattern on a part's colour.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Finish {
    Plain,
    /// Rows of windows, this far apart along the wall and upwards, in metres.
    Windows(f32, f32),
    /// Courses of bricks or blocks of this height.
    Bricks(f32),
    /// Mottled in two sizes: foliage.
    Leaves,
    /// Stripes of this width across the x axis, in the colour and this grey.
    Stripes(f32, f32),
    /// Corrugated sheet with ribs this far apart.
    Ribs(f32),
    /// Grainy: soil, concrete, cloth.
    Grain,
}

impl Finish {
    /// The colour of the point `at` on a surface with this `normal`, both in the object's coordinates. `salt` differs
    /// between objects.
    pub(super) fn colour(self, colour: Vec3, at: Vec3, normal: Vec3, salt: u32) -> Vec3 {
        // Along a wall, whichever way it faces.
        let along = if normal.x.abs() > normal.y.abs() { at.y } else { at.x };
        match self {
            Finish::Plain => colour,
            Finish::Windows(..) | Finish::Bricks(_) if normal.z.abs() > 0.5 => colour * 0.7,
            Finish::Windows(wide, high) => {
                let (column, row) = (along / wide, at.z / high);
                let (u, v) = ((fraction(column) - 0.5).abs(), (fraction(row) - 0.55).abs());
                if u < 0.24 && v < 0.26 {
                    let pane = speckle(column.floor(), row.floor(), salt);
                    Vec3::new(0.24, 0.30, 0.37) * (0.4 + 0.9 * pane)
                } else if u < 0.29 && v < 0.31 {
                    (colour * 1.2).min(Vec3::ONE)
                } else {
                    colour * (0.93 + 0.14 * speckle((along * 4.0).floor(), (at.z * 4.0).floor(), salt))
                }
            }
            Finish::Bricks(high) => {
                let row = at.z / high;
                let column = along / (high * 2.5) + 0.5 * fraction(row.floor() * 0.5);
                let joint = fraction(row) < 0.12 || fraction(column) < 0.06;
                let tone = 0.8 + 0.35 * speckle(column.floor(), row.floor(), salt);
                if joint { colour * 0.6 + Vec3::splat(0.2) } else { colour * tone }
            }
            Finish::Leaves => {
                let fine = speckle3(at * 7.0, salt);
                let coarse = speckle3(at * 2.2, salt ^ 1);
                colour * (0.55 + 0.4 * fine + 0.4 * coarse)
            }
            Finish::Stripes(wide, grey) => {
                if fraction((at.x + 0.4 * at.z) / wide * 0.5) < 0.5 {
                    colour
                } else {
                    Vec3::splat(grey)
                }
            }
            Finish::Ribs(apart) => colour * if fraction(along / apart) < 0.3 { 0.72 } else { 1.0 },
            Finish::Grain => colour * (0.8 + 0.4 * speckle3(at * 9.0, salt)),
        }
    }
}

/// `x` less the integer below.
pub(super) fn fraction(x: f32) -> f32 {
    x - x.floor()
}

/// A number in [0, 1) that depends on two integers and `salt`.
pub(super) fn speckle(a: f32, b: f32, salt: u32) -> f32 {
    speckle_of(a as i32 as u32, b as i32 as u32, salt)
}

fn speckle_of(a: u32, b: u32, salt: u32) -> f32 {
    let mut h = a.wrapping_mul(0x9e37_79b1) ^ b.wrapping_mul(0x85eb_ca77) ^ salt;
    h = (h ^ h >> 15).wrapping_mul(0x2c1b_3c6d);
    h = (h ^ h >> 12).wrapping_mul(0x297a_2d39);
    ((h ^ h >> 15) >> 8) as f32 * (1.0 / (1u32 << 24) as f32)
}

/// A number in [0, 1) that depends on the lattice cell of `at` and on `salt`.
pub(super) fn speckle3(at: Vec3, salt: u32) -> f32 {
    let at = at.floor();
    speckle(at.x, at.y, salt ^ (at.z as i32 as u32).wrapping_mul(0xc2b2_ae3d))
}

/// Noise in [0, 1) that changes smoothly from one point of the integer lattice to the next.
pub(super) fn smooth(x: f32, y: f32, salt: u32) -> f32 {
    let (i, j) = (x.floor(), y.floor());
    let ease = |t: f32| t * t * (3.0 - 2.0 * t);
    let (u, v) = (ease(x - i), ease(y - j));
    let (i, j) = (i as i32 as u32, j as i32 as u32);
    let row = |j: u32| speckle_of(i, j, salt) * (1.0 - u) + speckle_of(i.wrapping_add(1), j, salt) * u;
    row(j) * (1.0 - v) + row(j.wrapping_add(1)) * v
}

/// A colour written as 0xRRGGBB.
pub(super) fn hex(colour: u32) -> Vec3 {
    Vec3::new((colour >> 16) as f32, (colour >> 8 & 255) as f32, (colour & 255) as f32) * (1.0 / 255.0)
}

/// One of several.
pub(super) fn pick<T: Copy>(random: &mut Random, from: &[T]) -> T {
    from[random.below(from.len())]
}

/// A colour of any hue: `low` to `high` bright, greyish or not.
pub(super) fn any_colour(random: &mut Random, low: f32, high: f32) -> Vec3 {
    let hue = Vec3::new(random.next_f32(), random.next_f32(), random.next_f32());
    let grey = Vec3::splat((hue.x + hue.y + hue.z) / 3.0);
    let mixed = hue.lerp(grey, random.range(0.0, 0.9));
    let top = mixed.max_element().max(0.05);
    mixed * (random.range(low, high) / top)
}

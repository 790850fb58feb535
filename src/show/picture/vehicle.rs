//! The vehicle that carries the cameras, as a simple car: two prisms across its width.

use super::cells::Cells;
use super::patch::Patch;
use glam::{DVec3, Vec3};

/// A flat part of the car.
pub(crate) struct Part {
    pub(crate) patch: Patch,
    /// Light of its colour.
    pub(crate) colour: Vec3,
    /// Unit vector out of the car.
    pub(crate) normal: Vec3,
}

/// Length and width in metres.
pub(crate) const SIZE: [f32; 2] = [4.6, 1.9];

/// Outlines seen from the left, anticlockwise from the rear: metres ahead of the middle and above the road.
const BODY: [[f64; 2]; 6] = [[-2.25, 0.30], [2.25, 0.30], [2.30, 0.62], [2.10, 0.80], [0.95, 1.00], [-2.25, 1.04]];
const GLASS: [[f64; 2]; 4] = [[-2.05, 1.02], [1.05, 0.98], [0.25, 1.50], [-1.55, 1.54]];
const ROOF: [[f64; 2]; 4] = [[-1.60, 1.50], [0.32, 1.46], [0.20, 1.58], [-1.45, 1.62]];
const WHEEL: [[f64; 2]; 8] =
    [[-0.14, 0.0], [0.14, 0.0], [0.34, 0.2], [0.34, 0.48], [0.14, 0.68], [-0.14, 0.68], [-0.34, 0.48], [-0.34, 0.2]];

/// The parts of the car that stands at the origin of the grid's frame, on the road there.
pub(crate) fn parts(grid: &Cells) -> Vec<Part> {
    let (ahead, left) = (grid.ahead.as_dvec3(), grid.left().as_dvec3());
    let origin = DVec3::Z * f64::from(grid.road());
    let place = |p: [f64; 2], y: f64| origin + ahead * p[0] + left * y + DVec3::Z * p[1];
    let mut parts = Vec::new();
    let (white, dark, black) = (Vec3::splat(0.93), Vec3::new(0.030, 0.038, 0.050), Vec3::splat(0.012));
    prism(&mut parts, &BODY, 0.95, white, place);
    prism(&mut parts, &GLASS, 0.84, dark, place);
    prism(&mut parts, &ROOF, 0.80, white, place);
    for wheel in [-1.38, 1.42] {
        prism(&mut parts, &WHEEL.map(|p| [p[0] + wheel, p[1]]), 0.97, black, place);
    }
    parts
}

/// The sides and the rim of a convex outline that reaches `half` metres to the left and right.
fn prism(parts: &mut Vec<Part>, outline: &[[f64; 2]], half: f64, colour: Vec3, place: impl Fn([f64; 2], f64) -> DVec3) {
    let mut add = |corner: DVec3, edges: [DVec3; 2], triangle: bool, outward: DVec3| {
        let normal = edges[0].cross(edges[1]).normalize_or_zero();
        let normal = if normal.dot(outward) < 0.0 { -normal } else { normal };
        parts.push(Part { patch: Patch { corner, edges, triangle }, colour, normal: normal.as_vec3() });
    };
    let across = place([0.0; 2], 1.0) - place([0.0; 2], 0.0);
    let count = outline.len() as f64;
    let middle = outline.iter().fold([0.0; 2], |m, p| [m[0] + p[0] / count, m[1] + p[1] / count]);
    for (i, &a) in outline.iter().enumerate() {
        let b = outline[(i + 1) % outline.len()];
        let (from, to) = (place(a, -half), place(b, -half));
        add(from, [to - from, across * (2.0 * half)], false, from - place(middle, -half));
        for y in [-half, half] {
            let centre = place(middle, y);
            add(centre, [place(a, y) - centre, place(b, y) - centre], true, across * y);
        }
    }
}

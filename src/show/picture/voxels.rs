//! The 3-D view: visible voxel faces through a perspective camera behind and above the vehicle.
//!
//! A z-buffer over several samples per pixel keeps the nearest face of each sample; a second pass shades what is left:
//! sun with soft shadows cast through the voxels, darker corners where voxels meet, thin lines along edges. Work goes in
//! bands of rows, so that memory stays small. One thread, fixed order: equal input gives equal bytes.

use super::canvas::{display, light};
use super::cells::{Cells, SUN_DISC};
use super::patch::Patch;
use super::vehicle;
use super::{Occupancy, Palette};
use glam::{DVec3, Vec3};

/// Samples per pixel along each axis.
const SAMPLES: usize = 3;

/// Rows of pixels that are drawn at a time.
const BAND: usize = 16;

/// Largest panel side in pixels; sample rows must fit 16 bits.
const MAX_PANEL: usize = 8192;

/// Colour of the plate under the voxels, as the square root of its light.
const PLATE: Vec3 = Vec3::new(0.885, 0.893, 0.905);

/// Metres between the plate's lines.
pub(crate) const PLATE_LINES: f32 = 10.0;

/// What voxels that no camera sees are mixed with.
const UNSEEN: [u8; 3] = [226, 229, 234];

/// Share of the light that comes from the sky; the sun gives a level surface the rest.
const SKY: f32 = 0.46;

/// A visible face: which voxel, which side, and how it meets its neighbours.
#[derive(Clone, Copy)]
struct Face {
    voxel: u32,
    /// Axis times two, plus one for the side of higher coordinates.
    side: u8,
    /// Two bits for each corner (u + 2 v): how many of the voxels around it stand out.
    corners: u8,
    /// One bit for each edge (u = 0, u = 1, v = 0, v = 1): the surface ends or the class changes there.
    edges: u8,
    /// First and last sample row.
    rows: [u16; 2],
}

/// The camera: an eye, three axes, and an off-centre window on its image plane.
struct Viewpoint {
    eye: DVec3,
    right: DVec3,
    up: DVec3,
    ahead: DVec3,
    /// Samples per unit of tangent.
    scale: f64,
    /// Sample coordinates of the view axis.
    centre: [f64; 2],
}

/// A patch as seen: 1/depth and its two coordinates over depth are affine in the sample's position.
#[derive(Clone, Copy)]
struct Seen {
    /// Samples x0, y0, x1, y1 (exclusive) that can see it.
    window: [i32; 4],
    /// For 1/depth, u/depth, v/depth: value at the window's first sample, step per column, step per row.
    affine: [[f32; 3]; 3],
    triangle: bool,
}

impl Viewpoint {
    /// The camera that shows all of the grid's ground plan, and the drawn layers on it, in `w` x `h` samples.
    fn new(grid: &Cells, floor: f32, w: usize, h: usize) -> Self {
        let (ahead_h, left) = (grid.ahead.as_dvec3(), grid.left().as_dvec3());
        let ahead = (ahead_h * 0.97 + left * 0.24 - DVec3::Z * 0.74).normalize();
        let right = ahead.cross(DVec3::Z).normalize();
        let up = right.cross(ahead);
        let (low, high) = (grid.low.as_dvec3(), grid.high().as_dvec3());
        let top = low.z + f64::from(grid.step.z) * grid.top as f64;
        let levels = [f64::from(floor), top.max(f64::from(floor))];
        let middle = (low + high) * 0.5;
        let size = high - low;
        let eye = DVec3::new(middle.x, middle.y, levels[0])
            - ahead * (0.80 * (size.x * size.x + size.y * size.y).sqrt() + size.z);
        let mut view = Self { eye, right, up, ahead, scale: 1.0, centre: [0.0; 2] };
        let (mut least, mut most) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for corner in 0..8 {
            let pick = |bit: usize, a: f64, b: f64| if corner >> bit & 1 == 0 { a } else { b };
            let p =
                view.project(DVec3::new(pick(0, low.x, high.x), pick(1, low.y, high.y), pick(2, levels[0], levels[1])));
            for k in 0..2 {
                least[k] = least[k].min(p[k]);
                most[k] = most[k].max(p[k]);
            }
        }
        let margin = 4.0 * SAMPLES as f64;
        let room = |samples: usize, k: usize| (samples as f64 - 2.0 * margin).max(1.0) / (most[k] - least[k]).max(1e-9);
        view.scale = room(w, 0).min(room(h, 1));
        let centre = |samples: usize, k: usize| 0.5 * (samples as f64 - view.scale * (least[k] + most[k]));
        view.centre = [centre(w, 0), centre(h, 1)];
        view
    }

    /// Sample coordinates of a point.
    fn project(&self, p: DVec3) -> [f64; 2] {
        let p = p - self.eye;
        let per_depth = self.scale / self.ahead.dot(p).max(1e-6);
        [self.centre[0] + self.right.dot(p) * per_depth, self.centre[1] - self.up.dot(p) * per_depth]
    }

    /// The ray through sample coordinates (x, y), one unit deep.
    fn ray(&self, x: f64, y: f64) -> DVec3 {
        self.ahead + self.right * ((x - self.centre[0]) / self.scale) - self.up * ((y - self.centre[1]) / self.scale)
    }

    fn see(&self, patch: &Patch, w: usize, h: usize) -> Seen {
        let [e1, e2] = patch.edges;
        let (mut least, mut most) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for corner in [DVec3::ZERO, e1, e2, e1 + e2] {
            let p = self.project(patch.corner + corner);
            for k in 0..2 {
                least[k] = least[k].min(p[k]);
                most[k] = most[k].max(p[k]);
            }
        }
        let clip = |v: f64, limit: usize| v.clamp(0.0, limit as f64) as i32;
        let (from, to) =
            ([least[0].floor() - 1.0, least[1].floor() - 1.0], [most[0].ceil() + 1.0, most[1].ceil() + 1.0]);
        let window = [clip(from[0], w), clip(from[1], h), clip(to[0], w), clip(to[1], h)];
        // corner + u e1 + v e2 = depth * ray, solved by Cramer's rule: each unknown over depth is a dot product with ray.
        let p0 = patch.corner - self.eye;
        let normal = e1.cross(e2);
        let volume = normal.dot(p0);
        let inverse = if volume == 0.0 { 0.0 } else { 1.0 / volume };
        let first = self.ray(f64::from(window[0]) + 0.5, f64::from(window[1]) + 0.5);
        let (column, row) = (self.right / self.scale, -self.up / self.scale);
        let affine = [normal, e2.cross(p0), p0.cross(e1)].map(|c| {
            let c = c * inverse;
            [c.dot(first) as f32, c.dot(column) as f32, c.dot(row) as f32]
        });
        Seen { window, affine, triangle: patch.triangle }
    }
}

impl Seen {
    /// 1/depth, u/depth and v/depth at a sample.
    fn at(&self, x: i32, y: i32) -> [f32; 3] {
        let (dx, dy) = ((x - self.window[0]) as f32, (y - self.window[1]) as f32);
        self.affine.map(|[value, column, row]| value + column * dx + row * dy)
    }

    /// Claims the samples of rows `rows` that lie in the patch and see nothing nearer.
    fn draw(&self, id: u32, rows: [i32; 2], w: usize, nearest: &mut [(f32, u32)]) {
        for y in self.window[1].max(rows[0])..self.window[3].min(rows[1]) {
            let line = &mut nearest[(y - rows[0]) as usize * w..][..w];
            let [mut inverse, mut u, mut v] = self.at(self.window[0], y);
            let [di, du, dv] = self.affine.map(|a| a[1]);
            for sample in &mut line[self.window[0] as usize..self.window[2] as usize] {
                // A little overlap closes the seams that rounding would leave between neighbours.
                let slack = 2e-3 * inverse;
                let end = inverse + slack;
                let inside =
                    u >= -slack && v >= -slack && if self.triangle { u + v <= end } else { u <= end && v <= end };
                if inside && inverse > sample.0 {
                    *sample = (inverse, id);
                }
                inverse += di;
                u += du;
                v += dv;
            }
        }
    }
}

/// Draws `occupancy` as rows of `width` x `height` RGB pixels over `page`. Sides beyond 8192 are cut to it by the caller.
pub(crate) fn render(
    occupancy: &Occupancy<'_>,
    palette: &Palette,
    width: usize,
    height: usize,
    page: [u8; 3],
) -> Vec<u8> {
    let (width, height) = (width.clamp(1, MAX_PANEL), height.clamp(1, MAX_PANEL));
    let grid = Cells::new(occupancy, palette);
    let floor = grid.floor();
    let (w, h) = (width * SAMPLES, height * SAMPLES);
    let view = Viewpoint::new(&grid, floor, w, h);
    let mut faces = visible_faces(&grid, &view, w, h);
    let car = if grid.holds_vehicle() { vehicle::parts(&grid) } else { Vec::new() };
    // Within a band faces keep their order, whatever the sort: it decides between samples of equal depth.
    faces.sort_by_key(|f| f.rows[0]);
    let colours = palette.classes().iter().map(|c| Vec3::from_array(c.rgb.map(light))).collect();
    let scene = Shader {
        grid: &grid,
        view: &view,
        car: &car,
        faces: &faces,
        colours,
        floor,
        page: Vec3::from_array(page.map(light)),
        size: [w, h],
    };
    let mut rgb = Vec::with_capacity(width * height * 3);
    let mut nearest = vec![(0.0f32, u32::MAX); w * BAND * SAMPLES];
    let mut open: Vec<usize> = Vec::new();
    let mut upcoming = 0;
    for band in 0..height.div_ceil(BAND) {
        let first = band * BAND * SAMPLES;
        let rows = [first as i32, (first + BAND * SAMPLES).min(h) as i32];
        nearest.fill((0.0, u32::MAX));
        while upcoming < faces.len() && i32::from(faces[upcoming].rows[0]) < rows[1] {
            open.push(upcoming);
            upcoming += 1;
        }
        open.retain(|&f| i32::from(faces[f].rows[1]) >= rows[0]);
        for &f in &open {
            view.see(&patch(&grid, &faces[f]), w, h).draw(f as u32, rows, w, &mut nearest);
        }
        for (k, part) in car.iter().enumerate() {
            view.see(&part.patch, w, h).draw((faces.len() + k) as u32, rows, w, &mut nearest);
        }
        scene.shade(rows, &nearest, &mut rgb);
    }
    rgb
}

/// The two axes of a face's own coordinates.
fn face_axes(side: u8) -> [usize; 2] {
    [[1, 2], [0, 2], [0, 1]][usize::from(side / 2)]
}

fn coordinates(grid: &Cells, voxel: u32) -> [i32; 3] {
    let [_, y, z] = grid.size;
    let voxel = voxel as usize;
    [(voxel / z / y) as i32, (voxel / z % y) as i32, (voxel % z) as i32]
}

fn patch(grid: &Cells, face: &Face) -> Patch {
    let mut corner = coordinates(grid, face.voxel);
    corner[usize::from(face.side / 2)] += i32::from(face.side % 2);
    let step = grid.step.as_dvec3();
    let edge = |k: usize| DVec3::AXES[k] * step[k];
    let [a, b] = face_axes(face.side);
    let corner = grid.low.as_dvec3() + DVec3::from_array(corner.map(f64::from)) * step;
    Patch { corner, edges: [edge(a), edge(b)], triangle: false }
}

fn visible_faces(grid: &Cells, view: &Viewpoint, w: usize, h: usize) -> Vec<Face> {
    let eye = (view.eye.as_vec3() - grid.low) / grid.step;
    let mut faces = Vec::new();
    for (voxel, &class) in grid.cells.iter().enumerate() {
        if class == 0 {
            continue;
        }
        let v = coordinates(grid, voxel as u32);
        for side in 0..6u8 {
            let (axis, out) = (usize::from(side / 2), i32::from(side % 2));
            let plane = (v[axis] + out) as f32;
            let outward = if out == 1 { eye[axis] > plane } else { eye[axis] < plane };
            let mut front = v;
            front[axis] += 2 * out - 1;
            if !outward || grid.at(front) != 0 {
                continue;
            }
            let [a, b] = face_axes(side);
            let beside = |from: [i32; 3], da: i32, db: i32| {
                let mut n = from;
                n[a] += da;
                n[b] += db;
                grid.at(n)
            };
            let mut face = Face { voxel: voxel as u32, side, corners: 0, edges: 0, rows: [0; 2] };
            for corner in 0..4 {
                let (da, db) = (2 * (corner & 1) - 1, (corner & 2) - 1);
                let [s, t, c] = [(da, 0), (0, db), (da, db)].map(|(da, db)| u8::from(beside(front, da, db) != 0));
                let level = if s + t == 2 { 3 } else { s + t + c };
                face.corners |= level << (2 * corner);
            }
            for (edge, (da, db)) in [(-1, 0), (1, 0), (0, -1), (0, 1)].into_iter().enumerate() {
                let ends = beside(v, da, db) != class && beside(front, da, db) == 0;
                face.edges |= u8::from(ends) << edge;
            }
            let seen = view.see(&patch(grid, &face), w, h);
            if seen.window[0] < seen.window[2] && seen.window[1] < seen.window[3] {
                face.rows = [seen.window[1] as u16, (seen.window[3] - 1) as u16];
                faces.push(face);
            }
        }
    }
    faces
}

/// Everything that a sample's colour depends on.
struct Shader<'a> {
    grid: &'a Cells,
    view: &'a Viewpoint,
    car: &'a [vehicle::Part],
    faces: &'a [Face],
    colours: Vec<Vec3>,
    floor: f32,
    page: Vec3,
    size: [usize; 2],
}

/// What a run of samples of one patch has in common.
struct Surface {
    seen: Seen,
    colour: Vec3,
    normal: Vec3,
    corners: [f32; 4],
    edges: u8,
    /// Strength of the lines along its edges, 0 or 1.
    pattern: f32,
}

impl Shader<'_> {
    /// Appends the pixels of sample rows `rows`.
    fn shade(&self, rows: [i32; 2], nearest: &[(f32, u32)], rgb: &mut Vec<u8>) {
        let w = self.size[0];
        let mut sums = vec![Vec3::ZERO; w / SAMPLES];
        for y in rows[0]..rows[1] {
            let line = &nearest[(y - rows[0]) as usize * w..][..w];
            let start = self.view.ray(0.5, f64::from(y) + 0.5).as_vec3();
            let column = (self.view.right / self.view.scale).as_vec3();
            let mut surface: Option<(u32, Surface)> = None;
            for (x, &(inverse, id)) in line.iter().enumerate() {
                // Each sample of a pixel looks at another part of the sun: shadows get soft edges.
                let part = x % SAMPLES * SAMPLES + y as usize % SAMPLES;
                let ray = start + column * x as f32;
                let colour = if id == u32::MAX {
                    self.ground(ray, part)
                } else {
                    if surface.as_ref().is_none_or(|s| s.0 != id) {
                        surface = Some((id, self.surface(id)));
                    }
                    surface.as_ref().map_or(self.page, |s| self.face(&s.1, [x as i32, y], ray, inverse, part))
                };
                sums[x / SAMPLES] += colour;
            }
            if (y as usize + 1).is_multiple_of(SAMPLES) {
                for sum in &mut sums {
                    let mean = *sum / (SAMPLES * SAMPLES) as f32;
                    rgb.extend(mean.to_array().map(display));
                    *sum = Vec3::ZERO;
                }
            }
        }
    }

    fn sun(&self, part: usize) -> Vec3 {
        // A 3 x 3 pattern whose rows and columns are spread over the disc.
        const DISC: [[f32; 2]; 9] = [
            [-0.7, -0.3],
            [0.2, 0.9],
            [0.6, -0.6],
            [-0.2, 0.4],
            [0.0, 0.0],
            [0.9, 0.2],
            [-0.9, 0.3],
            [-0.3, -0.9],
            [0.4, 0.3],
        ];
        let [a, b] = DISC[part % 9];
        self.grid.sun + (self.grid.ahead * a + self.grid.left() * b) * SUN_DISC
    }

    /// Light on a surface: from the sky, and from the sun where nothing stands before it. A level surface gets 1.
    fn lit(&self, point: Vec3, normal: Vec3, part: usize) -> f32 {
        let facing = normal.dot(self.grid.sun) / self.grid.sun.z;
        let sky = SKY * (0.80 + 0.20 * normal.z);
        if facing <= 0.0 || self.grid.is_shaded(point, self.sun(part)) { sky } else { sky + (1.0 - SKY) * facing }
    }

    fn surface(&self, id: u32) -> Surface {
        let [w, h] = self.size;
        let Some(face) = self.faces.get(id as usize) else {
            let part = &self.car[id as usize - self.faces.len()];
            let seen = self.view.see(&part.patch, w, h);
            return Surface {
                seen,
                colour: part.colour,
                normal: part.normal,
                corners: [1.0; 4],
                edges: 0,
                pattern: 0.0,
            };
        };
        let mut normal = Vec3::ZERO;
        normal[usize::from(face.side / 2)] = if face.side % 2 == 1 { 1.0 } else { -1.0 };
        let colour = self.colours[usize::from(self.grid.cells[face.voxel as usize])];
        Surface {
            seen: self.view.see(&patch(self.grid, face), w, h),
            colour: if self.grid.is_unseen(face.voxel as usize) {
                colour.lerp(Vec3::from_array(UNSEEN.map(light)), 0.65)
            } else {
                colour
            },
            normal,
            corners: std::array::from_fn(|k| 1.0 - 0.15 * f32::from((face.corners >> (2 * k)) & 3)),
            edges: face.edges,
            pattern: 1.0,
        }
    }

    fn face(&self, surface: &Surface, [x, y]: [i32; 2], ray: Vec3, inverse: f32, part: usize) -> Vec3 {
        let [_, u, v] = surface.seen.at(x, y);
        let (u, v) = ((u / inverse).clamp(0.0, 1.0), (v / inverse).clamp(0.0, 1.0));
        let [a, b, c, d] = surface.corners;
        let (near, far) = (a + (b - a) * u, c + (d - c) * u);
        let open = near + (far - near) * v;
        let point = self.view.eye.as_vec3() + ray / inverse + surface.normal * 0.02;
        let line = surface.pattern * self.line(surface, inverse, u, v);
        surface.colour * (self.lit(point, surface.normal, part) * open * (1.0 - line))
    }

    /// How dark the line is on which a sample lies: strong where the surface or the class ends, faint between voxels.
    fn line(&self, surface: &Surface, inverse: f32, u: f32, v: f32) -> f32 {
        let [[_, ix, iy], [_, ux, uy], [_, vx, vy]] = surface.seen.affine;
        let slope = |value: f32, x: f32, y: f32| {
            let (x, y) = (x - value * ix, y - value * iy);
            (x * x + y * y).sqrt() / inverse
        };
        let (per_u, per_v) = (slope(u, ux, uy).max(1e-9), slope(v, vx, vy).max(1e-9));
        // Voxels of a pixel or two would turn into lines alone.
        let room = (1.0 / per_u.max(per_v) / SAMPLES as f32 - 1.5) * 0.25;
        let room = room.clamp(0.0, 1.0);
        let distances = [u / per_u, (1.0 - u) / per_u, v / per_v, (1.0 - v) / per_v];
        let mut dark = 0.0f32;
        for (edge, distance) in distances.into_iter().enumerate() {
            let strong = surface.edges >> edge & 1 == 1;
            let (width, strength) = if strong { (0.8, 0.42 * (0.3 + 0.7 * room)) } else { (0.55, 0.20 * room) };
            if distance < width * SAMPLES as f32 {
                dark = dark.max(strength);
            }
        }
        dark
    }

    /// The plate under the voxels, with a line every ten metres, or the page around it.
    fn ground(&self, ray: Vec3, part: usize) -> Vec3 {
        let eye = self.view.eye.as_vec3();
        let depth = (self.floor - eye.z) / ray.z;
        let point = eye + ray * depth;
        let (low, high) = (self.grid.low, self.grid.high());
        let inside = ray.z < 0.0 && point.x > low.x && point.x < high.x && point.y > low.y && point.y < high.y;
        if !inside {
            return self.page;
        }
        let lit = self.lit(point + Vec3::Z * 0.02, Vec3::Z, part);
        let soft = 1.0 - 0.55 * (1.0 - lit);
        let wide = 0.55 * depth * SAMPLES as f32 / self.view.scale as f32;
        let near = |v: f32| (v - (v / PLATE_LINES).round() * PLATE_LINES).abs() < wide;
        let rim = [point.x - low.x, high.x - point.x, point.y - low.y, high.y - point.y]
            .into_iter()
            .fold(f32::INFINITY, f32::min);
        let line = if rim < 2.5 * wide {
            0.62
        } else if near(point.x) || near(point.y) {
            0.86
        } else {
            1.0
        };
        PLATE * PLATE * (soft * line)
    }
}

#[cfg(test)]
mod tests;

//! The bird's-eye-view map: the class of the highest voxel of each column, forward up, shaded by height.

use super::canvas::{Canvas, Rect, Rgb, display, light};
use super::cells::Cells;
use super::text::{Fonts, Weight};
use super::{Occupancy, Palette, vehicle};
use glam::Vec3;

/// Samples per pixel along each axis.
const SAMPLES: usize = 3;

/// Colour of columns in which nothing is drawn.
const EMPTY: Rgb = [247, 248, 250];

const INK: Rgb = [38, 42, 48];

/// Pixels from one line of the hatching to the next, along a row.
const HATCH: usize = 9;

/// What places that no camera sees are mixed with, between the hatching's lines and on them.
const HATCH_TONES: [Rgb; 2] = [[232, 234, 238], [150, 155, 163]];

/// How the map lies on the grid: grid axes that point up and right on it, and whether they point along growing indices.
struct Orientation {
    up: usize,
    up_grows: bool,
    right: usize,
    right_grows: bool,
}

impl Orientation {
    /// Up is the grid axis closest to forward.
    fn of(forward: [f32; 2]) -> Self {
        if forward[0].abs() > forward[1].abs() {
            let grows = forward[0] > 0.0;
            Self { up: 0, up_grows: grows, right: 1, right_grows: !grows }
        } else {
            let grows = forward[1] >= 0.0;
            Self { up: 1, up_grows: grows, right: 0, right_grows: grows }
        }
    }

    /// Metres along (right, up) from the map's lower left corner to a point of the frame.
    fn place(&self, grid: &Cells, p: Vec3) -> [f32; 2] {
        let along =
            |axis: usize, grows: bool| if grows { p[axis] - grid.low[axis] } else { grid.high()[axis] - p[axis] };
        [along(self.right, self.right_grows), along(self.up, self.up_grows)]
    }

    /// Metres from left to right and from bottom to top.
    fn extent(&self, grid: &Cells) -> [f32; 2] {
        let size = grid.high() - grid.low;
        [size[self.right], size[self.up]]
    }
}

/// Width over height of the map of `occupancy`, from 1/4 to 4.
pub(crate) fn aspect(occupancy: &Occupancy<'_>) -> f32 {
    let o = Orientation::of(occupancy.forward);
    let length = |k: usize| occupancy.grid.bounds[k][1] - occupancy.grid.bounds[k][0];
    (length(o.right) / length(o.up)).clamp(0.25, 4.0)
}

/// Draws the map into `rect`, with the vehicle, an arrow ahead of it and a scale bar.
pub(crate) fn draw(canvas: &mut Canvas, rect: Rect, occupancy: &Occupancy<'_>, palette: &Palette, fonts: &Fonts) {
    let grid = Cells::new(occupancy, palette);
    let orientation = Orientation::of(occupancy.forward);
    let columns = columns(&grid, palette);
    canvas.put(rect, &pixels(&grid, &orientation, &columns, rect.w, rect.h));
    canvas.frame(rect, 2, [190, 194, 200]);
    let extent = orientation.extent(&grid);
    let per_metre = [rect.w as f32 / extent[0], rect.h as f32 / extent[1]];
    if grid.holds_vehicle() {
        marker(canvas, rect, &grid, &orientation, per_metre);
    }
    scale_bar(canvas, rect, extent[0], fonts);
}

/// One column of the grid, seen from above.
#[derive(Clone, Copy)]
struct Column {
    /// Light of its colour.
    colour: Vec3,
    /// Whether what is shown, or all of an empty column, is seen by no camera.
    unseen: bool,
    /// One bit for each side (-x, +x, -y, +y) on which a pale class ends: drawn as a line, so that it shows on the page.
    outline: u8,
}

/// The columns of the grid, x slowest.
fn columns(grid: &Cells, palette: &Palette) -> Vec<Column> {
    let [nx, ny, nz] = grid.size;
    let lights: Vec<Vec3> = palette.classes().iter().map(|c| Vec3::from_array(c.rgb.map(light))).collect();
    let heights: Vec<usize> =
        grid.cells.chunks_exact(nz).map(|c| c.iter().rposition(|&v| v != 0).map_or(0, |z| z + 1)).collect();
    let lowest = heights.iter().copied().filter(|&h| h > 0).min().unwrap_or(0);
    let span = (grid.top - lowest).max(1) as f32;
    let class = |x: usize, y: usize| match heights[x * ny + y] {
        0 => 0,
        h => grid.cells[(x * ny + y) * nz + h - 1],
    };
    let mut columns = Vec::with_capacity(nx * ny);
    for x in 0..nx {
        for y in 0..ny {
            let h = heights[x * ny + y];
            let base = match h {
                0 => Vec3::from_array(EMPTY.map(light)),
                _ => {
                    lights[usize::from(grid.cells[(x * ny + y) * nz + h - 1])]
                        * (0.90 + 0.10 * (h - lowest) as f32 / span)
                }
            };
            let mut tone = 1.0;
            if h > 0 {
                let shaded = (0..4).filter(|k| {
                    let at = Vec3::new(
                        x as f32 + 0.25 + 0.5 * (k & 1) as f32,
                        y as f32 + 0.25 + 0.25 * (k & 2) as f32,
                        h as f32 + 0.02,
                    );
                    grid.is_shaded(grid.low + grid.step * at, grid.sun)
                });
                tone -= 0.07 * shaded.count() as f32;
            }
            // A step up darkens its foot and thereby outlines what stands there.
            let pale = h > 0 && base.min_element() > 0.62;
            let mut outline = 0;
            for (side, (dx, dy)) in [(-1i32, 0i32), (1, 0), (0, -1), (0, 1)].into_iter().enumerate() {
                let (i, j) = ((x as i32 + dx) as usize, (y as i32 + dy) as usize);
                if i < nx && j < ny {
                    if heights[i * ny + j] > h + 1 {
                        tone -= 0.06;
                    }
                    outline |= u8::from(pale && class(i, j) != class(x, y)) << side;
                }
            }
            let first = (x * ny + y) * nz;
            let unseen = match h {
                0 => (first..first + nz).all(|i| grid.is_unseen(i)),
                h => grid.is_unseen(first + h - 1),
            };
            columns.push(Column { colour: base * tone, unseen, outline });
        }
    }
    columns
}

fn pixels(grid: &Cells, o: &Orientation, columns: &[Column], w: usize, h: usize) -> Vec<u8> {
    // Cell along an axis of the grid, and where in it the sample lies, in 0..1.
    let locate = |axis: usize, grows: bool, sample: usize, samples: usize| {
        let n = grid.size[axis];
        let i = (sample * 2 + 1) * n / (samples * 2);
        let within = (sample as f32 + 0.5) * n as f32 / samples as f32 - i as f32;
        if grows { (i, within) } else { (n - 1 - i, 1.0 - within) }
    };
    // Lines are a pixel and a half wide, and never more than a quarter of a cell.
    let line = [0, 1].map(|axis| {
        let pixels = if axis == o.right { w } else { h };
        (1.5 * grid.size[axis] as f32 / pixels as f32).min(0.25)
    });
    let hatch = HATCH_TONES.map(|tone| Vec3::from_array(tone.map(light)));
    let mut rgb = Vec::with_capacity(w * h * 3);
    for row in 0..h {
        for column in 0..w {
            let mut sum = Vec3::ZERO;
            for s in 0..SAMPLES * SAMPLES {
                let mut at = [(0, 0.0); 2];
                at[o.right] = locate(o.right, o.right_grows, column * SAMPLES + s % SAMPLES, w * SAMPLES);
                at[o.up] = locate(o.up, !o.up_grows, row * SAMPLES + s / SAMPLES, h * SAMPLES);
                let [(x, u), (y, v)] = at;
                let Column { mut colour, unseen, outline } = columns[x * grid.size[1] + y];
                if unseen {
                    let line = (column + row) % HATCH < HATCH / 3;
                    colour = colour.lerp(hatch[usize::from(line)], if line { 0.60 } else { 0.35 });
                }
                let near = [u < line[0], u > 1.0 - line[0], v < line[1], v > 1.0 - line[1]];
                let lined = (0..4).any(|side| near[side] && outline >> side & 1 == 1);
                sum += if lined { colour * 0.30 } else { colour };
            }
            rgb.extend((sum / (SAMPLES * SAMPLES) as f32).to_array().map(display));
        }
    }
    rgb
}

/// The vehicle in its true place and size (but never too small to see), and an arrow along its forward direction.
fn marker(canvas: &mut Canvas, rect: Rect, grid: &Cells, o: &Orientation, per_metre: [f32; 2]) {
    let unit = per_metre[0].min(per_metre[1]);
    let [length, width] = vehicle::SIZE;
    let length = (length * unit).max(34.0);
    let width = length * width / vehicle::SIZE[0];
    let at = o.place(grid, Vec3::ZERO);
    let inside = |v: f32, low: f32, size: usize| {
        v.clamp(low + 0.5 * length + 4.0, (low + size as f32 - 0.5 * length - 4.0).max(low + 0.5 * length + 4.0))
    };
    let x = inside(rect.x as f32 + at[0] * per_metre[0], rect.x as f32, rect.w);
    let y = inside((rect.y + rect.h) as f32 - at[1] * per_metre[1], rect.y as f32, rect.h);
    // Ahead and right of the vehicle on the map, whose y grows downwards.
    let sign = |grows: bool| if grows { 1.0 } else { -1.0 };
    let ahead = [grid.ahead[o.right] * sign(o.right_grows), -grid.ahead[o.up] * sign(o.up_grows)];
    let turn = |p: [f32; 2]| [x + ahead[0] * p[0] - ahead[1] * p[1], y + ahead[1] * p[0] + ahead[0] * p[1]];
    let (l, w) = (0.5 * length, 0.5 * width);
    let body = |e: f32| {
        let (l, w) = (l + e, w + e);
        [
            [-l, -w * 0.8],
            [-l * 0.9, -w],
            [l * 0.62, -w],
            [l * 0.93, -w * 0.72],
            [l, 0.0],
            [l * 0.93, w * 0.72],
            [l * 0.62, w],
            [-l * 0.9, w],
            [-l, w * 0.8],
        ]
        .map(turn)
    };
    let head = l + 1.7 * length;
    let arrow = |e: f32| {
        let (shaft, barb) = (0.09 * length + e, 0.30 * length + e);
        let (start, neck) = (l + 0.30 * length - e, head - 0.62 * length - e);
        [
            [start, -shaft],
            [neck, -shaft],
            [neck, -barb],
            [head + 1.6 * e, 0.0],
            [neck, barb],
            [neck, shaft],
            [start, shaft],
        ]
        .map(turn)
    };
    for (extra, colour) in [(3.0, [255; 3]), (0.0, INK)] {
        canvas.fill_polygon(&body(extra), colour, 1.0);
        canvas.fill_polygon(&arrow(extra), colour, 1.0);
    }
    let screen = [[l * 0.50, -w * 0.62], [l * 0.16, -w * 0.50], [l * 0.16, w * 0.50], [l * 0.50, w * 0.62]].map(turn);
    canvas.fill_polygon(&screen, [200, 214, 228], 1.0);
}

/// A bar of a round number of metres in the lower left corner.
fn scale_bar(canvas: &mut Canvas, rect: Rect, metres: f32, fonts: &Fonts) {
    let length = round_length(metres * 0.22);
    let bar = length / metres * rect.w as f32;
    let label = format!("{length} m");
    let size = 24.0;
    let wide = fonts.width(&label, size, Weight::Regular).max(bar);
    if wide + 48.0 > rect.w as f32 || rect.h < 90 {
        return;
    }
    let (left, bottom) = (rect.x as f32 + 14.0, (rect.y + rect.h) as f32 - 14.0);
    canvas.fill_round([left, bottom - 56.0, left + wide + 28.0, bottom], 8.0, [255; 3], 0.88);
    let x = left + 14.0 + 0.5 * (wide - bar);
    let y = (bottom - 16.0).round();
    canvas.fill_polygon(&[[x, y - 2.0], [x + bar, y - 2.0], [x + bar, y + 2.0], [x, y + 2.0]], INK, 1.0);
    for end in [x, x + bar - 3.0] {
        canvas.fill_polygon(&[[end, y - 7.0], [end + 3.0, y - 7.0], [end + 3.0, y + 7.0], [end, y + 7.0]], INK, 1.0);
    }
    let text = left + 14.0 + 0.5 * (wide - fonts.width(&label, size, Weight::Regular));
    fonts.draw(canvas, &label, [text, y - 14.0], size, Weight::Regular, INK);
}

/// The largest of 1, 2, 5 times a power of ten, from a millimetre up, that is at most `limit`.
fn round_length(limit: f32) -> f32 {
    const POWERS: [f32; 9] = [1e-3, 1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3, 1e4, 1e5];
    let lengths = POWERS.iter().flat_map(|&power| [power, 2.0 * power, 5.0 * power]);
    lengths.take_while(|&length| length <= limit).last().unwrap_or(POWERS[0])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::Grid;

    #[test]
    fn lengths_are_round() {
        for (limit, expected) in [(22.0, 20.0), (11.3, 10.0), (5.0, 5.0), (0.3, 0.2), (0.99, 0.5), (4321.0, 2000.0)] {
            assert_eq!(round_length(limit), expected);
        }
    }

    #[test]
    fn forward_is_up_and_left_is_left() {
        let palette = Palette::of(17);
        // One voxel ahead and left of the middle, in either convention.
        for (forward, voxel) in
            [([0.0, 1.0], [1usize, 7usize]), ([1.0, 0.0], [7, 6]), ([0.0, -1.0], [6, 1]), ([-1.0, 0.0], [1, 1])]
        {
            let mut classes = vec![0u8; 8 * 8 * 2];
            classes[(voxel[0] * 8 + voxel[1]) * 2] = 11;
            let bounds = [[-4.0, 4.0], [-4.0, 4.0], [-1.0, 1.0]];
            let occupancy = Occupancy::new("", &classes, Grid::new([8, 8, 2], bounds), forward).unwrap();
            let grid = Cells::new(&occupancy, &palette);
            let o = Orientation::of(forward);
            let rgb = pixels(&grid, &o, &columns(&grid, &palette), 80, 80);
            let magenta: Vec<[usize; 2]> =
                (0..6400).filter(|&i| rgb[3 * i] > 200 && rgb[3 * i + 1] < 50).map(|i| [i % 80, i / 80]).collect();
            assert_eq!(magenta.len(), 100);
            assert!(magenta.iter().all(|p| p[0] < 40 && p[1] < 20), "forward {forward:?}: {:?}", magenta[0]);
        }
    }
}

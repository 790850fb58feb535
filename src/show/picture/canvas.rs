//! A page of pixels with the few things that are drawn on it: rectangles, smooth shapes, images.

/// 8-bit RGB.
pub(crate) type Rgb = [u8; 3];

/// Rows of RGB pixels, top to bottom.
pub(crate) struct Canvas {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) rgb: Vec<u8>,
}

/// Pixels from (x, y), `w` wide and `h` high.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Rect {
    pub(crate) x: usize,
    pub(crate) y: usize,
    pub(crate) w: usize,
    pub(crate) h: usize,
}

/// Samples per axis and pixel for smooth edges.
const SAMPLES: i32 = 4;

impl Canvas {
    pub(crate) fn new(width: usize, height: usize, colour: Rgb) -> Self {
        let mut rgb = vec![0; width * height * 3];
        rgb.chunks_exact_mut(3).for_each(|p| p.copy_from_slice(&colour));
        Self { width, height, rgb }
    }

    /// Lays `colour` over the pixel with weight `alpha` in 0..=1; pixels beyond the page are ignored.
    pub(crate) fn blend(&mut self, x: i32, y: i32, colour: Rgb, alpha: f32) {
        if x < 0 || y < 0 || x as usize >= self.width || y as usize >= self.height {
            return;
        }
        let at = (y as usize * self.width + x as usize) * 3;
        for (old, new) in self.rgb[at..at + 3].iter_mut().zip(colour) {
            let mixed = f32::from(*old) + (f32::from(new) - f32::from(*old)) * alpha;
            *old = (mixed + 0.5) as u8;
        }
    }

    /// Copies `rgb`, rows of `rect.w` pixels, to `rect`.
    pub(crate) fn put(&mut self, rect: Rect, rgb: &[u8]) {
        let visible = rect.w.min(self.width.saturating_sub(rect.x)) * 3;
        for (row, line) in rgb.chunks_exact(rect.w * 3).take(rect.h).enumerate() {
            if visible > 0 && rect.y + row < self.height {
                let at = ((rect.y + row) * self.width + rect.x) * 3;
                self.rgb[at..at + visible].copy_from_slice(&line[..visible]);
            }
        }
    }

    /// Fills where `inside` says so, given pixel coordinates, with smooth edges; only pixels within `bounds`
    /// (x0, y0, x1, y1) are asked.
    pub(crate) fn fill(&mut self, bounds: [f32; 4], colour: Rgb, alpha: f32, inside: impl Fn(f32, f32) -> bool) {
        let clip = |v: f32, limit: usize| (v.max(0.0) as usize).min(limit) as i32;
        let (x0, x1) = (clip(bounds[0].floor(), self.width), clip(bounds[2].ceil(), self.width));
        let (y0, y1) = (clip(bounds[1].floor(), self.height), clip(bounds[3].ceil(), self.height));
        let sub = |i: i32| (i as f32 + 0.5) / SAMPLES as f32;
        for y in y0..y1 {
            for x in x0..x1 {
                let hits = (0..SAMPLES * SAMPLES)
                    .filter(|s| inside(x as f32 + sub(s % SAMPLES), y as f32 + sub(s / SAMPLES)))
                    .count();
                if hits > 0 {
                    self.blend(x, y, colour, alpha * hits as f32 / (SAMPLES * SAMPLES) as f32);
                }
            }
        }
    }

    /// A rectangle with corners rounded by `radius`.
    pub(crate) fn fill_round(&mut self, [x0, y0, x1, y1]: [f32; 4], radius: f32, colour: Rgb, alpha: f32) {
        let radius = radius.min((x1 - x0) / 2.0).min((y1 - y0) / 2.0).max(0.0);
        self.fill([x0, y0, x1, y1], colour, alpha, |x, y| {
            let dx = (x0 + radius - x).max(x - x1 + radius).max(0.0);
            let dy = (y0 + radius - y).max(y - y1 + radius).max(0.0);
            (x0..x1).contains(&x) && (y0..y1).contains(&y) && dx * dx + dy * dy <= radius * radius
        });
    }

    /// The outline of a rectangle, `thick` pixels wide, lying inside it.
    pub(crate) fn frame(&mut self, rect: Rect, thick: usize, colour: Rgb) {
        let (x0, y0) = (rect.x as i32, rect.y as i32);
        let (x1, y1, t) = ((rect.x + rect.w) as i32, (rect.y + rect.h) as i32, thick as i32);
        for y in y0..y1 {
            for x in x0..x1 {
                if x < x0 + t || x >= x1 - t || y < y0 + t || y >= y1 - t {
                    self.blend(x, y, colour, 1.0);
                }
            }
        }
    }

    /// A polygon, convex or not, by the even-odd rule.
    pub(crate) fn fill_polygon(&mut self, corners: &[[f32; 2]], colour: Rgb, alpha: f32) {
        let bound = |axis: usize, least: bool| {
            let start = if least { f32::INFINITY } else { f32::NEG_INFINITY };
            corners.iter().fold(start, |m, c| if least { m.min(c[axis]) } else { m.max(c[axis]) })
        };
        let bounds = [bound(0, true), bound(1, true), bound(0, false), bound(1, false)];
        self.fill(bounds, colour, alpha, |x, y| {
            let mut inside = false;
            for (i, a) in corners.iter().enumerate() {
                let b = corners[(i + 1) % corners.len()];
                if (a[1] > y) != (b[1] > y) && x < a[0] + (y - a[1]) * (b[0] - a[0]) / (b[1] - a[1]) {
                    inside = !inside;
                }
            }
            inside
        });
    }
}

/// A display value of 0..=255 as light; the square stands for the display's gamma and is the same everywhere.
pub(crate) fn light(value: u8) -> f32 {
    let v = f32::from(value) * (1.0 / 255.0);
    v * v
}

/// The display value of `light`, which is clamped to 0..=1.
pub(crate) fn display(light: f32) -> u8 {
    (light.clamp(0.0, 1.0).sqrt() * 255.0 + 0.5) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pixel(canvas: &Canvas, x: usize, y: usize) -> Rgb {
        let at = (y * canvas.width + x) * 3;
        [canvas.rgb[at], canvas.rgb[at + 1], canvas.rgb[at + 2]]
    }

    #[test]
    fn shapes_cover_what_they_should_and_clip() {
        let mut canvas = Canvas::new(20, 10, [255; 3]);
        canvas.fill_polygon(&[[2.0, 2.0], [6.0, 2.0], [6.0, 6.0], [2.0, 6.0]], [0; 3], 1.0);
        assert_eq!((pixel(&canvas, 2, 2), pixel(&canvas, 5, 5), pixel(&canvas, 6, 5)), ([0; 3], [0; 3], [255; 3]));
        canvas.fill_round([9.5, -5.0, 50.0, 50.0], 1.0, [100; 3], 0.5);
        assert_eq!(pixel(&canvas, 19, 9), [178; 3]);
        assert_eq!(pixel(&canvas, 9, 5), [216; 3], "half of the pixel at half the weight");
        canvas.blend(-1, 3, [0; 3], 1.0);
        canvas.put(Rect { x: 18, y: 8, w: 4, h: 4 }, &[7; 48]);
        assert_eq!((pixel(&canvas, 19, 9), pixel(&canvas, 17, 9)), ([7; 3], [178; 3]));
        canvas.put(Rect { x: 30, y: 0, w: 2, h: 1 }, &[9; 6]);
    }

    #[test]
    fn light_and_display_are_inverse() {
        assert!((0..=255).all(|v| display(light(v)) == v));
        assert_eq!((display(-1.0), display(7.0)), (0, 255));
    }
}

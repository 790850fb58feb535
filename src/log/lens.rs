//! Lenses: how a distorted image becomes that of a pinhole camera.
//!
//! The undistorted image has the size and the camera matrix of the distorted one. Each of its pixels is taken from where the
//! lens has moved it, between the four nearest ones with weights in steps of 1/256; what the camera did not see is black.
//! Places are computed in f64 from additions, multiplications, divisions and square roots, and pixels in integers, so that
//! the bytes are the same on every machine.

use crate::base::error::{Error, ErrorKind, Result};
use crate::scene::Image;

/// A model of distortion, in coordinates (x, y) of the plane at depth 1, with r^2 = x^2 + y^2.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Lens {
    /// `plumb_bob` and `rational_polynomial`: (x, y) times (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6), plus
    /// (2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y).
    Radial { k: [f64; 6], p: [f64; 2] },
    /// `equidistant` (also called fisheye and kannala_brandt): with t = atan r, (x, y) times
    /// t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) / r.
    Equidistant { k: [f64; 4] },
}

impl Lens {
    /// The lens of a calibration's `distortion_model` and `D`; none for a camera without distortion.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] for other models and numbers of coefficients.
    pub(super) fn of(model: &str, d: &[f64]) -> Result<Option<Self>> {
        if d.iter().all(|&v| v == 0.0) {
            return Ok(None);
        }
        match (model, d) {
            ("plumb_bob", &[k1, k2, p1, p2]) => Ok(Some(Lens::Radial { k: [k1, k2, 0.0, 0.0, 0.0, 0.0], p: [p1, p2] })),
            ("plumb_bob", &[k1, k2, p1, p2, k3]) => {
                Ok(Some(Lens::Radial { k: [k1, k2, k3, 0.0, 0.0, 0.0], p: [p1, p2] }))
            }
            ("rational_polynomial", &[k1, k2, p1, p2, k3, k4, k5, k6]) => {
                Ok(Some(Lens::Radial { k: [k1, k2, k3, k4, k5, k6], p: [p1, p2] }))
            }
            ("equidistant" | "fisheye" | "kannala_brandt", &[k1, k2, k3, k4]) => {
                Ok(Some(Lens::Equidistant { k: [k1, k2, k3, k4] }))
            }
            _ => {
                let message = format!(
                    "distortion {model:?} of {} coefficients, expected plumb_bob (4 or 5), rational_polynomial (8) or \
                     equidistant (4)",
                    d.len()
                );
                Err(Error::new(ErrorKind::Unsupported, message))
            }
        }
    }

    /// Where the lens shows what lies at (x, y).
    fn distort(&self, x: f64, y: f64) -> [f64; 2] {
        let r2 = x * x + y * y;
        match *self {
            Lens::Radial { k: [k1, k2, k3, k4, k5, k6], p: [p1, p2] } => {
                let above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
                let below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
                let radial = above / below;
                [
                    x * radial + (2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)),
                    y * radial + (p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y),
                ]
            }
            Lens::Equidistant { k: [k1, k2, k3, k4] } => {
                let r = r2.sqrt();
                if r < 1e-12 {
                    return [x, y];
                }
                let t = arctangent(r);
                let t2 = t * t;
                let scale = t * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / r;
                [x * scale, y * scale]
            }
        }
    }
}

/// atan of `r` >= 0 to about 1e-16: reduced below 0.2, then its series.
fn arctangent(r: f64) -> f64 {
    if r > 1.0 {
        return std::f64::consts::FRAC_PI_2 - arctangent(1.0 / r);
    }
    // Twice half the angle is the angle.
    let half = |x: f64| x / (1.0 + (1.0 + x * x).sqrt());
    let x = half(half(r));
    let x2 = x * x;
    let series = (0..13).rev().fold(0.0, |sum, i| 1.0 / f64::from(2 * i + 1) - x2 * sum);
    4.0 * x * series
}

/// From which pixels each pixel of the undistorted image comes.
pub(super) struct Undistortion {
    size: [usize; 2],
    /// Column and row, in 1/256 pixels; none outside.
    from: Vec<Option<[u32; 2]>>,
}

impl Undistortion {
    /// For images of height and width `size` and the row-major camera matrix `k`, whose focal lengths are not 0.
    pub(super) fn new(lens: &Lens, k: &[f64; 9], size: [usize; 2]) -> Self {
        let [fx, skew, cx, _, fy, cy, ..] = *k;
        let [height, width] = size;
        let place = |metres: f64, side: usize| {
            let at = (metres * 256.0 + 0.5).floor();
            (at >= 0.0 && at <= 256.0 * (side - 1) as f64).then_some(at as u32)
        };
        let mut from = Vec::with_capacity(height * width);
        for v in 0..height {
            for u in 0..width {
                let y = (v as f64 - cy) / fy;
                let x = (u as f64 - cx - skew * y) / fx;
                let [x, y] = lens.distort(x, y);
                let (column, row) = (place(fx * x + skew * y + cx, width), place(fy * y + cy, height));
                from.push(column.zip(row).map(|(column, row)| [column, row]));
            }
        }
        Self { size, from }
    }

    /// The undistorted image of one that has the size that this was made for.
    pub(super) fn apply(&self, image: &Image) -> Image {
        let [height, width] = self.size;
        debug_assert_eq!([image.height, image.width], self.size);
        let pixel = |x: usize, y: usize| &image.bgr[3 * (y * width + x)..][..3];
        let mut bgr = vec![0; 3 * height * width];
        for (out, from) in bgr.as_chunks_mut::<3>().0.iter_mut().zip(&self.from) {
            let Some([column, row]) = *from else { continue };
            let (x, y) = (column as usize / 256, row as usize / 256);
            let (right, down) = (column % 256, row % 256);
            // Where the last column or row is met exactly, the next has no weight.
            let (x1, y1) = ((x + 1).min(width - 1), (y + 1).min(height - 1));
            let corners = [pixel(x, y), pixel(x1, y), pixel(x, y1), pixel(x1, y1)];
            let weights = [(256 - right) * (256 - down), right * (256 - down), (256 - right) * down, right * down];
            for (c, out) in out.iter_mut().enumerate() {
                let sum: u32 = corners.iter().zip(weights).map(|(corner, weight)| u32::from(corner[c]) * weight).sum();
                *out = ((sum + (1 << 15)) >> 16) as u8;
            }
        }
        Image { height, width, bgr }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arctangents() {
        for i in 0..4000 {
            let r = f64::from(i) * 0.01;
            assert!((arctangent(r) - r.atan()).abs() < 4e-16 * (1.0 + r.atan()), "{r}");
        }
    }

    #[test]
    fn models_by_hand() {
        let lens = |model, d: &[f64]| Lens::of(model, d).expect(model);
        assert_eq!(lens("anything", &[0.0; 3]), None);
        assert_eq!(lens("", &[]), None);
        // r^2 = 0.05 at (0.1, 0.2).
        let [x, y] = lens("plumb_bob", &[-0.3, 0.1, 0.001, -0.002, 0.01]).expect("a lens").distort(0.1, 0.2);
        let radial = 1.0 - 0.3 * 0.05 + 0.1 * 0.0025 + 0.01 * 0.000_125;
        assert!((x - (0.1 * radial + 2.0 * 0.001 * 0.02 - 0.002 * (0.05 + 0.02))).abs() < 1e-15);
        assert!((y - (0.2 * radial + 0.001 * (0.05 + 0.08) - 2.0 * 0.002 * 0.02)).abs() < 1e-15);
        let [x, _] =
            lens("rational_polynomial", &[0.1, 0.2, 0.0, 0.0, 0.3, 0.4, 0.5, 0.6]).expect("a lens").distort(1.0, 0.0);
        assert!((x - 1.6 / 2.5).abs() < 1e-15);
        // An ideal fisheye shows 45 degrees at a radius of pi / 4.
        let [x, y] = lens("equidistant", &[1e-300, 0.0, 0.0, 0.0]).expect("a lens").distort(0.0, 1.0);
        assert!(x == 0.0 && (y - std::f64::consts::FRAC_PI_4).abs() < 1e-15);
        let error = Lens::of("plumb_bob", &[0.1; 3]).unwrap_err();
        assert!(error.message().contains("distortion \"plumb_bob\" of 3 coefficients"), "{error}");
        assert!(Lens::of("thin_prism", &[0.1; 4]).is_err());
    }

    #[test]
    fn a_distorted_picture_becomes_straight_again() {
        let (lens, k) = (
            Lens::Radial { k: [-0.25, 0.05, 0.0, 0.0, 0.0, 0.0], p: [0.001, -0.001] },
            [50.0, 0.0, 39.5, 0.0, 50.0, 29.5, 0.0, 0.0, 1.0],
        );
        // What the plane at depth 1 looks like: smooth, and another in each channel.
        let colour = |x: f64, y: f64| [100.0 + 60.0 * x, 100.0 + 80.0 * y, 128.0 + 50.0 * (x - y)];
        let (height, width) = (60, 80);
        let draw = |place: &dyn Fn(f64, f64) -> [f64; 2]| {
            let mut bgr = Vec::new();
            for v in 0..height {
                for u in 0..width {
                    let [x, y] = place((u as f64 - 39.5) / 50.0, (v as f64 - 29.5) / 50.0);
                    bgr.extend(colour(x, y).map(|c| c.round() as u8));
                }
            }
            Image { height, width, bgr }
        };
        // The distorted image shows at a pixel what the lens takes there: inverted by iteration.
        let undo = |x: f64, y: f64| {
            let (mut a, mut b) = (x, y);
            for _ in 0..50 {
                let [c, d] = lens.distort(a, b);
                (a, b) = (a + x - c, b + y - d);
            }
            [a, b]
        };
        let (distorted, expected) = (draw(&undo), draw(&|x, y| [x, y]));
        let found = Undistortion::new(&lens, &k, [height, width]).apply(&distorted);
        let seen = found.bgr.iter().zip(&expected.bgr).filter(|&(&found, _)| found != 0);
        let worst = seen.clone().map(|(a, b)| a.abs_diff(*b)).max();
        assert!(worst <= Some(1) && seen.count() > 14_000, "{worst:?}");
        assert!(distorted.bgr.iter().zip(&expected.bgr).any(|(a, b)| a.abs_diff(*b) > 5), "the lens does something");
    }
}

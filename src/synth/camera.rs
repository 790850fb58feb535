//! The ring of cameras that looks at a synthetic world.

use crate::network::Network;
use glam::DVec3;

/// The six cameras of nuScenes in its order: name, yaw in degrees (left is positive), place in metres ahead of, left of and
/// above the lidar, focal length over image width.
const RING: [(&str, f64, [f64; 3], f64); 6] = [
    ("CAM_FRONT", 0.0, [0.76, 0.0, -0.33], 0.79),
    ("CAM_FRONT_RIGHT", -56.0, [0.61, -0.49, -0.34], 0.79),
    ("CAM_FRONT_LEFT", 56.0, [0.58, 0.49, -0.33], 0.79),
    ("CAM_BACK", 180.0, [-0.91, 0.0, -0.26], 0.506),
    ("CAM_BACK_LEFT", 108.0, [0.09, 0.48, -0.25], 0.79),
    ("CAM_BACK_RIGHT", -108.0, [0.07, -0.48, -0.28], 0.79),
];

/// A pinhole camera in vehicle coordinates: x ahead, y left, z up, the lidar at the origin.
#[derive(Clone, Debug)]
pub(super) struct Pinhole {
    pub(super) name: String,
    pub(super) at: DVec3,
    /// Of one pixel to the right, one pixel down, and of the middle of the image's first pixel, at depth 1.
    pub(super) right: DVec3,
    pub(super) down: DVec3,
    pub(super) first: DVec3,
    /// Height and width in pixels.
    pub(super) size: [usize; 2],
    /// Row-major 4x4, lidar-frame metres to pixels times depth.
    pub(super) lidar2img: [f32; 16],
}

impl Pinhole {
    /// Camera `index` of the ring that `network` expects. Six are mounted and named as in nuScenes, any other number looks
    /// around evenly, the first one ahead.
    pub(super) fn of_ring(index: usize, network: &Network, forward: [f32; 2]) -> Self {
        let [height, width] = network.image;
        let cameras = network.cameras;
        let (name, yaw, at, focal) = if cameras == RING.len() {
            let (name, yaw, at, focal) = RING[index];
            (name.to_owned(), yaw, at, focal)
        } else {
            // Neighbours overlap by a seventh; a single camera sees what KITTI's does.
            let half = if cameras == 1 { 41.0 } else { (180.0 / cameras as f64 * 1.15).min(60.0) };
            let (sin, cos) = sin_cos(half);
            (format!("CAM_{index}"), -360.0 * index as f64 / cameras as f64, [0.5, 0.0, -0.25], 0.5 * cos / sin)
        };
        let (sin, cos) = sin_cos(yaw);
        let (right, ahead) = (DVec3::new(sin, -cos, 0.0), DVec3::new(cos, sin, 0.0));
        // A wide image is cut from the middle of a 16:9 one, its horizon raised so that more of it shows the ground.
        let [h, w] = [height as f64, width as f64];
        let centre = [0.5 * w, (0.53 * h).min(0.38 * h + 0.417 * (h - 0.36 * w).max(0.0))];
        Self::new(name, DVec3::from_array(at), [right, -DVec3::Z, ahead], focal * w, centre, [height, width], forward)
    }

    #[allow(clippy::too_many_arguments, reason = "a camera has as many parameters")]
    fn new(
        name: String,
        at: DVec3,
        [right, down, ahead]: [DVec3; 3],
        focal: f64,
        [cu, cv]: [f64; 2],
        size: [usize; 2],
        forward: [f32; 2],
    ) -> Self {
        let [fx, fy] = forward.map(f64::from);
        let lidar = |v: DVec3| DVec3::new(v.x * fx - v.y * fy, v.x * fy + v.y * fx, v.z);
        let rows = [right * focal + ahead * cu, down * focal + ahead * cv, ahead].map(lidar);
        let lidar2img = std::array::from_fn(|i| match (i / 4, i % 4) {
            (3, c) => f32::from(c == 3),
            (r, 3) => -rows[r].dot(lidar(at)) as f32,
            (r, c) => rows[r][c] as f32,
        });
        let first = ahead - right * (cu / focal) - down * (cv / focal);
        Self { name, at, right: right / focal, down: down / focal, first, size, lidar2img }
    }

    /// The camera of a calibration's matrix, for images of `size`; none if the matrix cannot be one of a camera.
    pub(super) fn of_matrix(name: String, lidar2img: &[f32; 16], size: [usize; 2], forward: [f32; 2]) -> Option<Self> {
        let row = |r: usize| DVec3::from_array(std::array::from_fn(|c| f64::from(lidar2img[4 * r + c])));
        let matrix = glam::DMat3::from_cols(row(0), row(1), row(2)).transpose();
        let determinant = matrix.determinant();
        if !(determinant.is_finite() && determinant.abs() > 1e-9) {
            return None;
        }
        let inverse = matrix.inverse();
        let shift = DVec3::new(f64::from(lidar2img[3]), f64::from(lidar2img[7]), f64::from(lidar2img[11]));
        let [fx, fy] = forward.map(f64::from);
        let vehicle = |v: DVec3| DVec3::new(v.x * fx + v.y * fy, v.y * fx - v.x * fy, v.z);
        Some(Self {
            name,
            at: vehicle(-(inverse * shift)),
            right: vehicle(inverse.col(0)),
            down: vehicle(inverse.col(1)),
            first: vehicle(inverse.col(2)),
            size,
            lidar2img: *lidar2img,
        })
    }

    /// The direction of a place in the image, in pixels; a point at depth d lies d times as far.
    pub(super) fn ray(&self, u: f64, v: f64) -> DVec3 {
        self.first + self.right * u + self.down * v
    }
}

/// Sine and cosine of `degrees` from -360 to 360, to about 1e-15: Taylor series of an eighth of the angle, doubled thrice.
fn sin_cos(degrees: f64) -> (f64, f64) {
    let x = degrees * (std::f64::consts::PI / 180.0 / 8.0);
    let (mut sin, mut cos, mut term) = (0.0, 0.0, 1.0);
    for k in 0..24 {
        match k % 4 {
            0 => cos += term,
            1 => sin += term,
            2 => cos -= term,
            _ => sin -= term,
        }
        term *= x / f64::from(k + 1);
    }
    for _ in 0..3 {
        (sin, cos) = (2.0 * sin * cos, cos * cos - sin * sin);
    }
    (sin, cos)
}

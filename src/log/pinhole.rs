//! The parts of a projection: what a camera is, and where it stands.

use crate::base::error::{Error, Result};
use glam::{DMat3, DQuat, DVec3};

/// A camera without distortion, in f64.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Pinhole {
    /// Row-major 3x3, upper triangular: places of the camera's frame to pixels times depth. The last number is 1 but for the
    /// rounding of the matrix that it was taken from.
    pub(super) k: [f64; 9],
    /// The camera's frame in the lidar's: quaternion (w, x, y, z).
    pub(super) rotation: [f64; 4],
    /// Where the camera stands in the lidar's frame, in metres.
    pub(super) place: [f64; 3],
}

impl Pinhole {
    /// The parts of a row-major 4x4 `lidar2img`, which is the product of both again to about 1e-15.
    ///
    /// # Errors
    /// [`ErrorKind::Format`](crate::ErrorKind::Format) for a matrix that no camera has: without an inverse, or mirrored.
    pub(super) fn of(lidar2img: &[f32; 16]) -> Result<Self> {
        let row = |r: usize| DVec3::from_array(std::array::from_fn(|c| f64::from(lidar2img[4 * r + c])));
        let shift = [3, 7, 11].map(|i| f64::from(lidar2img[i]));
        // From the last row on, what the rows before have in common with it is taken out of them.
        let k22 = row(2).length();
        let ahead = row(2) / k22;
        let k12 = row(1).dot(ahead);
        let down = row(1) - ahead * k12;
        let k11 = down.length();
        let down = down / k11;
        let (k01, k02) = (row(0).dot(down), row(0).dot(ahead));
        let right = row(0) - down * k01 - ahead * k02;
        let k00 = right.length();
        let right = right / k00;
        let sound = [k00, k11, k22].iter().all(|k| k.is_normal()) && right.cross(down).dot(ahead) > 0.0;
        if !sound || !shift.iter().all(|v| v.is_finite()) {
            return Err(Error::format(
                "lidar2img is not that of a camera, expected one with an inverse and not mirrored",
            ));
        }
        let z = shift[2] / k22;
        let y = (shift[1] - k12 * z) / k11;
        let x = (shift[0] - k01 * y - k02 * z) / k00;
        // Columns are the camera's axes in the lidar's frame.
        let axes = DMat3::from_cols(right, down, ahead);
        let turn = DQuat::from_mat3(&axes).normalize();
        let place = -(axes * DVec3::new(x, y, z));
        Ok(Self {
            k: [k00, k01, k02, 0.0, k11, k12, 0.0, 0.0, k22],
            rotation: [turn.w, turn.x, turn.y, turn.z],
            place: place.into(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::pose::Pose;
    use crate::base::random::Random;

    #[test]
    fn parts_make_the_whole_again() {
        let mut random = Random::new(5);
        let mut number = |low: f64, high: f64| low + (high - low) * f64::from(random.next_f32());
        for _ in 0..200 {
            let turn = [0; 4].map(|_| number(-1.0, 1.0));
            let place = [0; 3].map(|_| number(-3.0, 3.0));
            let k = [
                [number(100.0, 2000.0), number(-5.0, 5.0), number(100.0, 900.0)],
                [0.0, number(100.0, 2000.0), number(100.0, 500.0)],
                [0.0, 0.0, 1.0],
            ];
            let matrix = Pose::new(turn, place).expect("a pose").inverse().then_project(&k);
            let pinhole = Pinhole::of(&matrix).expect("a camera");
            assert!(pinhole.place.iter().zip(place).all(|(a, b)| (a - b).abs() < 1e-4), "{pinhole:?}, {place:?}");
            assert!(pinhole.k.iter().zip(k.as_flattened()).all(|(a, b)| (a - b).abs() < 2e-2), "{pinhole:?}, {k:?}");
            let rows: [[f64; 3]; 3] = std::array::from_fn(|r| std::array::from_fn(|c| pinhole.k[3 * r + c]));
            let again = Pose::new(pinhole.rotation, pinhole.place).expect("a pose").inverse().then_project(&rows);
            assert_eq!(again, matrix, "rounded once, the product is the matrix");
        }
    }

    #[test]
    fn what_is_no_camera_is_refused() {
        let sound = [1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1.];
        assert_eq!(Pinhole::of(&sound).expect("a camera").rotation, [1.0, 0.0, 0.0, 0.0]);
        for (at, value) in [(0, -1.0), (0, 0.0), (10, 0.0), (5, f32::NAN), (3, f32::INFINITY)] {
            let mut matrix = sound;
            matrix[at] = value;
            assert!(Pinhole::of(&matrix).is_err(), "{at} {value}");
        }
    }
}

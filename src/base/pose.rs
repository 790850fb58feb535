//! Where one frame of reference lies in another.

use crate::base::error::{Error, Result};
use glam::{DMat3, DQuat, DVec3};

/// A rotation and then a shift in metres, in f64: points of an inner frame to an outer one, such as a sensor's to those of
/// the vehicle that carries it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    rotation: DMat3,
    shift: DVec3,
}

impl Pose {
    /// One frame that is the other.
    pub const IDENTITY: Self = Self { rotation: DMat3::IDENTITY, shift: DVec3::ZERO };

    /// The pose with a rotation by the quaternion (w, x, y, z), of any length but zero, and a shift.
    ///
    /// # Errors
    /// [`ErrorKind::Format`](crate::ErrorKind::Format) for a quaternion without direction and for what is not finite.
    pub fn new([w, x, y, z]: [f64; 4], shift: [f64; 3]) -> Result<Self> {
        let quaternion = DQuat::from_xyzw(x, y, z, w);
        let length = quaternion.length();
        if !length.is_normal() {
            return Err(Error::format(format!(
                "rotation [{w}, {x}, {y}, {z}], expected a quaternion that is finite and not zero"
            )));
        }
        if !shift.iter().all(|v| v.is_finite()) {
            return Err(Error::format(format!("translation {shift:?}, expected finite metres")));
        }
        Ok(Self { rotation: DMat3::from_quat(quaternion / length), shift: shift.into() })
    }

    /// The pose of a row-major 4x4 that is a rotation and a shift.
    #[cfg(feature = "eval")]
    pub(crate) fn from_rigid(m: &[[f64; 4]; 4]) -> Self {
        let rotation = DMat3::from_cols_array_2d(&[m[0], m[1], m[2]].map(|[x, y, z, _]| [x, y, z])).transpose();
        Self { rotation, shift: DVec3::new(m[0][3], m[1][3], m[2][3]) }
    }

    /// The outer frame's place of a point of the inner one.
    pub fn apply(&self, point: [f64; 3]) -> [f64; 3] {
        (self.rotation * DVec3::from(point) + self.shift).into()
    }

    /// Where the inner frame has its origin.
    pub fn origin(&self) -> [f64; 3] {
        self.shift.into()
    }

    /// Its numbers: the rotation column by column, then the shift.
    #[cfg(feature = "eval")]
    pub(crate) fn numbers(&self) -> [f64; 12] {
        let [a, b, c, d, e, f, g, h, i] = self.rotation.to_cols_array();
        let [x, y, z] = self.shift.to_array();
        [a, b, c, d, e, f, g, h, i, x, y, z]
    }

    /// The outer frame in the inner one.
    #[must_use]
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.transpose();
        Self { rotation, shift: -(rotation * self.shift) }
    }

    /// Row-major 4x4 of a camera that lies so that this pose leads to its frame: points (x, y, z, 1) to (u d, v d, d, 1)
    /// for the rows `intrinsic`. It is computed in f64 and rounded once.
    pub(crate) fn then_project(&self, intrinsic: &[[f64; 3]; 3]) -> [f32; 16] {
        let intrinsic = DMat3::from_cols_array_2d(intrinsic).transpose();
        let (turned, shifted) = (intrinsic * self.rotation, intrinsic * self.shift);
        let mut matrix = [0.0; 16];
        matrix[15] = 1.0;
        for row in 0..3 {
            for column in 0..3 {
                matrix[4 * row + column] = turned.col(column)[row] as f32;
            }
            matrix[4 * row + 3] = shifted[row] as f32;
        }
        matrix
    }
}

/// `outer * inner`: first the inner pose, then the outer one.
impl std::ops::Mul for Pose {
    type Output = Self;

    fn mul(self, inner: Self) -> Self {
        Self { rotation: self.rotation * inner.rotation, shift: self.rotation * inner.shift + self.shift }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(found: [f64; 3], expected: [f64; 3]) {
        let near = found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12);
        assert!(near, "{found:?}, expected {expected:?}");
    }

    /// A quarter turn to the left, and 10 m ahead.
    fn left() -> Pose {
        Pose::new([2.0, 0.0, 0.0, 2.0], [10.0, 0.0, 1.0]).expect("a pose")
    }

    #[test]
    fn points_by_hand() {
        close(left().apply([3.0, 4.0, 5.0]), [6.0, 3.0, 6.0]);
        close(left().inverse().apply([6.0, 3.0, 6.0]), [3.0, 4.0, 5.0]);
        close((left() * left()).apply([3.0, 4.0, 5.0]), [7.0, 6.0, 7.0]);
        close((left().inverse() * left()).apply([3.0, 4.0, 5.0]), [3.0, 4.0, 5.0]);
        // A third of a turn about (1, 1, 1) takes x to y, y to z, z to x.
        let third = Pose::new([0.5; 4], [0.0; 3]).expect("a pose");
        close(third.apply([1.0, 2.0, 3.0]), [3.0, 1.0, 2.0]);
        assert_eq!(left().origin(), [10.0, 0.0, 1.0]);
    }

    #[test]
    fn pixels_by_hand() {
        let camera = left().then_project(&[[100.0, 0.0, 50.0], [0.0, 200.0, 60.0], [0.0, 0.0, 1.0]]);
        let expected = [0.0, -100.0, 50.0, 1050.0, 200.0, 0.0, 60.0, 60.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0f32];
        assert!(camera.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-4), "{camera:?}");
    }

    #[test]
    fn what_is_no_pose_is_refused() {
        for (rotation, shift, expected) in [
            ([0.0; 4], [0.0; 3], "rotation [0, 0, 0, 0]"),
            ([f64::NAN, 0.0, 0.0, 1.0], [0.0; 3], "rotation [NaN"),
            ([1.0, 0.0, 0.0, 0.0], [0.0, f64::INFINITY, 0.0], "translation [0.0, inf"),
        ] {
            let error = Pose::new(rotation, shift).expect_err(expected);
            assert!(error.message().contains(expected), "{error}");
        }
    }
}

//! What one step of an `i8` tensor stands for.

use crate::base::error::{Error, Result};
use serde::{Deserialize, Serialize};
use std::hash::{Hash, Hasher};

/// The largest element of an `i8` tensor; the smallest is its negative.
pub const LEVELS: f64 = 127.0;

/// What one step of an `i8` tensor stands for: its elements are `scale * q`, q from -127 to 127. A positive, normal f32,
/// so that model files, kernels and whoever reads a dump mean the same number.
#[derive(Clone, Copy, Debug, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(try_from = "f32", into = "f32")]
pub struct Scale(f32);

impl Scale {
    /// The scale whose largest element stands for `range`, rounded to f32 once.
    ///
    /// # Errors
    /// [`ErrorKind::Format`](crate::ErrorKind::Format) for a range that is not positive and finite, or so small or large
    /// that its step is no normal f32: "underflows", "overflows".
    pub fn of_range(range: f64) -> Result<Self> {
        if !range.is_finite() || range <= 0.0 {
            return Err(Error::format(format!("range {range}, expected a positive, finite number")));
        }
        Self::try_from((range / LEVELS) as f32).map_err(|e| Error::format(format!("range {range:e}: {}", e.message())))
    }

    /// The step.
    pub fn step(self) -> f32 {
        self.0
    }

    /// The step, for arithmetic at import.
    pub fn wide(self) -> f64 {
        f64::from(self.0)
    }

    /// What the largest element stands for.
    pub fn range(self) -> f64 {
        LEVELS * self.wide()
    }
}

impl TryFrom<f32> for Scale {
    type Error = Error;

    fn try_from(step: f32) -> Result<Self> {
        if step.is_normal() && step > 0.0 && (1.0 / step).is_normal() {
            return Ok(Self(step));
        }
        let what = if step.abs() < 1.0 { "the scale underflows: " } else { "the scale overflows: " };
        Err(Error::format(format!("{what}{step:e}, expected a positive normal number whose inverse is one")))
    }
}

impl From<Scale> for f32 {
    fn from(scale: Scale) -> Self {
        scale.0
    }
}

// A scale is never NaN.
impl Eq for Scale {}

impl Hash for Scale {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.0.to_bits().hash(state);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scales_are_positive_normal_numbers() {
        let scale = Scale::of_range(254.0).expect("a range");
        assert_eq!((scale.step(), scale.range()), (2.0, 254.0));
        let json = serde_json::to_string(&Scale::of_range(1.0).expect("a range")).expect("a number");
        assert_eq!(serde_json::from_str::<Scale>(&json).expect("its own JSON"), Scale::of_range(1.0).expect("a range"));
        for (range, expected) in [
            (0.0, "range 0, expected a positive"),
            (-1.0, "range -1"),
            (f64::NAN, "range NaN"),
            (f64::INFINITY, "range inf"),
            (1e-40, "underflows"),
            (1e60, "overflows"),
        ] {
            let error = Scale::of_range(range).expect_err("no range");
            assert!(error.message().contains(expected), "{error}");
        }
        assert!(serde_json::from_str::<Scale>("0").is_err());
    }
}

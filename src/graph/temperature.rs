//! How soft the softmax is that says how sure a network is.

use crate::base::error::{Error, Result};
use std::fmt;
use std::str::FromStr;

/// What logits are divided by before their softmax is a probability: above 1 for a network that is too sure of itself. A
/// positive, normal f32 whose inverse is one, so that model files and kernels mean the same number.
#[derive(Clone, Copy, Debug, PartialEq, PartialOrd)]
pub struct Temperature(f32);

impl Temperature {
    /// Logits as they are.
    pub const ONE: Self = Self(1.0);

    /// The number.
    pub fn value(self) -> f32 {
        self.0
    }

    /// What logits are multiplied by, rounded to f32 once.
    pub fn inverse(self) -> f32 {
        1.0 / self.0
    }
}

impl Default for Temperature {
    fn default() -> Self {
        Self::ONE
    }
}

impl TryFrom<f32> for Temperature {
    type Error = Error;

    fn try_from(value: f32) -> Result<Self> {
        if value.is_normal() && value > 0.0 && (1.0 / value).is_normal() {
            return Ok(Self(value));
        }
        Err(Error::format(format!("temperature {value:e}, expected a positive normal number whose inverse is one")))
    }
}

impl FromStr for Temperature {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let value: f32 = text.parse().map_err(|_| Error::format(format!("temperature {text:?}, expected a number")))?;
        Self::try_from(value)
    }
}

/// The shortest decimal that is read as the same number.
impl fmt::Display for Temperature {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

// A temperature is never NaN.
impl Eq for Temperature {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn temperatures_are_positive_normal_numbers() {
        let temperature: Temperature = "1.6".parse().expect("a temperature");
        assert_eq!((temperature.value(), temperature.inverse()), (1.6, 0.625));
        assert_eq!(temperature.to_string().parse::<Temperature>().expect("its own text"), temperature);
        assert_eq!((Temperature::default(), Temperature::ONE.to_string().as_str()), (Temperature::ONE, "1"));
        for text in ["", "warm", "0", "-1", "nan", "inf", "1e-40", "1e39", "3e38"] {
            let error = text.parse::<Temperature>().expect_err(text);
            assert!(error.message().starts_with("temperature "), "{text}: {error}");
        }
    }
}

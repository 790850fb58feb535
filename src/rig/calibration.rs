//! Which calibration a rig was built from: a digest of each camera's matrix.

use crate::base::digest;
use crate::base::error::{Error, Result};
use std::fmt;

/// The XXH3-64 of each camera's matrix, in the order of the cameras; empty where nobody knows it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Calibration(Vec<u64>);

/// Digest of one matrix: of its sixteen little-endian f32, -0 as 0 and every NaN as one.
fn digest_of(matrix: &[f32; 16]) -> u64 {
    // -0 + 0 is 0, and nothing else changes.
    digest::floats(&matrix.map(|value| value + 0.0))
}

impl Calibration {
    /// Becomes that of these matrices. Memory that it has is used again.
    pub(super) fn set(&mut self, lidar2img: &[[f32; 16]]) {
        self.0.clear();
        self.0.extend(lidar2img.iter().map(digest_of));
    }

    pub(super) fn is_known(&self) -> bool {
        !self.0.is_empty()
    }

    /// Reads what [`fmt::Display`] writes for `cameras` cameras.
    pub(super) fn parse(text: &str, cameras: usize) -> Result<Self> {
        let hex = |word: &str| {
            let sound = word.len() == 16 && word.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'));
            u64::from_str_radix(word, 16).ok().filter(|_| sound)
        };
        let digests: Option<Vec<u64>> = text.split(' ').take(cameras + 1).map(hex).collect();
        match digests.filter(|digests| digests.len() == cameras) {
            Some(digests) => Ok(Self(digests)),
            None => {
                let shown: String = text.chars().take(40).collect();
                let message = format!("the metadata's \"calibration\" is {shown:?}, expected {cameras} digests");
                Err(Error::format(message))
            }
        }
    }

    /// Whether this is the calibration `lidar2img`; false where nobody knows.
    pub(super) fn check(&self, lidar2img: &[[f32; 16]]) -> Result<bool> {
        if !self.is_known() {
            return Ok(false);
        }
        let digests: Vec<u64> = lidar2img.iter().map(digest_of).collect();
        if self.0 == digests {
            return Ok(true);
        }
        let sorted = |mut digests: Vec<u64>| {
            digests.sort_unstable();
            digests
        };
        let what = if self.0.len() != digests.len() {
            format!("it has {} cameras, expected {}", self.0.len(), digests.len())
        } else if sorted(self.0.clone()) == sorted(digests.clone()) {
            "the same cameras in another order, expected the order of the scene".to_owned()
        } else {
            let differs = |(i, (a, b)): (usize, (&u64, &u64))| (a != b).then(|| i.to_string());
            let differ: Vec<String> = self.0.iter().zip(&digests).enumerate().filter_map(differs).collect();
            let count = digests.len();
            format!(
                "camera {} of {count} (from 0) is not where the scene has it, expected the scene's matrices",
                differ.join(", ")
            )
        };
        Err(Error::mismatch(format!("a rig of another calibration: {what}")))
    }
}

impl fmt::Display for Calibration {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, digest) in self.0.iter().enumerate() {
            write!(f, "{}{digest:016x}", if i == 0 { "" } else { " " })?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn matrices(n: usize) -> Vec<[f32; 16]> {
        (0..n).map(|c| std::array::from_fn(|i| (c * 16 + i) as f32 * 0.5)).collect()
    }

    fn of(matrices: &[[f32; 16]]) -> Calibration {
        let mut calibration = Calibration::default();
        calibration.set(matrices);
        calibration
    }

    #[test]
    fn what_is_written_is_read_and_any_change_is_seen() {
        let sound = matrices(3);
        let calibration = of(&sound);
        assert_eq!(Calibration::parse(&calibration.to_string(), 3).unwrap(), calibration);
        assert!(calibration.check(&sound).unwrap());
        assert!(!Calibration::default().check(&sound).unwrap(), "a plain rig does not say");
        let mut zeros = sound.clone();
        zeros[0][0] = -0.0;
        assert!(calibration.check(&zeros).unwrap(), "zeros of both signs project alike");
        for i in 0..48 {
            let mut other = sound.clone();
            other[i / 16][i % 16] = f32::from_bits(other[i / 16][i % 16].to_bits() + 1);
            let message = calibration.check(&other).unwrap_err().message().to_owned();
            assert!(message.contains(&format!("camera {} of 3", i / 16)), "{message}");
        }
        let mut turned = sound.clone();
        turned.rotate_left(1);
        assert!(calibration.check(&turned).unwrap_err().message().contains("another order"));
        assert!(calibration.check(&sound[..2]).unwrap_err().message().contains("3 cameras, expected 2"));
        assert!(calibration.check(&[sound[0]; 3]).unwrap_err().message().contains("camera 1, 2 of 3"));
    }

    #[test]
    fn what_is_no_list_of_digests_is_refused() {
        let text = of(&matrices(2)).to_string();
        for (text, cameras) in [
            (text.as_str(), 1),
            (&text, 3),
            (&text[1..], 2),
            (&text.to_uppercase(), 2),
            (&text.replace(' ', "  "), 2),
            (&format!("+{}", &text[1..]), 2),
            ("", 1),
            ("0123456789abcdeg", 1),
        ] {
            let error = Calibration::parse(text, cameras).expect_err(text);
            assert!(error.message().contains("digests"), "{error}");
        }
    }
}

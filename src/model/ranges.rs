//! The ranges of a network's tensors, measured on scenes: what int8 models are made from, kept as JSON.

use crate::base::digest;
use crate::base::error::{Error, Result};
use crate::file::replace::replace_file;
use crate::graph::Scale;
use crate::network::Network;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;

/// Value of the key `format`.
pub const FORMAT: &str = "voxcast-ranges-1";

/// How thresholds are chosen: the value of the key `rule`.
pub const RULE: &str = "mse-127";

/// Bytes of the largest file that is read. A thousand tensors need a tenth of a mebibyte.
const MAX_BYTES: u64 = 16 << 20;

/// What was measured of one tensor.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Range {
    /// The largest magnitude that was seen.
    pub max: f64,
    /// The magnitude that the largest of 127 steps stands for.
    pub threshold: f64,
}

/// The ranges of a network's tensors.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ranges {
    /// [`FORMAT`].
    format: String,
    /// [`Ranges::digest_of`] the network.
    network: String,
    /// How thresholds were chosen; [`RULE`].
    pub rule: String,
    /// Frames that were looked at.
    pub frames: usize,
    /// Of each tensor, by name.
    pub tensors: BTreeMap<String, Range>,
}

impl Ranges {
    /// The ranges `tensors` of `network`, measured on `frames` frames.
    pub fn new(network: &Network, frames: usize, tensors: BTreeMap<String, Range>) -> Self {
        let network = Self::digest_of(network);
        Self { format: FORMAT.to_owned(), network, rule: RULE.to_owned(), frames, tensors }
    }

    /// By what ranges know their network: 16 hexadecimal digits of its numbers, not of its weights.
    pub fn digest_of(network: &Network) -> String {
        format!("{:016x}", digest::bytes(network.to_json().as_bytes()))
    }

    /// Reads ranges of `network`.
    ///
    /// # Errors
    /// [`ErrorKind::Io`](crate::ErrorKind::Io) if the file cannot be read; [`ErrorKind::Format`](crate::ErrorKind::Format)
    /// and [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) as [`Ranges::from_json`]. Each names the file.
    pub fn open(path: &Path, network: &Network) -> Result<Self> {
        let read = |e: std::io::Error| Error::io(path, "read", &e);
        let bytes = std::fs::metadata(path).map_err(read)?.len();
        if bytes > MAX_BYTES {
            return Err(Error::format(format!("{bytes} bytes, expected ranges of at most {MAX_BYTES}")).in_file(path));
        }
        let text = std::fs::read_to_string(path).map_err(read)?;
        Self::from_json(&text, network).map_err(|e| e.in_file(path))
    }

    /// Ranges of `network` from JSON.
    ///
    /// # Errors
    /// [`ErrorKind::Format`](crate::ErrorKind::Format) for what is no ranges, and for a number that is not positive and
    /// finite, with the tensor; [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) for those of another network.
    pub fn from_json(text: &str, network: &Network) -> Result<Self> {
        let ranges: Self = serde_json::from_str(text).map_err(|e| Error::format(format!("ranges JSON: {e}")))?;
        let expected = Self::digest_of(network);
        for (key, found, expected) in [("format", &ranges.format, FORMAT), ("rule", &ranges.rule, RULE)] {
            if found != expected {
                return Err(Error::format(format!("ranges key \"{key}\": found \"{found}\", expected \"{expected}\"")));
            }
        }
        if ranges.network != expected {
            let message = format!("ranges of another network: found digest {}, expected {expected}", ranges.network);
            return Err(Error::mismatch(message));
        }
        for (name, range) in &ranges.tensors {
            for (key, value) in [("max", range.max), ("threshold", range.threshold)] {
                if !value.is_finite() || value < 0.0 {
                    let message =
                        format!("tensor \"{name}\": {key} is {value}, expected a finite number of at least 0");
                    return Err(Error::format(message));
                }
            }
        }
        Ok(ranges)
    }

    /// The ranges as JSON, readable by [`Ranges::from_json`].
    pub fn to_json(&self) -> String {
        let mut text = serde_json::to_string_pretty(self).unwrap_or_default();
        text.push('\n');
        text
    }

    /// Writes them to `path`. The file appears whole or not at all.
    ///
    /// # Errors
    /// [`ErrorKind::Io`](crate::ErrorKind::Io) if it cannot be written.
    pub fn save(&self, path: &Path) -> Result<()> {
        replace_file(path, |out| out.write_all(self.to_json().as_bytes()))
    }

    /// The scale that the threshold of tensor `name` asks for.
    ///
    /// # Errors
    /// [`ErrorKind::Format`](crate::ErrorKind::Format) naming the tensor, if its range is missing, zero, or its scale
    /// underflows.
    pub fn scale(&self, name: &str) -> Result<Scale> {
        let range = self.tensors.get(name).ok_or_else(|| {
            Error::format(format!(
                "tensor \"{name}\": the ranges lack it; calibrate this network, or keep what writes it in f32"
            ))
        })?;
        if range.threshold == 0.0 {
            let message = format!(
                "tensor \"{name}\": its range is 0, for it was zero in every frame; calibrate on other scenes, or keep what writes it in f32"
            );
            return Err(Error::format(message));
        }
        Scale::of_range(range.threshold).map_err(|e| Error::format(format!("tensor \"{name}\": {}", e.message())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ErrorKind;

    fn network() -> Network {
        Network::built_in("edge").expect("built in")
    }

    fn ranges() -> Ranges {
        let range = |threshold| Range { max: 2.0, threshold };
        let tensors = [("a", 1.27), ("dead", 0.0), ("small", 1e-40)].map(|(n, t)| (n.to_owned(), range(t)));
        Ranges::new(&network(), 3, tensors.into())
    }

    #[test]
    fn ranges_survive_their_file() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("ranges.json");
        ranges().save(&path).expect("written");
        assert_eq!(Ranges::open(&path, &network()).expect("read"), ranges());
        assert!((ranges().scale("a").expect("a scale").wide() - 0.01).abs() < 1e-9);
    }

    #[test]
    fn what_cannot_be_used_is_one_line() {
        for (name, expected) in [
            ("b", "\"b\": the ranges lack it"),
            ("dead", "\"dead\": its range is 0"),
            ("small", "\"small\": range 1e-40: the scale underflows"),
        ] {
            let error = ranges().scale(name).expect_err(name);
            assert!(error.message().contains(expected) && !error.message().contains('\n'), "{error}");
        }
        let other = Network { classes: 18, ..network() };
        let error = Ranges::from_json(&ranges().to_json(), &other).expect_err("another network");
        assert_eq!(error.kind(), ErrorKind::Mismatch);
        assert!(error.message().contains("another network"), "{error}");
        let text = ranges().to_json();
        for (from, to, expected) in [
            ("voxcast-ranges-1", "voxcast-ranges-2", "\"format\": found"),
            ("mse-127", "max", "\"rule\": found \"max\""),
            ("1.27", "-1.27", "\"a\": threshold is -1.27"),
            ("1.27", "null", "ranges JSON"),
            ("1.27", "1e999", "ranges JSON"),
            ("\"frames\": 3,", "", "missing field `frames`"),
        ] {
            let error = Ranges::from_json(&text.replace(from, to), &network()).expect_err(to);
            assert!(error.message().contains(expected), "{error}");
        }
    }
}

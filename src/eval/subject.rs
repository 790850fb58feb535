//! What is evaluated, and which part of it is one's own.

use super::{Kind, Options};
use crate::base::digest;
use crate::base::error::{Error, Result};
use crate::eval::dataset::{DataSet, Published};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::fmt;
use std::str::FromStr;

/// What an evaluation covers and measures.
#[derive(Clone, Debug)]
pub struct Scope {
    /// What to score.
    pub options: Options,
    /// Whether the losses of the training are computed.
    pub losses: bool,
    /// Whether it is counted how often what the network was so sure of came true.
    pub calibration: bool,
    /// Only so many frames from the first on; all if none.
    pub limit: Option<usize>,
    /// Of these, which part.
    pub shard: Shard,
}

impl Default for Scope {
    fn default() -> Self {
        Self { options: Options::default(), losses: false, calibration: false, limit: None, shard: Shard::WHOLE }
    }
}

/// What an evaluation is of: all that decides its numbers, as journals keep it. Two evaluations with equal subjects give
/// equal numbers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Subject {
    /// The data set, as it was named.
    pub data: String,
    /// Its frames, and the XXH3-64 of what it calls them, one a line, in hexadecimal.
    pub frames: usize,
    /// See `frames`.
    pub ids: String,
    /// By what each predictor is known again.
    pub predictors: Vec<String>,
    /// For each, how the set's own evaluation is counted, if it is.
    pub published: Vec<Option<Published>>,
    /// Voxels of the labels along x, y, z.
    pub size: [usize; 3],
    /// [min, max] of x, of y, of z in metres.
    pub bounds: [[f32; 2]; 3],
    /// Names of the classes, the empty one first.
    pub classes: Vec<String>,
    /// Names of the set's masks.
    pub masks: Vec<String>,
    /// Whether losses are computed.
    pub losses: bool,
    /// Whether calibration is counted.
    pub calibration: bool,
    /// Ends of the distance rings in metres.
    pub rings: Vec<f64>,
    /// The program's version.
    pub version: String,
}

impl Subject {
    /// The evaluation of `predictors`, each with how its [`Published`] score is counted, on the set that was named `data`.
    pub fn new(set: &dyn DataSet, data: &str, predictors: Vec<(String, Option<Published>)>, scope: &Scope) -> Self {
        let (predictors, published) = predictors.into_iter().unzip();
        let mut ids = String::new();
        for index in 0..set.len() {
            ids.push_str(set.id(index));
            ids.push('\n');
        }
        let owned = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect();
        let grid = set.grid();
        Self {
            data: data.to_owned(),
            frames: set.len(),
            ids: format!("{:016x}", digest::bytes(ids.as_bytes())),
            predictors,
            published,
            size: grid.size,
            bounds: grid.bounds,
            classes: owned(set.classes()),
            masks: owned(set.masks()),
            losses: scope.losses,
            calibration: scope.calibration,
            rings: scope.options.rings.clone(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
        }
    }

    /// How large its scores are.
    pub fn kind(&self) -> Kind {
        Kind { classes: self.classes.len(), regions: self.masks.len() + 2, rings: self.rings.len() + 1 }
    }

    /// The first thing in which it differs from `expected`, with both values; none if they are equal.
    pub fn difference(&self, expected: &Subject) -> Option<String> {
        let fields = |subject| match serde_json::to_value(subject) {
            Ok(Value::Object(fields)) => fields,
            _ => serde_json::Map::new(),
        };
        let (found, expected) = (fields(self), fields(expected));
        let (name, value) = found.iter().find(|(name, value)| expected.get(*name) != Some(value))?;
        Some(format!("\"{name}\": found {value}, expected {}", expected.get(name).unwrap_or(&Value::Null)))
    }
}

/// A part of the frames of a set: frame k belongs to shard k mod N of N.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "[usize; 2]", into = "[usize; 2]")]
pub struct Shard {
    index: usize,
    count: usize,
}

impl Shard {
    /// All frames.
    pub const WHOLE: Self = Self { index: 0, count: 1 };

    /// Most shards that there can be.
    pub const MOST: usize = 1 << 20;

    /// Shard `index`, from 0 on, of `count`.
    ///
    /// # Errors
    /// [`ErrorKind::Format`](crate::ErrorKind::Format) if there is no such shard, or more than [`Shard::MOST`].
    pub fn new(index: usize, count: usize) -> Result<Self> {
        if index < count && count <= Self::MOST {
            return Ok(Self { index, count });
        }
        let message =
            format!("shard {index}/{count}, expected I/N with I from 0 to N - 1 and N at most {}", Self::MOST);
        Err(Error::format(message))
    }

    /// Its number, from 0 on.
    pub fn index(self) -> usize {
        self.index
    }

    /// How many shards there are.
    pub fn count(self) -> usize {
        self.count
    }

    /// Whether frame `frame` belongs to it.
    pub fn has(self, frame: usize) -> bool {
        frame % self.count == self.index
    }

    /// Its frames, of the first `frames` of the set.
    pub fn frames(self, frames: usize) -> impl Iterator<Item = usize> {
        (self.index..frames).step_by(self.count)
    }
}

impl TryFrom<[usize; 2]> for Shard {
    type Error = Error;

    fn try_from([index, count]: [usize; 2]) -> Result<Self> {
        Self::new(index, count)
    }
}

impl From<Shard> for [usize; 2] {
    fn from(shard: Shard) -> Self {
        [shard.index, shard.count]
    }
}

impl FromStr for Shard {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let numbers = || {
            let (index, count) = text.split_once('/')?;
            Some((index.parse().ok()?, count.parse().ok()?))
        };
        let (index, count) =
            numbers().ok_or_else(|| Error::format(format!("shard {text:?}, expected I/N such as 0/8")))?;
        Self::new(index, count)
    }
}

impl fmt::Display for Shard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.index, self.count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shards_share_out_every_frame_once() {
        for (count, frames) in [(1, 5), (3, 10), (7, 7), (8, 3)] {
            let mut taken = vec![0; frames];
            for index in 0..count {
                let shard = Shard::new(index, count).expect("a shard");
                shard.frames(frames).for_each(|frame| taken[frame] += 1);
                assert!((0..frames).all(|frame| shard.has(frame) == (frame % count == index)));
                assert_eq!(shard.to_string().parse::<Shard>().expect("a shard"), shard);
            }
            assert!(taken.iter().all(|&times| times == 1), "{count} shards of {frames}");
        }
    }

    #[test]
    fn what_is_no_shard_is_refused() {
        for text in ["", "3", "3/3", "0/0", "-1/2", "1/1048577", "a/2", "1/2/3"] {
            assert!(text.parse::<Shard>().expect_err(text).message().contains("expected I/N"), "{text}");
        }
    }
}

//! Two dumps, stage by stage: which stage is the first to differ, where, and by how much.
//!
//! A dump is any safetensors file or `.npz` whose tensors are named after stages: what `voxcast run --dump` or `-o` wrote,
//! or expected values of another program. Stages are compared in the order in which the network runs them, one at a time.

use crate::base::error::{Error, Result};
use crate::file::container::Container;
use crate::graph::{Graph, Results};
use crate::network::Network;
use safetensors::Dtype;
use std::borrow::Cow;
use std::collections::BTreeSet;
use std::path::Path;

/// Named tensors in a file.
pub struct Dump {
    contents: Contents,
}

enum Contents {
    Tensors(Container),
    #[cfg(feature = "npz")]
    Arrays(Vec<crate::file::npz::OwnedArray>),
}

/// Numbers of one stage.
enum Values<'a> {
    Floats(Cow<'a, [u8]>),
    /// Bytes and the width of one element.
    Integers(Cow<'a, [u8]>, usize),
}

impl Dump {
    /// Opens a dump: a safetensors file, an `.npz`, or a directory that `run --dump` wrote.
    ///
    /// # Errors
    /// [`ErrorKind::Io`](crate::ErrorKind::Io) and [`ErrorKind::Format`](crate::ErrorKind::Format), naming the file.
    pub fn open(path: &Path) -> Result<Self> {
        let within = path.join("stages.safetensors");
        let path = if path.is_dir() { &within } else { path };
        #[cfg(feature = "npz")]
        if path.extension().is_some_and(|e| e == "npz") {
            return Ok(Self { contents: Contents::Arrays(crate::file::npz::read_npz(path)?) });
        }
        Ok(Self { contents: Contents::Tensors(Container::open(path)?) })
    }

    /// Names of the stages, in the order in which a network runs them; others follow by name.
    pub fn names(&self) -> Vec<String> {
        let mut names: Vec<String> = match &self.contents {
            Contents::Tensors(container) => container.names(),
            #[cfg(feature = "npz")]
            Contents::Arrays(arrays) => arrays.iter().map(|a| a.name.clone()).collect(),
        };
        let order = order();
        names.sort_by_key(|name| (order.iter().position(|o| o == name).unwrap_or(order.len()), name.clone()));
        names
    }

    fn get(&self, name: &str) -> Option<(Vec<usize>, Result<Values<'_>>)> {
        match &self.contents {
            Contents::Tensors(container) => {
                let (dtype, shape, bytes) = container.tensor(name)?;
                let bytes = Cow::Borrowed(bytes);
                let values = match dtype {
                    Dtype::F32 => Ok(Values::Floats(bytes)),
                    Dtype::U8 | Dtype::I8 | Dtype::BOOL => Ok(Values::Integers(bytes, 1)),
                    Dtype::U16 | Dtype::I16 => Ok(Values::Integers(bytes, 2)),
                    Dtype::U32 | Dtype::I32 => Ok(Values::Integers(bytes, 4)),
                    Dtype::U64 | Dtype::I64 => Ok(Values::Integers(bytes, 8)),
                    other => Err(Error::format(format!("tensor \"{name}\" is {other:?}, expected f32 or integers"))),
                };
                Some((shape.to_vec(), values))
            }
            #[cfg(feature = "npz")]
            Contents::Arrays(arrays) => {
                use crate::file::npz::OwnedElements;
                let array = arrays.iter().find(|a| a.name == name)?;
                let values = match &array.elements {
                    OwnedElements::U8(v) => Ok(Values::Integers(Cow::Borrowed(v), 1)),
                    OwnedElements::U16(v) => Ok(Values::Integers(Cow::Owned(bytemuck::cast_slice(v).to_vec()), 2)),
                    OwnedElements::F32(v) => Ok(Values::Floats(Cow::Owned(bytemuck::cast_slice(v).to_vec()))),
                    OwnedElements::Unread(what) => {
                        Err(Error::format(format!("array \"{name}\" is {what}, expected u8, u16 or f32 in C order")))
                    }
                };
                Some((array.shape.clone(), values))
            }
        }
    }
}

/// Stages in running order. Their names are those of every network.
fn order() -> Vec<String> {
    let network = Network::built_in("nuscenes-200").unwrap_or_else(|| unreachable!("a built-in name"));
    let mut order: Vec<String> = Graph::build(&network, Results::ALL).stages().map(str::to_owned).collect();
    let first = order.iter().position(|s| s.starts_with("level")).unwrap_or(order.len());
    let matrix = |l: usize, kind: &str, part: &str| format!("level{l}.csr_{kind}.{part}");
    let matrices = (1..=3).flat_map(|l| {
        [("volume", "ptr"), ("volume", "col"), ("bev", "ptr"), ("bev", "col")].map(|(kind, part)| matrix(l, kind, part))
    });
    order.splice(first..first, matrices);
    order.extend(["logits", "support", "classes"].map(str::to_owned));
    order
}

/// How one stage of two dumps compares.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome {
    /// The same in every bit.
    Equal,
    /// Numbers differ, within the tolerance or beyond.
    Differs(Difference),
    /// Shapes: there is nothing to compare.
    Shapes([Vec<usize>; 2]),
    /// Only the first (0) or the second (1) has it.
    OnlyIn(usize),
}

/// By how much a stage differs.
#[derive(Clone, Debug, PartialEq)]
pub struct Difference {
    /// Elements that differ.
    pub count: usize,
    /// The largest absolute difference; NaN where one is NaN and the other is not.
    pub max: f64,
    /// The same over the root mean square of the second dump's stage.
    pub relative: f64,
    /// Signal to noise in decibels: the squares of the second dump's stage over those of the differences; none for integers.
    pub snr: Option<f64>,
    /// Representable f32 numbers from one to the other, at most; none for integers.
    pub ulp: Option<u64>,
    /// The element with the largest difference, an index per axis, and both values.
    pub at: Vec<usize>,
    /// What the two dumps have there.
    pub values: [f64; 2],
    /// Whether it is beyond the tolerance.
    pub beyond: bool,
}

/// A stage and its outcome.
#[derive(Clone, Debug, PartialEq)]
pub struct Stage {
    /// Its name.
    pub name: String,
    /// Its elements in the first dump that has it.
    pub elements: usize,
    /// What was found.
    pub outcome: Outcome,
}

impl Stage {
    /// Whether the dumps part here.
    pub fn diverges(&self) -> bool {
        match &self.outcome {
            Outcome::Equal => false,
            Outcome::Differs(difference) => difference.beyond,
            Outcome::Shapes(_) | Outcome::OnlyIn(_) => true,
        }
    }
}

/// Compares two dumps, stage by stage in running order. `tolerance` is the largest difference of f32 stages over the root
/// mean square of `b`'s stage; `None` asks for equal bits (any NaN equals any NaN). Integers must be equal; classes may
/// differ in the share `tolerance` of voxels. With `common`, stages that only one of them has are left out.
///
/// # Errors
/// [`ErrorKind::Format`](crate::ErrorKind::Format) for a tensor of other elements, or if no stage is in both.
pub fn compare(a: &Dump, b: &Dump, tolerance: Option<f64>, common: bool) -> Result<Vec<Stage>> {
    let mut names = a.names();
    let known: BTreeSet<&String> = names.iter().collect();
    let others: Vec<String> = b.names().into_iter().filter(|n| !known.contains(n)).collect();
    names.extend(others);
    let order = order();
    names.sort_by_key(|name| order.iter().position(|o| o == name).unwrap_or(order.len()));
    let mut stages = Vec::new();
    let mut shared = false;
    for name in names {
        let (elements, outcome) = match (a.get(&name), b.get(&name)) {
            (Some((first, x)), Some((second, y))) => {
                shared = true;
                let elements = first.iter().product();
                if first == second {
                    (elements, difference(&name, &first, &x?, &y?, tolerance)?)
                } else {
                    (elements, Outcome::Shapes([first, second]))
                }
            }
            (Some((shape, _)), None) if !common => (shape.iter().product(), Outcome::OnlyIn(0)),
            (None, Some((shape, _))) if !common => (shape.iter().product(), Outcome::OnlyIn(1)),
            _ => continue,
        };
        stages.push(Stage { name, elements, outcome });
    }
    if !shared {
        return Err(Error::mismatch("no stage is in both, expected dumps of the same network"));
    }
    Ok(stages)
}

fn difference(name: &str, shape: &[usize], a: &Values<'_>, b: &Values<'_>, tolerance: Option<f64>) -> Result<Outcome> {
    let mut found = Difference {
        count: 0,
        max: 0.0,
        relative: 0.0,
        snr: None,
        ulp: None,
        at: Vec::new(),
        values: [0.0; 2],
        beyond: false,
    };
    let mut worst = None;
    let mut see = |index: usize, x: f64, y: f64| {
        found.count += 1;
        let off = (x - y).abs();
        // A NaN is worse than any number; the first of equals counts.
        let worse = worst.is_none() || (!found.max.is_nan() && (off.is_nan() || off > found.max));
        if worse {
            (worst, found.max, found.values) = (Some(index), off, [x, y]);
        }
    };
    let len: usize = shape.iter().product();
    match (a, b) {
        (Values::Floats(a), Values::Floats(b)) => {
            let (mut squares, mut noise, mut ulp) = (0.0f64, 0.0f64, 0u64);
            let number = |bytes: &[u8; 4]| f32::from_le_bytes(*bytes);
            for (index, (x, y)) in a.as_chunks().0.iter().zip(b.as_chunks().0).enumerate() {
                let (x, y) = (number(x), number(y));
                squares += f64::from(y) * f64::from(y);
                noise += (f64::from(x) - f64::from(y)).powi(2);
                if x.to_bits() != y.to_bits() && !(x.is_nan() && y.is_nan()) {
                    ulp = ulp.max(rank(x).abs_diff(rank(y)));
                    see(index, f64::from(x), f64::from(y));
                }
            }
            found.ulp = Some(ulp);
            found.snr = Some(10.0 * (squares / noise).log10());
            found.relative = found.max / (squares / len.max(1) as f64).sqrt().max(f64::MIN_POSITIVE);
            found.beyond = tolerance.is_none_or(|t| found.relative.is_nan() || found.relative > t);
        }
        (Values::Integers(a, n), Values::Integers(b, m)) if n == m => {
            let number = |bytes: &[u8]| bytes.iter().rev().fold(0u64, |v, &b| v << 8 | u64::from(b)) as f64;
            for (index, (x, y)) in a.chunks_exact(*n).zip(b.chunks_exact(*n)).enumerate() {
                if x != y {
                    see(index, number(x), number(y));
                }
            }
            let share = found.count as f64 / len.max(1) as f64;
            found.relative = share;
            let allowed = tolerance.filter(|_| name == "classes").unwrap_or(0.0);
            found.beyond = share > allowed;
        }
        _ => return Err(Error::mismatch(format!("stage \"{name}\" has other types of elements in the two dumps"))),
    }
    let Some(mut index) = worst else { return Ok(Outcome::Equal) };
    found.at = vec![0; shape.len()];
    for (place, &side) in found.at.iter_mut().zip(shape).rev() {
        (*place, index) = (index % side, index / side);
    }
    Ok(Outcome::Differs(found))
}

/// Position of a number among all f32, so that neighbours differ by one.
fn rank(x: f32) -> i64 {
    let bits = i64::from(x.to_bits());
    if x.is_sign_negative() { 0x8000_0000 - bits } else { bits }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::file::container::{self, Data, Layout, Tensor};
    use std::collections::BTreeMap;

    fn dump(directory: &Path, name: &str, stages: &[(&str, &[usize], &[f32])]) -> Dump {
        let path = directory.join(name);
        let tensors = stages.iter().map(|(name, shape, values)| Tensor {
            name: (*name).to_owned(),
            dtype: Dtype::F32,
            shape: shape.to_vec(),
            data: Data::Bytes(bytemuck::cast_slice(values)),
        });
        container::write(&path, tensors.collect(), &BTreeMap::new(), Layout::Packed).expect("written");
        Dump::open(&path).expect("a dump")
    }

    #[test]
    fn the_first_stage_that_differs_is_named_with_place_and_size() {
        let directory = tempfile::tempdir().expect("a directory");
        let same: &[f32] = &[1.0, f32::NAN, 3.0, 4.0];
        let a = dump(
            directory.path(),
            "a",
            &[
                ("logits.lvl0", &[2, 2], &[1.0, 2.0, 3.0, 9.0]),
                ("backbone.c3", &[2, 2], same),
                ("fpn.p3", &[1, 2, 2], &[1.0, 2.0, 3.5, 4.0]),
            ],
        );
        let b = dump(
            directory.path(),
            "b",
            &[
                ("backbone.c3", &[2, 2], same),
                ("fpn.p3", &[1, 2, 2], &[1.0, 2.0, 3.0, 4.0]),
                ("logits.lvl0", &[2, 2], &[1.0, 2.0, 3.0, 4.0]),
            ],
        );
        let stages = compare(&a, &b, None, false).expect("comparable");
        let names: Vec<&str> = stages.iter().map(|s| s.name.as_str()).collect();
        assert_eq!(names, ["backbone.c3", "fpn.p3", "logits.lvl0"]);
        assert_eq!(stages[0].outcome, Outcome::Equal);
        let Outcome::Differs(found) = &stages[1].outcome else { panic!("{:?}", stages[1]) };
        assert_eq!((found.count, found.max, found.at.as_slice(), found.values), (1, 0.5, &[0, 1, 0][..], [3.5, 3.0]));
        assert!((found.relative - 0.5 / 7.5f64.sqrt()).abs() < 1e-12 && found.ulp == Some(1 << 21) && found.beyond);
        // The square of 0.5 in those of 1, 2, 3, 4.
        assert!((found.snr.expect("floats") - 10.0 * (30.0f64 / 0.25).log10()).abs() < 1e-9);
        let within = compare(&a, &b, Some(0.2), false).expect("comparable");
        assert!(!within[1].diverges() && within[2].diverges());
    }

    #[test]
    fn missing_stages_shapes_and_nan_diverge() {
        let directory = tempfile::tempdir().expect("a directory");
        let a = dump(
            directory.path(),
            "a",
            &[("x", &[2], &[1.0, f32::NAN]), ("y", &[2], &[0.0, 0.0]), ("z", &[1], &[0.0])],
        );
        let b =
            dump(directory.path(), "b", &[("x", &[2], &[1.0, 2.0]), ("y", &[1, 2], &[0.0, 0.0]), ("w", &[1], &[-0.0])]);
        let stages = compare(&a, &b, Some(1e9), false).expect("comparable");
        assert!(stages.iter().all(Stage::diverges), "{stages:?}");
        assert_eq!(stages.len(), 4);
        assert_eq!(compare(&a, &b, None, true).expect("comparable").len(), 2);
        let c = dump(directory.path(), "c", &[("w", &[1], &[0.0])]);
        assert!(compare(&b, &c, None, false).expect("comparable")[0].diverges(), "-0 is not 0 in bits");
        assert!(compare(&a, &c, None, false).is_err());
    }

    #[test]
    fn ranks_count_representable_numbers() {
        assert_eq!(rank(1.0).abs_diff(rank(1.0 + f32::EPSILON)), 1);
        assert_eq!(rank(0.0), rank(-0.0));
        assert_eq!(rank(f32::from_bits(1)).abs_diff(rank(-f32::from_bits(1))), 2);
    }
}

//! Golden cases on disk: networks with scene and expected stages, and the expected results of single operations.

use crate::gpu::Gpu;
use crate::network::{self, Matrices, Stage};
use crate::ops::Matrix;
use crate::{Failure, network_i8, operations, operations_i8};
use safetensors::{Dtype, SafeTensors};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use voxcast::calibrate::Calibrator;
use voxcast::checkpoint::Checkpoint;
use voxcast::container::{self, Data, Layout};
use voxcast::graph::Rewrites;
use voxcast::import::{Integers, Source, import_int8_to_bytes, import_to_bytes};
use voxcast::model::Options;
use voxcast::model::ranges::Ranges;
use voxcast::scene::{Image, Scene};
use voxcast::weights::Precision;
use voxcast::{Isa, Model, Network, Threads};

#[path = "../../support/scene.rs"]
mod scene;
#[path = "../../support/weights.rs"]
mod weights;

/// Where the golden files lie: `tests/golden`.
pub fn golden() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../golden")
}

/// Where those that the reference makes lie.
pub fn own() -> PathBuf {
    golden().join("reference")
}

/// The manifest in `directory`.
///
/// # Errors
/// If it is missing or no JSON.
pub fn manifest(directory: &Path) -> Result<Value, Failure> {
    let path = directory.join("manifest.json");
    let text = std::fs::read_to_string(&path).map_err(|e| Failure(format!("{}: cannot read: {e}", path.display())))?;
    serde_json::from_str(&text).map_err(|e| Failure(format!("{}: {e}", path.display())))
}

/// A network, its weights and a scene.
pub struct Case {
    /// Name of its directory.
    pub name: String,
    directory: PathBuf,
    network: Network,
    weights: Box<dyn Source>,
    scene: Scene,
}

impl Case {
    /// Reads a directory with `network.json`, `scene.safetensors`, and `checkpoint.safetensors` or `checkpoint.pth`.
    ///
    /// # Errors
    /// If one of them is missing or malformed.
    pub fn open(directory: &Path) -> Result<Self, Failure> {
        let path = ["checkpoint.safetensors", "checkpoint.pth"].map(|name| directory.join(name));
        let path = path.iter().find(|path| path.is_file());
        let path =
            path.ok_or_else(|| Failure(format!("{}: no checkpoint.safetensors or .pth", directory.display())))?;
        Self::read(directory, Box::new(Checkpoint::open(path)?))
    }

    /// The cases that `directory`'s manifest lists; their weights are drawn from a seed where it names one.
    ///
    /// # Errors
    /// As [`Case::open`]; a manifest without cases.
    pub fn listed(directory: &Path) -> Result<Vec<Self>, Failure> {
        let manifest = manifest(directory)?;
        let cases = manifest["cases"].as_array().filter(|cases| !cases.is_empty());
        let cases = cases.ok_or_else(|| Failure(format!("{}: the manifest lists no cases", directory.display())))?;
        let open = |case: &Value| {
            let directory = directory.join(case["name"].as_str().unwrap_or_default());
            match case["seed"].as_u64() {
                Some(seed) => Self::seeded(&directory, seed),
                None => Self::open(&directory),
            }
        };
        cases.iter().map(open).collect()
    }

    /// A case with drawn weights. Its scene is drawn too, and written, if there is none.
    fn seeded(directory: &Path, seed: u64) -> Result<Self, Failure> {
        let path = directory.join("scene.safetensors");
        if !path.exists() {
            let network = read_network(directory)?;
            write_scene(&path, &cropped(scene::scene(&network, seed)))?;
        }
        Self::read(directory, Box::new(weights::Tempered(seed)))
    }

    fn read(directory: &Path, weights: Box<dyn Source>) -> Result<Self, Failure> {
        let name = directory.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let network = read_network(directory)?;
        let scene = Scene::open(&directory.join("scene.safetensors"))?;
        Ok(Self { name, directory: directory.to_owned(), network, weights, scene })
    }

    /// The expected stages.
    ///
    /// # Errors
    /// If the file is missing or malformed.
    pub fn expected(&self) -> Result<Vec<Stage>, Failure> {
        read_stages(&self.directory.join("expected.safetensors"))
    }

    /// Runs the network, with the matrices among `stages` if it is given, else with the reference's own.
    ///
    /// # Errors
    /// If the weights do not fit the network, or matrices are missing.
    pub fn run(&self, gpu: &Gpu, stages: Option<&[Stage]>) -> Result<Vec<Stage>, Failure> {
        let matrices = stages.map(matrices).transpose()?;
        network::run(gpu, &self.network, &*self.weights, &self.scene, matrices)
    }

    /// The reference's own matrices, as stages.
    pub fn matrices(&self, gpu: &Gpu) -> Matrices {
        crate::projection::matrices(gpu, &self.network, &self.scene.lidar2img)
    }

    /// Where the ranges lie from which the case's int8 model is made, if it has one.
    fn ranges(&self) -> PathBuf {
        self.directory.join("ranges.json")
    }

    /// Whether it has an int8 model.
    pub fn has_i8(&self) -> bool {
        self.ranges().is_file()
    }

    /// The expected stages of the int8 model.
    ///
    /// # Errors
    /// If the file is missing or malformed.
    pub fn expected_i8(&self) -> Result<Vec<Stage>, Failure> {
        read_stages(&self.expected_i8_path())
    }

    fn expected_i8_path(&self) -> PathBuf {
        self.directory.join("expected_i8.safetensors")
    }

    /// Runs the int8 model, with the matrices among `stages`.
    ///
    /// # Errors
    /// If the ranges or the weights do not fit the network, or matrices are missing.
    pub fn run_i8(&self, gpu: &Gpu, stages: &[Stage]) -> Result<Vec<Stage>, Failure> {
        let ranges = Ranges::open(&self.ranges(), &self.network)?;
        let integers = Integers { rewrites: Rewrites::ALL, ranges: &ranges, keep_f32: &[] };
        let bytes = import_int8_to_bytes(&*self.weights, &self.network, &integers, &mut |_, _| ())?;
        let model = Model::from_bytes(bytes)?;
        network_i8::run(gpu, &model, &*self.weights, &self.scene, Some(matrices(stages)?))
    }

    /// Measures ranges on the case's scene if there are none, computes the expected stages of the int8 model anew and writes
    /// them, but for the matrices, which are those of the case.
    ///
    /// # Errors
    /// As [`Case::run_i8`]; failed writes.
    pub fn bless_i8(&self, gpu: &Gpu) -> Result<(), Failure> {
        if !self.has_i8() {
            let options = Options { precision: Precision::F32, rewrites: Rewrites::ALL };
            let bytes = import_to_bytes(&*self.weights, &self.network, options, &mut |_, _| ())?;
            let model = Arc::new(Model::from_bytes(bytes)?);
            let mut calibrator = Calibrator::new(model, Isa::best(), &Threads::new(1)?)?;
            calibrator.see(&self.scene)?;
            calibrator.ranges()?.save(&self.ranges())?;
        }
        let mut stages = self.run_i8(gpu, &self.expected()?)?;
        stages.retain(|s| !s.name.contains(".csr_"));
        write_stages(&self.expected_i8_path(), &stages)
    }

    /// Computes the expected stages anew and writes them, but for those of `left_out`, which are large.
    ///
    /// # Errors
    /// As [`Case::run`]; failed writes.
    pub fn bless(&self, gpu: &Gpu, left_out: &[&str]) -> Result<(), Failure> {
        let mut stages = self.run(gpu, None)?;
        stages.retain(|s| !left_out.contains(&s.name.as_str()));
        write_stages(&self.directory.join("expected.safetensors"), &stages)
    }
}

/// How far apart a stage may be, over the root mean square of what is expected. Integers must be equal, but for classes.
#[derive(Clone, Copy, Debug)]
pub struct Tolerance {
    /// The largest difference.
    pub max: f64,
    /// The root mean square of the differences.
    pub rms: f64,
    /// The share of voxels that must get the expected class.
    pub classes: f64,
}

impl Tolerance {
    /// None.
    pub const NONE: Self = Self { max: 0.0, rms: 0.0, classes: 1.0 };

    /// The tolerance called `name` in a manifest.
    ///
    /// # Errors
    /// If it is not there.
    pub fn named(manifest: &Value, name: &str) -> Result<Self, Failure> {
        let get = |key: &str| {
            let value = manifest["tolerance"][name][key].as_f64();
            value.ok_or_else(|| Failure(format!("the manifest has no tolerance.{name}.{key}")))
        };
        Ok(Self { max: get("max")?, rms: get("rms")?, classes: get("equal_classes")? })
    }

    /// That of the networks in `directory` for f32.
    ///
    /// # Errors
    /// As [`Tolerance::named`].
    pub fn of(directory: &Path) -> Result<Self, Failure> {
        Self::named(&manifest(directory)?, Precision::F32.name())
    }
}

/// A stage found and expected.
#[derive(Clone, Debug)]
pub struct Row {
    /// Its name.
    pub name: String,
    /// Its elements.
    pub elements: usize,
    /// The largest difference over the root mean square of what is expected; of integers, how many differ.
    pub max: f64,
    /// The root mean square of the differences, likewise; of integers, the share that differs.
    pub rms: f64,
    /// Whether it is within the tolerance.
    pub fits: bool,
}

impl fmt::Display for Row {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, elements, max, rms, fits } = self;
        let mark = if *fits { "" } else { "  <- too far" };
        write!(f, "{name:24} {elements:9} {max:10.2e} {rms:10.2e}{mark}")
    }
}

/// Compares every stage that is expected with the one found, in running order.
///
/// # Errors
/// If a stage was not found, or has another shape or type.
pub fn compare(found: &[Stage], expected: &[Stage], tolerance: Tolerance) -> Result<Vec<Row>, Failure> {
    let row = |want: &Stage| {
        let got = found.iter().find(|s| s.name == want.name);
        let got = got.ok_or_else(|| Failure(format!("stage \"{}\" was not computed", want.name)))?;
        if (&got.shape, got.dtype) != (&want.shape, want.dtype) {
            let [a, b] = [got, want].map(|s| format!("{:?} {:?}", s.dtype, s.shape));
            return Err(Failure(format!("stage \"{}\" is {a}, expected {b}", want.name)));
        }
        Ok(if want.dtype == Dtype::F32 {
            numbers(&want.name, &got.floats(), &want.floats(), tolerance)
        } else {
            let width = want.dtype.bitsize() / 8;
            let pairs = got.bytes.chunks(width).zip(want.bytes.chunks(width));
            let differ = pairs.filter(|(a, b)| a != b).count() as f64;
            let elements = want.bytes.len() / width;
            let share = differ / elements.max(1) as f64;
            let allowed = if want.name == "classes" { 1.0 - tolerance.classes } else { 0.0 };
            Row { name: want.name.clone(), elements, max: differ, rms: share, fits: share <= allowed }
        })
    };
    let mut expected: Vec<&Stage> = expected.iter().collect();
    // In running order.
    expected.sort_by_key(|want| found.iter().position(|s| s.name == want.name));
    expected.into_iter().map(row).collect()
}

/// Compares numbers.
///
/// # Panics
/// If there are more or fewer than expected.
pub fn numbers(name: &str, found: &[f32], expected: &[f32], tolerance: Tolerance) -> Row {
    assert_eq!(found.len(), expected.len(), "{name}");
    let len = expected.len().max(1) as f64;
    let square: f64 = expected.iter().map(|&v| f64::from(v) * f64::from(v)).sum();
    let scale = (square / len).sqrt().max(f64::MIN_POSITIVE);
    let (mut max, mut squares) = (0.0f64, 0.0);
    for (&a, &b) in found.iter().zip(expected) {
        let off = (f64::from(a) - f64::from(b)).abs();
        squares += off * off;
        // `max` would drop a NaN.
        max = if off > max || off.is_nan() { off } else { max };
    }
    let (max, rms) = (max / scale, (squares / len).sqrt() / scale);
    Row { name: name.to_owned(), elements: found.len(), max, rms, fits: max <= tolerance.max && rms <= tolerance.rms }
}

/// Entries that only one of two matrices has, and entries of the second.
pub fn entries_apart(a: &Matrix, b: &Matrix) -> (usize, usize) {
    let entries = |m: &Matrix| -> BTreeSet<(usize, u32)> {
        let rows = m.ptr.windows(2).enumerate();
        rows.flat_map(|(row, w)| m.col[w[0] as usize..w[1] as usize].iter().map(move |&c| (row, c))).collect()
    };
    let (a, b) = (entries(a), entries(b));
    (a.symmetric_difference(&b).count(), b.len())
}

/// The matrices among stages.
///
/// # Errors
/// If one is missing or has a number beyond 32 bits.
pub fn matrices(stages: &[Stage]) -> Result<Matrices, Failure> {
    let part = |name: String| {
        let stage = stages.iter().find(|s| s.name == name && s.dtype == Dtype::I64);
        let numbers = stage.and_then(|stage| {
            let numbers = stage.bytes.as_chunks().0.iter();
            numbers.map(|&b| u32::try_from(i64::from_le_bytes(b)).ok()).collect::<Option<Vec<u32>>>()
        });
        numbers.ok_or_else(|| Failure(format!("\"{name}\" is not there, expected i64 that fit 32 bits")))
    };
    let matrix = |level: usize, kind: &str| -> Result<Matrix, Failure> {
        let part = |p: &str| part(format!("level{level}.csr_{kind}.{p}"));
        Ok(Matrix { ptr: part("ptr")?, col: part("col")? })
    };
    let pair = |level| Ok::<_, Failure>([matrix(level, "volume")?, matrix(level, "bev")?]);
    Ok([pair(1)?, pair(2)?, pair(3)?])
}

/// Results of single operations as stages.
pub fn operation_stages(gpu: &Gpu) -> Vec<Stage> {
    let stage = |(name, values): (&str, Vec<f32>)| Stage {
        name: name.to_owned(),
        dtype: Dtype::F32,
        shape: vec![values.len()],
        bytes: values.iter().flat_map(|v| v.to_le_bytes()).collect(),
    };
    operations::results(gpu).into_iter().map(stage).collect()
}

/// Results of single operations on 8-bit tensors as stages of i32; values of f32 as their bits.
pub fn operation_i8_stages(gpu: &Gpu) -> Vec<Stage> {
    let stage = |(name, values): (String, Vec<i32>)| Stage {
        name,
        dtype: Dtype::I32,
        shape: vec![values.len()],
        bytes: values.iter().flat_map(|v| v.to_le_bytes()).collect(),
    };
    operations_i8::results(gpu).into_iter().map(stage).collect()
}

/// Reads stages from a safetensors file.
///
/// # Errors
/// If it is missing or malformed.
pub fn read_stages(path: &Path) -> Result<Vec<Stage>, Failure> {
    let failed = |e: &dyn fmt::Display| Failure(format!("{}: {e}", path.display()));
    let bytes = std::fs::read(path).map_err(|e| failed(&e))?;
    let file = SafeTensors::deserialize(&bytes).map_err(|e| failed(&e))?;
    let stages = file.iter().map(|(name, t)| Stage {
        name: name.to_owned(),
        dtype: t.dtype(),
        shape: t.shape().to_vec(),
        bytes: t.data().to_vec(),
    });
    Ok(stages.collect())
}

/// Writes stages to a safetensors file.
///
/// # Errors
/// If it cannot be written.
pub fn write_stages(path: &Path, stages: &[Stage]) -> Result<(), Failure> {
    let tensors = stages.iter().map(|s| container::Tensor {
        name: s.name.clone(),
        dtype: s.dtype,
        shape: s.shape.clone(),
        data: Data::Bytes(&s.bytes),
    });
    Ok(container::write(path, tensors.collect(), &BTreeMap::new(), Layout::Packed)?)
}

fn read_network(directory: &Path) -> Result<Network, Failure> {
    let path = directory.join("network.json");
    let text = std::fs::read_to_string(&path).map_err(|e| Failure(format!("{}: cannot read: {e}", path.display())))?;
    Ok(Network::from_json(&text)?)
}

/// The scene without some of its last rows and columns, so that images need padding.
fn cropped(mut scene: Scene) -> Scene {
    for image in &mut scene.images {
        let (height, width) = (image.height - 5, image.width - 3);
        let rows = image.bgr.chunks_exact(3 * image.width).take(height);
        *image = Image { height, width, bgr: rows.flat_map(|row| &row[..3 * width]).copied().collect() };
    }
    scene
}

fn write_scene(path: &Path, scene: &Scene) -> Result<(), Failure> {
    let (cameras, image) = (scene.cameras(), &scene.images[0]);
    let images = Stage {
        name: "images".to_owned(),
        dtype: Dtype::U8,
        shape: vec![cameras, image.height, image.width, 3],
        bytes: scene.images.iter().flat_map(|i| i.bgr.iter().copied()).collect(),
    };
    let matrices = Stage {
        name: "lidar2img".to_owned(),
        dtype: Dtype::F32,
        shape: vec![cameras, 4, 4],
        bytes: scene.lidar2img.as_flattened().iter().flat_map(|v| v.to_le_bytes()).collect(),
    };
    write_stages(path, &[images, matrices])
}

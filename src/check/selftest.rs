//! The power-on self-test: a stimulus that every model carries, and the digests that it must give on any machine.
//!
//! The stimulus is two cameras (one, if the network has one) with images drawn from a seed and a calibration of plain
//! numbers. A backbone pass is most of a frame, so this takes a fraction of the time of six cameras and still runs every
//! operation. What each operation must give is stored as a digest of its bits. They are the same on every instruction
//! set and number of threads, so a difference means that the machine, the build or the model's bytes are at fault.

pub use crate::model::selftest::{KEY, SelfTest};

use crate::base::digest;
use crate::base::error::{Error, ErrorKind, Result};
use crate::base::random::Random;
use crate::base::threads::Threads;
use crate::graph::Elements;
use crate::image::ImageView;
use crate::model::Model;
use crate::network::Network;
use crate::rig::RigBuilder;
use crate::runtime::session::{Session, SessionOptions};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use voxcast_kernels::Isa;

/// The seed of the stimulus that [`record`] stores.
const SEED: u64 = 1;

/// The first operation whose result is not what it must be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fault {
    /// Its name.
    pub operation: String,
    /// The stage of the network that ends with it, or the last that ended before.
    pub stage: Option<String>,
    /// Its camera, if it runs per camera.
    pub camera: Option<usize>,
    /// The digest that the model carries.
    pub expected: String,
    /// The digest of what this machine computed.
    pub found: String,
}

impl std::fmt::Display for Fault {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "operation {}", self.operation)?;
        if let Some(camera) = self.camera {
            write!(f, " of camera {camera}")?;
        }
        if let Some(stage) = &self.stage {
            write!(f, " (stage {stage})")?;
        }
        write!(f, " gave digest {}, expected {}", self.found, self.expected)
    }
}

/// What [`run`] found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Report {
    /// Operations that were compared: all, or those up to and with the first wrong one.
    pub operations: usize,
    /// The first wrong operation; `None` on a sound machine.
    pub fault: Option<Fault>,
}

/// Two cameras that look ahead and back along the x axis of the lidar frame.
struct Stimulus {
    images: Vec<Vec<u8>>,
    lidar2img: Vec<[f32; 16]>,
}

impl Stimulus {
    fn new(network: &Network, seed: u64) -> Self {
        let [height, width] = network.image;
        let count = network.cameras.min(2);
        let mut random = Random::new(seed);
        let image = |random: &mut Random| {
            // Blocks of one colour with some grain: neither flat nor mere noise.
            let blocks: Vec<u8> =
                (0..height.div_ceil(8) * width.div_ceil(8) * 3).map(|_| random.next_u64() as u8).collect();
            let mut bgr = vec![0u8; height * width * 3];
            for (i, value) in bgr.iter_mut().enumerate() {
                let (v, u, c) = (i / (3 * width), i / 3 % width, i % 3);
                let block = blocks[((v / 8) * width.div_ceil(8) + u / 8) * 3 + c];
                *value = block / 4 * 3 + (random.next_u64() >> 58) as u8;
            }
            bgr
        };
        let images = (0..count).map(|_| image(&mut random)).collect();
        let (cu, cv) = (0.5 * width as f32, 0.5 * height as f32);
        let focal = 0.75 * width as f32;
        // u d = cu x - focal y, v d = cv x - focal z, d = x; the second camera is turned around.
        let matrix = |ahead: f32| {
            let rows = [[cu * ahead, -focal * ahead, 0.0, 0.0], [cv * ahead, 0.0, -focal, 0.0], [ahead, 0.0, 0.0, 0.0]];
            std::array::from_fn(|i| rows.as_flattened().get(i).copied().unwrap_or(f32::from(i == 15)))
        };
        let lidar2img = [1.0, -1.0].into_iter().take(count).map(matrix).collect();
        Self { images, lidar2img }
    }
}

/// Calls `see` with every operation's name, stage, camera and digest, then with those of the logits and the classes.
fn compute(
    model: &Arc<Model>,
    seed: u64,
    isa: Isa,
    threads: &Threads,
    mut see: impl FnMut(&str, Option<&str>, Option<usize>, u64) + Send,
) -> Result<()> {
    let network = model.network();
    let stimulus = Stimulus::new(network, seed);
    let mut builder = RigBuilder::new(network, stimulus.images.len(), isa)?.with_threads(threads.clone());
    let rig = Arc::new(builder.build(&stimulus.lidar2img)?);
    let options = SessionOptions { isa, threads: threads.clone(), logits: true, ..SessionOptions::default() };
    let mut session = Session::new(model.clone(), rig, &options)?;
    let [height, width] = network.image;
    let images: Vec<_> = stimulus.images.iter().map(|bgr| ImageView::bgr(height, width, bgr)).collect();
    let result = session.run_observed(&images, &mut |event| {
        let operation = event.operation;
        see(&operation.name, operation.stage.as_deref(), event.camera, digest_of(event.output));
    })?;
    see("logits", None, None, digest::floats(result.logits.unwrap_or_default()));
    see("classes", None, None, digest::bytes(result.classes));
    Ok(())
}

/// Digest of what an operation wrote.
fn digest_of(elements: Elements<'_>) -> u64 {
    match elements.get() {
        Some(values) => digest::floats(values),
        None => digest::bytes(elements.bytes()),
    }
}

fn hex(digest: u64) -> String {
    format!("{digest:016x}")
}

/// Computes the model's stimulus and compares every operation with what the model says that it must give.
///
/// It takes the memory of a session for two cameras while it runs, on the threads that it is given.
///
/// # Errors
/// [`ErrorKind::Unsupported`] if the model carries no self-test; [`ErrorKind::Format`] if what it carries is malformed
/// or of another network; those of [`Session::new`]. A wrong result is no error, but the report's fault.
pub fn run(model: &Arc<Model>, isa: Isa, threads: &Threads) -> Result<Report> {
    let none =
        || Error::new(ErrorKind::Unsupported, "the model carries no self-test, expected one that import recorded");
    let expected = model.self_test()?.ok_or_else(none)?;
    let last = [("logits", &expected.logits), ("classes", &expected.classes)];
    let wanted = expected.operations.iter().map(|(name, digest)| (name.as_str(), digest));
    let mut wanted = wanted.chain(last).peekable();
    let (mut report, mut unknown, mut last_stage) = (Report { operations: 0, fault: None }, None, None);
    compute(model, expected.seed, isa, threads, |name, stage, camera, digest| {
        last_stage = stage.map(str::to_owned).or(last_stage.take());
        if report.fault.is_some() || unknown.is_some() {
            return;
        }
        let Some((_, expected)) = wanted.next_if(|(wanted, _)| *wanted == name) else {
            unknown = Some(name.to_owned());
            return;
        };
        report.operations += 1;
        let found = hex(digest);
        if found != *expected {
            let (operation, stage, expected) = (name.to_owned(), last_stage.clone(), expected.clone());
            report.fault = Some(Fault { operation, stage, camera, expected, found });
        }
    })?;
    let unknown = unknown.or_else(|| wanted.next().filter(|_| report.fault.is_none()).map(|(name, _)| name.to_owned()));
    match unknown {
        Some(name) => Err(Error::format(format!("the self-test's operations are not the network's, at \"{name}\""))),
        None => Ok(report),
    }
}

/// Computes the stimulus with the model at `path` and writes the model, with what it gave, to `path` again, by way of a
/// temporary file. The same model gives the same bytes.
///
/// # Errors
/// Those of [`Model::open`] and [`Session::new`]; failed writes, which leave the model as it was.
pub fn record(path: &Path, isa: Isa, threads: &Threads) -> Result<()> {
    let model = Arc::new(Model::open(path)?);
    let metadata = metadata(&model, isa, threads)?;
    model.save_with(path, &metadata)
}

/// The bytes of the model with what the stimulus gave, as [`record`] writes them.
///
/// # Errors
/// Those of [`Session::new`]; [`ErrorKind::TooLarge`] if the system has no memory for them.
pub fn record_to_bytes(model: &Arc<Model>, isa: Isa, threads: &Threads) -> Result<Vec<u8>> {
    let metadata = metadata(model, isa, threads)?;
    model.to_bytes_with(&metadata)
}

/// The model's metadata with the self-test in it.
fn metadata(model: &Arc<Model>, isa: Isa, threads: &Threads) -> Result<BTreeMap<String, String>> {
    let mut operations = Vec::new();
    compute(model, SEED, isa, threads, |name, _, _, digest| operations.push((name.to_owned(), hex(digest))))?;
    let (Some((_, classes)), Some((_, logits))) = (operations.pop(), operations.pop()) else {
        unreachable!("two at least")
    };
    let test = SelfTest { seed: SEED, operations, classes, logits };
    let mut metadata = model.metadata().clone();
    metadata.insert(KEY.to_owned(), serde_json::to_string(&test).unwrap_or_default());
    Ok(metadata)
}

#[cfg(test)]
mod tests;

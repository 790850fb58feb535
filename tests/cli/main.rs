//! The program from outside: what it does, what it prints, how it ends; and every kind of input that is at fault.

#![allow(clippy::type_complexity, reason = "tables of edits are read once, where they stand")]

#[path = "../support/pth.rs"]
#[allow(dead_code, reason = "the checkpoint tests use the rest")]
mod pth;
#[path = "../support/small.rs"]
#[allow(dead_code, reason = "other tests use the rest")]
mod small;

mod damaged;
mod drives;
mod evaluation;
mod int8;
mod logs;
mod outside;
mod results;
mod usage;

use serde_json::{Value, json};
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use voxcast::graph::Rewrites;
use voxcast::import::{Source, import};
use voxcast::model::Options;
use voxcast::npz::{Array, Elements, OwnedElements, read_npz, write_npz};
use voxcast::weights::Precision;
use voxcast::{Network, Result};

/// Address space for a program that is given hostile input: more than any of these networks needs, less than any lie.
const KILOBYTES: usize = 4 << 20;

fn voxcast(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_voxcast")).args(arguments).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}

/// The standard output of a run that must succeed, and must say nothing else.
fn done(arguments: &[&str]) -> String {
    let output = voxcast(arguments);
    assert_eq!((output.status.code(), text(&output.stderr)), (Some(0), String::new()), "{arguments:?}");
    text(&output.stdout)
}

/// Runs where memory is scarce.
fn bounded(arguments: &[&str]) -> Output {
    if !cfg!(target_os = "linux") {
        return voxcast(arguments);
    }
    // A sanitizer reserves more address space than there is memory; it has a limit of its own.
    if let Ok(options) = std::env::var("ASAN_OPTIONS") {
        let options = format!("{options}:hard_rss_limit_mb={}", KILOBYTES >> 10);
        let mut command = Command::new(env!("CARGO_BIN_EXE_voxcast"));
        return command.args(arguments).env("ASAN_OPTIONS", options).output().unwrap();
    }
    let script = format!("ulimit -v {KILOBYTES}; exec \"$0\" \"$@\"");
    let program = env!("CARGO_BIN_EXE_voxcast");
    Command::new("sh").args(["-c", &script, program]).args(arguments).output().unwrap()
}

/// The one line of a run that must fail cleanly. It names `file`.
fn refused(file: &str, arguments: &[&str]) -> String {
    let output = bounded(arguments);
    assert_refused(&output, file, &format!("{arguments:?}"))
}

fn assert_refused(output: &Output, file: &str, what: &str) -> String {
    let line = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{what}: {line}");
    assert!(line.starts_with("voxcast: ") && line.ends_with('\n') && line.lines().count() == 1, "{what}: {line:?}");
    assert!(line.contains(file), "{what}: {line:?} does not name {file}");
    assert!(!line.contains("panicked") && line.len() < 4000, "{what}: {line:?}");
    line
}

/// For damage that nobody can detect: success, or a clean failure.
fn refused_or_done(file: &str, arguments: &[&str]) {
    let output = bounded(arguments);
    if output.status.code() != Some(0) {
        assert_refused(&output, file, &format!("{arguments:?}"));
    }
}

/// Weights that write down what they were asked for.
struct Recorder(RefCell<Tensors>);

impl Source for Recorder {
    fn tensor(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>> {
        let values: Vec<f32> =
            small::Near(small::Weights(3)).tensor(name, shape)?.into_iter().map(|v| v as f32).collect();
        self.0.borrow_mut().insert(name.to_owned(), (shape.to_vec(), values.clone()));
        Ok(values.into_iter().map(f64::from).collect())
    }
}

/// Shape and values by name.
type Tensors = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

fn network() -> Network {
    Network {
        image: [32, 64],
        channels: [16, 16, 24, 32],
        grids: [[8, 12, 4], [4, 6, 2], [2, 3, 1]],
        depths: [1; 4],
        ..small::network()
    }
}

/// A directory with a network, its checkpoint in both formats, a scene; and, once asked for, a model and a rig.
struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        Self::of(&network())
    }

    fn of(network: &Network) -> Self {
        let place = Self(tempfile::tempdir().unwrap());
        fs::write(place.path("network.json"), network.to_json()).unwrap();
        let recorder = Recorder(RefCell::default());
        let options = Options { rewrites: Rewrites::NONE, ..Options::default() };
        import(&recorder, network, options, &place.path("recorded"), &mut |_, _| ()).unwrap();
        fs::remove_file(place.path("recorded")).unwrap();
        let tensors = recorder.0.into_inner();
        fs::write(place.path("weights.pth"), pth_bytes(&tensors)).unwrap();
        fs::write(place.path("weights.safetensors"), plain_bytes(&tensors)).unwrap();
        small::scene(network, 1).save(&place.path("scene")).unwrap();
        place
    }

    /// With model and rig.
    fn ready() -> Self {
        let place = Self::new();
        let [network, weights, model] = ["network.json", "weights.pth", "model"].map(|f| place.text(f));
        done(&["import", &weights, "--network", &network, "-o", &model]);
        done(&["rig", &place.text("scene"), "--model", &model, "-o", &place.text("rig")]);
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn text(&self, name: &str) -> String {
        self.path(name).to_str().unwrap().to_owned()
    }

    fn tensors(&self) -> Tensors {
        let checkpoint = voxcast::checkpoint::Checkpoint::open(self.path("weights.pth")).unwrap();
        let tensor = |name: &str| {
            let view = checkpoint.get(name).unwrap();
            (name.to_owned(), (view.shape().to_vec(), view.to_f32().unwrap()))
        };
        checkpoint.names().map(tensor).collect()
    }

    fn import(&self, weights: &str, network: &str) -> [String; 6] {
        let [weights, network, out] = [weights, network, "out"].map(|f| self.text(f));
        ["import".into(), weights, "--network".into(), network, "-o".into(), out]
    }

    fn run(&self, model: &str, rig: &str, scene: &str) -> Vec<String> {
        let [model, rig, scene, out] = [model, rig, scene, "out.npz"].map(|f| self.text(f));
        ["run", "--model", &model, "--rig", &rig, &scene, "-o", &out].map(str::to_owned).to_vec()
    }
}

fn words(arguments: &[String]) -> Vec<&str> {
    arguments.iter().map(String::as_str).collect()
}

fn of_pth(tensors: &Tensors) -> Vec<(&str, pth::Tensor)> {
    let mut all = Vec::new();
    for (name, (shape, values)) in tensors {
        let shape: Vec<i64> = shape.iter().map(|&v| v as i64).collect();
        all.push((name.as_str(), pth::Tensor::f32(&shape, values)));
    }
    all
}

fn pth_bytes(tensors: &Tensors) -> Vec<u8> {
    pth::pth(2, pth::Wrap::Runner, &of_pth(tensors))
}

fn legacy_bytes(tensors: &Tensors) -> Vec<u8> {
    pth::legacy(pth::Wrap::Runner, &of_pth(tensors))
}

fn plain_bytes(tensors: &Tensors) -> Vec<u8> {
    let (mut header, mut data) = (serde_json::Map::new(), Vec::new());
    for (name, (shape, values)) in tensors {
        let from = data.len();
        data.extend(values.iter().flat_map(|v| v.to_le_bytes()));
        header.insert(name.clone(), json!({"dtype": "F32", "shape": shape, "data_offsets": [from, data.len()]}));
    }
    let header = Value::Object(header).to_string();
    [&(header.len() as u64).to_le_bytes()[..], header.as_bytes(), &data].concat()
}

/// Lengths to cut a file of `len` bytes to.
fn cuts(len: usize) -> Vec<usize> {
    vec![0, 1, 7, 8, 9, 64, 1000, len / 3, len / 2, len - 1000, len - 64, len - 1]
}

/// Bits to flip in a file of `len` bytes: some of the start, which headers are, and some all over.
fn flips(len: usize) -> Vec<usize> {
    let start = [0, 3, 7, 8, 20, 41, 100, 150, 230].into_iter().map(|at| at * 8 + at % 8);
    start.chain((0..8).map(|i| (i * (len - 1) / 7) * 8 + i)).collect()
}

fn flip(bytes: &[u8], bit: usize) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    bytes[bit / 8] ^= 1 << (bit % 8);
    bytes
}

//! Whole networks against golden cases: every stage, within the tolerance that each `manifest.json` states and explains.
//! Those in `golden` come from PyTorch, those in `golden/reference` from the reference (docs/reference.md).

use safetensors::{Dtype, SafeTensors};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use voxcast::checkpoint::Checkpoint;
use voxcast::container::{self, Data, Layout, Tensor};
use voxcast::graph::{Element, Graph, Op, Results, Rewrites, Section};
use voxcast::import::{Integers, Source, import, import_int8};
use voxcast::model::Options;
use voxcast::model::ranges::Ranges;
use voxcast::rig::RigBuilder;
use voxcast::session::views;
use voxcast::weights::Precision;
use voxcast::{Isa, Model, Network, Rig, Scene, Session, SessionOptions, Threads};
use voxcast_kernels::cases::{isas, isas_in_words};

#[path = "support/weights.rs"]
mod weights;

/// Where golden cases lie, each with a manifest.
fn golden() -> [PathBuf; 2] {
    let golden = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/golden");
    [golden.join("reference"), golden]
}

fn manifest(directory: &Path) -> Value {
    serde_json::from_str(&std::fs::read_to_string(directory.join("manifest.json")).unwrap()).unwrap()
}

/// A golden case with everything but its expected stages read.
struct Case {
    name: String,
    network: Network,
    scene: Scene,
    weights: Box<dyn Source>,
    /// What its manifest says of tolerances.
    tolerance: Value,
    expected: Vec<u8>,
    left_out: BTreeSet<String>,
    /// The expected stages of an int8 model, and the ranges that it is made from.
    ranges: Option<(Vec<u8>, Ranges)>,
    rig: Arc<Rig>,
    directory: tempfile::TempDir,
}

/// What a run gave: stages in running order, channels last, cameras one after the other; and the classes.
struct Found {
    stages: Vec<Stage>,
    classes: Vec<u8>,
}

struct Stage {
    name: String,
    channels: usize,
    /// Positions of one camera, or of the frame.
    rows: usize,
    values: Vec<f32>,
}

/// How far apart a stage may be, over the root mean square of what is expected.
#[derive(Clone, Copy)]
struct Tolerance {
    /// The largest difference.
    max: f64,
    /// The root mean square of the differences.
    rms: f64,
    /// The share of voxels that must get the expected class.
    classes: f64,
}

fn cases() -> Vec<Case> {
    let mut cases = vec![];
    for directory in golden() {
        let manifest = manifest(&directory);
        let entries = manifest["cases"].as_array().unwrap();
        assert!(entries.len() >= 2);
        cases.extend(entries.iter().map(|entry| Case::read(&directory, entry, &manifest["tolerance"])));
    }
    cases
}

impl Case {
    fn read(directory: &Path, entry: &Value, tolerance: &Value) -> Self {
        let name = entry["name"].as_str().unwrap().to_owned();
        let from = directory.join(&name);
        let weights: Box<dyn Source> = match entry["checkpoint"].as_str() {
            Some(file) => Box::new(Checkpoint::open(from.join(file)).unwrap()),
            None => Box::new(weights::Tempered(entry["seed"].as_u64().unwrap())),
        };
        let network = Network::from_json(&std::fs::read_to_string(from.join("network.json")).unwrap()).unwrap();
        let scene = Scene::open(&from.join("scene.safetensors")).unwrap();
        scene.check(&network).unwrap();
        let expected = std::fs::read(from.join("expected.safetensors")).unwrap();
        let ranges = (entry["int8"] == true).then(|| {
            let ranges = Ranges::open(&from.join("ranges.json"), &network).unwrap();
            (std::fs::read(from.join("expected_i8.safetensors")).unwrap(), ranges)
        });
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("rig");
        write_rig(&SafeTensors::deserialize(&expected).unwrap(), &path);
        Case {
            rig: Arc::new(Rig::open(&path, &network, scene.cameras()).unwrap()),
            weights,
            tolerance: tolerance.clone(),
            left_out: entry["left_out"].as_array().unwrap().iter().map(|v| v.as_str().unwrap().to_owned()).collect(),
            name,
            network,
            scene,
            expected,
            ranges,
            directory,
        }
    }

    fn tolerance(&self, precision: Precision) -> Tolerance {
        let tolerance = &self.tolerance[precision.name()];
        let get = |key: &str| tolerance[key].as_f64().unwrap();
        Tolerance { max: get("max"), rms: get("rms"), classes: get("equal_classes") }
    }

    fn expected(&self) -> SafeTensors<'_> {
        SafeTensors::deserialize(&self.expected).unwrap()
    }

    fn model(&self, precision: Precision, rewrites: Rewrites) -> Arc<Model> {
        let path = self.directory.path().join("model");
        let options = Options { precision, rewrites };
        import(&*self.weights, &self.network, options, &path, &mut |_, _| ()).unwrap();
        Arc::new(Model::open(&path).unwrap())
    }

    /// A session with every stage there is.
    fn session(&self, model: Arc<Model>, unfolded: bool, isa: Isa) -> Session {
        let options = SessionOptions {
            isa,
            threads: Threads::new(2).unwrap(),
            unfolded,
            logits: true,
            coarse_heads: true,
            ..SessionOptions::default()
        };
        Session::new(model, self.rig.clone(), &options).unwrap()
    }

    /// Runs every stage there is.
    fn run(&self, model: Arc<Model>, unfolded: bool, isa: Isa) -> Found {
        let mut session = self.session(model, unfolded, isa);
        let graph = session.graph().clone();
        let mut stages: Vec<Stage> = vec![];
        let result = session
            .run_observed(&views(&self.scene), &mut |event| {
                let Some(name) = &event.operation.stage else { return };
                let tensor = graph.tensor(event.operation.result());
                let (channels, rows) = (tensor.channels, tensor.rows());
                assert_eq!(event.output.len(), channels * rows, "{name}");
                assert_eq!(tensor.section == Section::Head, name.starts_with("logits."));
                let output: &[f32] = event.output.of();
                match stages.iter_mut().find(|s| s.name == *name) {
                    Some(stage) => stage.values.extend(output),
                    None => stages.push(Stage { name: name.clone(), channels, rows, values: output.to_vec() }),
                }
            })
            .unwrap();
        Found { stages, classes: result.classes.to_vec() }
    }

    /// Compares `found` with the expected stages, which must be exactly those of `graph`.
    fn compare(&self, what: &str, graph: &Graph, found: &Found, tolerance: Tolerance) {
        let expected = self.expected();
        let mut table = format!("{}, {what}: differences over the stage's rms\n", self.name);
        writeln!(table, "{:24} {:>9} {:>9}", "", "max", "rms").unwrap();
        writeln!(table, "{:24} {:9.1e} {:9.1e}", "at most", tolerance.max, tolerance.rms).unwrap();
        let mut good = true;
        let mut seen = BTreeSet::new();
        for stage in &found.stages {
            seen.insert(stage.name.clone());
            if self.left_out.contains(&stage.name) {
                continue;
            }
            let tensor = expected.tensor(&stage.name).unwrap_or_else(|e| panic!("{}: {e}", stage.name));
            assert_eq!(tensor.dtype(), Dtype::F32, "{}", stage.name);
            let values = floats(tensor.data());
            assert_eq!(values.len(), stage.values.len(), "{} has shape {:?}", stage.name, tensor.shape());
            let (max, rms) = difference(stage, &values);
            let fits = max <= tolerance.max && rms <= tolerance.rms;
            good &= fits;
            let mark = if fits { "" } else { "  <- too far" };
            writeln!(table, "{:24} {max:9.2e} {rms:9.2e}{mark}", stage.name).unwrap();
        }
        let classes = expected.tensor("classes").unwrap();
        assert_eq!(classes.data().len(), found.classes.len());
        let equal = classes.data().iter().zip(&found.classes).filter(|(a, b)| a == b).count();
        let share = equal as f64 / found.classes.len() as f64;
        writeln!(table, "classes equal {share:.5}, at least {}", tolerance.classes).unwrap();
        assert!(good && share >= tolerance.classes, "{table}");
        let stages: BTreeSet<String> = graph.stages().map(str::to_owned).collect();
        assert_eq!(seen, stages, "every stage is observed");
    }
}

/// The expected matrices as a plain rig, such as another program would write.
fn write_rig(expected: &SafeTensors<'_>, path: &std::path::Path) {
    let mut tensors = vec![];
    for level in 1..=3 {
        for matrix in ["volume", "bev"] {
            for part in ["ptr", "col"] {
                let words: Vec<u8> = integers(expected, &format!("level{level}.csr_{matrix}.{part}"))
                    .into_iter()
                    .flat_map(u32::to_le_bytes)
                    .collect();
                tensors.push(Tensor {
                    name: format!("level{level}.{matrix}.{part}"),
                    dtype: Dtype::U32,
                    shape: vec![words.len() / 4],
                    data: Data::Make(Box::new(move || Ok(words))),
                });
            }
        }
    }
    container::write(path, tensors, &BTreeMap::new(), Layout::Packed).unwrap();
}

fn integers(expected: &SafeTensors<'_>, name: &str) -> Vec<u32> {
    let tensor = expected.tensor(name).unwrap();
    assert_eq!(tensor.dtype(), Dtype::I64, "{name}");
    tensor.data().as_chunks().0.iter().map(|&b| u32::try_from(i64::from_le_bytes(b)).unwrap()).collect()
}

fn floats(bytes: &[u8]) -> Vec<f32> {
    bytes.as_chunks().0.iter().map(|&b| f32::from_le_bytes(b)).collect()
}

/// The largest difference and the root mean square of all, both over the root mean square of what is expected. Only logits
/// are channels last on both sides.
fn difference(stage: &Stage, expected: &[f32]) -> (f64, f64) {
    let square: f64 = expected.iter().map(|&v| f64::from(v) * f64::from(v)).sum();
    let rms = (square / expected.len() as f64).sqrt().max(f64::MIN_POSITIVE);
    let (rows, channels) = (stage.rows, stage.channels);
    let (mut largest, mut squares) = (0.0f64, 0.0);
    for (i, &found) in stage.values.iter().enumerate() {
        let (camera, row, channel) = (i / (rows * channels), i / channels % rows, i % channels);
        let at = if stage.name.starts_with("logits.") { i } else { (camera * channels + channel) * rows + row };
        let off = (f64::from(found) - f64::from(expected[at])).abs();
        squares += off * off;
        // `max` would drop a NaN.
        largest = if off > largest || off.is_nan() { off } else { largest };
    }
    (largest / rms, (squares / expected.len() as f64).sqrt() / rms)
}

#[test]
fn unfolded_stages_agree() {
    for case in cases() {
        let model = case.model(Precision::F32, Rewrites::ALL);
        let found = case.run(model.clone(), true, Isa::best());
        let graph = model.graph(true, Results::ALL);
        assert!(graph.stages().any(|s| s == "level1.gather.volume"));
        case.compare("projection kept", &graph, &found, case.tolerance(Precision::F32));
    }
}

#[test]
fn folded_stages_agree() {
    for case in cases() {
        let model = case.model(Precision::F32, Rewrites::ALL);
        let found = case.run(model.clone(), false, Isa::best());
        let graph = model.graph(false, Results::ALL);
        assert!(!graph.stages().any(|s| s == "level1.gather.volume") && graph.stages().any(|s| s == "level1.volume"));
        case.compare("projection folded", &graph, &found, case.tolerance(Precision::F32));
    }
}

/// The other tests are of Winograd's minimal filtering where it is worth it.
#[test]
fn direct_sums_agree() {
    let mut others = 0;
    for case in cases() {
        let graph = case.model(Precision::F32, Rewrites::ALL).graph(false, Results::ALL);
        others += graph.operations.iter().filter(|o| matches!(o.op, Op::Winograd(_))).count();
        let model = case.model(Precision::F32, Rewrites { winograd: false, ..Rewrites::ALL });
        let found = case.run(model.clone(), false, Isa::best());
        case.compare("direct sums", &model.graph(false, Results::ALL), &found, case.tolerance(Precision::F32));
    }
    assert!(others > 0, "no case has a convolution that is worth it");
}

#[test]
fn stages_without_any_rewrite_agree() {
    for case in cases() {
        let model = case.model(Precision::F32, Rewrites::NONE);
        let found = case.run(model.clone(), false, Isa::best());
        case.compare("no rewrites", &model.graph(false, Results::ALL), &found, case.tolerance(Precision::F32));
    }
}

#[test]
fn half_precision_agrees() {
    for case in cases() {
        let model = case.model(Precision::F16, Rewrites::ALL);
        for unfolded in [false, true] {
            let found = case.run(model.clone(), unfolded, Isa::best());
            case.compare(
                "half precision",
                &model.graph(unfolded, Results::ALL),
                &found,
                case.tolerance(Precision::F16),
            );
        }
    }
}

/// The bytes of a stage, all cameras', channels first.
fn channels_first(values: &[u8], rows: usize, channels: usize) -> Vec<u8> {
    let camera = |x: &[u8]| (0..x.len()).map(|i| x[i % rows * channels + i / rows]).collect::<Vec<_>>();
    values.chunks_exact(rows * channels).flat_map(camera).collect()
}

/// Int8 models against the reference in integers: every stage, the logits and the classes are equal on every instruction set,
/// AVX-VNNI among them, which a signal handler carries out where the CPU lacks it.
#[test]
fn integers_equal_the_reference() {
    let cases: Vec<Case> = cases().into_iter().filter(|case| case.ranges.is_some()).collect();
    assert!(!cases.is_empty());
    // Not `eprintln`, which the harness would keep to itself.
    let said = format!("int8 networks are compared on: {}\n", isas_in_words());
    std::io::Write::write_all(&mut std::io::stderr(), said.as_bytes()).expect("standard error");
    for case in cases {
        let (bytes, ranges) = case.ranges.as_ref().unwrap();
        let expected = SafeTensors::deserialize(bytes).unwrap();
        let path = case.directory.path().join("model");
        let integers = Integers { rewrites: Rewrites::ALL, ranges, keep_f32: &[] };
        import_int8(&*case.weights, &case.network, &integers, &path, &mut |_, _| ()).unwrap();
        let model = Arc::new(Model::open(&path).unwrap());
        for isa in isas() {
            let mut found = BTreeMap::<String, Vec<u8>>::new();
            let mut session = case.session(model.clone(), false, isa);
            let graph = session.graph().clone();
            let result = session.run_observed(&views(&case.scene), &mut |event| {
                let Some(name) = &event.operation.stage else { return };
                let tensor = graph.tensor(event.operation.result());
                let (rows, channels) = (tensor.rows(), tensor.channels);
                let bytes: Vec<u8> = match event.output.element() {
                    Element::I8 => channels_first(event.output.bytes(), rows, channels),
                    // Logits are channels last on both sides.
                    _ => event.output.bytes().to_vec(),
                };
                found.entry(name.clone()).or_default().extend(bytes);
            });
            found.insert("classes".to_owned(), result.unwrap().classes.to_vec());
            let names: BTreeSet<&str> = expected.names().into_iter().collect();
            assert_eq!(found.keys().map(String::as_str).collect::<BTreeSet<_>>(), names, "{}", case.name);
            for (name, found) in &found {
                let want = expected.tensor(name).unwrap().data();
                let what = format!("{}, {name} on {}", case.name, isa.name());
                assert_eq!(found.len(), want.len(), "{what}");
                let differ = found.iter().zip(want).filter(|(a, b)| a != b).count();
                assert_eq!(differ, 0, "{what}: so many of {} bytes differ", want.len());
            }
        }
    }
}

#[test]
fn every_instruction_set_agrees() {
    for case in cases() {
        for precision in [Precision::F32, Precision::F16] {
            let model = case.model(precision, Rewrites::ALL);
            for isa in Isa::available() {
                let found = case.run(model.clone(), false, isa);
                case.compare(isa.name(), &model.graph(false, Results::ALL), &found, case.tolerance(precision));
            }
        }
    }
}

#[test]
fn matrices_are_exactly_those_expected() {
    for case in cases() {
        let built = RigBuilder::new(&case.network, case.scene.cameras(), Isa::best())
            .unwrap()
            .build(&case.scene.lidar2img)
            .unwrap();
        let entries: usize = (0..3).map(|l| built.level(l).volume.col.len()).sum();
        assert!(entries > 500, "{}: {entries} entries show little", case.name);
        assert!(built == *case.rig, "{}: built {built:?}, expected {:?}", case.name, case.rig);
    }
}

#[test]
fn the_comparison_sees_a_single_wrong_number() {
    let stage = |values: &[f32]| Stage { name: "x".into(), channels: 2, rows: 2, values: values.to_vec() };
    // Channels first: [[1, 2], [3, 4]] is channels last [1, 3, 2, 4].
    let expected = [1.0, 2.0, 3.0, 4.0];
    assert_eq!(difference(&stage(&[1.0, 3.0, 2.0, 4.0]), &expected), (0.0, 0.0));
    let (max, rms) = difference(&stage(&[1.0, 3.0, 2.0, 4.5]), &expected);
    assert!((max - 0.5 / 7.5f64.sqrt()).abs() < 1e-12, "{max}");
    assert!((rms - 0.25 / 7.5f64.sqrt()).abs() < 1e-12, "{rms}");
    let (max, rms) = difference(&stage(&[1.0, f32::NAN, 2.0, 4.0]), &expected);
    assert!(!(max <= 1.0 || rms <= 1.0), "NaN fits no tolerance: {max}, {rms}");
}

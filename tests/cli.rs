//! The program from outside: what it does, what it prints, how it ends; and every kind of input that is at fault.

#![allow(clippy::type_complexity, reason = "tables of edits are read once, where they stand")]

#[path = "support/pth.rs"]
#[allow(dead_code, reason = "the checkpoint tests use the rest")]
mod pth;
#[path = "support/small.rs"]
#[allow(dead_code, reason = "other tests use the rest")]
mod small;

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
        let values: Vec<f32> = small::Weights(3).tensor(name, shape)?.into_iter().map(|v| v as f32).collect();
        self.0.borrow_mut().insert(name.to_owned(), (shape.to_vec(), values.clone()));
        Ok(values.into_iter().map(f64::from).collect())
    }
}

/// Shape and values by name.
type Tensors = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

fn network() -> Network {
    Network { image: [32, 64], grids: [[8, 12, 4], [4, 6, 2], [2, 3, 1]], depths: [1; 4], ..small::network() }
}

/// A directory with a network, its checkpoint in both formats, a scene; and, once asked for, a model and a rig.
struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        let place = Self(tempfile::tempdir().unwrap());
        fs::write(place.path("network.json"), network().to_json()).unwrap();
        let recorder = Recorder(RefCell::default());
        let options = Options { rewrites: Rewrites::NONE, ..Options::default() };
        import(&recorder, &network(), options, &place.path("recorded"), &mut |_, _| ()).unwrap();
        fs::remove_file(place.path("recorded")).unwrap();
        let tensors = recorder.0.into_inner();
        fs::write(place.path("weights.pth"), pth_bytes(&tensors)).unwrap();
        fs::write(place.path("weights.safetensors"), plain_bytes(&tensors)).unwrap();
        voxcast::demo::demo_scene(&network(), 1).save(&place.path("scene")).unwrap();
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

fn pth_bytes(tensors: &Tensors) -> Vec<u8> {
    let tensors: Vec<(&str, pth::Tensor)> = tensors
        .iter()
        .map(|(name, (shape, values))| {
            let shape: Vec<i64> = shape.iter().map(|&v| v as i64).collect();
            (name.as_str(), pth::Tensor::f32(&shape, values))
        })
        .collect();
    pth::pth(2, pth::Wrap::Runner, &tensors)
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

#[test]
fn the_whole_path() {
    let place = Place::new();
    let [net, pth, plain, model, half, rig, scene, out, dump] =
        ["network.json", "weights.pth", "weights.safetensors", "model", "half", "rig", "scene", "out.npz", "dump"]
            .map(|f| place.text(f));
    done(&["import", &pth, "--network", &net, "-o", &model]);
    let first = fs::read(&model).unwrap();
    done(&["import", &plain, "--network", &net, "-o", &model]);
    assert_eq!(fs::read(&model).unwrap(), first, "both formats hold the same weights");
    done(&["import", &pth, "--network", &net, "--precision", "f16", "-o", &half]);
    assert!(fs::metadata(&half).unwrap().len() < first.len() as u64);

    done(&["rig", &scene, "--model", &model, "-o", &rig]);
    let built = fs::read(&rig).unwrap();
    done(&["rig", &place.text("scene/calibration.json"), "--model", &model, "-o", &rig, "--threads", "3"]);
    assert_eq!(fs::read(&rig).unwrap(), built);
    done(&["rig", &scene, "--network", &net, "-o", &rig]);
    assert_eq!(fs::read(&rig).unwrap(), built, "matrices follow from the network alone");

    let run = |more: &[&str]| -> Value {
        let arguments = [&["run", "--model", &model, &scene, "-o", &out, "--json"][..], more].concat();
        serde_json::from_str(&done(&arguments)).unwrap()
    };
    let summary = run(&["--logits", "--rig", &rig]);
    let arrays = read_npz(Path::new(&out)).unwrap();
    assert_eq!((arrays[0].name.as_str(), &arrays[0].shape[..]), ("classes", &[16, 24, 8][..]));
    assert_eq!((arrays[1].name.as_str(), &arrays[1].shape[..]), ("logits", &[16, 24, 8, 19][..]));
    let OwnedElements::U8(classes) = &arrays[0].elements else { panic!("classes are bytes") };
    for (class, count) in summary["counts"].as_array().unwrap().iter().enumerate() {
        assert_eq!(count.as_u64().unwrap() as usize, classes.iter().filter(|&&c| usize::from(c) == class).count());
    }
    assert_eq!((arrays[2].name.as_str(), &arrays[2].shape[..]), ("support", &[16, 24, 8][..]));
    assert_eq!(arrays[3].name, "bounds");
    assert_eq!(arrays[3].elements, OwnedElements::F32(network().bounds.concat()));
    assert_eq!((arrays[4].name.as_str(), &arrays[4].shape[..]), ("colours", &[network().classes, 3][..]));
    let support = |out: &str| {
        let mut arrays = read_npz(Path::new(out)).unwrap().into_iter();
        match arrays.find(|a| a.name == "support").unwrap().elements {
            OwnedElements::U16(support) => support,
            other => panic!("support is u16, not {other:?}"),
        }
    };
    let all = support(&out);
    assert!(all.contains(&0) && all.iter().any(|&n| n > 1), "seen and unseen places");
    let masked = run(&["--mask", "1"]);
    assert_ne!(masked["digest"], summary["digest"]);
    let fewer = support(&out);
    assert!(fewer.iter().zip(&all).all(|(a, b)| a <= b) && fewer != all);
    assert_eq!(run(&["--mask", "CAM_1"])["digest"], masked["digest"], "by name");
    run(&["--mask", "0,1"]);
    assert!(support(&out).iter().all(|&n| n == 0));
    let (png, html) = (place.text("out.png"), place.text("out.html"));
    for more in [
        &["--threads", "1"][..],
        &["--threads", "5", "--rig", &rig],
        &["--isa", "scalar"],
        &["--png", &png, "--html", &html],
        &["--dump", &dump, "--stages", "level1.fused,logits.lvl2"],
    ] {
        assert_eq!(run(more)["digest"], summary["digest"], "{more:?}");
    }
    assert!(fs::read(&png).unwrap().starts_with(b"\x89PNG"));
    let page = page(&html);
    assert_eq!((&page["title"], &page["digest"]), (&json!("out.npz"), &summary["digest"]));
    assert_eq!((page["cameras"].as_array().unwrap().len(), page["classes"].as_array().unwrap().len()), (2, 19));
    run(&["--dump", &dump]);
    let stages = fs::read(place.path("dump/stages.safetensors")).unwrap();
    let stages = safetensors::SafeTensors::deserialize(&stages).unwrap();
    assert_eq!(stages.tensor("level1.gather.volume").unwrap().shape(), [1, 17, 8, 12, 4]);
    assert_eq!(stages.tensor("backbone.c5").unwrap().shape(), [2, 96, 1, 2]);
    assert_eq!(stages.tensor("classes").unwrap().shape(), [16, 24, 8]);

    let inspected: Value = serde_json::from_str(&done(&["inspect", &model, "--json", "--threads", "2"])).unwrap();
    assert_eq!((&inspected["kind"], &inspected["network"]["classes"]), (&json!("model"), &json!(19)));
    assert!(inspected["session_bytes"].as_u64() > inspected["arena_bytes"].as_u64());
    let inspected: Value = serde_json::from_str(&done(&["inspect", &rig, "--json"])).unwrap();
    assert_eq!((&inspected["kind"], &inspected["cameras"]), (&json!("rig"), &json!(2)));
    for more in ["--operations", "--plan", "--tensors"] {
        assert!(done(&["inspect", &model, more]).contains("refine_lvl0"), "{more}");
    }
    assert!(done(&["inspect", &rig]).contains("level 3"));

    let trace = place.text("trace.json");
    let profile = done(&["profile", "--model", &model, &scene, "--repeat", "1", "--json", "--trace", &trace]);
    let profile: Value = serde_json::from_str(&profile).unwrap();
    assert!(profile["rows"].as_array().unwrap().len() > 50);
    assert!(profile["longest_slice_seconds"].as_f64() > Some(0.0) && profile["slices"].as_u64() > Some(100));
    serde_json::from_slice::<Value>(&fs::read(&trace).unwrap()).unwrap();
    for by in ["part", "kind", "operation"] {
        assert!(done(&["profile", "--model", &model, &scene, "--repeat", "1", "--by", by]).contains("GMAC/s"));
    }
}

#[test]
fn the_demo_needs_no_other_file() {
    let place = tempfile::tempdir().unwrap();
    let directory = place.path().join("a/b").to_str().unwrap().to_owned();
    let told = done(&["demo", "-o", &directory, "--threads", "2"]);
    let digest = told.split("digest ").nth(1).unwrap().split_whitespace().next().unwrap();
    assert_eq!(digest, "cd3ac30234714157", "the same on every machine, until the network or the street is another");
    let file = |name: &str| format!("{directory}/{name}");
    let (model, scene, out) = (file("model.safetensors"), file("scene"), file("again.npz"));
    let again = done(&["run", "--model", &model, &scene, "-o", &out]);
    assert!(told.contains("mIoU") && again.contains(digest), "{again} {told}");
    assert_eq!(fs::read(file("occupancy.npz")).unwrap(), fs::read(&out).unwrap());
    assert!(fs::read(file("occupancy.png")).unwrap().starts_with(b"\x89PNG"));
    let shown = page(&file("demo.html"));
    assert_eq!((&shown["digest"], &shown["truth"]["caption"]), (&json!(digest), &json!("truth")));

    // The same page from the files, but for its title.
    let (result, labels, view) = (file("occupancy.npz"), file("scene/labels.npy"), file("view.html"));
    done(&["view", &result, "--scene", &scene, "--truth", &labels, "-o", &view]);
    let mut viewed = page(&view);
    assert_eq!((&viewed["title"], &viewed["subtitle"]), (&json!("occupancy.npz"), &json!("scene")));
    viewed["title"] = shown["title"].clone();
    viewed["subtitle"] = shown["subtitle"].clone();
    assert!(viewed == shown);
}

/// The data of a page.
fn page(path: &str) -> Value {
    let html = fs::read_to_string(path).unwrap();
    let (_, json) = html.split_once("<script type=\"application/json\" id=\"data\">").unwrap();
    serde_json::from_str(json.split_once("</script>").unwrap().0).unwrap()
}

#[test]
fn pages_of_results() {
    let place = tempfile::tempdir().unwrap();
    let file = |name: &str| place.path().join(name).to_str().unwrap().to_owned();
    let (classes, wide) = ([4u8; 24], [4u16; 24]);
    let bounds = [-2.0f32, 2.0, 0.0, 3.0, -1.0, 1.0];
    let array = |name, shape, elements| Array { name, shape, elements };
    let good = [
        array("classes", &[4, 3, 2], Elements::U8(&classes)),
        array("bounds", &[3, 2], Elements::F32(&bounds)),
        array("colours", &[8, 3], Elements::U8(&classes)),
    ];
    let out = file("out.npz");
    let write = |arrays: &[Array<'_>]| write_npz(Path::new(&out), arrays).unwrap();

    // Beside the result unless told otherwise; of another program, with the numbers of a network.
    write(&good);
    assert!(done(&["view", &out]).contains("out.html of "));
    let shown = page(&file("out.html"));
    assert_eq!(
        (&shown["classes"][3], &shown["support"]),
        (&json!({ "name": "class 3", "rgb": [4, 4, 4] }), &Value::Null)
    );
    assert_eq!(shown["bounds"], json!([[-2.0, 2.0], [0.0, 3.0], [-1.0, 1.0]]));
    // Of another program, with the numbers of a network, unless the file says others.
    let (network, json) = (network(), file("network.json"));
    fs::write(&json, network.to_json()).unwrap();
    let grid = network.output_grid();
    let many = vec![4u8; grid.iter().product()];
    let foreign = array("classes", &grid, Elements::U8(&many));
    write(&[foreign]);
    done(&["view", &out, "--network", &json]);
    let shown = page(&file("out.html"));
    assert_eq!((shown["classes"].as_array().unwrap().len(), &shown["bounds"]), (19, &json!(network.bounds)));
    fs::remove_file(file("out.html")).unwrap();

    for (arrays, expected) in [
        (vec![], "no array \"classes\", expected u8 [X, Y, Z]"),
        (vec![array("classes", &[4, 6], Elements::U8(&classes))], "\"classes\" is u8 [4, 6], expected u8 [X, Y, Z]"),
        (vec![array("classes", &[4, 3, 2], Elements::U16(&wide))], "\"classes\" is u16 [4, 3, 2]"),
        (vec![array("classes", &[4, 0, 2], Elements::U8(&[])), good[1], good[2]], "at least one voxel"),
        (good[..1].to_vec(), "no array \"bounds\", expected f32 [3, 2], or --network"),
        (good[..2].to_vec(), "no array \"colours\", expected u8 [K, 3], or --network"),
        (vec![good[0], array("bounds", &[2, 3], Elements::F32(&bounds)), good[2]], "\"bounds\" is f32 [2, 3]"),
        (vec![good[0], array("bounds", &[3, 2], Elements::F32(&[f32::NAN; 6])), good[2]], "bounds [NaN, NaN] on x"),
        (vec![good[0], good[1], array("colours", &[6, 4], Elements::U8(&classes))], "\"colours\" is u8 [6, 4]"),
        (vec![good[0], good[1], good[2], array("support", &[24], Elements::U16(&wide))], "\"support\" is u16 [24]"),
    ] {
        write(&arrays);
        let line = refused(&out, &["view", &out]);
        assert!(line.contains(expected), "{line}");
    }
    write(&[foreign, good[1], good[2]]);
    assert!(refused(&out, &["view", &out, "--network", &json]).contains("those of --network are"));
    write(&good);
    assert!(refused(&out, &["view", &out, "--network", &json]).contains("a grid of [4, 3, 2]"));
    write(&[good[0], good[1], array("colours", &[4, 3], Elements::U8(&classes[..12]))]);
    let line = refused(&out, &["view", &out]);
    assert!(line.contains("prediction: 24 voxels of class 4, the first at 0, expected 0 to 3"), "{line}");
    fs::write(&out, b"no zip").unwrap();
    refused(&out, &["view", &out]);
    refused(&file("none"), &["view", &file("none")]);
    write(&good);
    refused(&file("none"), &["view", &out, "--scene", &file("none")]);
    refused(&file("none"), &["view", &out, "--truth", &file("none")]);
    refused(&file("no/out.html"), &["view", &out, "-o", &file("no/out.html")]);
    let truth = file("truth.npz");
    write_npz(Path::new(&truth), &[array("classes", &[2, 3, 4], Elements::U8(&classes))]).unwrap();
    let line = refused(&truth, &["view", &out, "--truth", &truth]);
    assert!(line.contains("shape [2, 3, 4], expected [4, 3, 2]"), "{line}");
    assert!(!Path::new(&file("out.html")).exists(), "nothing is written on failure");
}

#[test]
fn help_and_usage() {
    assert!(done(&["--version"]).starts_with("voxcast "));
    let help = done(&["--help"]);
    for command in
        ["compare", "demo", "eval", "import", "inspect", "profile", "rig", "run", "selftest", "synth", "view"]
    {
        assert!(help.contains(command));
        assert!(done(&[command, "--help"]).contains("Examples:"), "{command}");
        assert!(done(&["help", command]).contains("Usage:"), "{command}");
    }
    for bad in [
        &[][..],
        &["nonsense"],
        &["run"],
        &["run", "scene"],
        &["run", "--model", "m", "scene"],
        &["run", "--model", "m", "scene", "-o", "x", "--stages", "a"],
        &["run", "--model", "m", "scene", "-o", "x", "--threads", "0"],
        &["run", "--model", "m", "scene", "-o", "x", "--threads", "many"],
        &["run", "--model", "m", "scene", "-o", "x", "--nonsense"],
        &["import", "a.pth", "-o", "b"],
        &["import", "a.pth", "--network", "x", "-o", "b", "--precision", "f8"],
        &["import", "a.pth", "--network", "x", "-o", "b", "--fold", "paper"],
        &["rig", "--model", "m", "-o", "x"],
        &["rig", "s", "-o", "x"],
        &["rig", "s", "--model", "m", "--network", "n", "-o", "x"],
        &["inspect"],
        &["inspect", "m", "--cameras", "65"],
        &["profile", "--model", "m", "scene", "--by", "day"],
        &["profile", "--model", "m", "scene", "--repeat", "0"],
        &["demo", "--seed", "-1"],
        &["eval", "--data", "synthetic:d"],
        &["eval", "--model", "m", "--data", "occ3d:d"],
        &["eval", "--model", "m", "--data", "semantickitti:d:22"],
        &["eval", "--compare", "a", "b", "--compare", "c", "d", "--data", "synthetic:d"],
        &["view"],
    ] {
        let output = voxcast(bad);
        assert_eq!((output.status.code(), output.stdout.is_empty()), (Some(2), true), "{bad:?}");
        assert!(text(&output.stderr).contains("--help"), "{bad:?}");
    }
}

#[test]
fn files_that_are_not_there() {
    let place = Place::ready();
    let nothing = place.text("nothing");
    let [net, weights, model, rig, scene, out] =
        ["network.json", "weights.pth", "model", "rig", "scene", "out.npz"].map(|f| place.text(f));
    refused(&nothing, &["import", &nothing, "--network", &net, "-o", &out]);
    refused(&nothing, &["import", &weights, "--network", &nothing, "-o", &out]);
    refused(&nothing, &["rig", &nothing, "--model", &model, "-o", &out]);
    refused(&nothing, &["rig", &scene, "--model", &nothing, "-o", &out]);
    refused(&nothing, &["run", "--model", &nothing, &scene, "-o", &out]);
    refused(&nothing, &["run", "--model", &model, &nothing, "-o", &out]);
    refused(&nothing, &["run", "--model", &model, "--rig", &nothing, &scene, "-o", &out]);
    refused(&nothing, &["inspect", &nothing]);
    refused(&nothing, &["profile", "--model", &nothing, &scene]);
    assert!(!place.path("out.npz").exists());

    // Directories where files belong, and the other way round.
    refused(&scene, &["inspect", &scene]);
    refused(&scene, &["import", &scene, "--network", &net, "-o", &out]);
    refused(&scene, &["import", &weights, "--network", &scene, "-o", &out]);
    refused(&model, &["run", "--model", &model, &model, "-o", &out]);
    refused(&scene, &["run", "--model", &model, &scene, "-o", &scene]);
    refused(&scene, &["import", &weights, "--network", &net, "-o", &scene]);
    refused(&scene, &["rig", &scene, "--model", &model, "-o", &scene]);

    let missing = place.text("no/such/out");
    // Before the frame, not after it: the model is not even looked for.
    refused(&missing, &["run", "--model", &nothing, &scene, "-o", &missing]);
    refused(&missing, &["run", "--model", &model, &scene, "-o", &out, "--png", &missing]);
    refused(&missing, &["import", &weights, "--network", &net, "-o", &missing]);
    refused(&missing, &["rig", &scene, "--model", &model, "-o", &missing]);
    refused(&missing, &["profile", "--model", &model, &scene, "--repeat", "1", "--trace", &missing]);
    let inside = place.text("model/demo");
    refused(&inside, &["demo", "-o", &inside]);
    refused(&inside, &["run", "--model", &model, &scene, "-o", &out, "--dump", &inside]);

    let image = fs::read_dir(place.path("scene")).unwrap().map(|e| e.unwrap().path());
    let image = image.filter(|p| p.extension().is_some_and(|e| e == "png")).min().unwrap();
    fs::remove_file(&image).unwrap();
    refused(image.to_str().unwrap(), &["run", "--model", &model, "--rig", &rig, &scene, "-o", &out]);
}

#[test]
fn names_and_numbers_that_are_unknown() {
    let place = Place::ready();
    let [weights, model, scene, out, dump] =
        ["weights.pth", "model", "scene", "out.npz", "dump"].map(|f| place.text(f));
    let line = refused("nuscenes-999", &["import", &weights, "--network", "nuscenes-999", "-o", &out]);
    assert!(line.contains("nuscenes-200"), "{line}");
    let line = refused("--isa", &["run", "--model", &model, &scene, "-o", &out, "--isa", "mmx"]);
    assert!(line.contains("scalar, avx2"), "{line}");
    let line = refused("no stage", &["run", "--model", &model, &scene, "-o", &out, "--dump", &dump, "--stages", "c9"]);
    assert!(line.contains("\"c9\"") && line.contains("logits.lvl0"), "{line}");
    let line = refused(&scene, &["run", "--model", &model, &scene, "-o", &out, "--mask", "0,2"]);
    assert!(line.contains("camera \"2\"") && line.contains("CAM_0, CAM_1"), "{line}");
    // The wrong published network for these weights.
    let line = refused(&weights, &["import", &weights, "--network", "nuscenes-200", "-o", &out]);
    assert!(line.contains("img_backbone.") && line.contains("expects"), "{line}");
}

#[test]
fn damaged_models_and_rigs() {
    let place = Place::ready();
    for name in ["model", "rig"] {
        let bytes = fs::read(place.path(name)).unwrap();
        let damaged = cuts(bytes.len()).into_iter().map(|n| bytes[..n].to_vec());
        let damaged = damaged.chain(flips(bytes.len()).into_iter().map(|bit| flip(&bytes, bit)));
        let bad = place.text("bad");
        let run = if name == "model" { place.run("bad", "rig", "scene") } else { place.run("model", "bad", "scene") };
        for (i, damaged) in damaged.enumerate() {
            fs::write(&bad, damaged).unwrap();
            refused(&bad, &["inspect", &bad]);
            if i % 4 == 0 {
                refused(&bad, &words(&run));
            }
        }
    }
    // Sound files of the other kind.
    let [model, rig] = ["model", "rig"].map(|f| place.text(f));
    refused(&rig, &words(&place.run("rig", "rig", "scene")));
    refused(&model, &words(&place.run("model", "model", "scene")));
    let weights = place.text("weights.safetensors");
    refused(&weights, &words(&place.run("weights.safetensors", "rig", "scene")));
    refused(&weights, &words(&place.run("model", "weights.safetensors", "scene")));
    refused(&weights, &["inspect", &weights]);
    assert!(!place.path("out.npz").exists());
}

#[test]
fn rigs_that_do_not_belong_here() {
    let place = Place::ready();
    let other = Network { grids: [[16, 12, 4], [8, 6, 2], [4, 3, 1]], ..network() };
    let bad = place.text("bad");
    small::rig(&other, 0.3).save(Path::new(&bad), &other).unwrap();
    let line = refused(&bad, &words(&place.run("model", "bad", "scene")));
    assert!(line.contains("grids"), "{line}");
    let three = Network { cameras: 3, ..network() };
    small::rig(&three, 0.3).save(Path::new(&bad), &three).unwrap();
    let line = refused(&bad, &words(&place.run("model", "bad", "scene")));
    assert!(line.contains("3 cameras"), "{line}");

    // Plain rigs, which other programs write: no checksum guards their numbers.
    let bytes = fs::read(place.path("rig")).unwrap();
    let rig = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let plain = |name: &str, edit: &dyn Fn(&mut Vec<u32>)| {
        let (mut header, mut data) = (serde_json::Map::new(), Vec::new());
        for (key, tensor) in rig.tensors() {
            let mut words: Vec<u32> = tensor.data().as_chunks().0.iter().map(|&b| u32::from_le_bytes(b)).collect();
            if key == name {
                edit(&mut words);
            }
            let from = data.len();
            data.extend(words.iter().flat_map(|w| w.to_le_bytes()));
            header.insert(key, json!({"dtype": "U32", "shape": [words.len()], "data_offsets": [from, data.len()]}));
        }
        let header = Value::Object(header).to_string();
        [&(header.len() as u64).to_le_bytes()[..], header.as_bytes(), &data].concat()
    };
    fs::write(&bad, plain("", &|_| ())).unwrap();
    done(&words(&place.run("model", "bad", "scene")));
    type Edit<'a> = &'a dyn Fn(&mut Vec<u32>);
    let cases: [(&str, Edit<'_>, &str); 7] = [
        ("level1.volume.col", &|w| *w.last_mut().unwrap() = u32::MAX, "4294967295"),
        ("level3.bev.col", &|w| *w.last_mut().unwrap() = 4, "less than 4"),
        ("level1.bev.ptr", &|w| w[5] = u32::MAX, "row 4"),
        ("level2.volume.ptr", &|w| w[0] = 1, "row 0 starts at entry 1"),
        ("level2.volume.ptr", &|w| w[3] = 0, "level2.volume.ptr: row"),
        ("level2.bev.ptr", &|w| w.truncate(24), "level2.bev.ptr has 23 rows, expected 24"),
        ("level3.volume.ptr", &|w| *w.last_mut().unwrap() += 1, "the length of"),
    ];
    for (name, edit, expected) in cases {
        fs::write(&bad, plain(name, edit)).unwrap();
        let line = refused(&bad, &words(&place.run("model", "bad", "scene")));
        assert!(line.contains(name) && line.contains(expected), "{name}: {line}");
    }
    let bytes = plain("", &|_| ());
    for bit in flips(bytes.len()) {
        fs::write(&bad, flip(&bytes, bit)).unwrap();
        refused_or_done(&bad, &words(&place.run("model", "bad", "scene")));
    }
}

#[test]
fn damaged_checkpoints_leave_the_old_model() {
    let place = Place::new();
    let out = place.path("out");
    for name in ["weights.pth", "weights.safetensors"] {
        let bytes = fs::read(place.path(name)).unwrap();
        let bad = place.text("bad");
        for n in cuts(bytes.len()) {
            fs::write(&out, "the old model").unwrap();
            fs::write(&bad, &bytes[..n]).unwrap();
            refused(&bad, &words(&place.import("bad", "network.json")));
            assert_eq!(fs::read(&out).unwrap(), b"the old model", "{name} cut to {n}");
        }
        for bit in flips(bytes.len()) {
            fs::write(&out, "the old model").unwrap();
            fs::write(&bad, flip(&bytes, bit)).unwrap();
            refused_or_done(&bad, &words(&place.import("bad", "network.json")));
            let model = fs::read(&out).unwrap();
            assert!(model == b"the old model" || voxcast::Model::from_bytes(model).is_ok(), "{name}, bit {bit}");
        }
        let left: Vec<_> = fs::read_dir(place.path("")).unwrap().map(|e| e.unwrap().file_name()).collect();
        assert!(!left.iter().any(|f| f.to_string_lossy().ends_with(".tmp")), "{left:?}");
    }
}

#[test]
fn weights_that_cannot_be_used_are_named() {
    let place = Place::new();
    let sound = place.tensors();
    type Edit<'a> = &'a dyn Fn(&mut Tensors);
    let edits: [(&str, Edit<'_>, &str); 6] = [
        ("img_backbone.conv1.weight", &|t| t.get_mut("img_backbone.conv1.weight").unwrap().1[7] = f32::NAN, "NaN"),
        ("img_neck.fpn_convs.1.conv.bias", &|t| drop(t.remove("img_neck.fpn_convs.1.conv.bias")), "missing"),
        (
            "occ_head.mlp_occ_lvl0.4.bias",
            &|t| t.get_mut("occ_head.mlp_occ_lvl0.4.bias").unwrap().1[2] = f32::INFINITY,
            "inf",
        ),
        (
            "img_backbone.bn1.running_var",
            &|t| t.get_mut("img_backbone.bn1.running_var").unwrap().1[1] = -1.0,
            "variance",
        ),
        (
            "view_transformer.up_sample1.0.weight",
            &|t| t.get_mut("view_transformer.up_sample1.0.weight").unwrap().0.swap(0, 1),
            "expects",
        ),
        (
            "img_backbone.layer1.0.conv1",
            &|t| t.get_mut("img_backbone.layer1.0.conv1.weight").unwrap().1.fill(f32::MAX),
            "finite",
        ),
    ];
    for (name, edit, expected) in edits {
        let mut tensors = sound.clone();
        edit(&mut tensors);
        for (file, bytes) in [("bad.pth", pth_bytes(&tensors)), ("bad.safetensors", plain_bytes(&tensors))] {
            fs::write(place.path(file), bytes).unwrap();
            fs::write(place.path("out"), "the old model").unwrap();
            let line = refused(&place.text(file), &words(&place.import(file, "network.json")));
            assert!(line.contains(name) && line.contains(expected), "{line}");
            assert_eq!(fs::read(place.path("out")).unwrap(), b"the old model");
        }
    }
    // Half precision cannot hold it.
    let mut tensors = sound.clone();
    tensors.get_mut("occ_head.mlp_occ_lvl0.4.weight").unwrap().1[0] = 1e6;
    fs::write(place.path("bad.pth"), pth_bytes(&tensors)).unwrap();
    done(&words(&place.import("bad.pth", "network.json")));
    let import = place.import("bad.pth", "network.json");
    let import = [&words(&import)[..], &["--precision", "f16"]].concat();
    let line = refused("bad.pth", &import);
    assert!(line.contains("mlp_occ_lvl0") && line.contains("65504"), "{line}");
}

#[test]
fn a_pickle_that_would_call_something_is_refused() {
    let place = Place::new();
    let marker = place.text("marker");
    for (module, name) in [("os", "system"), ("builtins", "eval"), ("posix", "system"), ("subprocess", "check_output")]
    {
        let evil = pth::Pickle::new(2).global(module, name).text(&format!("touch {marker}")).raw(b"\x85R").stop();
        fs::write(place.path("evil.pth"), pth::pth_of(evil, &["0"])).unwrap();
        let line = refused("evil.pth", &words(&place.import("evil.pth", "network.json")));
        assert!(line.contains(&format!("{module}.{name}")) || line.contains(&format!("{module} {name}")), "{line}");
        assert!(!Path::new(&marker).exists());
    }
}

#[test]
fn damaged_scenes() {
    let place = Place::ready();
    let run = place.run("model", "rig", "scene");
    done(&words(&run));
    let entries = fs::read_dir(place.path("scene")).unwrap().map(|e| e.unwrap().path());
    let image = entries.filter(|p| p.extension().is_some_and(|e| e == "png")).min().unwrap();
    let sound = fs::read(&image).unwrap();
    for n in cuts(sound.len()) {
        fs::write(&image, &sound[..n]).unwrap();
        refused_or_done(image.to_str().unwrap(), &words(&run));
        if n < sound.len() / 2 {
            refused(image.to_str().unwrap(), &words(&run));
        }
    }
    for bit in flips(sound.len()) {
        fs::write(&image, flip(&sound, bit)).unwrap();
        refused_or_done(image.to_str().unwrap(), &words(&run));
    }
    fs::write(&image, &sound).unwrap();

    let calibration = place.path("scene/calibration.json");
    let sound = fs::read_to_string(&calibration).unwrap();
    let named = calibration.to_str().unwrap();
    for n in [0, 1, 10, sound.len() / 2, sound.len() - 3] {
        fs::write(&calibration, &sound[..n]).unwrap();
        refused(named, &words(&run));
        refused(named, &["rig", named, "--model", &place.text("model"), "-o", &place.text("out")]);
    }
    for (from, to) in [
        ("\"lidar2img\"", "\"lidar\""),
        ("\"width\":64", "\"width\":65"),
        ("\"width\":64", "\"width\":-64"),
        ("\"width\":64", "\"width\":1e99"),
        ("\"file\":\"", "\"file\":\"../"),
        ("\"cameras\"", "\"kameras\""),
        ("[", "[null,"),
    ] {
        assert!(sound.contains(from), "{from} in {sound}");
        fs::write(&calibration, sound.replacen(from, to, 1)).unwrap();
        refused(&place.text("scene"), &words(&run));
    }
    // A sound scene of the wrong size.
    let other = Network { image: [64, 64], ..network() };
    voxcast::demo::demo_scene(&other, 1).save(&place.path("other")).unwrap();
    let line = refused(&place.text("other"), &words(&place.run("model", "rig", "other")));
    assert!(line.contains("64x64") && line.contains("32x64"), "{line}");
    // And of another number of cameras.
    let other = Network { cameras: 1, ..network() };
    voxcast::demo::demo_scene(&other, 1).save(&place.path("one")).unwrap();
    let line = refused(&place.text("rig"), &words(&place.run("model", "rig", "one")));
    assert!(line.contains("2 cameras, expected 1"), "{line}");
}

#[test]
fn absurd_networks() {
    let place = Place::new();
    let sound = serde_json::to_value(network()).unwrap();
    let cases = [
        ("depths", json!([65536, 1, 1, 1]), "depths"),
        ("depths", json!([0, 1, 1, 1]), "depths"),
        ("depths", json!([1, 1, 1]), "length 3"),
        ("width", json!(0), "width"),
        ("width", json!(-1), "-1"),
        ("width", json!(1e300), "1e"),
        ("width", json!(u64::MAX), "width"),
        ("fpn", json!("many"), "many"),
        ("channels", json!([1, 2, 3, 4]), "channels"),
        ("key_dims", json!([1, 1, 1]), "key_dims"),
        ("image", json!([31, 64]), "image"),
        ("image", json!([65536, 65536]), "image"),
        ("grids", json!([[32768, 32768, 4096], [16384, 16384, 2048], [8192, 8192, 1024]]), "grids"),
        ("grids", json!([[8, 12, 4], [4, 6, 2], [2, 3, 2]]), "grids"),
        ("grids", json!([[0, 0, 0], [0, 0, 0], [0, 0, 0]]), "grids"),
        ("bounds", json!([[1, 0], [0, 1], [0, 1]]), "bounds"),
        ("bounds", json!([[0, 1e60], [0, 1], [0, 1]]), ""),
        ("classes", json!(1), "classes"),
        ("classes", json!(300), "classes"),
        ("samples", json!([1, 2, 0]), "samples"),
        ("strides", json!([4, 8, 16]), "strides"),
        ("cameras", json!(0), "cameras"),
        ("sampling", json!("random"), "random"),
        ("block", json!("vgg"), "vgg"),
        ("nonsense", json!(1), "nonsense"),
    ];
    for (key, value, expected) in cases {
        let mut network = sound.clone();
        network[key] = value;
        fs::write(place.path("bad.json"), network.to_string()).unwrap();
        let line = refused("bad.json", &words(&place.import("weights.pth", "bad.json")));
        assert!(line.contains(expected), "{key}: {line}");
    }
    let whole = sound.to_string();
    for n in [0, 1, whole.len() / 2, whole.len() - 1] {
        fs::write(place.path("bad.json"), &whole[..n]).unwrap();
        refused("bad.json", &words(&place.import("weights.pth", "bad.json")));
    }
    fs::write(place.path("bad.json"), "[".repeat(100_000)).unwrap();
    refused("bad.json", &words(&place.import("weights.pth", "bad.json")));
    fs::write(place.path("bad.json"), b"\xff\xfe{}").unwrap();
    refused("bad.json", &words(&place.import("weights.pth", "bad.json")));
}

/// Sizes that the weights do not show and that no machine of this memory can hold.
#[test]
fn sizes_beyond_memory_are_refused_before_they_are_taken() {
    let place = Place::new();
    let sound = serde_json::to_value(network()).unwrap();
    let cases = [
        // More rows than a matrix may have.
        ("grids", json!([[8, 49152, 1024], [4, 24576, 512], [2, 12288, 256]]), "voxels"),
        ("samples", json!([65536, 65536, 65536]), "sample points"),
        ("samples", json!([1, 1, 60000]), "sample points"),
    ];
    for (key, value, expected) in cases {
        let mut network = sound.clone();
        network[key] = value;
        fs::write(place.path("large.json"), network.to_string()).unwrap();
        // Import computes the self-test, which such a model cannot have.
        let import = place.import("weights.pth", "large.json");
        let line = refused(&place.text("out"), &words(&import));
        assert!(line.contains(expected) && line.contains("--no-self-test"), "{line}");
        done(&[&words(&import)[..], &["--no-self-test"]].concat());
        let [model, scene, out] = ["out", "scene", "out.npz"].map(|f| place.text(f));
        let output = bounded(&["inspect", &model, "--operations"]);
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        let line = refused(&model, &["rig", &scene, "--model", &model, "-o", &out]);
        assert!(line.contains(expected), "{line}");
        let line = refused(&model, &["run", "--model", &model, &scene, "-o", &out]);
        assert!(line.contains(expected), "{line}");
    }
}

#[test]
fn an_imported_model_tests_the_machine() {
    let place = Place::ready();
    let model = place.text("model");
    let told = done(&["selftest", &model, "--threads", "3"]);
    assert!(told.contains("operations give what they must") && told.contains("3 threads"), "{told}");
    let report: Value = serde_json::from_str(&done(&["selftest", &model, "--json", "--isa", "scalar"])).unwrap();
    assert!(report["fault"].is_null() && report["operations"].as_u64().unwrap() > 100, "{report}");
    let [network, weights, plain] = ["network.json", "weights.pth", "plain"].map(|f| place.text(f));
    done(&["import", &weights, "--network", &network, "-o", &plain, "--no-self-test"]);
    assert!(refused(&plain, &["selftest", &plain]).contains("no self-test"));
}

#[test]
fn comparing_names_the_first_stage_that_differs() {
    let place = Place::ready();
    let [model, scene, out] = ["model", "scene", "out.npz"].map(|f| place.text(f));
    let [first, second] = ["first", "second"].map(|f| place.text(f));
    let run = |dump: &str, more: &[&str]| {
        let arguments = [&["run", "--model", &model, &scene, "-o", &out, "--dump", dump][..], more].concat();
        done(&arguments);
    };
    run(&first, &["--unfolded"]);
    run(&second, &["--unfolded", "--threads", "3"]);
    assert!(done(&["compare", &first, &second]).contains("agree"));
    assert!(done(&["compare", "--model", &model, &scene, "--against-isa", "scalar"]).contains("agree"));
    fs::remove_dir_all(place.path("second")).unwrap();
    run(&second, &["--unfolded", "--mask", "1"]);
    let output = voxcast(&["compare", &first, &second, "--common", "--json"]);
    assert_eq!(output.status.code(), Some(1));
    let table: Value = serde_json::from_slice(&output.stdout).unwrap();
    let stages = table["stages"].as_array().unwrap();
    let named = stages.iter().find(|s| s["diverges"] == true).unwrap();
    assert_eq!(table["first"], named["stage"], "{table}");
    assert_eq!(voxcast(&["compare", &first]).status.code(), Some(2));
    fs::write(place.path("no dump"), "no dump").unwrap();
    refused("no dump", &["compare", &first, &place.text("no dump")]);
}

#[test]
fn synthetic_scenes_run_and_sets_go_on() {
    let place = Place::ready();
    let mut street = network();
    street.bounds = [[-20.0, 20.0], [-20.0, 20.0], [-5.3, 2.7]];
    fs::write(place.path("street.json"), street.to_json()).unwrap();
    let [network, drive, set] = ["street.json", "drive", "set"].map(|f| place.text(f));
    done(&["synth", "--network", &network, "--seed", "5", "--frames", "2", "-o", &drive]);
    let [model, scene, out] = ["model", "drive/001", "out.npz"].map(|f| place.text(f));
    done(&["run", "--model", &model, &scene, "-o", &out]);
    let arguments = ["synth", "--network", &network, "--seed", "5", "--count", "3", "--set", &set, "--pixels"];
    done(&arguments);
    let file = place.path("set/000000006.safetensors");
    let whole = fs::read(&file).unwrap();
    fs::remove_file(&file).unwrap();
    done(&arguments);
    assert!(fs::read(&file).unwrap() == whole, "the frame that was missing is made again");
    done(&["run", "--model", &model, file.to_str().unwrap(), "-o", &out]);
    let line = refused("set.json", &["synth", "--seed", "5", "--count", "3", "--set", &set]);
    assert!(line.contains("other frames"), "{line}");
    let seeds = ["synth", "--network", &network, "--seed", "999999999", "--count", "2", "--set", &set];
    assert!(refused("", &seeds).contains("seeds below 1000000000"));
}

/// nuScenes with one key frame of the images in `samples`, and its labels of both kinds: a wall of cars 10 m ahead.
fn write_nuscenes(root: &Path, images: &[String]) {
    let cameras = ["CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT"];
    let (mut sensors, mut calibrated, mut egos, mut data) = (vec![], vec![], vec![], vec![]);
    for (index, name) in cameras.into_iter().chain(["LIDAR_TOP"]).enumerate() {
        let camera = index < cameras.len();
        let turn = std::f64::consts::PI * index as f64 / 6.0;
        let intrinsic = if camera { json!([[40, 0, 32], [0, 40, 16], [0, 0, 1]]) } else { json!([]) };
        // Cameras look along +y, turned about z; the lidar's y looks along the vehicle's x.
        let (s, c) = (turn.sin() * 0.5f64.sqrt(), turn.cos() * 0.5f64.sqrt());
        let rotation = if camera { json!([c, -c, -s, s]) } else { json!([0.5f64.sqrt(), 0, 0, -0.5f64.sqrt()]) };
        let file = if camera { images[index].clone() } else { "samples/LIDAR_TOP/sweep.pcd.bin".to_owned() };
        sensors.push(json!({"token": name, "channel": name}));
        calibrated
            .push(json!({"token": name, "sensor_token": name, "translation": [1.1, 0, 2.1], "rotation": rotation,
            "camera_intrinsic": intrinsic}));
        egos.push(json!({"token": name, "translation": [5, 6, 0], "rotation": [1, 0, 0, 0]}));
        data.push(json!({"token": name, "sample_token": "a", "ego_pose_token": name, "calibrated_sensor_token": name,
            "filename": file, "is_key_frame": true, "height": 32, "width": 64}));
    }
    fs::create_dir(root.join("v1.0-mini")).unwrap();
    for (table, rows) in [
        ("sensor", sensors),
        ("calibrated_sensor", calibrated),
        ("ego_pose", egos),
        ("sample_data", data),
        ("scene", vec![json!({"token": "s", "name": "scene-0103"})]),
        ("sample", vec![json!({"token": "a", "scene_token": "s", "timestamp": 7})]),
    ] {
        fs::write(root.join(format!("v1.0-mini/{table}.json")), json!(rows).to_string()).unwrap();
    }
    // 10 to 12 m ahead of the lidar, 4 m to either side, from 2 m below to 2 m above.
    let mut rows = Vec::new();
    for i in 0..16 * 4 * 8 {
        rows.extend([92 + (i / 32) as u8, 120 + (i / 8 % 4) as u8, 6 + (i % 8) as u8, 4]);
    }
    let mut literal = format!("{{'descr': '|u1', 'fortran_order': False, 'shape': ({}, 4), }}", rows.len() / 4);
    literal.push_str(&" ".repeat(117 - literal.len()));
    let file = [b"\x93NUMPY\x01\x00\x76\x00", literal.as_bytes(), b"\n", &rows].concat();
    fs::create_dir_all(root.join("occ/samples")).unwrap();
    fs::write(root.join("occ/samples/sweep.pcd.bin.npy"), file).unwrap();
    let mut semantics = vec![17u8; 640_000];
    for (x, y, z) in (0..5 * 20 * 10).map(|i| (128 + i / 200, 90 + i / 10 % 20, 3 + i % 10)) {
        semantics[(x * 200 + y) * 16 + z] = 4;
    }
    let mask = vec![1u8; 640_000];
    let arrays = [("semantics", &semantics), ("mask_lidar", &mask), ("mask_camera", &mask)]
        .map(|(name, values)| Array { name, shape: &[200, 200, 16], elements: Elements::U8(values) });
    fs::create_dir_all(root.join("gts/scene-0103/a")).unwrap();
    write_npz(&root.join("gts/scene-0103/a/labels.npz"), &arrays).unwrap();
}

#[test]
fn published_sets_are_scored() {
    let place = Place(tempfile::tempdir().unwrap());
    let network = Network { classes: 17, cameras: 6, ..network() };
    fs::write(place.path("model"), small::model_bytes(&network, Precision::F32, Rewrites::ALL, 3)).unwrap();
    let scene = voxcast::demo::demo_scene(&network, 1);
    scene.save(&place.path("samples")).unwrap();
    let images: Vec<String> = scene.names.iter().map(|name| format!("samples/{name}.png")).collect();
    write_nuscenes(place.0.path(), &images);
    let (model, root) = (place.text("model"), place.0.path().to_str().unwrap());
    let (surroundocc, occ3d) = (format!("surroundocc:{root}:{root}/occ:val"), format!("occ3d:{root}:{root}/gts"));
    let scores = |predictor: [&str; 2], data: &str| -> Value {
        let json = place.text("scores.json");
        done(&["eval", predictor[0], predictor[1], "--data", data, "--json", &json]);
        serde_json::from_slice(&fs::read(json).unwrap()).unwrap()
    };
    let of_model = scores(["--model", &model], &occ3d);
    assert_eq!(of_model["frames"], 1);
    assert_eq!(of_model["regions"].as_object().unwrap().len(), 4, "{of_model}");
    assert_eq!(scores(["--model", &model], &surroundocc)["regions"].as_object().unwrap().len(), 2);
    // The same wall in the frames of lidar and vehicle.
    for predictor in [&surroundocc, &occ3d] {
        let iou = &scores(["--majority", predictor], &occ3d)["regions"]["camera"]["iou"];
        assert_eq!(iou.as_f64(), Some(1.0), "{predictor}");
    }
    let line = text(&voxcast(&["eval", "--majority", &occ3d, "--data", &surroundocc]).stderr);
    assert!(line.contains("axes of the ego vehicle"), "{line}");
    fs::remove_file(place.path("gts/scene-0103/a/labels.npz")).unwrap();
    refused("gts/scene-0103/a/labels.npz", &["eval", "--model", &model, "--data", &occ3d]);

    let kitti = place.path("kitti/sequences/08");
    fs::create_dir_all(kitti.join("voxels")).unwrap();
    fs::write(kitti.join("calib.txt"), "P2: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: 1 0 0 0 0 1 0 0 0 0 1 0\n").unwrap();
    fs::write(kitti.join("voxels/000000.label"), vec![0; 4 << 20]).unwrap();
    let data = format!("semantickitti:{root}/kitti");
    let line = refused("model", &["eval", "--model", &model, "--data", &data]);
    assert!(line.contains("a model of 17 classes") && line.contains("has 20"), "{line}");
    refused("voxels/000000.invalid", &["eval", "--majority", &data, "--data", &data]);
}

/// A model for drawn streets, and a set of four of them.
fn street_set(place: &Place) -> [String; 2] {
    let street = Network { classes: 17, bounds: [[-20.0, 20.0], [-20.0, 20.0], [-5.3, 2.7]], ..network() };
    fs::write(place.path("street"), small::model_bytes(&street, Precision::F32, Rewrites::ALL, 3)).unwrap();
    fs::write(place.path("street.json"), street.to_json()).unwrap();
    let [network, set, model] = ["street.json", "set", "street"].map(|f| place.text(f));
    done(&["synth", "--network", &network, "--seed", "5", "--count", "4", "--set", &set]);
    [model, format!("synthetic:{set}")]
}

#[test]
fn an_evaluation_that_was_stopped_goes_on() {
    let place = Place(tempfile::tempdir().unwrap());
    let [model, data] = street_set(&place);
    let [journal, json, markdown] = ["scores.jsonl", "scores.json", "scores.md"].map(|f| place.text(f));
    let base = ["eval", "--model", &model, "--data", &data, "--losses"];
    let at_once = done(&[&base[..], &["--json", &json, "--markdown", &markdown]].concat());
    assert!(at_once.contains("4 frames") && at_once.contains("mIoU") && at_once.contains("lovasz"), "{at_once}");
    let whole = fs::read(&json).unwrap();
    assert!(fs::read_to_string(&markdown).unwrap().contains("| mIoU |"));

    let resumed = [&base[..], &["--resume", &journal, "--json", &json, "--workers", "2"]].concat();
    done(&[&resumed[..], &["--limit", "2"]].concat());
    // The second frame's line loses its end, as after a kill.
    let bytes = fs::read(&journal).unwrap();
    assert_eq!(bytes.iter().filter(|&&b| b == b'\n').count(), 3);
    fs::write(&journal, &bytes[..bytes.len() - 40]).unwrap();
    assert_eq!(done(&resumed), at_once);
    assert!(fs::read(&json).unwrap() == whole, "the same numbers to the last bit");
    assert_eq!(fs::read_to_string(&journal).unwrap().lines().count(), 5);
    // All is known: nothing is computed again, and the set's images are not needed.
    let frame = place.path("set/000000007.safetensors");
    let kept = fs::read(&frame).unwrap();
    fs::write(&frame, "damaged").unwrap();
    assert_eq!(done(&resumed), at_once);
    fs::write(&frame, kept).unwrap();
    let line = refused("scores.jsonl", &["eval", "--model", &model, "--data", &data, "--resume", &journal]);
    assert!(line.contains("another evaluation"), "{line}");
    let line = refused("scores.jsonl", &[&resumed[..8], &["--json", &journal]].concat());
    assert!(line.contains("--resume and --json write the same file"), "{line}");
    assert_eq!(fs::read_to_string(&journal).unwrap().lines().count(), 5);
    fs::write(place.path("notes"), "my notes\n").unwrap();
    refused("notes", &["eval", "--model", &model, "--data", &data, "--resume", &place.text("notes")]);
    assert_eq!(fs::read_to_string(place.path("notes")).unwrap(), "my notes\n");
}

#[test]
fn two_models_are_compared() {
    let place = Place(tempfile::tempdir().unwrap());
    let [model, data] = street_set(&place);
    let street = Network::from_json(&fs::read_to_string(place.path("street.json")).unwrap()).unwrap();
    fs::write(place.path("half"), small::model_bytes(&street, Precision::F16, Rewrites::ALL, 3)).unwrap();
    let [half, json, picture] = ["half", "scores.json", "confusion.png"].map(|f| place.text(f));
    let told = done(&["eval", "--compare", &model, &half, "--data", &data, "--json", &json, "--confusion", &picture]);
    assert!(told.contains("B - A") && told.contains("say the same of"), "{told}");
    let scores: Value = serde_json::from_slice(&fs::read(&json).unwrap()).unwrap();
    let equal = scores["comparison"]["equal"].as_f64().unwrap();
    assert!((0.5..1.0).contains(&equal), "f16 weights change some voxels and not all: {equal}");
    let alone = |model: &str| -> Value {
        done(&["eval", "--model", model, "--data", &data, "--json", &json]);
        serde_json::from_slice(&fs::read(&json).unwrap()).unwrap()
    };
    assert_eq!([alone(&model), alone(&half)].to_vec(), scores["reports"].as_array().unwrap()[..]);
    assert_eq!(&fs::read(place.path("confusion.png")).unwrap()[..4], b"\x89PNG");
    assert_eq!(voxcast(&["eval", "--compare", &model, "--data", &data]).status.code(), Some(2));
}

#[test]
fn a_drive_is_run_with_one_session() {
    let place = Place::ready();
    let street = Network { bounds: [[-20.0, 20.0], [-20.0, 20.0], [-5.3, 2.7]], ..network() };
    fs::write(place.path("street.json"), street.to_json()).unwrap();
    let [network, model, drive, out] = ["street.json", "model", "drive", "out"].map(|f| place.text(f));
    done(&["synth", "--network", &network, "--seed", "5", "--frames", "3", "-o", &drive]);
    let film = place.text("drive.png");
    let run = ["run", "--model", &model, &drive, "-o", &out];
    let told = done(&[&run[..], &["--animation", &film, "--width", "320", "--mask", "1"]].concat());
    assert!(told.contains("3 scenes") && told.contains("99th percentile"), "{told}");
    // The number of frames is in the animation's control chunk.
    let bytes = fs::read(&film).unwrap();
    let control = bytes.windows(4).position(|w| w == b"acTL").unwrap();
    assert_eq!(bytes[control + 4..control + 8], [0, 0, 0, 3]);
    for name in ["000", "001", "002"] {
        let (scene, alone) = (format!("{drive}/{name}"), place.text("alone.npz"));
        done(&["run", "--model", &model, &scene, "-o", &alone, "--mask", "1"]);
        let one = fs::read(&alone).unwrap();
        assert!(fs::read(place.path(&format!("out/{name}.npz"))).unwrap() == one, "{name} alone gives the same");
    }
    let summary: Value = serde_json::from_str(&done(&[&run[..], &["--json"]].concat())).unwrap();
    assert_eq!(summary["scenes"].as_array().unwrap().len(), 3);
    assert!(summary["seconds"]["frame"]["worst"].as_f64() >= summary["seconds"]["frame"]["median"].as_f64());
    assert!(refused("drive", &[&run[..], &["--png", &film]].concat()).contains("--png shows one scene"));
    let one = place.text("drive/000");
    refused("000", &["run", "--model", &model, &one, "-o", &place.text("o.npz"), "--animation", &film]);
    let rig = place.text("rig of the drive");
    done(&["rig", &one, "--model", &model, "-o", &rig]);
    let with_rig = [&run[..], &["--rig", &rig, "--json"]].concat();
    let again: Value = serde_json::from_str(&done(&with_rig)).unwrap();
    assert_eq!((&again["digest"], &again["rigs"]), (&summary["digest"], &json!(1)));
    // A camera that moves gets matrices of its own, unless a rig is given.
    let calibration = place.path("drive/002/calibration.json");
    let mut moved: Value = serde_json::from_slice(&fs::read(&calibration).unwrap()).unwrap();
    moved["cameras"][0]["lidar2img"][0][3] = json!(1.5);
    fs::write(&calibration, moved.to_string()).unwrap();
    let again: Value = serde_json::from_str(&done(&[&run[..], &["--json"]].concat())).unwrap();
    assert_eq!(again["rigs"], 2);
    assert!(refused("drive/002", &with_rig).contains("another calibration"));
    fs::write(place.path("drive/001/calibration.json"), "{}").unwrap();
    refused("drive/001/calibration.json", &[&run[..], &["--animation", &film]].concat());
    assert!(fs::read(&film).unwrap() == bytes, "the old animation stays");
}

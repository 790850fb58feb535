//! Writes small valid inputs into `corpus/<target>`, for the fuzzer to start from:
//! `cargo run --manifest-path fuzz/Cargo.toml --bin seeds`.

#[path = "../../../tests/support/pth.rs"]
#[allow(dead_code, reason = "the library's tests use the rest")]
mod pth;

use pth::{Entry, Tensor, Wrap};
use std::io::Read;
use std::path::Path;
use voxcast::graph::Rewrites;
use voxcast::model::Options;
use voxcast::random::Random;
use voxcast::rig::RigBuilder;
use voxcast::weights::Precision;

fn main() -> std::io::Result<()> {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus");
    let mut all = vec![
        ("calibration", calibrations()),
        ("checkpoint", checkpoints()),
        ("image", images()),
        ("legacy", legacy()),
        ("log", logs()),
        ("model", models()),
        ("npz", archives()),
        ("rig", rigs()),
        ("scene", scenes()),
        ("uniocc", uniocc()),
    ];
    all.extend(DRAWN.map(|target| (target, drawn())));
    for (target, seeds) in all {
        let dir = corpus.join(target);
        std::fs::create_dir_all(&dir)?;
        for (name, bytes) in &seeds {
            std::fs::write(dir.join(name), bytes)?;
        }
        println!("{}: {} seeds", dir.display(), seeds.len());
    }
    Ok(())
}

/// A list of scenes, and cameras with matrices as rows and as arrays.
fn uniocc() -> Vec<(String, Vec<u8>)> {
    let p = || pth::Pickle::new(4);
    let scenes = p().raw(b"](}(").text("occ_in_scene_paths").raw(b"](").text("a.npz").raw(b"eue").stop();
    let row = |p: pth::Pickle, row: &[i64]| row.iter().fold(p.raw(b"]("), |p, &n| p.int(n)).raw(b"e");
    let camera = p().raw(b"](}(").text("name").text("C").text("filename").text("a.png").text("intrinsics").raw(b"](");
    let camera = [[9, 0, 4], [0, 9, 4], [0, 0, 1]].iter().fold(camera, |p, numbers| row(p, numbers));
    let camera = camera.raw(b"e").text("extrinsics").global("numpy.core.multiarray", "_reconstruct");
    let camera = camera.raw(b"(").global("numpy", "ndarray").ints(&[0]).raw(b"C\x01btR(").int(1).ints(&[4, 4]);
    let camera =
        camera.global("numpy", "dtype").raw(b"(").text("u1").raw(b"\x89\x88tR(").int(3).text("|").raw(b"NNNtb");
    let camera = camera.raw(b"\x89C\x10\x01\0\0\0\0\x01\0\0\0\0\x01\0\0\0\0\x01tbue").stop();
    vec![("scenes".to_owned(), scenes), ("cameras".to_owned(), camera)]
}

/// A log of one frame.
fn logs() -> Vec<(String, Vec<u8>)> {
    use voxcast::log::{Encoded, LogFrame, LogWriter, Shot};
    use voxcast::session::CameraStatus;
    let network = voxcast::Network {
        image: [32, 64],
        cameras: 1,
        grids: [[4, 4, 4], [2, 2, 2], [1, 1, 1]],
        ..voxcast::Network::built_in("edge").expect("built in")
    };
    let scene = voxcast::synth::Synthesiser::new(&network).expect("17 classes").frame(1).scene;
    let path = std::env::temp_dir().join(format!("voxcast-seed-{}.mcap", std::process::id()));
    let mut log = LogWriter::create(&path, &network).expect("a log");
    let (classes, support) = ([1; 512], [1; 512]);
    let occupancy = voxcast::Occupancy {
        confidence: None,
        grid: voxcast::network::Grid::of(&network),
        classes: &classes,
        logits: None,
        support: &support,
        cameras: &[CameraStatus::default()],
    };
    let file = Encoded::png(&scene.images[0]).expect("a PNG");
    let shot =
        Shot { name: &scene.names[0], stamp: 1, file: Some(&file), size: [32, 64], lidar2img: &scene.lidar2img[0] };
    let frame = LogFrame { stamp: 1, shots: &[shot], occupancy, latency: std::time::Duration::from_millis(1) };
    log.push(&frame).and_then(|()| log.finish()).expect("written");
    let bytes = std::fs::read(&path).expect("a log");
    std::fs::remove_file(&path).expect("removed");
    vec![("whole".to_owned(), bytes)]
}

/// Targets whose inputs are shapes and values, which drawn bytes make as well as any others.
const DRAWN: [&str; 2] = ["kernels", "session"];

fn drawn() -> Vec<(String, Vec<u8>)> {
    let mut random = Random::new(1);
    let lengths = [0, 4, 16, 16, 64, 64, 256, 1024];
    let bytes = |(i, n): (usize, usize)| (i.to_string(), (0..n).map(|_| random.next_u64() as u8).collect());
    lengths.into_iter().enumerate().map(bytes).collect()
}

fn calibrations() -> Vec<(String, Vec<u8>)> {
    let matrix = "[[1,2,3,4],[5,6e-1,7,8],[9,10,11,12],[0,0,0,1]]";
    let pose = "[[0,-1,0,0.5],[0,0,-1,2.5e-1],[1,0,0,-2],[0,0,0,1]]";
    let direct = format!(r#"{{"name":"a","file":"img/a.png","width":20,"height":10,"lidar2img":{matrix}}}"#);
    let product = format!(
        r#"{{"name":"b","file":"b.png","width":20,"height":10,
            "intrinsic":[[100,0,10],[0,200,5],[0,0,1]],"lidar2camera":{pose}}}"#
    );
    let more = product.replacen(
        "\"intrinsic\"",
        "\"distortion\":[0,0,0,0],\"camera_model\":\"pinhole\",\"x\":[1],\"intrinsic\"",
        1,
    );
    let both = format!("{direct},{product}");
    let file = |cameras: &str| format!(r#"{{"source":null,"cameras":[{cameras}]}}"#).into_bytes();
    vec![
        ("direct".into(), file(&direct)),
        ("product".into(), file(&product)),
        ("both".into(), file(&both)),
        ("more".into(), file(&more)),
    ]
}

/// Files of every decoder and several colour types, behind their size.
fn images() -> Vec<(String, Vec<u8>)> {
    use image::{DynamicImage, ImageFormat};
    let mut random = Random::new(2);
    let (width, height) = (9, 7);
    let mut pixels = |n: u32| (0..width * height * n).map(|_| random.next_u64() as u8).collect::<Vec<_>>();
    let rgb = image::RgbImage::from_raw(width, height, pixels(3)).expect("as many bytes as pixels ask for");
    let rgb = DynamicImage::from(rgb);
    let kinds = [
        ("rgb.png", rgb.clone(), ImageFormat::Png),
        ("rgba16.png", rgb.to_rgba16().into(), ImageFormat::Png),
        ("grey.png", rgb.to_luma8().into(), ImageFormat::Png),
        ("rgb.jpg", rgb.clone(), ImageFormat::Jpeg),
        ("grey.jpg", rgb.to_luma8().into(), ImageFormat::Jpeg),
    ];
    let mut seeds: Vec<_> = kinds
        .map(|(name, image, format)| {
            let mut bytes = std::io::Cursor::new(vec![width as u8, height as u8]);
            bytes.set_position(2);
            image.write_to(&mut bytes, format).expect("memory to write to");
            (name.to_owned(), bytes.into_inner())
        })
        .into();
    // Every subsampling, restarts, progressive: the files of the library's tests, which `expected.json` gives the sizes of.
    let place = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/images");
    let expected = std::fs::read_to_string(place.join("expected.json")).expect("a file of this repository");
    let expected: serde_json::Value = serde_json::from_str(&expected).expect("JSON");
    for (name, size) in expected["images"].as_object().expect("images by name") {
        let side = |key: &str| size[key].as_u64().expect("a number") as u8;
        let file = std::fs::read(place.join(format!("{name}.jpg"))).expect("a file of this repository");
        seeds.push((format!("{name}.jpg"), [&[side("width"), side("height")][..], &file].concat()));
    }
    seeds
}

/// A whole scene, and a header that asks for its data.
fn scenes() -> Vec<(String, Vec<u8>)> {
    let header = r#"{"images":{"dtype":"U8","shape":[2,3,4,3],"data_offsets":[0,72]},"lidar2img":{"dtype":"F32","shape":[2,4,4],"data_offsets":[72,200]}}"#;
    let whole = [&(header.len() as u64).to_le_bytes()[..], header.as_bytes(), &[0x3f; 200]].concat();
    vec![("whole".into(), whole), ("header".into(), header.into())]
}

/// The headers of sound models, behind a byte that chooses the weights.
fn models() -> Vec<(String, Vec<u8>)> {
    let mut seeds = Vec::new();
    for (precision, name) in [(Precision::F32, "f32"), (Precision::F16, "f16")] {
        for (rewrites, fold) in [(Rewrites::ALL, "all"), (Rewrites::NONE, "none")] {
            let file = voxcast_fuzz::model_bytes(Options { precision, rewrites });
            for kind in 0..4u8 {
                let seed = [&[kind][..], voxcast_fuzz::split(&file).0.trim_ascii_end()].concat();
                seeds.push((format!("{name}-{fold}-{kind}"), seed));
            }
        }
    }
    seeds
}

/// A whole archive, and its entries behind a byte that chooses how they are stored.
fn archives() -> Vec<(String, Vec<u8>)> {
    use voxcast::npz::{Array, Elements, write_npz};
    let path = voxcast_fuzz::scratch_file("seed");
    let array = |name, shape, elements| Array { name, shape, elements };
    let arrays = [
        array("classes", &[2, 3], Elements::U8(&[1; 6])),
        array("support", &[2], Elements::U16(&[1, 258])),
        array("logits", &[1, 1, 2], Elements::F32(&[0.5, -0.0])),
        array("time", &[], Elements::F32(&[1.0])),
    ];
    write_npz(&path, &arrays).expect("room for a small file");
    let file = std::fs::read(&path).expect("what was just written");
    std::fs::remove_file(&path).expect("what was just read");
    let mut seeds = vec![];
    let mut zip = zip::ZipArchive::new(std::io::Cursor::new(&file)).expect("what was just written");
    for (i, array) in arrays.iter().enumerate() {
        let mut bytes = vec![i as u8];
        zip.by_index(i).expect("an entry").read_to_end(&mut bytes).expect("memory");
        seeds.push((array.name.to_owned(), bytes));
    }
    seeds.push(("whole".into(), file));
    seeds
}

/// Edits, and a whole rig.
fn rigs() -> Vec<(String, Vec<u8>)> {
    let path = voxcast_fuzz::scratch_file("rig");
    let network = voxcast_fuzz::network();
    let camera = [20., 0., 8., 30., 0., 20., 0., 15., 0.1, 0., 0.5, 1., 0., 0., 0., 1.];
    let rig = RigBuilder::new(&network, 2, voxcast::Isa::best())
        .and_then(|mut b| b.build(&[camera; 2]))
        .expect("a small rig");
    rig.save(&path, &network).expect("room for a small file");
    let file = std::fs::read(&path).expect("what was just written");
    std::fs::remove_file(&path).expect("what was just read");
    vec![
        ("nothing".into(), vec![]),
        ("more-entries".into(), [[1, 7, 3, 0, 60], [3, 7, 0, 0, 9], [9, 7, 0, 0, 1]].concat()),
        ("other-pixels".into(), [[1, 1, 7, 0, 1], [5, 3, 1, 0, 0], [0, 2, 3, 0, 1]].concat()),
        ("lengths".into(), [[0, 4, 1, 0, 0], [2, 5, 1, 0, 0], [1, 6, 9, 0, 0]].concat()),
        ("file".into(), file),
    ]
}

/// Files without a zip, and the pickles in them.
fn legacy() -> Vec<(String, Vec<u8>)> {
    let values = [1.0, -2.0, 3.0, 0.5];
    let half = Tensor::new("HalfStorage", &[2], 2, vec![0, 0x3c, 0, 0xc0]);
    let tensors = [("module.w", Tensor::f32(&[2, 2], &values)), ("steps", half)];
    let mut seeds = vec![];
    for (wrap, name) in [(Wrap::Runner, "runner"), (Wrap::Bare, "bare"), (Wrap::Dict, "dict")] {
        let file = pth::legacy(wrap, &tensors);
        let head = pth::legacy_head().len();
        seeds.push((format!("{name}.tail"), file[head..].to_vec()));
        seeds.push((format!("{name}.pth"), file));
        let fitting = tensors
            .clone()
            .map(|(name, t)| (name, Tensor { numel: if t.class == "HalfStorage" { 32 } else { 16 }, ..t }));
        seeds.push((format!("{name}.pkl"), pth::pickle(2, wrap, &fitting)));
    }
    seeds
}

fn checkpoints() -> Vec<(String, Vec<u8>)> {
    let values = [1.0, -2.0, 3.0, 0.5];
    let turned = Tensor { stride: vec![1, 2], ..Tensor::f32(&[2, 2], &values) };
    let half = Tensor::new("HalfStorage", &[2], 2, vec![0, 0x3c, 0, 0xc0]);
    let tensors = [("module.conv.weight", turned), ("module.conv.bias", half)];
    let mut seeds = Vec::new();
    for protocol in [2, 4] {
        for wrap in [Wrap::Runner, Wrap::Bare, Wrap::Dict] {
            seeds.push((format!("{wrap:?}{protocol}.pth").to_lowercase(), pth::pth(protocol, wrap, &tensors)));
        }
    }
    let stored = pth::entries(pth::pickle(2, Wrap::Dict, &tensors), tensors.iter().map(|(_, t)| t));
    let deflated: Vec<_> = stored.iter().map(|e| Entry::deflated(&e.name, &e.bytes)).collect();
    seeds.push(("deflated.pth".into(), pth::zip(&deflated)));

    // Bare pickles; the target's archive has 64 bytes in each storage.
    let fitting =
        tensors.map(|(name, t)| (name, Tensor { numel: if t.class == "HalfStorage" { 32 } else { 16 }, ..t }));
    for (protocol, wrap) in [(2, Wrap::Runner), (4, Wrap::Bare), (2, Wrap::Dict)] {
        seeds.push((format!("{wrap:?}{protocol}.pkl").to_lowercase(), pth::pickle(protocol, wrap, &fitting)));
    }

    let header = r#"{"w":{"dtype":"F32","shape":[2],"data_offsets":[0,8]},"n":{"dtype":"I64","shape":[],"data_offsets":[8,16]}}"#;
    let plain = [&(header.len() as u64).to_le_bytes()[..], header.as_bytes(), &[0; 16]].concat();
    seeds.push(("plain.safetensors".into(), plain));
    seeds
}

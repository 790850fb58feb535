//! Writes small valid inputs into `corpus/<target>`, for the fuzzer to start from:
//! `cargo run --manifest-path fuzz/Cargo.toml --bin seeds`.

#[path = "../../../tests/support/pth.rs"]
#[allow(dead_code, reason = "the library's tests use the rest")]
mod pth;

use pth::{Entry, Tensor, Wrap};
use std::path::Path;
use voxcast::graph::Rewrites;
use voxcast::model::Options;
use voxcast::rig::RigBuilder;
use voxcast::weights::Precision;

fn main() -> std::io::Result<()> {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus");
    for (target, seeds) in [("checkpoint", checkpoints()), ("model", models()), ("rig", rigs())] {
        let dir = corpus.join(target);
        std::fs::create_dir_all(&dir)?;
        for (name, bytes) in &seeds {
            std::fs::write(dir.join(name), bytes)?;
        }
        println!("{}: {} seeds", dir.display(), seeds.len());
    }
    Ok(())
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

/// Edits, and a whole rig.
fn rigs() -> Vec<(String, Vec<u8>)> {
    let path = std::env::temp_dir().join(format!("voxcast-fuzz-rig-{}", std::process::id()));
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

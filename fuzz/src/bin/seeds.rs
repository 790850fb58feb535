//! Writes small valid inputs into `corpus/<target>`, for the fuzzer to start from:
//! `cargo run --manifest-path fuzz/Cargo.toml --bin seeds`.

#[path = "../../../tests/support/pth.rs"]
#[allow(dead_code, reason = "the library's tests use the rest")]
mod pth;

use pth::{Entry, Tensor, Wrap};
use std::path::Path;

fn main() -> std::io::Result<()> {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus");
    for (target, seeds) in [("checkpoint", checkpoints())] {
        let dir = corpus.join(target);
        std::fs::create_dir_all(&dir)?;
        for (name, bytes) in &seeds {
            std::fs::write(dir.join(name), bytes)?;
        }
        println!("{}: {} seeds", dir.display(), seeds.len());
    }
    Ok(())
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

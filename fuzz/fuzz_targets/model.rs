//! Any header as a model with any weights: an error, or a model that runs.
//!
//! The input is a byte that chooses the weights, and a header. The data that the header asks for is made up, and the
//! checksum made right: neither could be found by mutation.

#![no_main]

use libfuzzer_sys::fuzz_target;
use std::sync::Arc;
use voxcast::graph::Results;
use voxcast::random::Random;
use voxcast::rig::RigBuilder;
use voxcast::{Isa, Model, Session, SessionOptions};
use voxcast_fuzz::{data_len, images, sealed, views};

/// Bytes of weights to make up for one input.
const MAX_DATA: usize = 1 << 20;
/// Multiply-adds, bytes and sample points that one run may take.
const MAX_WORK: u64 = 1 << 24;
const MAX_MEMORY: usize = 1 << 25;
const MAX_POINTS: usize = 1 << 16;

/// Weights of a kind: zeros, ones, drawn, any bits at all.
fn data(kind: u8, len: usize) -> Vec<u8> {
    let mut random = Random::new(u64::from(kind));
    match kind % 4 {
        0 => vec![0; len],
        1 => [0, 0, 0x80, 0x3f].into_iter().cycle().take(len).collect(),
        2 => (0..len.div_ceil(4)).flat_map(|_| random.normal().to_le_bytes()).take(len).collect(),
        _ => (0..len).map(|_| random.next_u64() as u8).collect(),
    }
}

fn run(model: Model) {
    let network = model.network().clone();
    for unfolded in [false, true] {
        let options = SessionOptions { isa: Isa::best(), unfolded, logits: true, ..SessionOptions::default() };
        let Ok(memory) = Session::memory(&model, network.cameras, &options) else { return };
        let graph = model.graph(unfolded, Results { logits: true, ..Results::default() });
        let work = graph.operations.iter().map(|o| graph.multiply_adds(o)).fold(0, u64::saturating_add);
        if memory.total() > MAX_MEMORY || work.saturating_mul(network.cameras as u64) > MAX_WORK {
            return;
        }
    }
    let points = |l: usize| network.grids[l].iter().map(|v| v * network.samples[l]).product::<usize>();
    if network.cameras > 4 || network.samples.iter().any(|&n| n > 16) || (0..3).any(|l| points(l) > MAX_POINTS) {
        return;
    }
    let Ok(mut builder) = RigBuilder::new(&network, network.cameras, voxcast::Isa::best()) else { return };
    let down = [8., 0., 0., 20., 0., 8., 0., 15., 0., 0., 0., 1., 0., 0., 0., 1.];
    let rig = Arc::new(builder.build(&vec![down; network.cameras]).expect("a small rig"));
    let model = Arc::new(model);
    let pixels = images(&network, network.cameras);
    for unfolded in [false, true] {
        let options = SessionOptions { isa: Isa::best(), unfolded, logits: true, ..SessionOptions::default() };
        let mut session = Session::new(model.clone(), rig.clone(), &options).expect("as large as told");
        let result = session.run(&views(&network, &pixels)).expect("images of the network's size");
        assert!(result.classes.iter().all(|&c| usize::from(c) < network.classes));
    }
}

fuzz_target!(|bytes: &[u8]| {
    drop(Model::from_bytes(bytes.to_vec()));
    let Some((&kind, header)) = bytes.split_first() else { return };
    let len = data_len(header);
    if len > MAX_DATA {
        return;
    }
    if let Ok(model) = Model::from_bytes(sealed(header, &data(kind, len))) {
        run(model);
    }
});

//! Frames a second of the network that ships, computed one at a time by all threads, or several at a time by one thread each:
//! what `voxcast eval --workers` chooses between.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use std::sync::Arc;
use voxcast::rig::RigBuilder;
use voxcast::synth::Synthesiser;
use voxcast::{Isa, Model, Scene, Session, SessionOptions, Threads};

static EDGE: &[u8] = include_bytes!("../assets/edge.safetensors");

/// Frames of a measurement; every worker computes as many of them as the others.
const FRAMES: usize = 2;

fn workers(criterion: &mut Criterion) {
    let model = Arc::new(Model::from_bytes(EDGE).expect("the model that ships"));
    let scene = Synthesiser::new(model.network()).expect("17 classes").frame(1).scene;
    let rig =
        RigBuilder::new(model.network(), scene.cameras(), Isa::best()).and_then(|mut b| b.build(&scene.lidar2img));
    let rig = Arc::new(rig.expect("a rig"));
    let mut group = criterion.benchmark_group("workers");
    group.throughput(Throughput::Elements(FRAMES as u64)).sample_size(10);
    for workers in [1, FRAMES] {
        let session = || {
            let threads = Threads::new(FRAMES / workers).expect("threads");
            let options = SessionOptions { threads, ..SessionOptions::default() };
            Session::new(model.clone(), rig.clone(), &options).expect("a session")
        };
        let mut sessions: Vec<Session> = (0..workers).map(|_| session()).collect();
        group.bench_function(format!("{workers} of {} threads", FRAMES / workers), |bencher| {
            bencher.iter(|| side_by_side(&mut sessions, &scene));
        });
    }
    group.finish();
}

fn side_by_side(sessions: &mut [Session], scene: &Scene) {
    let each = FRAMES / sessions.len();
    std::thread::scope(|scope| {
        for session in sessions {
            scope.spawn(move || {
                for _ in 0..each {
                    session.run_scene(scene).expect("a scene of this network");
                }
            });
        }
    });
}

criterion_group!(benches, workers);
criterion_main!(benches);

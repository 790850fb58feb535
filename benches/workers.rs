//! Frames a second of the network that ships, in f16 and in int8, computed one at a time by all threads, or several at a time by one
//! thread each: what `voxcast eval --workers` chooses between.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use std::sync::Arc;
use voxcast::import::{Integers, import_int8_to_bytes};
use voxcast::model::ranges::Ranges;
use voxcast::model::unpacked::Unpacked;
use voxcast::rig::RigBuilder;
use voxcast::synth::Synthesiser;
use voxcast::{Isa, Model, Scene, Session, SessionOptions, Threads};

static EDGE: &[u8] = include_bytes!("../assets/edge.safetensors");
static RANGES: &str = include_str!("../assets/edge.ranges.json");

/// Frames of a measurement; every worker computes as many of them as the others.
const FRAMES: usize = 2;

fn workers(criterion: &mut Criterion) {
    let float = Model::from_bytes(EDGE).expect("the model that ships");
    let ranges = Ranges::from_json(RANGES, float.network()).expect("its ranges");
    let integers = Integers { rewrites: float.options().rewrites, ranges: &ranges, keep_f32: &[] };
    let source = Unpacked::new(&float).expect("a model in floating point");
    let int8 = import_int8_to_bytes(&source, float.network(), &integers, &mut |_, _| ()).expect("8 bits");
    let int8 = Model::from_bytes(int8).expect("a model");
    let scene = Synthesiser::new(float.network()).expect("17 classes").frame(1).scene;
    let rig =
        RigBuilder::new(float.network(), scene.cameras(), Isa::best()).and_then(|mut b| b.build(&scene.lidar2img));
    let rig = Arc::new(rig.expect("a rig"));
    for (name, model) in [("f16", Arc::new(float)), ("int8", Arc::new(int8))] {
        let mut group = criterion.benchmark_group(format!("workers {name}"));
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

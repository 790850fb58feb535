//! Building, saving and mapping the six matrices of `nuscenes-200` for a ring of six cameras.
//!
//! On as many threads as there are cores.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use std::hint::black_box;
use std::time::Duration;
use voxcast::Isa;
use voxcast::Network;
use voxcast::Threads;
use voxcast::rig::{Rig, RigBuilder};

/// Cameras 1.6 m above the ground that look outwards every 60 degrees, with a horizontal field of view of 65 degrees.
fn ring(network: &Network, cameras: usize) -> Vec<[f32; 16]> {
    let [height, width] = network.image.map(|v| v as f32);
    let (focal, centre_u, centre_v) = (0.79 * width, 0.5 * width, 0.52 * height);
    (0..cameras)
        .map(|i| {
            let (s, c) = (std::f32::consts::TAU * i as f32 / cameras as f32).sin_cos();
            let (right, down, ahead) = ([s, -c, 0.0, 0.0], [0.0, 0.0, -1.0, -0.2], [c, s, 0.0, -0.8]);
            let row = |a: [f32; 4], centre: f32| std::array::from_fn::<f32, 4, _>(|k| focal * a[k] + centre * ahead[k]);
            let rows = [row(right, centre_u), row(down, centre_v), ahead, [0.0, 0.0, 0.0, 1.0]];
            std::array::from_fn(|i| rows[i / 4][i % 4])
        })
        .collect()
}

fn entries(rig: &Rig) -> u64 {
    (0..3).map(|l| rig.level(l)).map(|l| (l.volume.col.len() + l.bev.col.len()) as u64).sum()
}

fn rig(c: &mut Criterion) {
    let network = Network::built_in("nuscenes-200").expect("a built-in network");
    let cameras = ring(&network, 6);
    let threads = Threads::new(std::thread::available_parallelism().map_or(1, usize::from)).expect("threads");
    let new = || RigBuilder::new(&network, cameras.len(), Isa::best()).map(|b| b.with_threads(threads.clone()));
    let mut builder = new().expect("a size that can be built");
    let mut rig = builder.build(&cameras).expect("as many matrices as cameras");
    let path = std::env::temp_dir().join(format!("voxcast-bench-{}.safetensors", std::process::id()));
    rig.save(&path, &network).expect("a writable temporary directory");

    let mut group = c.benchmark_group("rig");
    group.sample_size(10).warm_up_time(Duration::from_millis(300)).measurement_time(Duration::from_secs(1));
    group.throughput(Throughput::Elements(entries(&rig)));
    group.bench_function("build/nuscenes-200", |b| {
        b.iter(|| new().and_then(|mut builder| builder.build(black_box(&cameras))));
    });
    group.bench_function("rebuild/nuscenes-200", |b| b.iter(|| builder.rebuild(black_box(&cameras), &mut rig)));
    group.bench_function("open/nuscenes-200", |b| b.iter(|| Rig::open(black_box(&path), &network, cameras.len())));
    group.finish();
    // A benchmark that measured refusals would be fast and worthless.
    let opened = Rig::open(&path, &network, cameras.len()).expect("the rig that was saved");
    assert!(opened == rig && entries(&rig) > 4_000_000, "{rig:?}");
    std::fs::remove_file(&path).expect("the file that was saved");
}

criterion_group!(benches, rig);
criterion_main!(benches);

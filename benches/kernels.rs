//! Every kernel of the registry at the network's shapes, on one thread: multiply-adds a second, and beside criterion's
//! figures the shares of the machine's two ceilings, multiply-adds in registers and bytes from and to memory.
//!
//! `faer` is a peer on two of the 1x1 convolutions, which are plain matrix products. Every result is compared with the
//! scalar specification in places before it is timed.

use criterion::{Bencher, Criterion, Throughput};
use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};
use std::hint::black_box;
use std::io::Write;
use std::time::{Duration, Instant};
use voxcast_kernels::Isa;
use voxcast_kernels::cases::{Bench, Entry, REGISTRY, values};
use voxcast_kernels::peak::multiply_adds;

fn main() {
    let mut criterion = Criterion::default()
        .sample_size(10)
        .warm_up_time(Duration::from_millis(200))
        .measurement_time(Duration::from_secs(1))
        .configure_from_args();
    let isa = Isa::best();
    let peak = Peak::measure(isa);
    for entry in REGISTRY {
        for bench in (entry.benches)() {
            kernel(&mut criterion, isa, &peak, entry, bench);
        }
    }
    for (name, [rows, depth, columns]) in
        [("layer1 1x1 64-256", [232 * 400, 64, 256]), ("layer4 1x1 2048-512", [29 * 50, 2048, 512])]
    {
        peer(&mut criterion, name, [rows, depth, columns]);
    }
    criterion.final_summary();
}

/// What one thread of the machine can do.
struct Peak {
    /// Multiply-adds a second.
    arithmetic: f64,
    /// Bytes a second that are read or written, where they come from memory.
    memory: f64,
}

impl Peak {
    fn measure(isa: Isa) -> Self {
        let fastest = |work: &mut dyn FnMut() -> u64| {
            let rate = |_| {
                let start = Instant::now();
                let work = work();
                work as f64 / start.elapsed().as_secs_f64()
            };
            (0..5).map(rate).fold(0.0, f64::max)
        };
        let from = values(16 << 20, 1.0);
        let mut to = from.clone();
        Self {
            arithmetic: fastest(&mut || multiply_adds(isa, black_box(1_000_000)).0),
            memory: fastest(&mut || {
                black_box(&mut to).copy_from_slice(black_box(&from));
                8 * from.len() as u64
            }),
        }
    }

    fn report(&self, bench: &Bench, seconds: f64) {
        let arithmetic = 100.0 * bench.multiply_adds as f64 / seconds / self.arithmetic;
        let memory = 100.0 * bench.bytes as f64 / seconds / self.memory;
        writeln!(std::io::stdout(), "{:24}{arithmetic:.0} % of the FMA peak, {memory:.0} % of the memory peak", "")
            .expect("standard output");
    }
}

fn kernel(criterion: &mut Criterion, isa: Isa, peak: &Peak, entry: &Entry, mut bench: Bench) {
    let mut group = criterion.benchmark_group(entry.name);
    group.throughput(match bench.multiply_adds {
        0 => Throughput::Bytes(bench.bytes),
        work => Throughput::Elements(work),
    });
    let (name, mut fastest, mut checked) = (bench.name.clone(), f64::INFINITY, false);
    group.bench_function(name, |b: &mut Bencher<'_>| {
        if !checked {
            let difference = bench.difference(isa);
            assert_eq!(difference, None, "{} {}: other bits than the specification", entry.name, bench.name);
            checked = true;
        }
        b.iter_custom(|rounds| {
            let start = Instant::now();
            (0..rounds).for_each(|_| black_box(&mut bench).run(isa));
            let took = start.elapsed();
            fastest = fastest.min(took.as_secs_f64() / rounds as f64);
            took
        });
    });
    group.finish();
    if fastest.is_finite() {
        peak.report(&bench, fastest);
    }
}

/// The same 1x1 convolution, without bias and ReLU, as faer's matrix product on one thread.
fn peer(criterion: &mut Criterion, name: &str, [rows, depth, columns]: [usize; 3]) {
    let mut group = criterion.benchmark_group("conv by faer");
    group.throughput(Throughput::Elements((rows * depth * columns) as u64));
    let (input, weights) = (values(rows * depth, 1.0), values(depth * columns, 1.0 / depth as f32));
    let mut out = vec![0.0; rows * columns];
    let mut run = || {
        matmul(
            MatMut::from_row_major_slice_mut(black_box(&mut out), rows, columns),
            Accum::Replace,
            MatRef::from_row_major_slice(&input, rows, depth),
            MatRef::from_row_major_slice(&weights, depth, columns),
            1.0,
            Par::Seq,
        );
        let last: f32 = (0..depth).map(|k| input[(rows - 1) * depth + k] * weights[(k + 1) * columns - 1]).sum();
        (out[rows * columns - 1], last)
    };
    let mut checked = false;
    group.bench_function(name, |b| {
        if !checked {
            let (got, want) = run();
            assert!((got - want).abs() < 1e-4, "{name}: faer gives {got}, not {want}");
            checked = true;
        }
        b.iter(&mut run);
    });
    group.finish();
}

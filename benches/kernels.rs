//! Throughput of the kernels over the network's real shapes, in multiply-adds a second.
//!
//! `peak/fma` is the machine's ceiling on one thread, `faer` a peer on the 1x1 convolutions, which are plain matrix
//! products. Every result is compared with the scalar specification in places before it is timed.

mod shapes;

use criterion::{Criterion, Throughput};
use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};
use shapes::Layer;
use std::hint::black_box;
use std::ops::Range;
use std::time::Duration;
use voxcast_kernels::conv::{Conv, conv};
use voxcast_kernels::deconv3d::{Deconv3d, deconv3d};
use voxcast_kernels::deform_conv2d::{DeformConv2d, deform_conv2d};
use voxcast_kernels::gather::{Gather, gather};
use voxcast_kernels::head::{Head, head, scratch_len};
use voxcast_kernels::panels::packed_len;
use voxcast_kernels::peak::multiply_adds;
use voxcast_kernels::product::{Product, Residual, SCRATCH};
use voxcast_kernels::{Isa, Panels};

fn main() {
    let mut criterion = Criterion::default()
        .sample_size(10)
        .warm_up_time(Duration::from_millis(200))
        .measurement_time(Duration::from_secs(1))
        .configure_from_args();
    let isa = Isa::best();
    peak(&mut criterion, isa);
    pointwise(&mut criterion, isa);
    spatial(&mut criterion, isa);
    deformable(&mut criterion, isa);
    transposed(&mut criterion, isa);
    gathered(&mut criterion, isa);
    classified(&mut criterion, isa);
    criterion.final_summary();
}

/// Adds a benchmark of `work` multiply-adds. `prepare` runs only if the benchmark does.
fn bench<R: FnMut()>(criterion: &mut Criterion, group: &str, name: &str, work: u64, prepare: impl FnOnce() -> R) {
    let mut group = criterion.benchmark_group(group);
    group.throughput(Throughput::Elements(work));
    let (mut prepare, mut run) = (Some(prepare), None);
    group.bench_function(name, |b| {
        let run = run.get_or_insert_with(|| prepare.take().expect("prepared once")());
        b.iter(run);
    });
    group.finish();
}

/// `n` unequal numbers up to `scale`, of both signs.
fn numbers(n: usize, scale: f32) -> Vec<f32> {
    (0..n).map(|i| ((i * 37 % 101) as f32 * 0.02 - 1.0) * scale).collect()
}

fn zeros(n: usize) -> Vec<f32> {
    vec![0.0; n]
}

/// Asserts that `kernel` gives the same bits on `isa` as in its specification.
fn check<T: PartialEq>(isa: Isa, name: &str, mut kernel: impl FnMut(Isa) -> T) {
    assert!(kernel(isa) == kernel(Isa::Scalar), "{name}: {} gives other bits than the specification", isa.name());
}

/// Rows in the middle of `total`, few enough for the specification.
fn few(total: usize) -> Range<usize> {
    total / 2..(total / 2 + 2).min(total)
}

fn peak(criterion: &mut Criterion, isa: Isa) {
    const ROUNDS: usize = 100_000;
    bench(criterion, "peak", "fma", multiply_adds(isa, ROUNDS).0, || {
        move || {
            black_box(multiply_adds(isa, black_box(ROUNDS)));
        }
    });
}

/// Weights and biases of a product.
struct Weights {
    packed: Vec<f32>,
    bias: Vec<f32>,
    depth: usize,
    columns: usize,
}

impl Weights {
    fn new(depth: usize, columns: usize) -> Self {
        let packed = numbers(packed_len(depth, columns), 1.0 / depth as f32);
        Self { packed, bias: numbers(columns.next_multiple_of(16), 1.0), depth, columns }
    }

    fn product(&self) -> Product<'_> {
        Product {
            weights: Panels::F32(&self.packed),
            bias: &self.bias,
            depth: self.depth,
            columns: self.columns,
            relu: true,
            residual: Residual::None,
        }
    }
}

fn convolution(criterion: &mut Criterion, isa: Isa, group: &str, layer: &Layer) {
    let Layer { name, geometry, columns } = *layer;
    bench(criterion, group, name, layer.multiply_adds(), || {
        let input = numbers(geometry.input.iter().product::<usize>() * geometry.channels, 1.0);
        let weights = Weights::new(geometry.depth(), columns);
        let mut scratch = zeros(SCRATCH);
        let mut run = move |isa, rows, out: &mut [f32]| {
            let args = Conv { geometry, input: &input, product: weights.product() };
            conv(isa, &args, rows, columns, out, &mut scratch);
        };
        check(isa, name, |isa| {
            let rows = few(geometry.rows());
            let mut out = zeros(rows.len() * columns);
            run(isa, rows, &mut out);
            out
        });
        let mut out = zeros(geometry.rows() * columns);
        move || run(isa, 0..geometry.rows(), black_box(&mut out))
    });
}

fn pointwise(criterion: &mut Criterion, isa: Isa) {
    for layer in shapes::pointwise() {
        convolution(criterion, isa, "conv 1x1", &layer);
        if layer.geometry.stride == [1; 3] {
            peer(criterion, &layer);
        }
    }
}

/// The same 1x1 convolution, without bias and rectifier, as faer's matrix product on one thread.
fn peer(criterion: &mut Criterion, layer: &Layer) {
    let Layer { name, geometry, columns } = *layer;
    bench(criterion, "conv 1x1 faer", name, layer.multiply_adds(), || {
        let (rows, depth) = (geometry.rows(), geometry.depth());
        let input = numbers(rows * depth, 1.0);
        let weights = numbers(depth * columns, 1.0 / depth as f32);
        let mut out = zeros(rows * columns);
        let mut run = move || {
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
        let (got, want) = run();
        assert!((got - want).abs() < 1e-4, "{name}: faer gives {got}, not {want}");
        move || {
            black_box(run());
        }
    });
}

fn spatial(criterion: &mut Criterion, isa: Isa) {
    for layer in shapes::spatial() {
        convolution(criterion, isa, "conv", &layer);
    }
}

fn deformable(criterion: &mut Criterion, isa: Isa) {
    for layer in shapes::deformable() {
        let Layer { name, geometry, columns } = layer;
        bench(criterion, "deform_conv2d", name, layer.multiply_adds(), || {
            let input = numbers(geometry.input.iter().product::<usize>() * geometry.channels, 1.0);
            let offsets = numbers(geometry.rows() * 27, 3.0);
            let weights = Weights::new(geometry.depth(), columns);
            let mut scratch = zeros(SCRATCH);
            let mut run = move |isa, rows, out: &mut [f32]| {
                let args = DeformConv2d { geometry, input: &input, offsets: &offsets, product: weights.product() };
                deform_conv2d(isa, &args, rows, columns, out, &mut scratch);
            };
            check(isa, name, |isa| {
                let mut out = zeros(columns);
                run(isa, 100..101, &mut out);
                out
            });
            let mut out = zeros(geometry.rows() * columns);
            move || run(isa, 0..geometry.rows(), black_box(&mut out))
        });
    }
}

fn transposed(criterion: &mut Criterion, isa: Isa) {
    let (extent, channels, columns) = shapes::UP1;
    let voxels = extent.iter().product::<usize>();
    let work = (8 * voxels * 8 * channels * columns) as u64;
    bench(criterion, "deconv3d", "up1 64-32", work, || {
        let input = numbers(voxels * channels, 1.0);
        let weights = numbers(8 * packed_len(8 * channels, columns), 1.0 / channels as f32);
        let bias = numbers(columns.next_multiple_of(16), 1.0);
        let mut scratch = zeros(SCRATCH);
        let mut run = move |isa, planes, extent, out: &mut [f32]| {
            let [d, h, w]: [usize; 3] = extent;
            let args = Deconv3d {
                extent,
                channels,
                columns,
                input: &input[..d * h * w * channels],
                weights: Panels::F32(&weights),
                bias: &bias,
                relu: true,
                add: None,
            };
            deconv3d(isa, &args, planes, out, &mut scratch);
        };
        check(isa, "up1", |isa| {
            let mut out = zeros(4 * 3 * 4 * columns);
            run(isa, 1..2, [2, 3, 4], &mut out);
            out
        });
        let mut out = zeros(8 * voxels * columns);
        move || run(isa, 0..2 * extent[0], extent, black_box(&mut out))
    });
}

fn gathered(criterion: &mut Criterion, isa: Isa) {
    let (pixels, stride, total, channels) = shapes::GATHER;
    let work = (total * shapes::ENTRIES * channels) as u64;
    bench(criterion, "gather", "level1 volume", work, || {
        let ptr: Vec<u32> = (0..=total).map(|row| (row * shapes::ENTRIES) as u32).collect();
        let (col, features, bias) = (shapes::columns(), numbers(pixels * stride, 1.0), numbers(channels, 1.0));
        let run = move |isa, rows, out: &mut [f32]| {
            let args = Gather {
                ptr: &ptr,
                col: &col,
                mask: None,
                features: &features,
                stride,
                first_channel: 0,
                channels,
                bias: Some(&bias),
                relu: true,
            };
            gather(isa, &args, rows, out);
        };
        check(isa, "gather", |isa| {
            let mut out = zeros(2 * channels);
            run(isa, few(total), &mut out);
            out
        });
        let mut out = zeros(total * channels);
        move || run(isa, 0..total, black_box(&mut out))
    });
}

fn classified(criterion: &mut Criterion, isa: Isa) {
    let (voxels, channels, classes) = shapes::HEAD;
    let work = (voxels * channels * (2 * channels + classes)) as u64;
    bench(criterion, "head", "level0 32-17", work, || {
        let input = numbers(voxels * channels, 1.0);
        let layers = [channels, channels, classes].map(|columns| Weights::new(channels, columns));
        let mut scratch = zeros(scratch_len(channels, classes));
        let mut run = move |isa, rows, out: &mut [u8]| {
            let args = Head {
                input: &input,
                channels,
                classes,
                weights: layers.each_ref().map(|layer| Panels::F32(&layer.packed)),
                biases: layers.each_ref().map(|layer| &layer.bias[..]),
            };
            head(isa, &args, rows, out, None, &mut scratch);
        };
        check(isa, "head", |isa| {
            let mut out = vec![0; 2];
            run(isa, few(voxels), &mut out);
            out
        });
        let mut out = vec![0; voxels];
        move || run(isa, 0..voxels, black_box(&mut out))
    });
}

//! The table of single operations, computed by the shaders.

use crate::gpu::Gpu;
use crate::ops::{self, HeadWeights, Matrix, Norm, Tensor, Walk};

#[path = "../../support/named.rs"]
mod named;
#[path = "../../support/operations.rs"]
mod table;
#[path = "../../support/operations_i8.rs"]
pub(crate) mod table_i8;

use table::{After, Case, Kind, OFFSETS, QUERY_TAPS};

/// Every case's name and result, channels first; logits are channels last.
pub fn results(gpu: &Gpu) -> Vec<(&'static str, Vec<f32>)> {
    table::table().iter().map(|case| (case.name, result(gpu, case))).collect()
}

fn result(gpu: &Gpu, case: &Case) -> Vec<f32> {
    let tensor = |what: &str, extent: [usize; 3], channels: usize| {
        let len = extent.iter().product::<usize>() * channels;
        Tensor::new(gpu, extent, channels, &case.numbers(what, len))
    };
    let weights = |what: &str, len: usize| gpu.upload(&case.weights(what, len));
    let y = match case.kind {
        Kind::Normalise { height, width } => {
            let padded = [height.next_multiple_of(32), width.next_multiple_of(32)];
            ops::normalise(gpu, &case.bytes(height * width * 3), [height, width], padded)
        }
        Kind::Conv(conv) => {
            let (stride, dilation, padding) = conv.axes();
            let walk = Walk { kernel: conv.kernel, stride, dilation, padding };
            let taps: usize = conv.kernel.iter().product();
            let weight = weights("weight", conv.outputs * conv.inputs * taps);
            let x = tensor("x", conv.extent, conv.inputs);
            after(gpu, case, conv.after, ops::conv(gpu, &x, &walk, &weight, Some(&weights("bias", conv.outputs))))
        }
        Kind::DeformConv { height, width, inputs, outputs, reach } => {
            let extent = [1, height, width];
            let offsets = Tensor::new(gpu, extent, OFFSETS, &case.offsets(height * width, reach));
            ops::deform_conv(gpu, &tensor("x", extent, inputs), &offsets, &weights("weight", outputs * inputs * 9))
        }
        Kind::Depthwise { height, width, channels, side } => {
            let x = tensor("x", [1, height, width], channels);
            let y = ops::depthwise(gpu, &x, side, [height, width], &weights("weight", channels * side * side));
            ops::add(gpu, &y, &x)
        }
        Kind::BatchNorm { positions, channels, after: then } => {
            let x = tensor("x", [1, 1, positions], channels);
            after(gpu, case, then, ops::batch_norm(gpu, &x, &norm(gpu, case, "", channels)))
        }
        Kind::MaxPool { height, width, channels } => {
            ops::max_pool(gpu, &tensor("x", [1, height, width], channels), 3, 2, 1)
        }
        Kind::UpsampleAdd { low, size, channels } => {
            let small = tensor("low", [1, low[0], low[1]], channels);
            ops::upsample_add(gpu, &tensor("x", [1, size[0], size[1]], channels), &small)
        }
        Kind::Gather { rows, cameras, pixels, channels } => {
            let (ptr, col) = case.matrix(rows, cameras * pixels);
            let features: Vec<Tensor> =
                (0..cameras).map(|i| tensor(&format!("camera {i}"), [1, 1, pixels], channels)).collect();
            let features: Vec<&Tensor> = features.iter().collect();
            ops::gather(gpu, &Matrix { ptr, col }, &features, [1, 1, rows.len()])
        }
        Kind::Deconv { extent, inputs, outputs, after: then } => {
            let weight = weights("weight", inputs * outputs * 64);
            let y = ops::deconv(gpu, &tensor("x", extent, inputs), &weight, &weights("bias", outputs));
            after(gpu, case, then, y)
        }
        Kind::WindowAttention { plane, heads, part } => attention(gpu, case, plane, heads, part),
        Kind::Gate { columns: [x, y], depth, channels } => ops::gate(
            gpu,
            &tensor("volume", [x, y, depth], channels),
            &tensor("bev", [1, x, y], channels),
            &weights("weight", channels),
            &weights("bias", 1),
        ),
        Kind::GlobalMean { positions, channels } => ops::mean(gpu, &tensor("x", [1, 1, positions], channels)),
        Kind::Broadcast { positions, channels } => {
            ops::broadcast(gpu, &tensor("x", [1; 3], channels), [1, 1, positions])
        }
        Kind::Head { voxels, channels, classes } => return head(gpu, case, voxels, channels, classes),
    };
    gpu.read(&y.buffer)
}

fn after(gpu: &Gpu, case: &Case, after: After, y: Tensor) -> Tensor {
    let residual = || {
        let values = case.numbers("residual", y.positions() * y.channels);
        Tensor::new(gpu, y.extent, y.channels, &values)
    };
    match after {
        After::Nothing => y,
        After::Relu => ops::relu(gpu, &y),
        After::AddRelu => ops::relu(gpu, &ops::add(gpu, &y, &residual())),
        After::ReluAdd => ops::add(gpu, &ops::relu(gpu, &y), &residual()),
    }
}

fn norm(gpu: &Gpu, case: &Case, prefix: &str, channels: usize) -> Norm {
    Norm {
        gamma: gpu.upload(&case.positive(&format!("{prefix}gamma"), channels)),
        beta: gpu.upload(&case.weights(&format!("{prefix}beta"), channels)),
        mean: gpu.upload(&case.weights(&format!("{prefix}mean"), channels)),
        variance: gpu.upload(&case.positive(&format!("{prefix}variance"), channels)),
    }
}

fn attention(gpu: &Gpu, case: &Case, plane: [usize; 2], heads: usize, part: usize) -> Tensor {
    let channels = heads * part;
    let side = plane[0].min(7);
    let pair = |name: String, len: usize, outputs: usize| {
        (gpu.upload(&case.scaled(&name, len, len / outputs)), norm(gpu, case, &format!("{name}."), outputs))
    };
    let weights: Vec<HeadWeights> = (0..heads)
        .map(|i| HeadWeights {
            qkv: pair(format!("qkv.{i}"), 3 * part * part, 3 * part),
            query: pair(format!("query.{i}"), part * QUERY_TAPS, part),
            offsets: gpu.upload(&case.numbers(&format!("offsets.{i}"), side * side)),
        })
        .collect();
    let x = Tensor::new(gpu, [1, plane[0], plane[1]], channels, &case.numbers("x", plane[0] * plane[1] * channels));
    ops::window_attention(gpu, &x, 7, &weights, &pair("proj".to_owned(), channels * channels, channels))
}

fn head(gpu: &Gpu, case: &Case, voxels: usize, channels: usize, classes: usize) -> Vec<f32> {
    let layer = |i: usize, outputs: usize| {
        let weight = gpu.upload(&case.weights(&format!("{i}.weight"), outputs * channels));
        [weight, gpu.upload(&case.weights(&format!("{i}.bias"), outputs))]
    };
    let layers = [layer(0, channels), layer(1, channels), layer(2, classes)];
    let x = Tensor::new(gpu, [1, 1, voxels], channels, &case.numbers("x", voxels * channels));
    gpu.read(&ops::head(gpu, &x, &layers).0)
}

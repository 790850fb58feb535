//! One function per operation on 8-bit tensors: shapes checked, the shader run. Tensors are channels first, their elements
//! i32.

use crate::gpu::{Buffer, Gpu};
use crate::ops::{Matrix, Tensor, Walk, cameras, words};

/// What a sum starts from and becomes.
#[derive(Clone, Debug)]
pub struct Columns {
    /// `[3, outputs]`: bias, multiplier, and what is multiplied with the residual.
    pub numbers: Buffer,
    /// A tensor of the shape of the output that is added, and whether after ReLU.
    pub residual: Option<(Tensor, bool)>,
    /// Whether negative sums become 0.
    pub relu: bool,
}

impl Columns {
    fn outputs(&self) -> usize {
        self.numbers.len() / 3
    }

    /// Words of a shape: how the residual joins, and ReLU.
    fn words(&self) -> [usize; 2] {
        [self.residual.as_ref().map_or(0, |(_, after)| 1 + usize::from(*after)), self.relu.into()]
    }

    fn residual(&self, gpu: &Gpu, len: usize) -> Buffer {
        let Some((residual, _)) = &self.residual else { return gpu.zeros(1) };
        assert_eq!(residual.buffer.len(), len, "a residual of another shape");
        residual.buffer.clone()
    }
}

/// The sigmoid of -8, -8 + 1/64, ... in units of 1/1024.
fn sigmoid(gpu: &Gpu) -> Buffer {
    let value = |t: i32| (1024.0 / (1.0 + (-f64::from(t) / 64.0).exp())).round() as i32;
    gpu.upload(&(-512..512).map(value).collect::<Vec<_>>())
}

/// `weight` is `[outputs, inputs, kernel]`. Results are not clamped if they are `wide`.
pub fn conv(gpu: &Gpu, x: &Tensor, walk: &Walk, weight: &Buffer, columns: &Columns, wide: bool) -> Tensor {
    let (outputs, [residual, relu]) = (columns.outputs(), columns.words());
    assert_eq!(weight.len(), outputs * x.channels * walk.kernel.iter().product::<usize>(), "weights of another shape");
    let output = walk.output(x.extent);
    let mut shape = words([x.channels, outputs, residual, relu, wide.into(), 0, 0, 0]).to_vec();
    for [a, b, c] in [x.extent, output, walk.kernel, walk.stride, walk.dilation, walk.padding] {
        shape.extend(words([a, b, c, 0]));
    }
    let len = output.iter().product::<usize>() * outputs;
    let inputs = [&x.buffer, weight, &columns.numbers, &columns.residual(gpu, len)];
    Tensor::of(output, outputs, gpu.run("conv_i8", &shape, &inputs, len))
}

/// `weight` is `[outputs, inputs, 3, 3]`, `offsets` has 27 channels.
pub fn deform_conv(gpu: &Gpu, x: &Tensor, offsets: &Tensor, weight: &Buffer, columns: &Columns) -> Tensor {
    let [_, height, width] = x.extent;
    assert!(offsets.extent == x.extent && offsets.channels == 27, "offsets of another shape");
    let (outputs, [residual, relu]) = (columns.outputs(), columns.words());
    assert_eq!(weight.len(), outputs * x.channels * 9, "weights of another shape");
    let len = outputs * height * width;
    let inputs = [&x.buffer, &offsets.buffer, weight, &columns.numbers, &columns.residual(gpu, len), &sigmoid(gpu)];
    let shape = words([x.channels, outputs, residual, relu, height, width]);
    Tensor::of(x.extent, outputs, gpu.run("deform_conv_i8", &shape, &inputs, len))
}

/// `weight` is `[channels, 1, side, side]`. The input itself joins the sum if `residual`.
pub fn depthwise(gpu: &Gpu, x: &Tensor, side: usize, weight: &Buffer, numbers: &Buffer, residual: bool) -> Tensor {
    assert_eq!([weight.len(), numbers.len()], [x.channels * side * side, 3 * x.channels], "weights of another shape");
    let shape = words([x.channels, x.extent[1], x.extent[2], side, residual.into()]);
    Tensor::of(x.extent, x.channels, gpu.run("depthwise_i8", &shape, &[&x.buffer, weight, numbers], x.buffer.len()))
}

/// The largest of each `side` x `side` window.
pub fn max_pool(gpu: &Gpu, x: &Tensor, side: usize, stride: usize, padding: usize) -> Tensor {
    let [_, height, width] = x.extent;
    let [out_height, out_width] = [height, width].map(|v| (v + 2 * padding - side) / stride + 1);
    let shape = words([x.channels, height, width, out_height, out_width, side, stride, padding]);
    let buffer = gpu.run("max_pool_i8", &shape, &[&x.buffer], x.channels * out_height * out_width);
    Tensor::of([1, out_height, out_width], x.channels, buffer)
}

/// `x` and `low`, enlarged to the size of `x`, each times its factor.
pub fn upsample_add(gpu: &Gpu, x: &Tensor, low: &Tensor, factors: [i32; 2]) -> Tensor {
    let [_, height, width] = x.extent;
    let shape = words([x.channels, low.extent[1], low.extent[2], height, width]);
    let inputs = [&x.buffer, &low.buffer, &gpu.upload(&factors)];
    Tensor::of(x.extent, x.channels, gpu.run("upsample_add_i8", &shape, &inputs, x.buffer.len()))
}

/// The mean of the features that each row names, times `factor`, and a bias per channel.
pub fn gather(
    gpu: &Gpu,
    matrix: &Matrix,
    features: &[&Tensor],
    extent: [usize; 3],
    factor: i32,
    bias: &[i32],
    relu: bool,
) -> Tensor {
    let (channels, pixels) = (features[0].channels, features[0].positions());
    let rows = extent.iter().product::<usize>();
    assert!(matrix.ptr.len() == rows + 1 && bias.len() == channels, "a matrix or a bias of another shape");
    let [ptr, col] = matrix.upload(gpu);
    let inputs = [&ptr, &col, &cameras(gpu, features), &gpu.upload(&[&[factor], bias].concat())];
    let shape = words([channels, pixels, rows, relu.into()]);
    Tensor::of(extent, channels, gpu.run("gather_i8", &shape, &inputs, rows * channels))
}

/// `weight` is `[inputs, outputs, 4, 4, 4]`.
pub fn deconv(gpu: &Gpu, x: &Tensor, weight: &Buffer, columns: &Columns) -> Tensor {
    let (outputs, [residual, relu]) = (columns.outputs(), columns.words());
    assert_eq!(weight.len(), x.channels * outputs * 64, "weights of another shape");
    let [a, b, c] = x.extent;
    let shape = words([x.channels, outputs, residual, relu, a, b, c, 0]);
    let extent = x.extent.map(|v| 2 * v);
    let len = extent.iter().product::<usize>() * outputs;
    let inputs = [&x.buffer, weight, &columns.numbers, &columns.residual(gpu, len)];
    Tensor::of(extent, outputs, gpu.run("deconv_i8", &shape, &inputs, len))
}

/// `volume` and the gated `bev`, whose plane is the first two axes of the volume. `scalars` are bias, multiplier and the two
/// factors.
pub fn gate(gpu: &Gpu, volume: &Tensor, bev: &Tensor, weight: &Buffer, scalars: [i32; 4]) -> Tensor {
    let [x, y, depth] = volume.extent;
    assert!(bev.extent == [1, x, y] && bev.channels == volume.channels, "a bird's-eye view of another shape");
    let shape = words([volume.channels, x * y, depth]);
    let inputs = [&volume.buffer, &bev.buffer, weight, &gpu.upload(&scalars), &sigmoid(gpu)];
    Tensor::of(volume.extent, volume.channels, gpu.run("gate_i8", &shape, &inputs, volume.buffer.len()))
}

/// The mean over all positions, times `factor`.
pub fn mean(gpu: &Gpu, x: &Tensor, factor: i32) -> Tensor {
    let inputs = [&x.buffer, &gpu.upload(&[factor])];
    let buffer = gpu.run("mean_i8", &words([x.channels, x.positions()]), &inputs, x.channels);
    Tensor::of([1; 3], x.channels, buffer)
}

/// One position repeated over `extent`.
pub fn broadcast(gpu: &Gpu, x: &Tensor, extent: [usize; 3]) -> Tensor {
    let positions = extent.iter().product::<usize>();
    let buffer = gpu.run("broadcast_i8", &words([x.channels, positions]), &[&x.buffer], x.channels * positions);
    Tensor::of(extent, x.channels, buffer)
}

/// Image bytes, blue first, times factors and plus offsets (`[2, 3]`), padded with zeros.
pub fn normalise(gpu: &Gpu, bgr: &[u8], [height, width]: [usize; 2], padded: [usize; 2], factors: &[i32]) -> Tensor {
    assert!(bgr.len() == height * width * 3 && factors.len() == 6, "an image of another size");
    let image: Vec<u32> = bgr.iter().map(|&b| u32::from(b)).collect();
    let shape = words([height, width, padded[0], padded[1]]);
    let inputs = [&gpu.upload(&image), &gpu.upload(factors)];
    let buffer = gpu.run("normalise_i8", &shape, &inputs, 3 * padded[0] * padded[1]);
    Tensor::of([1, padded[0], padded[1]], 3, buffer)
}

/// Three linear layers with ReLUs between; the weights of each, and `[2, outputs]`: bias and multiplier. The sums of the last
/// one, `[positions, classes]`, and the classes.
pub fn head(gpu: &Gpu, x: &Tensor, layers: &[[Buffer; 2]; 3]) -> (Buffer, Buffer) {
    let positions = x.positions();
    let mut hidden = x.buffer.clone();
    for (i, [weight, columns]) in layers.iter().enumerate() {
        let outputs = columns.len() / 2;
        let shape = words([weight.len() / outputs, outputs, positions, usize::from(i == 2)]);
        hidden = gpu.run("linear_i8", &shape, &[&hidden, weight, columns], outputs * positions);
    }
    let classes = layers[2][1].len() / 2;
    let largest = gpu.run("argmax_i8", &words([classes]), &[&hidden], positions);
    (hidden, largest)
}

/// Numbers to 8 bits.
pub fn quantise(gpu: &Gpu, x: &Tensor, inverse: f32) -> Tensor {
    Tensor::of(x.extent, x.channels, gpu.run("quantise_i8", &[inverse.to_bits()], &[&x.buffer], x.buffer.len()))
}

/// 8 bits to numbers.
pub fn dequantise(gpu: &Gpu, x: &Tensor, scale: f32) -> Tensor {
    Tensor::of(x.extent, x.channels, gpu.run("dequantise_i8", &[scale.to_bits()], &[&x.buffer], x.buffer.len()))
}

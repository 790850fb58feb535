//! One function per operation: shapes checked, the shader run. Tensors are channels first.

use crate::gpu::{Buffer, Gpu};

/// Channels of three axes: a volume's x, y, z; 1 and an image's height and width; 1 and a plane's x and y.
#[derive(Clone, Debug)]
pub struct Tensor {
    /// Positions along each axis.
    pub extent: [usize; 3],
    /// Numbers per position.
    pub channels: usize,
    /// Channel by channel, then in the order of the axes.
    pub buffer: Buffer,
}

impl Tensor {
    /// A tensor of `values`.
    ///
    /// # Panics
    /// If there are more or fewer values than the shape says.
    pub fn new(gpu: &Gpu, extent: [usize; 3], channels: usize, values: &[f32]) -> Self {
        Self::of(extent, channels, gpu.upload(values))
    }

    pub(crate) fn of(extent: [usize; 3], channels: usize, buffer: Buffer) -> Self {
        assert_eq!(buffer.len(), extent.iter().product::<usize>() * channels, "{extent:?} x {channels}");
        Self { extent, channels, buffer }
    }

    /// Positions.
    pub fn positions(&self) -> usize {
        self.extent.iter().product()
    }

    fn len(&self) -> usize {
        self.positions() * self.channels
    }

    /// `count` channels from `first` on.
    pub fn slice(&self, gpu: &Gpu, first: usize, count: usize) -> Self {
        let positions = self.positions();
        let part = gpu.zeros(count * positions);
        gpu.copy(&self.buffer, first * positions, &part, 0, count * positions);
        Self::of(self.extent, count, part)
    }

    /// Writes `part` over the channels from `first` on.
    pub fn write(&self, gpu: &Gpu, first: usize, part: &Tensor) {
        assert!(part.extent == self.extent && first + part.channels <= self.channels, "a part of another shape");
        gpu.copy(&part.buffer, 0, &self.buffer, first * self.positions(), part.len());
    }
}

/// How a convolution walks its input. The axes are depth, height, width.
#[derive(Clone, Copy, Debug)]
pub struct Walk {
    /// Taps.
    pub kernel: [usize; 3],
    /// Input steps per output step.
    pub stride: [usize; 3],
    /// Input steps per tap.
    pub dilation: [usize; 3],
    /// Zeros on both sides.
    pub padding: [usize; 3],
}

impl Walk {
    /// One tap.
    pub const POINT: Self = Self { kernel: [1; 3], stride: [1; 3], dilation: [1; 3], padding: [0; 3] };

    pub(crate) fn output(&self, extent: [usize; 3]) -> [usize; 3] {
        std::array::from_fn(|a| {
            (extent[a] + 2 * self.padding[a] - self.dilation[a] * (self.kernel[a] - 1) - 1) / self.stride[a] + 1
        })
    }
}

/// The four tensors of a batch norm.
#[derive(Clone, Debug)]
pub struct Norm {
    /// Factor.
    pub gamma: Buffer,
    /// Addend.
    pub beta: Buffer,
    /// Running mean.
    pub mean: Buffer,
    /// Running variance.
    pub variance: Buffer,
}

pub(crate) fn words<const N: usize>(values: [usize; N]) -> [u32; N] {
    values.map(|v| u32::try_from(v).expect("shapes fit 32 bits"))
}

/// `weight` is `[outputs, inputs, kernel]`.
pub fn conv(gpu: &Gpu, x: &Tensor, walk: &Walk, weight: &Buffer, bias: Option<&Buffer>) -> Tensor {
    let outputs = weight.len() / (x.channels * walk.kernel.iter().product::<usize>());
    let output = walk.output(x.extent);
    let mut shape = words([x.channels, outputs, usize::from(bias.is_some()), 0]).to_vec();
    for [a, b, c] in [x.extent, output, walk.kernel, walk.stride, walk.dilation, walk.padding] {
        shape.extend(words([a, b, c, 0]));
    }
    let none = gpu.zeros(1);
    let inputs = [&x.buffer, weight, bias.unwrap_or(&none)];
    let buffer = gpu.run("conv", &shape, &inputs, output.iter().product::<usize>() * outputs);
    Tensor::of(output, outputs, buffer)
}

/// Taps of a deformable convolution.
const TAPS: usize = 3 * 3;

/// `weight` is `[outputs, inputs, 3, 3]`, `offsets` has three channels per tap.
pub fn deform_conv(gpu: &Gpu, x: &Tensor, offsets: &Tensor, weight: &Buffer) -> Tensor {
    let [_, height, width] = x.extent;
    assert!(offsets.extent == x.extent && offsets.channels == 3 * TAPS, "offsets of another shape");
    let outputs = weight.len() / (TAPS * x.channels);
    let inputs = [&x.buffer, &offsets.buffer, weight];
    let shape = words([x.channels, outputs, height, width]);
    Tensor::of(x.extent, outputs, gpu.run("deform_conv", &shape, &inputs, outputs * height * width))
}

/// `weight` is `[channels, 1, side, side]`; each window of `window` (height, width) is padded with zeros of its own.
pub fn depthwise(gpu: &Gpu, x: &Tensor, side: usize, window: [usize; 2], weight: &Buffer) -> Tensor {
    assert_eq!(weight.len(), x.channels * side * side, "weights of another shape");
    let shape = words([x.channels, x.extent[1], x.extent[2], side, window[0], window[1]]);
    Tensor::of(x.extent, x.channels, gpu.run("depthwise", &shape, &[&x.buffer, weight], x.len()))
}

/// One batch norm.
pub fn batch_norm(gpu: &Gpu, x: &Tensor, norm: &Norm) -> Tensor {
    let Norm { gamma, beta, mean, variance } = norm;
    assert!([gamma, beta, mean, variance].iter().all(|b| b.len() == x.channels), "a norm of other channels");
    let shape = words([x.channels, x.positions()]);
    let inputs = [&x.buffer, gamma, beta, mean, variance];
    Tensor::of(x.extent, x.channels, gpu.run("batch_norm", &shape, &inputs, x.len()))
}

/// Negative numbers become 0.
pub fn relu(gpu: &Gpu, x: &Tensor) -> Tensor {
    Tensor::of(x.extent, x.channels, gpu.run("relu", &words([x.len()]), &[&x.buffer], x.len()))
}

/// The sum of two tensors of one shape.
pub fn add(gpu: &Gpu, a: &Tensor, b: &Tensor) -> Tensor {
    assert!(a.extent == b.extent && a.channels == b.channels, "tensors of different shapes");
    Tensor::of(a.extent, a.channels, gpu.run("add", &words([a.len()]), &[&a.buffer, &b.buffer], a.len()))
}

/// The largest of each `side` x `side` window.
pub fn max_pool(gpu: &Gpu, x: &Tensor, side: usize, stride: usize, padding: usize) -> Tensor {
    let [_, height, width] = x.extent;
    let [out_height, out_width] = [height, width].map(|v| (v + 2 * padding - side) / stride + 1);
    let shape = words([x.channels, height, width, out_height, out_width, side, stride, padding]);
    let buffer = gpu.run("max_pool", &shape, &[&x.buffer], x.channels * out_height * out_width);
    Tensor::of([1, out_height, out_width], x.channels, buffer)
}

/// `x` and `low`, enlarged to the size of `x`.
pub fn upsample_add(gpu: &Gpu, x: &Tensor, low: &Tensor) -> Tensor {
    let [_, height, width] = x.extent;
    let shape = words([x.channels, low.extent[1], low.extent[2], height, width]);
    let buffer = gpu.run("upsample_add", &shape, &[&x.buffer, &low.buffer], x.len());
    Tensor::of(x.extent, x.channels, buffer)
}

/// A sparse matrix whose entries are all one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Matrix {
    /// Where each row starts in `col`, and the end.
    pub ptr: Vec<u32>,
    /// `camera * pixels + pixel` of each entry.
    pub col: Vec<u32>,
}

impl Matrix {
    /// Both parts on the adapter.
    pub(crate) fn upload(&self, gpu: &Gpu) -> [Buffer; 2] {
        // A buffer has at least one number; a matrix may have no entry.
        [gpu.upload(&self.ptr), if self.col.is_empty() { gpu.zeros(1) } else { gpu.upload(&self.col) }]
    }
}

/// The mean of the features that each row names; `features` has the pixels of all cameras, camera by camera.
pub fn gather(gpu: &Gpu, matrix: &Matrix, features: &[&Tensor], extent: [usize; 3]) -> Tensor {
    let (channels, pixels) = (features[0].channels, features[0].positions());
    let rows = extent.iter().product::<usize>();
    assert_eq!(matrix.ptr.len(), rows + 1, "a matrix of other rows");
    let [ptr, col] = matrix.upload(gpu);
    let inputs = [&ptr, &col, &cameras(gpu, features)];
    Tensor::of(extent, channels, gpu.run("gather", &words([channels, pixels, rows]), &inputs, rows * channels))
}

/// The features of all cameras in one buffer.
pub(crate) fn cameras(gpu: &Gpu, features: &[&Tensor]) -> Buffer {
    let len = features[0].len();
    let all = gpu.zeros(features.len() * len);
    for (camera, tensor) in features.iter().enumerate() {
        gpu.copy(&tensor.buffer, 0, &all, camera * len, len);
    }
    all
}

/// `weight` is `[inputs, outputs, 4, 4, 4]`.
pub fn deconv(gpu: &Gpu, x: &Tensor, weight: &Buffer, bias: &Buffer) -> Tensor {
    let outputs = bias.len();
    assert_eq!(weight.len(), x.channels * outputs * 64, "weights of another shape");
    let [a, b, c] = x.extent;
    let shape = words([x.channels, outputs, 0, 0, a, b, c, 0]);
    let extent = x.extent.map(|v| 2 * v);
    let len = extent.iter().product::<usize>() * outputs;
    Tensor::of(extent, outputs, gpu.run("deconv", &shape, &[&x.buffer, weight, bias], len))
}

/// `volume` and the gated `bev`, whose plane is the first two axes of the volume.
pub fn gate(gpu: &Gpu, volume: &Tensor, bev: &Tensor, weight: &Buffer, bias: &Buffer) -> Tensor {
    let [x, y, depth] = volume.extent;
    assert!(bev.extent == [1, x, y] && bev.channels == volume.channels, "a bird's-eye view of another shape");
    let shape = words([volume.channels, x * y, depth]);
    let inputs = [&volume.buffer, &bev.buffer, weight, bias];
    Tensor::of(volume.extent, volume.channels, gpu.run("gate", &shape, &inputs, volume.len()))
}

/// The mean over all positions.
pub fn mean(gpu: &Gpu, x: &Tensor) -> Tensor {
    let buffer = gpu.run("mean", &words([x.channels, x.positions()]), &[&x.buffer], x.channels);
    Tensor::of([1; 3], x.channels, buffer)
}

/// One position repeated over `extent`.
pub fn broadcast(gpu: &Gpu, x: &Tensor, extent: [usize; 3]) -> Tensor {
    let positions = extent.iter().product::<usize>();
    let buffer = gpu.run("broadcast", &words([x.channels, positions]), &[&x.buffer], x.channels * positions);
    Tensor::of(extent, x.channels, buffer)
}

/// The weights of one head of cascaded attention.
#[derive(Clone, Debug)]
pub struct HeadWeights {
    /// `[3 * key_dim, part, 1, 1]` and its norm.
    pub qkv: (Buffer, Norm),
    /// `[key_dim, 1, 5, 5]` and its norm.
    pub query: (Buffer, Norm),
    /// `[side * side]`.
    pub offsets: Buffer,
}

/// Cascaded group attention (arXiv 2305.07027) within windows of at most `side` x `side`: padded with zeros at the ends,
/// head after head, each with the result of the one before added to its share of the channels; then a ReLU, a 1x1
/// convolution and its norm, cropped and added to `x`.
pub fn window_attention(
    gpu: &Gpu,
    x: &Tensor,
    side: usize,
    heads: &[HeadWeights],
    (proj, proj_norm): &(Buffer, Norm),
) -> Tensor {
    let [_, height, width] = x.extent;
    let side = side.min(height);
    let whole = height <= side && width <= side;
    let window = if whole { [height, width] } else { [side; 2] };
    let padded = [height.next_multiple_of(window[0]), width.next_multiple_of(window[1])];
    let plane = resize(gpu, x, padded);
    let part = x.channels / heads.len();
    let dim = heads[0].query.1.gamma.len();
    let cascade = gpu.zeros(heads.len() * dim * padded[0] * padded[1]);
    let all = Tensor::of(plane.extent, heads.len() * dim, cascade);
    let mut before: Option<Tensor> = None;
    for (i, head) in heads.iter().enumerate() {
        let own = plane.slice(gpu, i * part, part);
        let input = before.map_or_else(|| own.clone(), |before| add(gpu, &before, &own));
        let qkv = batch_norm(gpu, &conv(gpu, &input, &Walk::POINT, &head.qkv.0, None), &head.qkv.1);
        let [q, k, v] = [0, 1, 2].map(|j| qkv.slice(gpu, j * dim, dim));
        let q = batch_norm(gpu, &depthwise(gpu, &q, 5, window, &head.query.0), &head.query.1);
        let shape = words([dim, padded[0], padded[1], window[0], window[1], side]);
        let inputs = [&q.buffer, &k.buffer, &v.buffer, &head.offsets];
        let result = Tensor::of(plane.extent, dim, gpu.run("window_attention", &shape, &inputs, q.len()));
        all.write(gpu, i * dim, &result);
        before = Some(result);
    }
    let mixed = batch_norm(gpu, &conv(gpu, &relu(gpu, &all), &Walk::POINT, proj, None), proj_norm);
    add(gpu, x, &resize(gpu, &mixed, [height, width]))
}

/// A plane cut off, or continued with zeros, at the ends of both axes.
fn resize(gpu: &Gpu, x: &Tensor, [height, width]: [usize; 2]) -> Tensor {
    let shape = words([x.channels, x.extent[1], x.extent[2], height, width]);
    let buffer = gpu.run("resize", &shape, &[&x.buffer], x.channels * height * width);
    Tensor::of([1, height, width], x.channels, buffer)
}

/// Image bytes, blue first, minus the mean, padded with zeros.
pub fn normalise(gpu: &Gpu, bgr: &[u8], [height, width]: [usize; 2], padded: [usize; 2]) -> Tensor {
    assert_eq!(bgr.len(), height * width * 3, "an image of another size");
    let image: Vec<u32> = bgr.iter().map(|&b| u32::from(b)).collect();
    let shape = words([height, width, padded[0], padded[1]]);
    let buffer = gpu.run("normalise", &shape, &[&gpu.upload(&image)], 3 * padded[0] * padded[1]);
    Tensor::of([1, padded[0], padded[1]], 3, buffer)
}

/// Three linear layers with ReLUs between; `[weight, bias]` of each. Logits `[positions, classes]`, and the classes.
pub fn head(gpu: &Gpu, x: &Tensor, layers: &[[Buffer; 2]; 3]) -> (Buffer, Buffer) {
    let positions = x.positions();
    let layer = |x: &Buffer, [weight, bias]: &[Buffer; 2], last: bool| {
        let shape = words([weight.len() / bias.len(), bias.len(), positions, usize::from(last)]);
        gpu.run("linear", &shape, &[x, weight, bias], bias.len() * positions)
    };
    let mut hidden = x.buffer.clone();
    for weights in &layers[..2] {
        let y = layer(&hidden, weights, false);
        hidden = gpu.run("relu", &words([y.len()]), &[&y], y.len());
    }
    let logits = layer(&hidden, &layers[2], true);
    let classes = gpu.run("argmax", &words([layers[2][1].len()]), &[&logits], positions);
    (logits, classes)
}

/// For each camera's 4x4 matrix and each point of the product of three `axes`: the flat pixel hit, or 0.
pub fn project(gpu: &Gpu, axes: &[Vec<f32>; 3], matrices: &[[f32; 16]], image: [usize; 2], stride: usize) -> Vec<u32> {
    let [x, y, z] = [0, 1, 2].map(|a| axes[a].len());
    let shape = words([x, y, z, matrices.len(), image[0], image[1], stride, 0]);
    let inputs = [gpu.upload(&axes.concat()), gpu.upload(matrices.as_flattened())];
    gpu.read(&gpu.run("project", &shape, &[&inputs[0], &inputs[1]], matrices.len() * x * y * z))
}

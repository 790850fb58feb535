//! The table of single operations that the reference computes and the kernels are held to: shapes, and inputs drawn from
//! each case's name. Everything is channels first, as checkpoints and PyTorch have it.

use super::named;
use voxcast::random::Random;

/// Taps of a deformable convolution.
pub(crate) const TAPS: usize = 3 * 3;

/// Channels of its offsets: down and right of each tap, then each tap's mask.
pub(crate) const OFFSETS: usize = 3 * TAPS;

/// Taps of the convolution on an attention head's queries.
pub(crate) const QUERY_TAPS: usize = 5 * 5;

/// One operation on one shape.
#[derive(Clone, Debug)]
pub(crate) struct Case {
    /// Unique; names the expected tensor and seeds the inputs.
    pub(crate) name: &'static str,
    pub(crate) kind: Kind,
}

/// What follows an operation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum After {
    #[default]
    Nothing,
    Relu,
    /// A tensor is added, then the ReLU.
    AddRelu,
    /// The ReLU, then a tensor is added.
    ReluAdd,
}

#[derive(Clone, Debug)]
pub(crate) enum Kind {
    Normalise {
        height: usize,
        width: usize,
    },
    Conv(Conv),
    /// Offsets of up to `reach` pixels.
    DeformConv {
        height: usize,
        width: usize,
        inputs: usize,
        outputs: usize,
        reach: f32,
    },
    Depthwise {
        height: usize,
        width: usize,
        channels: usize,
        side: usize,
    },
    BatchNorm {
        positions: usize,
        channels: usize,
        after: After,
    },
    MaxPool {
        height: usize,
        width: usize,
        channels: usize,
    },
    UpsampleAdd {
        low: [usize; 2],
        size: [usize; 2],
        channels: usize,
    },
    /// Rows of the given lengths.
    Gather {
        rows: &'static [usize],
        cameras: usize,
        pixels: usize,
        channels: usize,
    },
    Deconv {
        extent: [usize; 3],
        inputs: usize,
        outputs: usize,
        after: After,
    },
    WindowAttention {
        plane: [usize; 2],
        heads: usize,
        part: usize,
    },
    Gate {
        columns: [usize; 2],
        depth: usize,
        channels: usize,
    },
    GlobalMean {
        positions: usize,
        channels: usize,
    },
    Broadcast {
        positions: usize,
        channels: usize,
    },
    Head {
        voxels: usize,
        channels: usize,
        classes: usize,
    },
}

/// A convolution. `padding` keeps the size at stride 1.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Conv {
    pub(crate) extent: [usize; 3],
    pub(crate) inputs: usize,
    pub(crate) outputs: usize,
    pub(crate) kernel: [usize; 3],
    pub(crate) stride: usize,
    pub(crate) dilation: usize,
    pub(crate) after: After,
}

impl Conv {
    const fn new(extent: [usize; 3], inputs: usize, outputs: usize, kernel: [usize; 3]) -> Self {
        Self { extent, inputs, outputs, kernel, stride: 1, dilation: 1, after: After::Nothing }
    }

    /// Steps, dilation and padding along an axis: an axis that the kernel does not reach over has none.
    pub(crate) fn axes(&self) -> ([usize; 3], [usize; 3], [usize; 3]) {
        let depth = self.extent[0] == 1;
        let stride = std::array::from_fn(|a| if a == 0 && depth { 1 } else { self.stride });
        let dilation = std::array::from_fn(|a| if a == 0 && depth { 1 } else { self.dilation });
        (stride, dilation, std::array::from_fn(|a| dilation[a] * (self.kernel[a] / 2)))
    }
}

/// Every case.
pub(crate) fn table() -> Vec<Case> {
    const IMAGE: [usize; 3] = [1, 3, 3];
    let conv = Conv::new;
    let after = |conv: Conv, after| Conv { after, ..conv };
    let strided = |conv: Conv, stride| Conv { stride, ..conv };
    let dilated = |conv: Conv, dilation| Conv { dilation, ..conv };
    let cases = [
        ("normalise.whole", Kind::Normalise { height: 32, width: 32 }),
        ("normalise.padded", Kind::Normalise { height: 33, width: 5 }),
        ("conv.point", Kind::Conv(conv([1, 5, 7], 13, 17, [1; 3]))),
        ("conv.one_pixel", Kind::Conv(conv([1; 3], 5, 3, IMAGE))),
        ("conv.image", Kind::Conv(conv([1, 9, 11], 7, 33, IMAGE))),
        ("conv.offsets", Kind::Conv(conv([1, 6, 5], 8, OFFSETS, IMAGE))),
        ("conv.stem", Kind::Conv(after(strided(conv([1, 18, 21], 3, 20, [1, 7, 7]), 2), After::Relu))),
        ("conv.stride", Kind::Conv(strided(conv([1, 9, 8], 6, 16, IMAGE), 2))),
        ("conv.stride_point", Kind::Conv(strided(conv([1, 9, 8], 6, 16, [1; 3]), 2))),
        ("conv.dilated", Kind::Conv(dilated(conv([1, 13, 10], 4, 18, IMAGE), 6))),
        ("conv.dilated_beyond", Kind::Conv(dilated(conv([1, 5, 12], 4, 15, IMAGE), 18))),
        ("conv.volume", Kind::Conv(conv([5, 4, 3], 5, 19, [3; 3]))),
        ("conv.volume_flat", Kind::Conv(after(conv([4, 6, 1], 9, 8, [3; 3]), After::Relu))),
        ("conv.deep", Kind::Conv(conv([1, 3, 4], 300, 16, IMAGE))),
        ("conv.add_relu", Kind::Conv(after(conv([1, 7, 9], 12, 31, [1; 3]), After::AddRelu))),
        ("conv.relu_add", Kind::Conv(after(conv([1, 7, 9], 12, 31, [1; 3]), After::ReluAdd))),
        ("deform.still", Kind::DeformConv { height: 6, width: 7, inputs: 5, outputs: 9, reach: 0.0 }),
        ("deform.near", Kind::DeformConv { height: 8, width: 9, inputs: 11, outputs: 17, reach: 1.5 }),
        ("deform.border", Kind::DeformConv { height: 5, width: 4, inputs: 8, outputs: 16, reach: 6.0 }),
        ("deform.outside", Kind::DeformConv { height: 3, width: 5, inputs: 4, outputs: 5, reach: 300.0 }),
        ("depthwise.plane", Kind::Depthwise { height: 7, width: 10, channels: 21, side: 3 }),
        ("depthwise.narrow", Kind::Depthwise { height: 9, width: 1, channels: 16, side: 3 }),
        ("depthwise.wide_kernel", Kind::Depthwise { height: 4, width: 6, channels: 5, side: 5 }),
        ("batch_norm.plain", Kind::BatchNorm { positions: 35, channels: 19, after: After::Nothing }),
        ("batch_norm.add_relu", Kind::BatchNorm { positions: 12, channels: 33, after: After::AddRelu }),
        ("batch_norm.relu_add", Kind::BatchNorm { positions: 12, channels: 16, after: After::ReluAdd }),
        ("max_pool.even", Kind::MaxPool { height: 8, width: 12, channels: 17 }),
        ("max_pool.odd", Kind::MaxPool { height: 7, width: 5, channels: 4 }),
        ("max_pool.one", Kind::MaxPool { height: 1, width: 1, channels: 3 }),
        ("upsample_add.double", Kind::UpsampleAdd { low: [3, 5], size: [6, 10], channels: 18 }),
        ("upsample_add.odd", Kind::UpsampleAdd { low: [3, 4], size: [5, 7], channels: 7 }),
        ("gather.rows", Kind::Gather { rows: &[0, 1, 27, 0, 3, 64, 2, 1, 5, 0], cameras: 3, pixels: 40, channels: 70 }),
        ("gather.empty", Kind::Gather { rows: &[0; 5], cameras: 1, pixels: 6, channels: 9 }),
        ("deconv.cube", Kind::Deconv { extent: [3, 4, 2], inputs: 7, outputs: 18, after: After::Nothing }),
        ("deconv.flat", Kind::Deconv { extent: [2, 5, 1], inputs: 16, outputs: 9, after: After::ReluAdd }),
        ("attention.window", Kind::WindowAttention { plane: [7, 7], heads: 8, part: 2 }),
        ("attention.small", Kind::WindowAttention { plane: [3, 3], heads: 8, part: 3 }),
        ("attention.padded", Kind::WindowAttention { plane: [16, 9], heads: 8, part: 4 }),
        ("attention.narrow", Kind::WindowAttention { plane: [5, 8], heads: 8, part: 2 }),
        ("gate.volume", Kind::Gate { columns: [4, 3], depth: 5, channels: 19 }),
        ("gate.flat", Kind::Gate { columns: [5, 2], depth: 1, channels: 16 }),
        ("global_mean.plane", Kind::GlobalMean { positions: 77, channels: 21 }),
        ("broadcast.plane", Kind::Broadcast { positions: 12, channels: 5 }),
        ("head.classes", Kind::Head { voxels: 37, channels: 18, classes: 17 }),
        ("head.few", Kind::Head { voxels: 3, channels: 9, classes: 5 }),
    ];
    cases.into_iter().map(|(name, kind)| Case { name, kind }).collect()
}

impl Case {
    fn random(&self, what: &str) -> Random {
        named::random(self.name, what)
    }

    /// Inputs: close to standard normal.
    pub(crate) fn numbers(&self, what: &str, len: usize) -> Vec<f32> {
        let mut random = self.random(what);
        (0..len).map(|_| random.normal()).collect()
    }

    /// Weights that half precision holds exactly, so that both precisions give the same: multiples of 1/256 below 1/4.
    pub(crate) fn weights(&self, what: &str, len: usize) -> Vec<f32> {
        let mut random = self.random(what);
        (0..len).map(|_| (random.below(127) as f32 - 63.0) / 256.0).collect()
    }

    /// Weights of sums over `fan` inputs that keep the size of numbers.
    pub(crate) fn scaled(&self, what: &str, len: usize, fan: usize) -> Vec<f32> {
        self.numbers(what, len).into_iter().map(|v| v / (fan as f32).sqrt()).collect()
    }

    /// Numbers around one, above zero: variances and factors.
    pub(crate) fn positive(&self, what: &str, len: usize) -> Vec<f32> {
        let mut random = self.random(what);
        (0..len).map(|_| random.range(0.5, 1.5)).collect()
    }

    /// Bytes of an image.
    pub(crate) fn bytes(&self, len: usize) -> Vec<u8> {
        let mut random = self.random("image");
        (0..len).map(|_| random.below(256) as u8).collect()
    }

    /// Offsets of a deformable convolution, [`OFFSETS`] channels of `positions`: some are whole pixels, some land just on the
    /// border of the image, the rest are anywhere within `reach`. Then the mask's logits.
    pub(crate) fn offsets(&self, positions: usize, reach: f32) -> Vec<f32> {
        let mut random = self.random("offsets");
        let mut offset = || match random.below(4) {
            0 => random.range(-reach, reach).round(),
            1 => random.range(-reach, reach).round() + 0.5,
            _ => random.range(-reach, reach),
        };
        let mut values: Vec<f32> = (0..2 * TAPS * positions).map(|_| offset()).collect();
        values.extend(self.numbers("mask", TAPS * positions));
        values
    }

    /// A matrix with rows of these lengths: offsets, then ascending columns below `columns` without duplicates.
    pub(crate) fn matrix(&self, rows: &[usize], columns: usize) -> (Vec<u32>, Vec<u32>) {
        named::matrix(self.random("matrix"), rows, columns)
    }
}

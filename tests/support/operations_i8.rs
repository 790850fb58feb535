//! The table of single operations on 8-bit tensors that the reference computes and the kernels are held to, without any
//! tolerance: shapes, and inputs drawn from each case's name. Everything is channels first.

use super::named;
use voxcast::random::Random;

/// One operation on one shape.
#[derive(Clone, Debug)]
pub(crate) struct Case {
    /// Unique; names the expected tensor and seeds the inputs.
    pub(crate) name: String,
    pub(crate) kind: Kind,
    values: Values,
}

/// What inputs are like.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Values {
    /// Any, and multipliers for which results are of the size of inputs.
    Drawn,
    /// Mostly the ends of what is allowed, so that sums come close to the ends of 32 bits, and results to theirs.
    Ends,
}

/// What follows a sum.
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

impl After {
    pub(crate) fn relu(self) -> bool {
        self != After::Nothing
    }

    pub(crate) fn adds(self) -> bool {
        matches!(self, After::AddRelu | After::ReluAdd)
    }
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
        reach: i32,
        after: After,
    },
    Depthwise {
        height: usize,
        width: usize,
        channels: usize,
        side: usize,
        residual: bool,
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
    /// Rows of the given lengths; with a bias and ReLU or without both.
    Gather {
        rows: &'static [usize],
        cameras: usize,
        pixels: usize,
        channels: usize,
        ends: bool,
    },
    Deconv {
        extent: [usize; 3],
        inputs: usize,
        outputs: usize,
        after: After,
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
    Quantise {
        len: usize,
    },
    Dequantise {
        len: usize,
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
    /// Whether inputs may be negative.
    pub(crate) signed: bool,
    /// Whether results are not clamped.
    pub(crate) wide: bool,
    pub(crate) after: After,
}

impl Conv {
    const fn new(extent: [usize; 3], inputs: usize, outputs: usize, kernel: [usize; 3]) -> Self {
        let (signed, wide, after) = (true, false, After::Nothing);
        Self { extent, inputs, outputs, kernel, stride: 1, dilation: 1, signed, wide, after }
    }

    /// Steps, dilation and padding along an axis: an axis that the kernel does not reach over has none.
    pub(crate) fn axes(&self) -> ([usize; 3], [usize; 3], [usize; 3]) {
        let depth = self.extent[0] == 1;
        let stride = std::array::from_fn(|a| if a == 0 && depth { 1 } else { self.stride });
        let dilation = std::array::from_fn(|a| if a == 0 && depth { 1 } else { self.dilation });
        (stride, dilation, std::array::from_fn(|a| dilation[a] * (self.kernel[a] / 2)))
    }

    /// Positions of the output.
    pub(crate) fn output(&self) -> [usize; 3] {
        let (stride, dilation, padding) = self.axes();
        std::array::from_fn(|a| {
            (self.extent[a] + 2 * padding[a] - dilation[a] * (self.kernel[a] - 1) - 1) / stride[a] + 1
        })
    }
}

/// Every case: each shape with drawn values, then with the ends.
pub(crate) fn table() -> Vec<Case> {
    const IMAGE: [usize; 3] = [1, 3, 3];
    let conv = Conv::new;
    let after = |conv: Conv, after| Conv { after, ..conv };
    let positive = |conv: Conv| Conv { signed: false, ..conv };
    let strided = |conv: Conv, stride| Conv { stride, ..conv };
    let dilated = |conv: Conv, dilation| Conv { dilation, ..conv };
    let deform = |height, width, inputs, outputs, reach, after| Kind::DeformConv {
        height,
        width,
        inputs,
        outputs,
        reach,
        after,
    };
    let gather = |rows, pixels, channels, ends| Kind::Gather { rows, cameras: 3, pixels, channels, ends };
    let cases = [
        ("normalise", Kind::Normalise { height: 33, width: 5 }),
        ("conv.point", Kind::Conv(conv([1, 5, 7], 12, 17, [1; 3]))),
        ("conv.point_positive", Kind::Conv(positive(conv([1, 5, 7], 20, 33, [1; 3])))),
        ("conv.one_pixel", Kind::Conv(conv([1; 3], 4, 3, IMAGE))),
        ("conv.image", Kind::Conv(positive(conv([1, 9, 11], 8, 33, IMAGE)))),
        ("conv.offsets", Kind::Conv(Conv { wide: true, ..conv([1, 6, 5], 8, 27, IMAGE) })),
        ("conv.stem", Kind::Conv(after(strided(conv([1, 18, 21], 4, 20, [1, 7, 7]), 2), After::Relu))),
        ("conv.stride", Kind::Conv(strided(conv([1, 9, 8], 8, 16, IMAGE), 2))),
        ("conv.stride_point", Kind::Conv(strided(positive(conv([1, 9, 8], 8, 16, [1; 3])), 2))),
        ("conv.dilated", Kind::Conv(dilated(conv([1, 13, 10], 4, 18, IMAGE), 6))),
        ("conv.dilated_beyond", Kind::Conv(dilated(positive(conv([1, 5, 12], 4, 15, IMAGE)), 18))),
        ("conv.volume", Kind::Conv(conv([5, 4, 3], 4, 19, [3; 3]))),
        ("conv.volume_flat", Kind::Conv(after(positive(conv([4, 6, 1], 12, 8, [3; 3])), After::Relu))),
        ("conv.deep", Kind::Conv(conv([1, 3, 4], 300, 16, IMAGE))),
        ("conv.deep_positive", Kind::Conv(positive(conv([1, 3, 4], 520, 16, IMAGE)))),
        ("conv.add_relu", Kind::Conv(after(positive(conv([1, 7, 9], 12, 31, [1; 3])), After::AddRelu))),
        ("conv.relu_add", Kind::Conv(after(conv([1, 7, 9], 12, 31, [1; 3]), After::ReluAdd))),
        ("deform.still", deform(6, 7, 4, 9, 0, After::Nothing)),
        ("deform.near", deform(8, 9, 12, 17, 2, After::Relu)),
        ("deform.border", deform(5, 4, 8, 16, 6, After::AddRelu)),
        ("deform.outside", deform(3, 5, 4, 5, 300, After::Nothing)),
        ("depthwise.plane", Kind::Depthwise { height: 7, width: 10, channels: 21, side: 3, residual: true }),
        ("depthwise.narrow", Kind::Depthwise { height: 9, width: 1, channels: 16, side: 3, residual: false }),
        ("depthwise.wide_kernel", Kind::Depthwise { height: 4, width: 6, channels: 5, side: 5, residual: true }),
        ("max_pool.even", Kind::MaxPool { height: 8, width: 12, channels: 17 }),
        ("max_pool.odd", Kind::MaxPool { height: 7, width: 5, channels: 4 }),
        ("max_pool.one", Kind::MaxPool { height: 1, width: 1, channels: 3 }),
        ("upsample_add.double", Kind::UpsampleAdd { low: [3, 5], size: [6, 10], channels: 18 }),
        ("upsample_add.odd", Kind::UpsampleAdd { low: [3, 4], size: [5, 7], channels: 7 }),
        ("gather.rows", gather(&[0, 1, 27, 0, 3, 64, 2, 1, 5, 0], 40, 70, false)),
        ("gather.folded", gather(&[0, 1, 27, 0, 3, 64, 2, 1, 5, 0], 40, 70, true)),
        ("gather.long", gather(&[255, 256, 300], 120, 17, true)),
        ("deconv.cube", Kind::Deconv { extent: [3, 4, 2], inputs: 8, outputs: 18, after: After::Nothing }),
        ("deconv.flat", Kind::Deconv { extent: [2, 5, 1], inputs: 16, outputs: 9, after: After::ReluAdd }),
        ("gate.volume", Kind::Gate { columns: [4, 3], depth: 5, channels: 19 }),
        ("gate.flat", Kind::Gate { columns: [5, 2], depth: 1, channels: 16 }),
        ("global_mean.plane", Kind::GlobalMean { positions: 77, channels: 21 }),
        ("global_mean.large", Kind::GlobalMean { positions: 1000, channels: 5 }),
        ("broadcast", Kind::Broadcast { positions: 12, channels: 5 }),
        ("head.classes", Kind::Head { voxels: 37, channels: 20, classes: 17 }),
        ("head.few", Kind::Head { voxels: 3, channels: 8, classes: 5 }),
        ("quantise", Kind::Quantise { len: 300 }),
        ("dequantise", Kind::Dequantise { len: 300 }),
    ];
    let drawn = |(name, kind): &(&str, Kind)| Case { name: (*name).into(), kind: kind.clone(), values: Values::Drawn };
    let ends = |(name, kind)| Case { name: format!("{name}.ends"), kind, values: Values::Ends };
    cases.iter().map(drawn).collect::<Vec<_>>().into_iter().chain(cases.clone().into_iter().map(ends)).collect()
}

/// What a sum starts from and becomes, a value per output.
pub(crate) struct Columns {
    pub(crate) bias: Vec<i32>,
    pub(crate) multiplier: Vec<i32>,
    /// What an added tensor is multiplied by.
    pub(crate) residual: Vec<i32>,
}

impl Case {
    fn random(&self, what: &str) -> Random {
        named::random(&self.name, what)
    }

    /// Elements of an 8-bit tensor.
    pub(crate) fn elements(&self, what: &str, len: usize, signed: bool) -> Vec<i32> {
        let mut random = self.random(what);
        let mut sign = 1;
        let mut element = |i: usize| {
            if self.values == Values::Drawn {
                return if signed { random.below(255) as i32 - 127 } else { random.below(128) as i32 };
            }
            // Runs of one sign, so that whole sums have it.
            if i.is_multiple_of(64) {
                sign = if random.below(2) == 0 || !signed { 1 } else { -1 };
            }
            match random.below(16) {
                0 => 0,
                1 if signed => -127 * sign,
                _ => 127 * sign,
            }
        };
        (0..len).map(&mut element).collect()
    }

    /// Those of sums of `depth` products of elements.
    pub(crate) fn columns(&self, what: &str, depth: usize, outputs: usize) -> Columns {
        let mut random = self.random(what);
        let column = |_| match self.values {
            Values::Drawn => {
                let typical = 5500.0 * (depth as f32).sqrt();
                let multiplier = f64::from(random.range(30.0, 90.0) / typical) * f64::from(1u32 << 31) * 2.0;
                let residual = random.range(1.0, typical / 60.0) as i32;
                (random.range(-typical, typical) as i32, multiplier.min(f64::from(i32::MAX)) as i32, residual)
            }
            Values::Ends => {
                // What is left of 32 bits, for the residual and for the bias.
                let room = i32::MAX - 127 * 127 * depth as i32;
                let residual = room / 127 / [2, 1000, 1_000_000][random.below(3)];
                let bias = (room - 127 * residual) * if random.below(2) == 0 { 1 } else { -1 };
                (bias, [0, 1, 200, 256, 1 << 30, i32::MAX][random.below(6)], residual)
            }
        };
        let columns: Vec<(i32, i32, i32)> = (0..outputs).map(column).collect();
        Columns {
            bias: columns.iter().map(|c| c.0).collect(),
            multiplier: columns.iter().map(|c| c.1).collect(),
            residual: columns.iter().map(|c| c.2).collect(),
        }
    }

    /// `len` integers from 0 to `high`, or from `-high`: the ends among them.
    pub(crate) fn integers(&self, what: &str, len: usize, high: i32, signed: bool) -> Vec<i32> {
        let mut random = self.random(what);
        let integer = |_| {
            let magnitude = match (self.values, random.below(8)) {
                (Values::Drawn, 0..=3) => random.below(high as usize / 4) as i32,
                (Values::Drawn, _) => random.below(high as usize + 1) as i32,
                (Values::Ends, 0) => 0,
                (Values::Ends, _) => high,
            };
            if signed && random.below(2) == 0 { -magnitude } else { magnitude }
        };
        (0..len).map(integer).collect()
    }

    /// Numbers that become 8-bit integers: of order 1, halves of steps of 1/64, or far outside.
    pub(crate) fn numbers(&self, what: &str, len: usize) -> Vec<f32> {
        let mut random = self.random(what);
        let number = |_| match self.values {
            Values::Drawn if random.below(2) == 0 => random.normal(),
            Values::Drawn => (random.below(512) as f32 - 255.5) / 64.0,
            Values::Ends => [0.0, -0.0, 1e30, -1e30, 127.0 / 64.0, -127.5 / 64.0][random.below(6)],
        };
        (0..len).map(number).collect()
    }

    /// Bytes of an image.
    pub(crate) fn bytes(&self, len: usize) -> Vec<u8> {
        self.integers("image", len, 255, false).into_iter().map(|byte| byte as u8).collect()
    }

    /// Offsets of a deformable convolution, 27 channels of `positions`: in units of 1/256 pixel, whole pixels and halves among
    /// them; then the mask's logits, in units of 1/64.
    pub(crate) fn offsets(&self, positions: usize, reach: i32) -> Vec<i32> {
        let mut random = self.random("offsets");
        let mut offset = || {
            let whole = random.below(2 * reach as usize + 1) as i32 - reach;
            match (self.values, random.below(4)) {
                (Values::Ends, 0) if reach > 0 => [i32::MIN, i32::MAX, 1 << 30, -(1 << 30)][random.below(4)],
                (_, 0) => 256 * whole,
                (_, 1) => 256 * whole + 128,
                _ => 256 * whole + random.below(256) as i32 * reach.min(1),
            }
        };
        let mut values: Vec<i32> = (0..18 * positions).map(|_| offset()).collect();
        let high = if self.values == Values::Ends { i32::MAX } else { 400 };
        values.extend(self.integers("mask", 9 * positions, high, true));
        values
    }

    /// A matrix with rows of these lengths: offsets, then ascending columns below `columns` without duplicates.
    pub(crate) fn matrix(&self, rows: &[usize], columns: usize) -> (Vec<u32>, Vec<u32>) {
        named::matrix(self.random("matrix"), rows, columns)
    }
}

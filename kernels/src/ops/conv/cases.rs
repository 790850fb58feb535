//! [`super::conv()`] with any arguments, and at the network's shapes.

use super::{Conv, Geometry, conv};
use crate::cases::draw::{Right, span};
use crate::cases::{Bench, Case, Draw, Memory, Output, values};
use crate::isa::Isa;
use crate::matmul::layout::packed_len;
use crate::matmul::{Panels, Product, Residual, SCRATCH};
use std::ops::Range;
use std::vec::Vec;

struct Call {
    geometry: Geometry,
    rows: Range<usize>,
    stride: usize,
    right: Right,
    input: Vec<f32>,
    before: Vec<f32>,
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let mut three = |low, high| core::array::from_fn(|_| draw.extent(low, high));
    let (output, kernel) = (three(1, 6), three(1, 3));
    let (stride, dilation, padding, input) = (three(1, 3), three(1, 3), three(0, 3), three(1, 6));
    let channels = draw.extent(1, 80);
    let g = Geometry { input, channels, kernel, stride, dilation, padding, output };
    let columns = draw.columns(g.rows() * g.depth())?;
    let rows = draw.rows(g.rows());
    let stride = columns + draw.extent(0, 3);
    Some(Call {
        geometry: g,
        right: Right::draw(draw, g.rows(), g.depth(), columns),
        input: draw.values(input.iter().product::<usize>() * channels),
        before: draw.values(span(rows.len(), stride, columns)),
        rows,
        stride,
    })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let (input, right) = (memory.hold(&self.input), self.right.hold(memory));
        let (mut out, mut scratch) = (memory.hold(&self.before), memory.filled(SCRATCH, f32::NAN));
        let args = Conv { geometry: self.geometry, input: &input, product: right.product() };
        conv(isa, &args, self.rows.clone(), self.stride, &mut out, &mut scratch);
        Output::from(&out[..])
    }
}

/// A bench of a convolution of `geometry` to `columns` channels.
fn bench(name: &str, geometry: Geometry, columns: usize) -> Bench {
    let (rows, depth) = (geometry.rows(), geometry.depth());
    let input = values(geometry.input.iter().product::<usize>() * geometry.channels, 1.0);
    let weights = values(packed_len(depth, columns), 1.0 / depth as f32);
    let bias = values(columns.next_multiple_of(16), 1.0);
    let mut scratch = values(SCRATCH, 0.0);
    let read = 4 * (input.len() + weights.len());
    Bench::new(name, [rows, columns], depth * columns, read, move |isa, rows, out| {
        let product = Product {
            weights: Panels::F32(&weights),
            bias: &bias,
            depth,
            columns,
            relu: true,
            residual: Residual::None,
        };
        conv(isa, &Conv { geometry, input: &input, product }, rows, columns, out, &mut scratch);
    })
}

/// A square kernel on an image, padded so that the output is the input over the stride.
fn image([h, w]: [usize; 2], channels: usize, kernel: usize, stride: usize) -> Geometry {
    Geometry {
        input: [1, h, w],
        channels,
        kernel: [1, kernel, kernel],
        stride: [1, stride, stride],
        dilation: [1; 3],
        padding: [0, kernel / 2, kernel / 2],
        output: [1, h.div_ceil(stride), w.div_ceil(stride)],
    }
}

/// A 3x3x3 kernel on a volume.
fn volume(extent: [usize; 3], channels: usize) -> Geometry {
    Geometry {
        input: extent,
        channels,
        kernel: [3; 3],
        stride: [1; 3],
        dilation: [1; 3],
        padding: [1; 3],
        output: extent,
    }
}

/// The convolutions of `nuscenes-200` at 928 x 1600 pixels, one camera: input, walk, output channels. A stage's first block
/// halves the image.
pub(crate) fn shapes() -> Vec<(&'static str, Geometry, usize)> {
    std::vec![
        ("stem 7x7 3-64 stride 2", image([928, 1600], 3, 7, 2), 64),
        ("layer1 1x1 64-64", image([232, 400], 64, 1, 1), 64),
        ("layer1 1x1 64-256", image([232, 400], 64, 1, 1), 256),
        ("layer1 1x1 256-64", image([232, 400], 256, 1, 1), 64),
        ("layer1 3x3 64", image([232, 400], 64, 3, 1), 64),
        ("layer2 1x1 256-128 stride 2", image([232, 400], 256, 1, 2), 128),
        ("layer2 1x1 256-512 stride 2", image([232, 400], 256, 1, 2), 512),
        ("layer2 1x1 128-512", image([116, 200], 128, 1, 1), 512),
        ("layer2 1x1 512-128", image([116, 200], 512, 1, 1), 128),
        ("layer2 3x3 128", image([116, 200], 128, 3, 1), 128),
        ("layer3 1x1 256-1024", image([58, 100], 256, 1, 1), 1024),
        ("layer3 1x1 1024-256", image([58, 100], 1024, 1, 1), 256),
        ("layer3 offsets 3x3 256-27", image([58, 100], 256, 3, 1), 27),
        ("layer4 1x1 512-2048", image([29, 50], 512, 1, 1), 2048),
        ("layer4 1x1 2048-512", image([29, 50], 2048, 1, 1), 512),
        ("layer4 offsets 3x3 512-27", image([29, 50], 512, 3, 1), 27),
        ("folded fpn level1 3x3 512-128", image([116, 200], 512, 3, 1), 128),
        ("level1 3x3x3 64", volume([100, 100, 8], 64), 64),
        ("level3 3x3x3 256", volume([25, 25, 2], 256), 256),
        ("refine0 3x3x3 32", volume([200, 200, 16], 32), 32),
    ]
}

pub(crate) fn benches() -> Vec<Bench> {
    shapes().into_iter().map(|(name, geometry, columns)| bench(name, geometry, columns)).collect()
}

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
fn image(name: &str, [h, w]: [usize; 2], widths: [usize; 2], kernel: usize, stride: usize) -> Bench {
    let geometry = Geometry {
        input: [1, h, w],
        channels: widths[0],
        kernel: [1, kernel, kernel],
        stride: [1, stride, stride],
        dilation: [1; 3],
        padding: [0, kernel / 2, kernel / 2],
        output: [1, h.div_ceil(stride), w.div_ceil(stride)],
    };
    bench(name, geometry, widths[1])
}

/// A 3x3x3 kernel on a volume.
fn volume(name: &str, extent: [usize; 3], width: usize) -> Bench {
    let geometry = Geometry {
        input: extent,
        channels: width,
        kernel: [3; 3],
        stride: [1; 3],
        dilation: [1; 3],
        padding: [1; 3],
        output: extent,
    };
    bench(name, geometry, width)
}

/// Of `nuscenes-200` at 928 x 1600 pixels, one camera. A stage's first block halves the image.
pub(crate) fn benches() -> Vec<Bench> {
    std::vec![
        image("stem 7x7 3-64 stride 2", [928, 1600], [3, 64], 7, 2),
        image("layer1 1x1 64-64", [232, 400], [64, 64], 1, 1),
        image("layer1 1x1 64-256", [232, 400], [64, 256], 1, 1),
        image("layer1 1x1 256-64", [232, 400], [256, 64], 1, 1),
        image("layer1 3x3 64", [232, 400], [64, 64], 3, 1),
        image("layer2 1x1 256-128 stride 2", [232, 400], [256, 128], 1, 2),
        image("layer2 1x1 256-512 stride 2", [232, 400], [256, 512], 1, 2),
        image("layer2 1x1 128-512", [116, 200], [128, 512], 1, 1),
        image("layer2 1x1 512-128", [116, 200], [512, 128], 1, 1),
        image("layer2 3x3 128", [116, 200], [128, 128], 3, 1),
        image("layer3 1x1 256-1024", [58, 100], [256, 1024], 1, 1),
        image("layer3 1x1 1024-256", [58, 100], [1024, 256], 1, 1),
        image("layer3 offsets 3x3 256-27", [58, 100], [256, 27], 3, 1),
        image("layer4 1x1 512-2048", [29, 50], [512, 2048], 1, 1),
        image("layer4 1x1 2048-512", [29, 50], [2048, 512], 1, 1),
        image("layer4 offsets 3x3 512-27", [29, 50], [512, 27], 3, 1),
        image("folded fpn level1 3x3 512-128", [116, 200], [512, 128], 3, 1),
        volume("level1 3x3x3 64", [100, 100, 8], 64),
        volume("level3 3x3x3 256", [25, 25, 2], 256),
        volume("refine0 3x3x3 32", [200, 200, 16], 32),
    ]
}

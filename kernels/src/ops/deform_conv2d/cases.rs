//! [`super::deform_conv2d()`] with any arguments, and at the network's shapes.

use super::{DeformConv2d, deform_conv2d};
use crate::cases::draw::{Right, span};
use crate::cases::{Bench, Case, Draw, Memory, Output, values};
use crate::isa::Isa;
use crate::matmul::layout::packed_len;
use crate::matmul::{Panels, Product, Residual, SCRATCH};
use crate::ops::conv::Geometry;
use std::ops::Range;
use std::vec::Vec;

struct Call {
    geometry: Geometry,
    rows: Range<usize>,
    stride: usize,
    right: Right,
    input: Vec<f32>,
    offsets: Vec<f32>,
    before: Vec<f32>,
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let mut plane = |low, high, depth| [depth, draw.extent(low, high), draw.extent(low, high)];
    let (output, kernel) = (plane(1, 12, 1), plane(1, 3, 1));
    let (stride, dilation, padding, input) = (plane(1, 3, 1), plane(1, 3, 1), plane(0, 3, 0), plane(1, 9, 1));
    let channels = draw.extent(1, 80);
    let g = Geometry { input, channels, kernel, stride, dilation, padding, output };
    let columns = draw.columns(g.rows() * g.depth())?;
    let rows = draw.rows(g.rows());
    let stride = columns + draw.extent(0, 3);
    Some(Call {
        geometry: g,
        offsets: draw.values(g.rows() * 3 * kernel[1] * kernel[2]),
        right: Right::draw(draw, g.rows(), g.depth(), columns),
        input: draw.values(input.iter().product::<usize>() * channels),
        before: draw.values(span(rows.len(), stride, columns)),
        rows,
        stride,
    })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let (input, offsets, right) = (memory.hold(&self.input), memory.hold(&self.offsets), self.right.hold(memory));
        let (mut out, mut scratch) = (memory.hold(&self.before), memory.filled(SCRATCH, f32::NAN));
        let args = DeformConv2d { geometry: self.geometry, input: &input, offsets: &offsets, product: right.product() };
        deform_conv2d(isa, &args, self.rows.clone(), self.stride, &mut out, &mut scratch);
        Output::from(&out[..])
    }
}

/// The backbone's deformable convolutions of `nuscenes-200` at 928 x 1600 pixels.
pub(crate) fn benches() -> Vec<Bench> {
    let layers = [("layer3 3x3 256", [58, 100], 256), ("layer4 3x3 512", [29, 50], 512)];
    layers.map(|(name, [h, w], width)| bench(name, [h, w], width)).into()
}

fn bench(name: &str, [h, w]: [usize; 2], width: usize) -> Bench {
    let geometry = Geometry {
        input: [1, h, w],
        channels: width,
        kernel: [1, 3, 3],
        stride: [1; 3],
        dilation: [1; 3],
        padding: [0, 1, 1],
        output: [1, h, w],
    };
    let (rows, depth) = (geometry.rows(), geometry.depth());
    let taps = depth / width;
    let (input, offsets) = (values(rows * width, 1.0), values(rows * 3 * taps, 3.0));
    let (weights, bias) = (values(packed_len(depth, width), 1.0 / depth as f32), values(width, 1.0));
    let mut scratch = values(SCRATCH, 0.0);
    let read = 4 * (input.len() + offsets.len() + weights.len());
    Bench::new(name, [rows, width], depth * width, read, move |isa, rows, out| {
        let product = Product {
            weights: Panels::F32(&weights),
            bias: &bias,
            depth,
            columns: width,
            relu: true,
            residual: Residual::None,
        };
        let args = DeformConv2d { geometry, input: &input, offsets: &offsets, product };
        deform_conv2d(isa, &args, rows, width, out, &mut scratch);
    })
}

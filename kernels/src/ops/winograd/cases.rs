//! [`super::winograd()`] with any arguments, and at the network's shapes.

use super::{Reads, Scheme, Shape, Winograd, winograd};
use crate::cases::draw::span;
use crate::cases::{Bench, Case, Draw, Memory, Output, values};
use crate::conv::Geometry;
use crate::isa::Isa;
use crate::matmul::Residual;
use std::ops::Range;
use std::vec::Vec;

struct Call {
    shape: Shape,
    tile_rows: Range<usize>,
    stride: usize,
    weights: Vec<f32>,
    bias: Vec<f32>,
    relu: bool,
    joins: u8,
    added: Vec<f32>,
    added_stride: usize,
    input: Vec<f32>,
    before: Vec<f32>,
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let scheme = [Scheme::Two, Scheme::Three, Scheme::Four][draw.extent(0, 2)];
    let plane = [draw.extent(1, 9), draw.extent(1, 9)];
    let (layers, layer_taps) = match scheme {
        Scheme::Three => (draw.extent(1, 4), 2),
        _ if draw.flag() => (draw.extent(1, 4), 3),
        _ => (1, 1),
    };
    let channels = 16 * draw.extent(1, 5);
    let one = Shape { plane, layers, layer_taps, channels, columns: 1, scheme };
    let columns = draw.columns(one.multiply_adds() as usize)?;
    let shape = Shape { columns, ..one };
    let tile_rows = draw.rows(shape.tiles()[0]);
    let (stride, added_stride) = (columns + draw.extent(0, 3), columns + draw.extent(0, 3));
    let joins = draw.byte() % 4;
    Some(Call {
        weights: draw.values(shape.weights_len()),
        bias: draw.values(columns.next_multiple_of(16)),
        relu: draw.flag(),
        added: draw.values(if joins > 1 { span(shape.rows(), added_stride, columns) } else { 0 }),
        input: draw.values(shape.inputs() * channels),
        before: draw.values(span(shape.positions(&tile_rows).len(), stride, columns)),
        shape,
        tile_rows,
        stride,
        joins,
        added_stride,
    })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let (input, weights) = (memory.hold(&self.input), memory.hold(&self.weights));
        let (bias, added) = (memory.hold(&self.bias), memory.hold(&self.added));
        let (mut out, mut scratch) = (memory.hold(&self.before), memory.filled(self.shape.scratch_len(), f32::NAN));
        let (rows, stride) = (&added[..], self.added_stride);
        let args = Winograd {
            shape: self.shape,
            input: &input,
            weights: &weights,
            bias: &bias,
            relu: self.relu,
            residual: match self.joins {
                0 => Residual::None,
                1 => Residual::InPlace,
                2 => Residual::Before { rows, stride },
                _ => Residual::After { rows, stride },
            },
        };
        winograd(isa, &args, self.tile_rows.clone(), self.stride, &mut out, &mut scratch);
        Output::from(&out[..])
    }
}

/// A convolution.
fn bench(name: &str, input: [usize; 3], kernel: [usize; 3], channels: usize, columns: usize) -> Bench {
    let padding = kernel.map(|taps| taps / 2);
    let geometry = Geometry { input, channels, kernel, stride: [1; 3], dilation: [1; 3], padding, output: input };
    rows_of_tiles(name, Shape::best(&geometry, columns, Reads::PerFrame).expect("worth it"), geometry.depth())
}

/// A transposed convolution.
fn doubled(name: &str, extent: [usize; 3], channels: usize, columns: usize) -> Bench {
    let shape = Shape::best_deconv3d(extent, channels, columns, Reads::PerFrame).expect("worth it");
    rows_of_tiles(name, shape, 8 * channels)
}

/// A bench whose units are rows of tiles, as many as the plane has whole ones, in multiply-adds of direct sums of `depth` products.
fn rows_of_tiles(name: &str, shape: Shape, depth: usize) -> Bench {
    let columns = shape.columns;
    let units = shape.plane[0] / shape.scheme.outputs();
    let each = shape.positions(&(0..1)).len();
    let (input, weights) = (values(shape.inputs() * shape.channels, 1.0), values(shape.weights_len(), 0.01));
    let (bias, mut scratch) = (values(columns.next_multiple_of(16), 1.0), values(shape.scratch_len(), 0.0));
    let read = 4 * (input.len() + weights.len());
    Bench::new(name, [units, each * columns], each * depth * columns, read, move |isa, tile_rows, out| {
        let (input, weights, bias) = (&input[..], &weights[..], &bias[..]);
        let args = Winograd { shape, input, weights, bias, relu: true, residual: Residual::None };
        winograd(isa, &args, tile_rows, columns, out, &mut scratch);
    })
}

/// Of `nuscenes-200` at 928 x 1600 pixels, one camera.
pub(crate) fn benches() -> Vec<Bench> {
    let (plane, cube) = ([1, 3, 3], [3; 3]);
    std::vec![
        bench("layer1 3x3 64", [1, 232, 400], plane, 64, 64),
        bench("layer2 3x3 128", [1, 116, 200], plane, 128, 128),
        bench("folded fpn level1 3x3 512-128", [1, 116, 200], plane, 512, 128),
        bench("level1 3x3x3 64", [100, 100, 8], cube, 64, 64),
        bench("refine0 3x3x3 32", [200, 200, 16], cube, 32, 32),
        doubled("up_sample2 128-64", [50, 50, 4], 128, 64),
        doubled("up_sample1 64-32", [100, 100, 8], 64, 32),
    ]
}

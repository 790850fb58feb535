//! [`super::deform_conv2d_i8()`] with any arguments, and at the network's shapes.

use super::{DeformConv2dI8, deform_conv2d_i8};
use crate::cases::draw::span;
use crate::cases::right_i8::{RightI8, left};
use crate::cases::{Bench, Case, Draw, Memory, Output, bytes};
use crate::isa::Isa;
use crate::matmul::int8::scratch_len;
use crate::ops::conv::Geometry;
use std::ops::Range;
use std::vec;
use std::vec::Vec;

struct Call {
    geometry: Geometry,
    rows: Range<usize>,
    stride: usize,
    right: RightI8,
    input: Vec<i8>,
    offsets: Vec<i32>,
    before: Vec<i8>,
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let mut plane = |low, high, depth| [depth, draw.extent(low, high), draw.extent(low, high)];
    let (output, kernel) = (plane(1, 12, 1), plane(1, 3, 1));
    let (stride, dilation, padding, input) = (plane(1, 3, 1), plane(1, 3, 1), plane(0, 3, 0), plane(1, 9, 1));
    let channels = 4 * draw.extent(1, 30);
    let g = Geometry { input, channels, kernel, stride, dilation, padding, output };
    let columns = draw.columns(g.rows() * g.depth())?;
    let rows = draw.rows(g.rows());
    let stride = columns + draw.extent(0, 3);
    let right = RightI8::draw(draw, g.rows(), g.depth(), columns);
    // Any offset, but most within some pixels.
    let mut offset = || if draw.flag() { draw.int32() } else { draw.int32() % 1500 };
    let offsets = (0..g.rows() * 3 * kernel[1] * kernel[2]).map(|_| offset()).collect();
    Some(Call {
        geometry: g,
        offsets,
        input: left(draw, input.iter().product::<usize>() * channels, right.signed),
        before: left(draw, span(rows.len(), stride, columns), true),
        right,
        rows,
        stride,
    })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let (input, offsets, right) = (memory.hold(&self.input), memory.hold(&self.offsets), self.right.hold(memory));
        let args =
            DeformConv2dI8 { geometry: self.geometry, input: &input, offsets: &offsets, product: right.product() };
        let mut scratch = memory.filled(scratch_len(args.product.depth, args.product.columns), i32::MIN);
        let mut out = memory.hold(&self.before);
        deform_conv2d_i8(isa, &args, self.rows.clone(), self.stride, &mut out, &mut scratch);
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
    let input: Vec<i8> = bytes(rows * width).into_iter().map(|x| x.max(0)).collect();
    // Up to three pixels.
    let offsets: Vec<i32> = bytes(rows * 27).into_iter().map(|x| 6 * i32::from(x)).collect();
    let right = RightI8::bench(depth, width, false);
    let mut scratch = vec![0; scratch_len(depth, width)];
    let read = input.len() + 4 * offsets.len() + right.bytes();
    Bench::new(name, [rows, width], depth * width, read, move |isa, rows, out| {
        let args = DeformConv2dI8 { geometry, input: &input, offsets: &offsets, product: right.product() };
        deform_conv2d_i8(isa, &args, rows, width, out, &mut scratch);
    })
}

//! [`super::conv_i8()`] with any arguments, and at the network's shapes.

use super::{ConvI8, conv_i8, conv_i8_wide};
use crate::cases::draw::span;
use crate::cases::right_i8::{RightI8, left};
use crate::cases::{Bench, Case, Draw, Memory, Output, bytes};
use crate::isa::Isa;
use crate::matmul::int8::scratch_len;
use crate::ops::conv::{Geometry, cases};
use std::ops::Range;
use std::vec;
use std::vec::Vec;

struct Call {
    geometry: Geometry,
    rows: Range<usize>,
    stride: usize,
    right: RightI8,
    input: Vec<i8>,
    before: Vec<i8>,
    wide: bool,
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let mut three = |low, high| core::array::from_fn(|_| draw.extent(low, high));
    let (output, kernel) = (three(1, 6), three(1, 3));
    let (stride, dilation, padding, input) = (three(1, 3), three(1, 3), three(0, 3), three(1, 6));
    let channels = if draw.flag() { draw.extent(1, 15) } else { 4 * draw.extent(1, 30) };
    let g = Geometry { input, channels, kernel, stride, dilation, padding, output };
    let columns = draw.columns(g.rows() * g.depth_i8())?;
    let rows = draw.rows(g.rows());
    let stride = columns + draw.extent(0, 3);
    let right = RightI8::draw(draw, g.rows(), g.depth_i8(), columns);
    Some(Call {
        geometry: g,
        input: left(draw, input.iter().product::<usize>() * channels, right.signed),
        before: left(draw, span(rows.len(), stride, columns), true),
        wide: draw.flag(),
        right,
        rows,
        stride,
    })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let (input, right) = (memory.hold(&self.input), self.right.hold(memory));
        let args = ConvI8 { geometry: self.geometry, input: &input, product: right.product() };
        let mut scratch = memory.filled(scratch_len(args.product.depth, args.product.columns), i32::MIN);
        if self.wide {
            let before: Vec<i32> = self.before.iter().copied().map(i32::from).collect();
            let mut out = memory.hold(&before);
            conv_i8_wide(isa, &args, self.rows.clone(), self.stride, &mut out, &mut scratch);
            Output { values: vec![], codes: out.iter().copied().map(i64::from).collect() }
        } else {
            let mut out = memory.hold(&self.before);
            conv_i8(isa, &args, self.rows.clone(), self.stride, &mut out, &mut scratch);
            Output::from(&out[..])
        }
    }
}

/// The convolutions of f32. That of an image reads signed elements, the others what ReLU left.
pub(crate) fn benches() -> Vec<Bench> {
    cases::shapes().into_iter().map(|(name, geometry, columns)| bench(name, geometry, columns)).collect()
}

fn bench(name: &str, geometry: Geometry, columns: usize) -> Bench {
    let (rows, depth, signed) = (geometry.rows(), geometry.depth_i8(), geometry.channels == 3);
    let mut input = bytes(geometry.input.iter().product::<usize>() * geometry.channels);
    input.iter_mut().filter(|_| !signed).for_each(|x| *x = (*x).max(0));
    let right = RightI8::bench(depth, columns, signed);
    let mut scratch = vec![0; scratch_len(depth, columns)];
    let read = input.len() + right.bytes();
    Bench::new(name, [rows, columns], depth * columns, read, move |isa, rows, out| {
        let args = ConvI8 { geometry, input: &input, product: right.product() };
        conv_i8(isa, &args, rows, columns, out, &mut scratch);
    })
}

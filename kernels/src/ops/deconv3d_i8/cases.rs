//! [`super::deconv3d_i8()`] with any arguments, and at the network's shapes.

use super::{Deconv3dI8, deconv3d_i8};
use crate::cases::right_i8::{WeightsI8, left, padded};
use crate::cases::{Bench, Case, Draw, Memory, Output, bytes};
use crate::isa::Isa;
use crate::matmul::int8::scratch_len;
use std::ops::Range;
use std::vec;
use std::vec::Vec;

struct Call {
    extent: [usize; 3],
    channels: usize,
    columns: usize,
    planes: Range<usize>,
    signed: bool,
    input: Vec<i8>,
    weights: WeightsI8,
    bias: Vec<i32>,
    multiplier: Vec<i32>,
    relu: bool,
    add: Option<(Vec<i8>, Vec<i32>)>,
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let extent: [usize; 3] = core::array::from_fn(|_| draw.extent(1, 5));
    let channels = 4 * draw.extent(1, 10);
    let voxels = extent.iter().product::<usize>();
    let columns = draw.columns(voxels * channels * 64)?;
    let signed = draw.flag();
    Some(Call {
        extent,
        channels,
        columns,
        planes: draw.rows(2 * extent[0]),
        signed,
        weights: WeightsI8::draw(draw, 8 * channels, columns, 8),
        input: left(draw, voxels * channels, signed),
        bias: padded(draw, columns, i32::MIN),
        multiplier: padded(draw, columns, 0),
        relu: draw.flag(),
        add: draw.flag().then(|| (left(draw, 8 * voxels * columns, true), padded(draw, columns, i32::MIN))),
    })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let (input, weights) = (memory.hold(&self.input), self.weights.hold(memory));
        let (bias, multiplier) = (memory.hold(&self.bias), memory.hold(&self.multiplier));
        let add = self.add.as_ref().map(|(rows, multiplier)| (memory.hold(rows), memory.hold(multiplier)));
        let plane = 4 * self.extent[1] * self.extent[2] * self.columns;
        let mut out = memory.filled(self.planes.len() * plane, i8::MIN);
        let mut scratch = memory.filled(scratch_len(8 * self.channels, self.columns), i32::MIN);
        let args = Deconv3dI8 {
            extent: self.extent,
            channels: self.channels,
            columns: self.columns,
            input: &input,
            signed: self.signed,
            weights: &weights.packed,
            sums: &weights.sums,
            pairs: &weights.pairs,
            bias: &bias,
            relu: self.relu,
            add: add.as_ref().map(|(rows, multiplier)| (&rows[..], &multiplier[..])),
            multiplier: &multiplier,
        };
        deconv3d_i8(isa, &args, self.planes.clone(), &mut out, &mut scratch);
        Output::from(&out[..])
    }
}

/// The last transposed convolution of `nuscenes-200`.
pub(crate) fn benches() -> Vec<Bench> {
    let (extent, channels, columns): (_, usize, usize) = ([100, 100, 8], 64, 32);
    let [d, h, w] = extent;
    let input: Vec<i8> = bytes(d * h * w * channels).into_iter().map(|x| x.max(0)).collect();
    let weights = WeightsI8::bench(8 * channels, columns, 8);
    let (bias, multiplier) = (vec![1000; columns], vec![1 << 20; columns]);
    let mut scratch = vec![0; scratch_len(8 * channels, columns)];
    let (plane, read) = (4 * h * w * columns, input.len() + weights.packed.len());
    vec![Bench::new("up1 64-32", [2 * d, plane], plane * 8 * channels, read, move |isa, planes, out| {
        let args = Deconv3dI8 {
            extent,
            channels,
            columns,
            input: &input,
            signed: false,
            weights: &weights.packed,
            sums: &weights.sums,
            pairs: &weights.pairs,
            bias: &bias,
            relu: true,
            add: None,
            multiplier: &multiplier,
        };
        deconv3d_i8(isa, &args, planes, out, &mut scratch);
    })]
}

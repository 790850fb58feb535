//! [`super::mean_i8()`] with any arguments, and at the network's shapes.

use super::{MAX_FACTOR, Mean, mean_i8};
use crate::cases::{Bench, Case, Draw, Memory, Output, bytes};
use crate::isa::Isa;
use crate::ops::pool::broadcast;
use std::vec;
use std::vec::Vec;

struct Call {
    channels: usize,
    offset: usize,
    stride: usize,
    factor: i32,
    input: Vec<i8>,
    before: Vec<i8>,
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let (rows, channels) = (draw.extent(1, 300), draw.extent(1, 150));
    let (offset, stride) = (draw.extent(0, 5), channels + 5 + draw.extent(0, 5));
    let factor = draw.int_within(0, MAX_FACTOR);
    let (input, before) = (draw.int8s(rows * channels), draw.int8s(3 * stride));
    Some(Call { channels, offset, stride, factor, input, before })
}

impl Case for Call {
    /// The mean, and its way back.
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let (input, mut out) = (memory.hold(&self.input), memory.hold(&self.before));
        let mut row = memory.filled(self.channels, 55i8);
        mean_i8(isa, &Mean { input: &input[..], channels: self.channels }, self.factor, &mut row);
        broadcast(&row, self.stride, self.offset, &mut out);
        Output::from(&out[..])
    }
}

/// The mean over the plane of level 1 of `nuscenes-200`.
pub(crate) fn benches() -> Vec<Bench> {
    let (rows, channels) = (100 * 100, 64);
    let input = bytes(rows * channels);
    vec![Bench::new("level1 mean 64", [1, channels], rows * channels, input.len(), move |isa, units, out| {
        if !units.is_empty() {
            mean_i8(isa, &Mean { input: &input[..], channels }, 1 << 24, out);
        }
    })]
}

//! [`super::gate_i8()`] with any arguments, and at the network's shapes.

use super::{GateI8, MAX_FACTORS, gate_i8};
use crate::cases::{Bench, Case, Draw, Memory, Output, bytes};
use crate::isa::Isa;
use std::vec;
use std::vec::Vec;

struct Call {
    depth: usize,
    channels: usize,
    bev: Vec<i8>,
    weights: Vec<i8>,
    bias: i32,
    multiplier: i32,
    factors: [i32; 2],
    volume: Vec<i8>,
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let (columns, depth, channels) = (draw.extent(0, 6), draw.extent(1, 20), draw.extent(1, 70));
    let mut weights = draw.int8s(channels);
    weights.resize(channels.next_multiple_of(16), 0);
    Some(Call {
        depth,
        channels,
        bev: draw.int8s(columns * channels),
        weights,
        bias: draw.int32(),
        multiplier: draw.int_within(0, i32::MAX),
        factors: MAX_FACTORS.map(|max| draw.int_within(0, max)),
        volume: draw.int8s(columns * depth * channels),
    })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let [bev, weights] = [&self.bev, &self.weights].map(|x| memory.hold(x));
        let mut volume = memory.hold(&self.volume);
        let Self { depth, channels, bias, multiplier, factors, .. } = *self;
        gate_i8(isa, &GateI8 { bev: &bev, depth, channels, weights: &weights, bias, multiplier, factors }, &mut volume);
        Output::from(&volume[..])
    }
}

/// Level 1 of `nuscenes-200`.
pub(crate) fn benches() -> Vec<Bench> {
    let (columns, depth, channels) = (100 * 100, 8, 64);
    let (bev, weights) = (bytes(columns * channels), bytes(channels));
    let (each, read) = (depth * channels, bev.len() + columns * depth * channels);
    vec![Bench::new("level1 64", [columns, each], 2 * each, read, move |isa, columns, volume| {
        let bev = &bev[columns.start * channels..columns.end * channels];
        let (bias, multiplier, factors) = (300, 1 << 22, [1 << 20, 1 << 10]);
        gate_i8(isa, &GateI8 { bev, depth, channels, weights: &weights, bias, multiplier, factors }, volume);
    })]
}

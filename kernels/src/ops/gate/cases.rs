//! [`super::gate()`] with any arguments, and at the network's shapes.

use super::{Gate, gate};
use crate::cases::{Bench, Case, Draw, Exact, Memory, Output, values};
use crate::isa::Isa;
use std::vec;
use std::vec::Vec;

struct Call {
    depth: usize,
    channels: usize,
    bev: Vec<f32>,
    weights: Vec<f32>,
    bias: f32,
    volume: Vec<f32>,
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let (columns, depth, channels) = (draw.extent(0, 6), draw.extent(1, 20), draw.extent(1, 70));
    let mut weights = draw.values(channels);
    weights.resize(channels.next_multiple_of(16), 0.0);
    let (bev, bias) = (draw.values(columns * channels), draw.value());
    Some(Call { depth, channels, bev, weights, bias, volume: draw.values(columns * depth * channels) })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let [bev, weights] = [&self.bev, &self.weights].map(|x| memory.hold(x));
        let mut volume = memory.hold(&self.volume);
        let (depth, channels, bias) = (self.depth, self.channels, self.bias);
        gate(isa, &Gate { bev: &bev, depth, channels, weights: &weights, bias }, &mut volume);
        Output::from(&volume[..])
    }

    fn exact(&self) -> Option<Exact> {
        let (depth, channels) = (self.depth, self.channels);
        let value = |(i, &volume): (usize, &f32)| {
            let voxel = &self.volume[i / channels * channels..][..channels];
            let products = voxel.iter().zip(&self.weights).map(|(x, w)| f64::from(*x) * f64::from(*w));
            let gate = 1.0 / (1.0 + (-(products.sum::<f64>() + f64::from(self.bias))).exp());
            f64::from(volume) + gate * f64::from(self.bev[i / (channels * depth) * channels + i % channels])
        };
        Some(Exact { values: self.volume.iter().enumerate().map(value).collect(), tolerance: 1e-6 })
    }
}

/// Level 1 of `nuscenes-200`.
pub(crate) fn benches() -> Vec<Bench> {
    let (columns, depth, channels) = (100 * 100, 8, 64);
    let (bev, weights) = (values(columns * channels, 1.0), values(channels, 0.1));
    let (each, read) = (depth * channels, 4 * (bev.len() + columns * depth * channels));
    vec![Bench::new("level1 64", [columns, each], 2 * each, read, move |isa, columns, volume| {
        let bev = &bev[columns.start * channels..columns.end * channels];
        gate(isa, &Gate { bev, depth, channels, weights: &weights, bias: 0.1 }, volume);
    })]
}

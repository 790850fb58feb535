//! [`super::mean()`] with any arguments, and at the network's shapes.

use super::{Mean, broadcast, mean};
use crate::cases::{Bench, Case, Draw, Exact, Memory, Output, values};
use crate::isa::Isa;
use std::vec;
use std::vec::Vec;

struct Call {
    channels: usize,
    offset: usize,
    stride: usize,
    input: Vec<f32>,
    before: Vec<f32>,
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let (rows, channels) = (draw.extent(1, 40), draw.extent(1, 70));
    let (offset, stride) = (draw.extent(0, 5), channels + 5 + draw.extent(0, 5));
    let (input, before) = (draw.values(rows * channels), draw.values(rows * stride));
    Some(Call { channels, offset, stride, input, before })
}

impl Case for Call {
    /// The mean, and its way back.
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let (input, mut out) = (memory.hold(&self.input), memory.hold(&self.before));
        let mut row = memory.filled(self.channels, f32::NAN);
        mean(isa, &Mean { input: &input, channels: self.channels }, &mut row);
        broadcast(&row, self.stride, self.offset, &mut out);
        Output::from(&out[..])
    }

    fn exact(&self) -> Option<Exact> {
        let rows = self.input.len() / self.channels;
        let sum = |c: usize| self.input.iter().skip(c).step_by(self.channels).map(|&v| f64::from(v)).sum::<f64>();
        let value = |(i, &before): (usize, &f32)| {
            let channel = (i % self.stride).checked_sub(self.offset).filter(|&c| c < self.channels);
            channel.map_or(f64::from(before), |c| sum(c) / rows as f64)
        };
        Some(Exact { values: self.before.iter().enumerate().map(value).collect(), tolerance: 1e-6 })
    }
}

/// The mean over the plane of level 1 of `nuscenes-200`.
pub(crate) fn benches() -> Vec<Bench> {
    let (rows, channels) = (100 * 100, 64);
    let input = values(rows * channels, 1.0);
    vec![Bench::new("level1 mean 64", [1, channels], rows * channels, 4 * input.len(), move |isa, units, out| {
        if !units.is_empty() {
            mean(isa, &Mean { input: &input, channels }, out);
        }
    })]
}

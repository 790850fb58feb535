//! [`super::scale_shift()`] with any arguments, and at the network's shapes.

use super::{ScaleShift, scale_shift};
use crate::cases::{Bench, Case, Draw, Exact, Memory, Output, values};
use crate::isa::Isa;
use std::vec;
use std::vec::Vec;

struct Call {
    channels: usize,
    first_channel: usize,
    stride: usize,
    scale: Vec<f32>,
    shift: Vec<f32>,
    residual: Option<Vec<f32>>,
    residual_after: bool,
    relu: bool,
    before: Vec<f32>,
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let (rows, channels, first_channel) = (draw.extent(0, 12), draw.extent(1, 70), draw.extent(0, 20));
    let stride = first_channel + channels + draw.extent(0, 20);
    let padded = channels.next_multiple_of(16);
    Some(Call {
        channels,
        first_channel,
        stride,
        scale: draw.values(padded),
        shift: draw.values(padded),
        residual: draw.maybe(rows * stride),
        residual_after: draw.flag(),
        relu: draw.flag(),
        before: draw.values(rows * stride),
    })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let [scale, shift] = [&self.scale, &self.shift].map(|x| memory.hold(x));
        let residual = self.residual.as_ref().map(|residual| memory.hold(residual));
        let mut rows = memory.hold(&self.before);
        let args = ScaleShift {
            scale: &scale,
            shift: &shift,
            channels: self.channels,
            first_channel: self.first_channel,
            stride: self.stride,
            residual: residual.as_deref(),
            residual_after: self.residual_after,
            relu: self.relu,
        };
        scale_shift(isa, &args, &mut rows);
        Output::from(&rows[..])
    }

    fn exact(&self) -> Option<Exact> {
        let value = |(i, &before): (usize, &f32)| {
            let channel = (i % self.stride).checked_sub(self.first_channel).filter(|&c| c < self.channels);
            let Some(c) = channel else { return f64::from(before) };
            let [x, scale, shift] = [before, self.scale[c], self.shift[c]].map(f64::from);
            let residual = self.residual.as_ref().map_or(0.0, |residual| f64::from(residual[i]));
            let [sooner, later] = if self.residual_after { [0.0, residual] } else { [residual, 0.0] };
            let sum = x * scale + shift + sooner;
            later + if self.relu { sum.max(0.0) } else { sum }
        };
        Some(Exact { values: self.before.iter().enumerate().map(value).collect(), tolerance: 3e-7 })
    }
}

/// A batch norm over the volume of level 1 of `nuscenes-200`, as an unfolded network has it.
pub(crate) fn benches() -> Vec<Bench> {
    let (rows, channels) = (100 * 100 * 8, 64);
    let (scale, shift) = (values(channels, 0.9), values(channels, 1.0));
    vec![Bench::new("level1 volume 64", [rows, channels], channels, 4 * rows * channels, move |isa, _, out| {
        let args = ScaleShift {
            scale: &scale,
            shift: &shift,
            channels,
            first_channel: 0,
            stride: channels,
            residual: None,
            residual_after: false,
            relu: true,
        };
        scale_shift(isa, &args, out);
    })]
}

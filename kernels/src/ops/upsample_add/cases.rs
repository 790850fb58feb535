//! [`super::upsample_add()`] with any arguments, and at the network's shapes.

use super::{UpsampleAdd, upsample_add};
use crate::cases::{Bench, Case, Draw, Exact, Memory, Output, values};
use crate::isa::Isa;
use std::ops::Range;
use std::vec;
use std::vec::Vec;

struct Call {
    low: [usize; 2],
    high: [usize; 2],
    channels: usize,
    rows: Range<usize>,
    input: Vec<f32>,
    before: Vec<f32>,
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let [low_height, low_width, height, width] = core::array::from_fn(|_| draw.extent(1, 8));
    let (channels, rows) = (draw.extent(1, 40), draw.rows(height));
    let input = draw.values(low_height * low_width * channels);
    let before = draw.values(rows.len() * width * channels);
    Some(Call { low: [low_height, low_width], high: [height, width], channels, rows, input, before })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let ([low_height, low_width], [height, width], channels) = (self.low, self.high, self.channels);
        let (low, mut out) = (memory.hold(&self.input), memory.hold(&self.before));
        let args = UpsampleAdd { low: &low, low_height, low_width, height, width, channels };
        upsample_add(isa, &args, self.rows.clone(), &mut out);
        Output::from(&out[..])
    }

    fn exact(&self) -> Option<Exact> {
        let ([low_height, low_width], [height, width], channels) = (self.low, self.high, self.channels);
        let nearest =
            |at: usize, low: usize, high: usize| (at as f64 * low as f64 / high as f64 + 1e-9).floor() as usize;
        let value = |(i, &before): (usize, &f32)| {
            let (y, x, c) = (self.rows.start + i / channels / width, i / channels % width, i % channels);
            let at = nearest(y, low_height, height) * low_width + nearest(x, low_width, width);
            f64::from(before) + f64::from(self.input[at * channels + c])
        };
        Some(Exact { values: self.before.iter().enumerate().map(value).collect(), tolerance: 1e-7 })
    }
}

/// The pyramid's last step in `nuscenes-200`.
pub(crate) fn benches() -> Vec<Bench> {
    let (low_height, low_width, height, width, channels) = (58, 100, 116, 200, 512);
    let low = values(low_height * low_width * channels, 1.0);
    let (line, read) = (width * channels, 4 * (low.len() + height * width * channels));
    vec![Bench::new("fpn level1 512", [height, line], 0, read, move |isa, rows, out| {
        let args = UpsampleAdd { low: &low, low_height, low_width, height, width, channels };
        upsample_add(isa, &args, rows, out);
    })]
}

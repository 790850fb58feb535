//! [`super::upsample_add_i8()`] with any arguments, and at the network's shapes.

use super::{UpsampleAdd, upsample_add_i8};
use crate::cases::{Bench, Case, Draw, Memory, Output, bytes};
use crate::isa::Isa;
use std::ops::Range;
use std::vec;
use std::vec::Vec;

struct Call {
    low: [usize; 2],
    high: [usize; 2],
    channels: usize,
    rows: Range<usize>,
    factors: [i16; 2],
    input: Vec<i8>,
    before: Vec<i8>,
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let [low_height, low_width, height, width] = core::array::from_fn(|_| draw.extent(1, 8));
    let (channels, rows) = (draw.extent(1, 40), draw.rows(height));
    let factors = core::array::from_fn(|_| draw.int_within(0, i16::MAX.into()) as i16);
    let input = draw.int8s(low_height * low_width * channels);
    let before = draw.int8s(rows.len() * width * channels);
    Some(Call { low: [low_height, low_width], high: [height, width], channels, rows, factors, input, before })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let ([low_height, low_width], [height, width], channels) = (self.low, self.high, self.channels);
        let (low, mut out) = (memory.hold(&self.input), memory.hold(&self.before));
        let args = UpsampleAdd { low: &low[..], low_height, low_width, height, width, channels };
        upsample_add_i8(isa, &args, self.factors, self.rows.clone(), &mut out);
        Output::from(&out[..])
    }
}

/// The pyramid's last step in `nuscenes-200`.
pub(crate) fn benches() -> Vec<Bench> {
    let (low_height, low_width, height, width, channels) = (58, 100, 116, 200, 512);
    let low = bytes(low_height * low_width * channels);
    let (line, read) = (width * channels, low.len() + height * width * channels);
    vec![Bench::new("fpn level1 512", [height, line], 0, read, move |isa, rows, out| {
        let args = UpsampleAdd { low: &low[..], low_height, low_width, height, width, channels };
        upsample_add_i8(isa, &args, [6000, 5000], rows, out);
    })]
}

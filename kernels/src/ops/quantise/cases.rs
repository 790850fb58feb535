//! [`super::quantise()`] with any arguments, and at the network's shapes.

use super::quantise;
use crate::cases::{Bench, Case, Draw, Memory, Output, values};
use crate::isa::Isa;
use std::vec;
use std::vec::Vec;

struct Call {
    inverse: f32,
    input: Vec<f32>,
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let n = draw.extent(0, 200);
    let inverse = if draw.flag() { 127.0 } else { draw.value() };
    Some(Call { inverse, input: draw.values(n) })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let input = memory.hold(&self.input);
        let mut out = memory.filled(input.len(), 55i8);
        quantise(isa, &input, self.inverse, &mut out);
        Output::from(&out[..])
    }
}

/// The plane of level 1 of `nuscenes-200`, after window attention.
pub(crate) fn benches() -> Vec<Bench> {
    let (rows, line) = (100, 100 * 64);
    let input = values(rows * line, 1.0);
    vec![Bench::new("level1 64", [rows, line], 0, 4 * input.len(), move |isa, rows, out| {
        quantise(isa, &input[rows.start * line..rows.end * line], 120.0, out);
    })]
}

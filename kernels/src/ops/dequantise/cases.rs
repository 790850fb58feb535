//! [`super::dequantise()`] with any arguments, and at the network's shapes.

use super::dequantise;
use crate::cases::{Bench, Case, Draw, Memory, Output, bytes};
use crate::isa::Isa;
use std::vec;
use std::vec::Vec;

struct Call {
    scale: f32,
    input: Vec<i8>,
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let n = draw.extent(0, 200);
    Some(Call { scale: draw.value(), input: draw.int8s(n) })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let input = memory.hold(&self.input);
        let mut out = memory.filled(input.len(), f32::NAN);
        dequantise(isa, &input, self.scale, &mut out);
        Output::from(&out[..])
    }
}

/// The plane of level 1 of `nuscenes-200`, before window attention.
pub(crate) fn benches() -> Vec<Bench> {
    let (rows, line) = (100, 100 * 64);
    let input = bytes(rows * line);
    vec![Bench::new("level1 64", [rows, line], 0, input.len(), move |isa, rows, out| {
        dequantise(isa, &input[rows.start * line..rows.end * line], 0.01, out);
    })]
}

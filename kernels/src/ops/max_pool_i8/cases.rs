//! [`super::max_pool_i8()`] with any arguments, and at the network's shapes.

use super::{MaxPool, max_pool_i8};
use crate::cases::{Bench, Case, Draw, Memory, Output, bytes};
use crate::isa::Isa;
use std::ops::Range;
use std::vec;
use std::vec::Vec;

struct Call {
    shape: [usize; 3],
    window: [usize; 3],
    rows: Range<usize>,
    input: Vec<i8>,
}

fn args(input: &[i8], [height, width, channels]: [usize; 3], [kernel, stride, padding]: [usize; 3]) -> MaxPool<'_, i8> {
    MaxPool { input, height, width, channels, kernel, stride, padding }
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let shape = [draw.extent(1, 9), draw.extent(1, 9), draw.extent(1, 150)];
    let (kernel, stride) = (draw.extent(1, 5), draw.extent(1, 4));
    let window = [kernel, stride, draw.extent(0, kernel - 1)];
    if shape[0].min(shape[1]) + 2 * window[2] < kernel {
        return None;
    }
    let input = draw.int8s(shape.iter().product());
    let rows = draw.rows(args(&input, shape, window).output()[0]);
    Some(Call { shape, window, rows, input })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let input = memory.hold(&self.input);
        let args = args(&input, self.shape, self.window);
        let mut out = memory.filled(self.rows.len() * args.output()[1] * args.channels, 55i8);
        max_pool_i8(isa, &args, self.rows.clone(), &mut out);
        Output::from(&out[..])
    }
}

/// After the stem of `nuscenes-200`.
pub(crate) fn benches() -> Vec<Bench> {
    let (shape, window) = ([464, 800, 64], [3, 2, 1]);
    let input = bytes(shape.iter().product());
    let ([height, width], read) = (args(&input, shape, window).output(), input.len());
    vec![Bench::new("stem 3x3 64", [height, width * 64], 0, read, move |isa, rows, out| {
        max_pool_i8(isa, &args(&input, shape, window), rows, out);
    })]
}

//! [`super::max_pool()`] with any arguments, and at the network's shapes.

use super::{MaxPool, max_pool};
use crate::cases::{Bench, Case, Draw, Exact, Memory, Output, values};
use crate::isa::Isa;
use std::ops::Range;
use std::vec;
use std::vec::Vec;

struct Call {
    shape: [usize; 3],
    window: [usize; 3],
    rows: Range<usize>,
    input: Vec<f32>,
}

fn args(input: &[f32], [height, width, channels]: [usize; 3], [kernel, stride, padding]: [usize; 3]) -> MaxPool<'_> {
    MaxPool { input, height, width, channels, kernel, stride, padding }
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let shape = [draw.extent(1, 9), draw.extent(1, 9), draw.extent(1, 40)];
    let (kernel, stride) = (draw.extent(1, 5), draw.extent(1, 4));
    let window = [kernel, stride, draw.extent(0, kernel - 1)];
    if shape[0].min(shape[1]) + 2 * window[2] < kernel {
        return None;
    }
    let input = draw.values(shape.iter().product());
    let rows = draw.rows(args(&input, shape, window).output()[0]);
    Some(Call { shape, window, rows, input })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let input = memory.hold(&self.input);
        let args = args(&input, self.shape, self.window);
        let mut out = memory.filled(self.rows.len() * args.output()[1] * args.channels, f32::NAN);
        max_pool(isa, &args, self.rows.clone(), &mut out);
        Output::from(&out[..])
    }

    fn exact(&self) -> Option<Exact> {
        let ([height, width, channels], [kernel, stride, padding]) = (self.shape, self.window);
        let mut padded = vec![f64::NEG_INFINITY; (height + 2 * padding) * (width + 2 * padding) * channels];
        let place = |y: usize, x: usize, c: usize| (y * (width + 2 * padding) + x) * channels + c;
        for (i, &v) in self.input.iter().enumerate() {
            let (y, x, c) = (i / channels / width, i / channels % width, i % channels);
            padded[place(y + padding, x + padding, c)] = f64::from(v);
        }
        let mut values = Vec::new();
        for y in self.rows.clone().map(|row| row * stride) {
            for x in (0..=width + 2 * padding - kernel).step_by(stride) {
                let taps = (y..y + kernel).flat_map(|y| (x..x + kernel).map(move |x| (y, x)));
                values.extend(
                    (0..channels)
                        .map(|c| taps.clone().map(|(y, x)| padded[place(y, x, c)]).fold(f64::NEG_INFINITY, f64::max)),
                );
            }
        }
        Some(Exact { values, tolerance: 0.0 })
    }
}

/// After the stem of `nuscenes-200`.
pub(crate) fn benches() -> Vec<Bench> {
    let (shape, window) = ([464, 800, 64], [3, 2, 1]);
    let input = values(shape.iter().product(), 1.0);
    let ([height, width], read) = (args(&input, shape, window).output(), 4 * input.len());
    vec![Bench::new("stem 3x3 64", [height, width * 64], 0, read, move |isa, rows, out| {
        max_pool(isa, &args(&input, shape, window), rows, out);
    })]
}

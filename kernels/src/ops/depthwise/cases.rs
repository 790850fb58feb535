//! [`super::depthwise()`] with any arguments, and at the network's shapes.

use super::{Depthwise, depthwise};
use crate::cases::{Bench, Case, Draw, Exact, MAX_WORK, Memory, Output, values};
use crate::isa::Isa;
use std::ops::Range;
use std::vec::Vec;

struct Call {
    shape: [usize; 3],
    kernel: usize,
    rows: Range<usize>,
    residual: bool,
    input: Vec<f32>,
    weights: Vec<f32>,
    bias: Vec<f32>,
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let shape = [draw.extent(1, 6), draw.extent(1, 30), draw.extent(1, 70)];
    let kernel = 2 * draw.extent(0, 4) + 1;
    let len = shape.iter().product::<usize>();
    let padded = shape[2].next_multiple_of(16);
    (len * kernel * kernel <= MAX_WORK).then(|| Call {
        shape,
        kernel,
        rows: draw.rows(shape[0]),
        residual: draw.flag(),
        input: draw.values(len),
        weights: draw.values(kernel * kernel * padded),
        bias: draw.values(padded),
    })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let [height, width, channels] = self.shape;
        let [input, weights, bias] = [&self.input, &self.weights, &self.bias].map(|x| memory.hold(x));
        let mut out = memory.filled(self.rows.len() * width * channels, f32::NAN);
        let (input, weights, bias) = (&input[..], &weights[..], &bias[..]);
        let (kernel, residual) = (self.kernel, self.residual);
        let args = Depthwise { input, height, width, channels, kernel, weights, bias, residual };
        depthwise(isa, &args, self.rows.clone(), &mut out);
        Output::from(&out[..])
    }

    fn exact(&self) -> Option<Exact> {
        let [height, width, channels] = self.shape;
        let (half, padded) = (self.kernel / 2, channels.next_multiple_of(16));
        let mut values = Vec::new();
        for (y, x, c) in
            self.rows.clone().flat_map(|y| (0..width).flat_map(move |x| (0..channels).map(move |c| (y, x, c))))
        {
            let mut sum = f64::from(self.bias[c]);
            for (ky, kx) in (0..self.kernel).flat_map(|ky| (0..self.kernel).map(move |kx| (ky, kx))) {
                let inside = |at: usize, size: usize| at.checked_sub(half).filter(|&at| at < size);
                if let (Some(y), Some(x)) = (inside(y + ky, height), inside(x + kx, width)) {
                    let weight = self.weights[(ky * self.kernel + kx) * padded + c];
                    sum += f64::from(weight) * f64::from(self.input[(y * width + x) * channels + c]);
                }
            }
            let residual = if self.residual { f64::from(self.input[(y * width + x) * channels + c]) } else { 0.0 };
            values.push(sum + residual);
        }
        Some(Exact { values, tolerance: 1e-5 })
    }
}

/// The plane of level 1 of `nuscenes-200` and that of level 3.
pub(crate) fn benches() -> Vec<Bench> {
    let planes = [("level1 3x3 64", 100, 64, 3), ("level3 3x3 256", 25, 256, 3)];
    let bench = |(name, side, channels, kernel): (_, usize, usize, usize)| {
        let input = values(side * side * channels, 1.0);
        let (weights, bias) = (values(kernel * kernel * channels, 0.2), values(channels, 1.0));
        let (line, read) = (side * channels, 4 * input.len());
        Bench::new(name, [side, line], line * kernel * kernel, read, move |isa, rows, out| {
            let (input, weights, bias) = (&input[..], &weights[..], &bias[..]);
            let (height, width, residual) = (side, side, true);
            let args = Depthwise { input, height, width, channels, kernel, weights, bias, residual };
            depthwise(isa, &args, rows, out);
        })
    };
    planes.map(bench).into()
}

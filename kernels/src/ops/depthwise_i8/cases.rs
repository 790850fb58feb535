//! [`super::depthwise_i8()`] with any arguments, and at the network's shapes.

use super::{Depthwise, DepthwiseI8, depthwise_i8};
use crate::cases::{Bench, Case, Draw, MAX_WORK, Memory, Output, bytes};
use crate::isa::Isa;
use std::ops::Range;
use std::vec;
use std::vec::Vec;

struct Call {
    shape: [usize; 3],
    kernel: usize,
    rows: Range<usize>,
    input: Vec<i8>,
    weights: Vec<i8>,
    bias: Vec<i32>,
    residual: Vec<i32>,
    multiplier: Vec<i32>,
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
        residual: if draw.flag() { draw.ints_within(padded, i32::MIN, i32::MAX) } else { vec![] },
        input: draw.int8s(len),
        weights: draw.int8s(kernel * kernel * padded),
        bias: draw.ints_within(padded, i32::MIN, i32::MAX),
        multiplier: draw.ints_within(padded, 0, i32::MAX),
    })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let [height, width, channels] = self.shape;
        let [input, weights] = [&self.input, &self.weights].map(|x| memory.hold(x));
        let [bias, residual, multiplier] = [&self.bias, &self.residual, &self.multiplier].map(|x| memory.hold(x));
        let mut out = memory.filled(self.rows.len() * width * channels, 55i8);
        let convolution = Depthwise {
            input: &input[..],
            height,
            width,
            channels,
            kernel: self.kernel,
            weights: &weights[..],
            bias: &bias[..],
            residual: !residual.is_empty(),
        };
        let args = DepthwiseI8 { convolution, residual: &residual, multiplier: &multiplier };
        depthwise_i8(isa, &args, self.rows.clone(), &mut out);
        Output::from(&out[..])
    }
}

/// The plane of level 1 of `nuscenes-200` and that of level 3.
pub(crate) fn benches() -> Vec<Bench> {
    let planes = [("level1 3x3 64", 100, 64, 3), ("level3 3x3 256", 25, 256, 3)];
    let bench = |(name, side, channels, kernel): (_, usize, usize, usize)| {
        let (input, weights) = (bytes(side * side * channels), bytes(kernel * kernel * channels));
        let (bias, residual, multiplier) = (vec![1000; channels], vec![100; channels], vec![20_000_000; channels]);
        let (line, read) = (side * channels, input.len());
        Bench::new(name, [side, line], line * kernel * kernel, read, move |isa, rows, out| {
            let (input, weights, bias) = (&input[..], &weights[..], &bias[..]);
            let (height, width) = (side, side);
            let convolution = Depthwise { input, height, width, channels, kernel, weights, bias, residual: true };
            let args = DepthwiseI8 { convolution, residual: &residual, multiplier: &multiplier };
            depthwise_i8(isa, &args, rows, out);
        })
    };
    planes.map(bench).into()
}

//! Convolutions on every instruction set, compared in bits with the scalar code.

#![no_main]

use libfuzzer_sys::fuzz_target;
use voxcast_fuzz::differential::{Input, Right, every_isa, span};
use voxcast_kernels::conv::{Conv, Geometry, conv};
use voxcast_kernels::product::SCRATCH;

fuzz_target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let mut three = |low, high| std::array::from_fn(|_| input.extent(low, high));
    let (output, kernel) = (three(1, 6), three(1, 3));
    let (stride, dilation, padding, extent) = (three(1, 3), three(1, 3), three(0, 3), three(1, 6));
    let channels = input.extent(1, 80);
    let g = Geometry { input: extent, channels, kernel, stride, dilation, padding, output };
    let Some(columns) = input.columns(g.rows() * g.depth()) else { return };
    let rows = input.rows(g.rows());
    let stride = columns + input.extent(0, 3);
    let right = Right::new(&mut input, g.rows(), g.depth(), columns);
    let image = input.numbers(extent.iter().product::<usize>() * channels);
    let before = input.numbers(span(rows.len(), stride, columns));
    let args = Conv { geometry: g, input: &image, product: right.product() };
    every_isa(&before, |isa, out| conv(isa, &args, rows.clone(), stride, out, &mut [f32::NAN; SCRATCH]));
});

//! Deformable convolutions on every instruction set, compared in bits with the scalar code.

#![no_main]

use libfuzzer_sys::fuzz_target;
use voxcast_fuzz::differential::{Input, Right, every_isa, span};
use voxcast_kernels::conv::Geometry;
use voxcast_kernels::deform_conv2d::{DeformConv2d, deform_conv2d};
use voxcast_kernels::product::SCRATCH;

fuzz_target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let mut plane = |low, high, depth| [depth, input.extent(low, high), input.extent(low, high)];
    let (output, kernel) = (plane(1, 12, 1), plane(1, 3, 1));
    let (stride, dilation, padding, extent) = (plane(1, 3, 1), plane(1, 3, 1), plane(0, 3, 0), plane(1, 9, 1));
    let channels = input.extent(1, 80);
    let g = Geometry { input: extent, channels, kernel, stride, dilation, padding, output };
    let Some(columns) = input.columns(g.rows() * g.depth()) else { return };
    let rows = input.rows(g.rows());
    let stride = columns + input.extent(0, 3);
    let offsets = input.numbers(g.rows() * 3 * kernel[1] * kernel[2]);
    let right = Right::new(&mut input, g.rows(), g.depth(), columns);
    let image = input.numbers(extent.iter().product::<usize>() * channels);
    let before = input.numbers(span(rows.len(), stride, columns));
    let args = DeformConv2d { geometry: g, input: &image, offsets: &offsets, product: right.product() };
    every_isa(&before, |isa, out| deform_conv2d(isa, &args, rows.clone(), stride, out, &mut [f32::NAN; SCRATCH]));
});

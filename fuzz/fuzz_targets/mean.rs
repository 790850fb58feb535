//! Global means, and their way back, on every instruction set, compared in bits with the scalar code.

#![no_main]

use libfuzzer_sys::fuzz_target;
use voxcast_fuzz::differential::{Input, every_isa};
use voxcast_kernels::pool::{Mean, broadcast, mean};

fuzz_target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let (rows, channels) = (input.extent(1, 40), input.extent(1, 70));
    let (offset, stride) = (input.extent(0, 5), channels + 5 + input.extent(0, 5));
    let image = input.numbers(rows * channels);
    let before = input.numbers(rows * stride);
    every_isa(&before, |isa, out| {
        let mut row = vec![f32::NAN; channels];
        mean(isa, &Mean { input: &image, channels }, &mut row);
        broadcast(&row, stride, offset, out);
    });
});

//! Depthwise convolutions on every instruction set, compared in bits with the scalar code.

#![no_main]

use libfuzzer_sys::fuzz_target;
use voxcast_fuzz::differential::{Input, MAX_WORK, every_isa};
use voxcast_kernels::depthwise::{Depthwise, depthwise};

fuzz_target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let (height, width, channels) = (input.extent(1, 6), input.extent(1, 30), input.extent(1, 70));
    let kernel = 2 * input.extent(0, 4) + 1;
    if height * width * channels * kernel * kernel > MAX_WORK {
        return;
    }
    let (rows, residual) = (input.rows(height), input.flag());
    let padded = channels.next_multiple_of(16);
    let image = input.numbers(height * width * channels);
    let (weights, bias) = (input.numbers(kernel * kernel * padded), input.numbers(padded));
    let before = input.numbers(rows.len() * width * channels);
    let args = Depthwise { input: &image, height, width, channels, kernel, weights: &weights, bias: &bias, residual };
    every_isa(&before, |isa, out| depthwise(isa, &args, rows.clone(), out));
});

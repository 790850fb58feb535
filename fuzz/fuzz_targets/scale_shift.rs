//! Scaling on every instruction set, compared in bits with the scalar code.

#![no_main]

use libfuzzer_sys::fuzz_target;
use voxcast_fuzz::differential::{Input, every_isa};
use voxcast_kernels::scale_shift::{ScaleShift, scale_shift};

fuzz_target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let (rows, channels, first_channel) = (input.extent(0, 12), input.extent(1, 70), input.extent(0, 20));
    let stride = first_channel + channels + input.extent(0, 20);
    let padded = channels.next_multiple_of(16);
    let (scale, shift) = (input.numbers(padded), input.numbers(padded));
    let (residual, residual_after, relu) = (input.maybe(rows * stride), input.flag(), input.flag());
    let before = input.numbers(rows * stride);
    let residual = residual.as_deref();
    let args =
        ScaleShift { scale: &scale, shift: &shift, channels, first_channel, stride, residual, residual_after, relu };
    every_isa(&before, |isa, out| scale_shift(isa, &args, out));
});

//! Max pooling on every instruction set, compared in bits with the scalar code.

#![no_main]

use libfuzzer_sys::fuzz_target;
use voxcast_fuzz::differential::{Input, every_isa};
use voxcast_kernels::max_pool::{MaxPool, max_pool};

fuzz_target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let (height, width, channels) = (input.extent(1, 9), input.extent(1, 9), input.extent(1, 40));
    let (kernel, stride) = (input.extent(1, 5), input.extent(1, 4));
    let padding = input.extent(0, kernel - 1);
    if height.min(width) + 2 * padding < kernel {
        return;
    }
    let image = input.numbers(height * width * channels);
    let args = MaxPool { input: &image, height, width, channels, kernel, stride, padding };
    let [height, width] = args.output();
    let rows = input.rows(height);
    every_isa(&vec![f32::NAN; rows.len() * width * channels], |isa, out| max_pool(isa, &args, rows.clone(), out));
});

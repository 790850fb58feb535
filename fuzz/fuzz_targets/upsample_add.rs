//! Enlargement on every instruction set, compared in bits with the scalar code.

#![no_main]

use libfuzzer_sys::fuzz_target;
use voxcast_fuzz::differential::{Input, every_isa};
use voxcast_kernels::upsample_add::{UpsampleAdd, upsample_add};

fuzz_target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let [low_height, low_width, height, width] = std::array::from_fn(|_| input.extent(1, 8));
    let channels = input.extent(1, 40);
    let rows = input.rows(height);
    let low = input.numbers(low_height * low_width * channels);
    let before = input.numbers(rows.len() * width * channels);
    let args = UpsampleAdd { low: &low, low_height, low_width, height, width, channels };
    every_isa(&before, |isa, out| upsample_add(isa, &args, rows.clone(), out));
});

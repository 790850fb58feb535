//! Gates on every instruction set, compared in bits with the scalar code.

#![no_main]

use libfuzzer_sys::fuzz_target;
use voxcast_fuzz::differential::{Input, every_isa};
use voxcast_kernels::gate::{Gate, gate};

fuzz_target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let (columns, depth, channels) = (input.extent(0, 6), input.extent(1, 20), input.extent(1, 70));
    let mut weights = input.numbers(channels);
    weights.resize(channels.next_multiple_of(16), 0.0);
    let (bev, bias) = (input.numbers(columns * channels), input.number());
    let volume = input.numbers(columns * depth * channels);
    let args = Gate { bev: &bev, depth, channels, weights: &weights, bias };
    every_isa(&volume, |isa, volume| gate(isa, &args, volume));
});

//! Gathered means on every instruction set, compared in bits with the scalar code.

#![no_main]

use libfuzzer_sys::fuzz_target;
use voxcast_fuzz::differential::{Input, every_isa};
use voxcast_kernels::gather::{Gather, Mask, gather};

fuzz_target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let (cameras, per_camera) = (input.extent(1, 5), input.extent(1, 8));
    let (pixels, channels, first_channel) = (cameras * per_camera, input.extent(0, 150), input.extent(0, 5));
    let stride = first_channel + channels + input.extent(0, 3);
    let mut ptr = vec![0];
    for _ in 0..input.extent(0, 12) {
        ptr.push(ptr[ptr.len() - 1] + input.byte() as u32 % 20);
    }
    let mut col: Vec<u32> = (0..ptr[ptr.len() - 1]).map(|_| input.extent(0, pixels - 1) as u32).collect();
    let masked: Vec<bool> = (0..cameras).map(|_| input.flag()).collect();
    let mask = input.flag().then_some(Mask { pixels: per_camera, masked: &masked });
    if mask.is_some() {
        ptr.windows(2).for_each(|row| col[row[0] as usize..row[1] as usize].sort_unstable());
    }
    let (rows, relu) = (input.rows(ptr.len() - 1), input.flag());
    let (features, bias) = (input.numbers(pixels * stride), input.maybe(channels));
    let before = input.numbers(rows.len() * channels);
    let args = Gather {
        ptr: &ptr,
        col: &col,
        mask,
        features: &features,
        stride,
        first_channel,
        channels,
        bias: bias.as_deref(),
        relu,
    };
    every_isa(&before, |isa, out| gather(isa, &args, rows.clone(), out));
});

//! Transposed convolutions on every instruction set, compared in bits with the scalar code.

#![no_main]

use libfuzzer_sys::fuzz_target;
use voxcast_fuzz::differential::{Input, Weights, every_isa};
use voxcast_kernels::deconv3d::{Deconv3d, deconv3d};
use voxcast_kernels::panels::packed_len;
use voxcast_kernels::product::SCRATCH;

fuzz_target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let extent = std::array::from_fn(|_| input.extent(1, 6));
    let channels = input.extent(1, 40);
    let voxels = extent.iter().product::<usize>();
    let Some(columns) = input.columns(voxels * channels * 64) else { return };
    let planes = input.rows(2 * extent[0]);
    let plane = 4 * extent[1] * extent[2] * columns;
    let weights = Weights::new(&mut input, 8 * packed_len(8 * channels, columns));
    let (volume, bias) = (input.numbers(voxels * channels), input.numbers(columns.next_multiple_of(16)));
    let (relu, add) = (input.flag(), input.maybe(2 * extent[0] * plane));
    let before = input.numbers(planes.len() * plane);
    let args = Deconv3d {
        extent,
        channels,
        columns,
        input: &volume,
        weights: weights.panels(),
        bias: &bias,
        relu,
        add: add.as_deref(),
    };
    every_isa(&before, |isa, out| deconv3d(isa, &args, planes.clone(), out, &mut [f32::NAN; SCRATCH]));
});

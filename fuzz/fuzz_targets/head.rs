//! The occupancy head on every instruction set, compared in bits with the scalar code.

#![no_main]

use libfuzzer_sys::fuzz_target;
use voxcast_fuzz::differential::{Input, MAX_WORK, Weights, every_isa};
use voxcast_kernels::head::{Head, head, scratch_len};
use voxcast_kernels::panels::packed_len;

fuzz_target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let (voxels, channels) = (input.extent(0, 110), input.extent(0, 40));
    let Some(classes) = input.columns(voxels * channels) else { return };
    if voxels * channels * channels > MAX_WORK {
        return;
    }
    let rows = input.rows(voxels);
    let columns = [channels, channels, classes];
    let weights = columns.map(|columns| Weights::new(&mut input, packed_len(channels, columns)));
    let biases = columns.map(|columns| input.numbers(columns.next_multiple_of(16)));
    let image = input.numbers(voxels * channels);
    let args = Head {
        input: &image,
        channels,
        classes,
        weights: weights.each_ref().map(Weights::panels),
        biases: biases.each_ref().map(|b| &b[..]),
    };
    let mut scratch = vec![f32::NAN; scratch_len(channels, classes)];
    // Logits, and behind them the classes.
    let before = vec![f32::NAN; rows.len() * (classes + 1)];
    let scratch = std::cell::RefCell::new(&mut scratch);
    every_isa(&before, |isa, out| {
        let (logits, chosen) = out.split_at_mut(rows.len() * classes);
        let mut bytes = vec![255; rows.len()];
        head(isa, &args, rows.clone(), &mut bytes, Some(logits), &mut scratch.borrow_mut());
        chosen.iter_mut().zip(&bytes).for_each(|(chosen, byte)| *chosen = f32::from(*byte));
    });
});

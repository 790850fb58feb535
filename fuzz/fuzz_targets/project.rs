//! Projections of sample points on every instruction set, compared in bits with the scalar code.

#![no_main]

use libfuzzer_sys::fuzz_target;
use voxcast_fuzz::differential::{Input, every_isa};
use voxcast_kernels::project::{Projection, Sum, project_points};

fuzz_target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let sum = if input.flag() { Sum::Pairs } else { Sum::Chain };
    let stride_log2 = input.extent(0, 7) as u32;
    let (width, height) = ((input.extent(1, 40) as u32) << stride_log2, (input.extent(1, 40) as u32) << stride_log2);
    let base = u32::from(input.byte()) * if input.flag() { 16_000_000 } else { 1 };
    if u64::from(base) + u64::from(width >> stride_log2) * u64::from(height >> stride_log2) > 1 << 32 {
        return;
    }
    let lengths = [input.extent(0, 5), input.extent(0, 5), input.extent(0, 40)];
    let matrix = std::array::from_fn(|_| input.number() * 64.0);
    let [xs, ys, zs] = lengths.map(|n| input.numbers(n));
    let p = Projection { matrix, sum, width, height, stride_log2, base };
    // Pixels as pairs of numbers that are exact, and whether any point hits one.
    let points = xs.len() * ys.len() * zs.len();
    every_isa(&vec![f32::NAN; 2 * points + 1], |isa, out| {
        let mut found = vec![7; points];
        out[2 * points] = f32::from(u8::from(project_points(isa, &p, &xs, &ys, &zs, &mut found)));
        for (out, pixel) in out.chunks_exact_mut(2).zip(found) {
            out.copy_from_slice(&[(pixel >> 16) as f32, (pixel & 0xffff) as f32]);
        }
    });
});

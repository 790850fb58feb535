//! Window attention on every instruction set, compared in bits with the scalar code.

#![no_main]

use libfuzzer_sys::fuzz_target;
use voxcast_fuzz::differential::{Input, MAX_WORK, every_isa};
use voxcast_kernels::panels::packed_len;
use voxcast_kernels::window_attention::{QUERY_KERNEL, Shape, WindowAttention, window_attention};

fuzz_target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let extent = [input.extent(1, 16), input.extent(1, 16)];
    let (heads, part, key_dim) = (input.extent(1, 4), input.extent(1, 18), input.extent(1, 18));
    let key_dim = if heads > 1 { part } else { key_dim };
    let shape = Shape { extent, channels: heads * part, heads, key_dim };
    let tokens = shape.window()[0] * shape.window()[1] * extent[1].div_ceil(shape.window()[1]);
    if tokens * heads * key_dim * (3 * part + QUERY_KERNEL * QUERY_KERNEL + 100 + shape.channels) > 8 * MAX_WORK {
        return;
    }
    let row = input.extent(0, shape.window_rows() - 1);
    let (pad, pad3) = (key_dim.next_multiple_of(16), (3 * key_dim).next_multiple_of(16));
    let lengths = [
        extent[0] * extent[1] * shape.channels,
        heads * packed_len(part, 3 * key_dim),
        heads * pad3,
        heads * QUERY_KERNEL * QUERY_KERNEL * pad,
        heads * pad,
        heads * shape.side() * shape.side(),
        packed_len(heads * key_dim, shape.channels),
        shape.channels.next_multiple_of(16),
    ];
    let tensors = lengths.map(|n| input.numbers(n));
    let [plane, qkv, qkv_bias, query, query_bias, offsets, proj, proj_bias] = tensors.each_ref().map(|t| &t[..]);
    let args = WindowAttention { shape, input: plane, qkv, qkv_bias, query, query_bias, offsets, proj, proj_bias };
    let before = vec![f32::NAN; shape.rows(row).len() * extent[1] * shape.channels];
    let junk = input.numbers(shape.scratch_len());
    every_isa(&before, |isa, out| window_attention(isa, &args, row, out, &mut junk.clone()));
});

//! [`super::window_attention()`] with any arguments, and at the network's shapes.

use super::{QUERY_KERNEL, Shape, WindowAttention, window_attention};
use crate::cases::{Bench, Case, Draw, MAX_WORK, Memory, Output, values};
use crate::isa::Isa;
use crate::matmul::layout::packed_len;
use std::vec::Vec;

struct Call {
    shape: Shape,
    row: usize,
    tensors: [Vec<f32>; 8],
    junk: Vec<f32>,
}

/// Sizes of input, qkv, its bias, query, its bias, offsets, proj and its bias.
fn lengths(shape: &Shape) -> [usize; 8] {
    let Shape { extent, channels, heads, key_dim } = *shape;
    let (pad, pad3) = (key_dim.next_multiple_of(16), (3 * key_dim).next_multiple_of(16));
    [
        extent[0] * extent[1] * channels,
        heads * packed_len(shape.part(), 3 * key_dim),
        heads * pad3,
        heads * QUERY_KERNEL * QUERY_KERNEL * pad,
        heads * pad,
        heads * shape.side() * shape.side(),
        packed_len(heads * key_dim, channels),
        channels.next_multiple_of(16),
    ]
}

fn args(shape: Shape, tensors: [&[f32]; 8]) -> WindowAttention<'_> {
    let [input, qkv, qkv_bias, query, query_bias, offsets, proj, proj_bias] = tensors;
    WindowAttention { shape, input, qkv, qkv_bias, query, query_bias, offsets, proj, proj_bias }
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let extent = [draw.extent(1, 16), draw.extent(1, 16)];
    let (heads, part, key_dim) = (draw.extent(1, 4), draw.extent(1, 18), draw.extent(1, 18));
    let key_dim = if heads > 1 { part } else { key_dim };
    let shape = Shape { extent, channels: heads * part, heads, key_dim };
    if work(&shape) * shape.window()[0] * extent[1].next_multiple_of(shape.window()[1]) > 8 * MAX_WORK {
        return None;
    }
    Some(Call {
        shape,
        row: draw.extent(0, shape.window_rows() - 1),
        tensors: lengths(&shape).map(|n| draw.values(n)),
        junk: draw.values(shape.scratch_len()),
    })
}

/// Multiply-adds of a token.
fn work(shape: &Shape) -> usize {
    let tokens = shape.window().iter().product::<usize>();
    let head = 3 * shape.part() + QUERY_KERNEL * QUERY_KERNEL + 2 * tokens + shape.channels;
    shape.heads * shape.key_dim * head
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let Self { shape, row, .. } = *self;
        let tensors = self.tensors.each_ref().map(|x| memory.hold(x));
        let mut out = memory.filled(shape.rows(row).len() * shape.extent[1] * shape.channels, f32::NAN);
        let mut scratch = memory.hold(&self.junk);
        window_attention(isa, &args(shape, tensors.each_ref().map(|x| &x[..])), row, &mut out, &mut scratch);
        Output::from(&out[..])
    }
}

/// Planes whose windows are all whole, of the widths of levels 1 and 3 of `nuscenes-200`.
pub(crate) fn benches() -> Vec<Bench> {
    let planes = [("level1 64", [98, 98], 64), ("level3 256", [28, 28], 256)];
    let bench = |(name, extent, channels): (_, [usize; 2], usize)| {
        let heads = 4;
        let shape = Shape { extent, channels, heads, key_dim: channels / heads };
        let tensors = lengths(&shape).map(|n| values(n, 0.1));
        let mut scratch = values(shape.scratch_len(), 0.0);
        let (line, read) = (shape.window()[0] * extent[1], 4 * tensors.iter().map(Vec::len).sum::<usize>());
        let units = [shape.window_rows(), line * channels];
        Bench::new(name, units, line * work(&shape), read, move |isa, rows, out| {
            let args = args(shape, tensors.each_ref().map(|x| &x[..]));
            for (row, out) in rows.zip(out.chunks_exact_mut(line * channels)) {
                window_attention(isa, &args, row, out, &mut scratch);
            }
        })
    };
    planes.map(bench).into()
}

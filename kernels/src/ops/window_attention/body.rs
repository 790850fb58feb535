//! The vector body: packed operands, tiles of rows by 16 columns.

use super::{QUERY_KERNEL, SIDE, Scratch, Shape, WindowAttention, tree_max};
use crate::math::exp_v;
use crate::matmul::Residual;
use crate::matmul::driver::Dense;
use crate::matmul::epilogue::End;
use crate::matmul::layout::packed_len;
use crate::matmul::tile::Single;
use crate::simd::{LANES, Simd, relu, tree_sum};
use core::ops::Range;

/// Zeros before and after each axis of the queries.
pub(super) const HALF: usize = QUERY_KERNEL / 2;

impl WindowAttention<'_> {
    /// What all windows of a call share: the offsets, one row per head and token, and zeros around the queries.
    pub(super) fn prepare(&self, scratch: &mut Scratch<'_>) {
        let (side, [height, width]) = (self.shape.side(), self.shape.window());
        let tokens = height * width;
        let mut rows = scratch.offsets.chunks_exact_mut(tokens.next_multiple_of(LANES));
        for table in self.offsets.chunks_exact(side * side) {
            for (t, row) in (0..tokens).zip(&mut rows) {
                for (ux, row) in row[..tokens].chunks_exact_mut(width).enumerate() {
                    let table = &table[(t / width).abs_diff(ux) * side..][..side];
                    for (uy, out) in row.iter_mut().enumerate() {
                        *out = table[(t % width).abs_diff(uy)];
                    }
                }
                row[tokens..].fill(f32::NEG_INFINITY);
            }
        }
        scratch.plane.fill(0.0);
    }

    /// Copies a window, `[tokens, channels]`, with zeros for its padding.
    pub(super) fn load(&self, rows: &Range<usize>, window: usize, out: &mut [f32]) {
        let Shape { extent, channels, .. } = self.shape;
        let width = self.shape.window()[1];
        let inside = width.min(extent[1] - window * width) * channels;
        for (dx, out) in out.chunks_exact_mut(width * channels).enumerate() {
            if dx >= rows.len() {
                out.fill(0.0);
                continue;
            }
            let at = ((rows.start + dx) * extent[1] + window * width) * channels;
            out[..inside].copy_from_slice(&self.input[at..at + inside]);
            out[inside..].fill(0.0);
        }
    }

    /// From the head's part of the window to convolved queries, packed keys and packed values.
    #[inline(always)]
    pub(super) fn queries_keys_values<S: Simd>(&self, s: S, head: usize, scratch: &mut Scratch<'_>) {
        let Shape { channels, key_dim, .. } = self.shape;
        let (part, tokens, width) = (self.shape.part(), self.shape.tokens(), self.shape.window()[1]);
        let (pad, columns) = (key_dim.next_multiple_of(LANES), (3 * key_dim).next_multiple_of(LANES));
        let weights = packed_len(part, 3 * key_dim);
        let weights = &self.qkv[head * weights..(head + 1) * weights];
        let bias = &self.qkv_bias[head * columns..(head + 1) * columns];
        let a = Dense::new(&scratch.window[head * part..], channels, part);
        product(s, a, weights, Some(bias), scratch.qkv, columns);

        let (keys, values) = scratch.packed.split_at_mut(packed_len(key_dim, tokens));
        for (t, qkv) in scratch.qkv.chunks_exact(columns).enumerate() {
            let at = (t / width + HALF) * (width + 2 * HALF) + t % width + HALF;
            copy(&qkv[..key_dim], &mut scratch.plane[at * pad..]);
            let panel = &mut keys[t / LANES * key_dim * LANES..][..key_dim * LANES];
            for (lanes, k) in panel.chunks_exact_mut(LANES).zip(&qkv[key_dim..2 * key_dim]) {
                lanes[t % LANES] = *k;
            }
            for (panel, v) in qkv[2 * key_dim..3 * key_dim].chunks(LANES).enumerate() {
                copy(v, &mut values[(panel * tokens + t) * LANES..][..LANES]);
            }
        }
        let taps = QUERY_KERNEL * QUERY_KERNEL * pad;
        let taps = &self.query[head * taps..(head + 1) * taps];
        convolve(s, self.shape.window(), scratch.plane, taps, &self.query_bias[head * pad..][..pad], scratch.query);
    }

    /// Scores, softmax and the weighted sum of the values, which also joins the next head's part of the window.
    #[inline(always)]
    pub(super) fn attend<S: Simd>(&self, s: S, head: usize, scratch: &mut Scratch<'_>) {
        let Shape { channels, heads, key_dim, .. } = self.shape;
        let tokens = self.shape.tokens();
        let (pad, padded) = (key_dim.next_multiple_of(LANES), tokens.next_multiple_of(LANES));
        let (keys, values) = scratch.packed.split_at(packed_len(key_dim, tokens));
        product(s, Dense::new(scratch.query, pad, key_dim), keys, None, scratch.scores, padded);
        let offsets = &scratch.offsets[head * tokens * padded..(head + 1) * tokens * padded];
        let last = tokens - (padded - LANES);
        let mut exist = [0.0; LANES];
        exist[..last].fill(1.0);
        let exist = s.load(&exist);
        for (scores, offsets) in scratch.scores.chunks_exact_mut(padded).zip(offsets.chunks_exact(padded)) {
            softmax(s, scores, offsets, last, exist, self.scale());
        }
        product(s, Dense::new(scratch.scores, padded, tokens), values, None, scratch.head, pad);
        for (t, out) in scratch.head.chunks_exact(pad).enumerate() {
            let all = &mut scratch.heads[(t * heads + head) * key_dim..][..key_dim];
            for (all, x) in all.iter_mut().zip(out) {
                *all = relu(*x);
            }
            if head + 1 < heads {
                let next = &mut scratch.window[t * channels + (head + 1) * key_dim..][..key_dim];
                for (next, x) in next.iter_mut().zip(out) {
                    *next += x;
                }
            }
        }
    }

    /// The last product and the residual, for the tokens that are not padding.
    #[inline(always)]
    pub(super) fn project<S: Simd>(
        &self,
        s: S,
        rows: &Range<usize>,
        window: usize,
        scratch: &mut Scratch<'_>,
        out: &mut [f32],
    ) {
        let Shape { extent, channels, heads, key_dim, .. } = self.shape;
        let (columns, width) = (channels.next_multiple_of(LANES), self.shape.window()[1]);
        let a = Dense::new(scratch.heads, heads * key_dim, heads * key_dim);
        product(s, a, self.proj, Some(self.proj_bias), scratch.proj, columns);
        for (t, y) in scratch.proj.chunks_exact(columns).enumerate() {
            let (row, column) = (t / width, window * width + t % width);
            if row >= rows.len() || column >= extent[1] {
                continue;
            }
            let x = &self.input[((rows.start + row) * extent[1] + column) * channels..][..channels];
            let out = &mut out[(row * extent[1] + column) * channels..][..channels];
            for ((out, x), y) in out.chunks_mut(LANES).zip(x.chunks(LANES)).zip(y.chunks_exact(LANES)) {
                s.store_part(out, s.add(s.load_part(y), s.load_part(x)));
            }
        }
    }
}

/// Copies all of `from` to the start of `to`. A loop, as it is a handful of values.
#[inline(always)]
fn copy(from: &[f32], to: &mut [f32]) {
    for (from, to) in from.iter().zip(to) {
        *to = *from;
    }
}

/// The depthwise convolution of `plane`, a window of queries with [`HALF`] zeros on all sides, into `out`.
#[inline(always)]
fn convolve<S: Simd>(s: S, [height, width]: [usize; 2], plane: &[f32], taps: &[f32], bias: &[f32], out: &mut [f32]) {
    let pad = bias.len();
    for c in (0..pad).step_by(LANES) {
        for x in 0..height {
            let mut y = 0;
            while y < width {
                let plane = &plane[(x * (width + 2 * HALF) + y) * pad + c..];
                let out = &mut out[(x * width + y) * pad + c..];
                let stride = [(width + 2 * HALF) * pad, pad];
                if y + SIDE <= width {
                    convolve_tile::<S, SIDE>(s, plane, stride, &taps[c..], &bias[c..], out);
                    y += SIDE;
                } else {
                    convolve_tile::<S, 1>(s, plane, stride, &taps[c..], &bias[c..], out);
                    y += 1;
                }
            }
        }
    }
}

/// `N` neighbouring outputs of [`convolve`], 16 channels of each. The slices start at the first one's first tap.
#[inline(always)]
fn convolve_tile<S: Simd, const N: usize>(
    s: S,
    plane: &[f32],
    [row, column]: [usize; 2],
    taps: &[f32],
    bias: &[f32],
    out: &mut [f32],
) {
    let mut sums = [s.load(lanes(bias)); N];
    for ky in 0..QUERY_KERNEL {
        for kx in 0..QUERY_KERNEL {
            let w = s.load(lanes(&taps[(ky * QUERY_KERNEL + kx) * column..]));
            let plane = &plane[ky * row + kx * column..];
            for (i, sum) in sums.iter_mut().enumerate() {
                *sum = s.mul_add(s.load(lanes(&plane[i * column..])), w, *sum);
            }
        }
    }
    for (i, sum) in sums.into_iter().enumerate() {
        s.store(lanes_mut(&mut out[i * column..]), sum);
    }
}

/// The first 16 values of a slice that has them.
#[inline(always)]
fn lanes(x: &[f32]) -> &[f32; LANES] {
    x.first_chunk().expect("rows are padded to whole vectors")
}

/// As [`lanes`].
#[inline(always)]
fn lanes_mut(x: &mut [f32]) -> &mut [f32; LANES] {
    x.first_chunk_mut().expect("rows are padded to whole vectors")
}

/// `scores`, the dot products of a token with the keys, become probabilities. Of the last 16 lanes `last` are keys: `exist` is
/// 1 there and 0 beyond, where offsets are -inf.
#[inline(always)]
fn softmax<S: Simd>(s: S, scores: &mut [f32], offsets: &[f32], last: usize, exist: S::V, scale: f32) {
    let (scores, _) = scores.as_chunks_mut::<LANES>();
    let (offsets, _) = offsets.as_chunks::<LANES>();
    let end = scores.len() - 1;
    let mut max = s.splat(f32::NEG_INFINITY);
    for (i, (score, offset)) in scores.iter_mut().zip(offsets).enumerate() {
        // What lies beyond the keys may be NaN: a query times the zeros of the panel.
        let x = if i == end { s.load_part(&score[..last]) } else { s.load(score) };
        let y = s.mul_add(x, s.splat(scale), s.load(offset));
        s.store(score, y);
        max = s.max(y, max);
    }
    let max = s.splat(tree_max(s.lanes(max)));
    let mut sum = s.splat(0.0);
    for (i, score) in scores.iter_mut().enumerate() {
        let mut y = exp_v(s, s.sub(s.load(score), max));
        if i == end {
            y = s.mul(y, exist);
        }
        s.store(score, y);
        sum = s.add(sum, y);
    }
    let sum = s.splat(tree_sum(s.lanes(sum)));
    for score in scores {
        let y = s.div(s.load(score), sum);
        s.store(score, y);
    }
}

/// `out[r][n] = bias[n] + left[r][0] * w[0][n] + left[r][1] * w[1][n] + ...`, one chain, for all columns of the packed
/// panels. A row of `out` has `columns` values, a multiple of 16. Without a bias the chain starts at 0.
#[inline(always)]
fn product<S: Simd>(s: S, left: Dense<'_, f32>, panels: &[f32], bias: Option<&[f32]>, out: &mut [f32], columns: usize) {
    let mut end = End { bias, relu: false, residual: Residual::None };
    left.product(s, Single, panels, &mut end, out, columns);
}

//! The vector body: packed operands, tiles of rows by 16 columns.

use super::{QUERY_KERNEL, Scratch, Shape, WindowAttention, tree_max};
use crate::depthwise::{self, Depthwise};
use crate::math::exp_v;
use crate::panels::packed_len;
use crate::simd::{Kernel, LANES, Simd, relu, tree_sum};
use std::ops::Range;

/// Rows of a tile: 12 accumulators of 8 lanes, the most that AVX2 holds beside weights and a broadcast.
const TILE: usize = 6;

impl WindowAttention<'_> {
    /// One row of offsets per head and token, so that a row of scores needs no look-ups.
    pub(super) fn spread_offsets(&self, out: &mut [f32]) {
        let tokens = self.shape.tokens();
        for (i, row) in out.chunks_exact_mut(tokens.next_multiple_of(LANES)).enumerate() {
            for (u, out) in row.iter_mut().enumerate() {
                *out = if u < tokens { self.offset(i / tokens, i % tokens, u) } else { 0.0 };
            }
        }
    }

    /// From the input and the previous head's output to convolved queries, packed keys and packed values.
    #[inline(always)]
    pub(super) fn queries_keys_values<S: Simd>(
        &self,
        s: S,
        rows: &Range<usize>,
        window: usize,
        head: usize,
        scratch: &mut Scratch<'_>,
    ) {
        let Shape { extent, channels, key_dim, .. } = self.shape;
        let (part, tokens, [height, width]) = (self.shape.part(), self.shape.tokens(), self.shape.window());
        let (pad, columns) = (key_dim.next_multiple_of(LANES), (3 * key_dim).next_multiple_of(LANES));
        for (t, feature) in scratch.feature.chunks_exact_mut(part).enumerate() {
            match self.position(rows, window, t) {
                Some([row, column]) => {
                    let at = ((rows.start + row) * extent[1] + column) * channels + head * part;
                    feature.copy_from_slice(&self.input[at..at + part]);
                }
                None => feature.fill(0.0),
            }
            if head > 0 {
                for (feature, previous) in feature.iter_mut().zip(&scratch.head[t * pad..]) {
                    *feature += previous;
                }
            }
        }
        let weights = packed_len(part, 3 * key_dim);
        let weights = &self.qkv[head * weights..(head + 1) * weights];
        let bias = &self.qkv_bias[head * columns..(head + 1) * columns];
        product(s, scratch.feature, part, weights, Some(bias), scratch.qkv, columns);

        let (plane, convolved) = scratch.query.split_at_mut(tokens * pad);
        let (keys, values) = scratch.packed.split_at_mut(packed_len(key_dim, tokens));
        for (t, qkv) in scratch.qkv.chunks_exact(columns).enumerate() {
            plane[t * pad..t * pad + key_dim].copy_from_slice(&qkv[..key_dim]);
            plane[t * pad + key_dim..(t + 1) * pad].fill(0.0);
            let panel = &mut keys[t / LANES * key_dim * LANES..][..key_dim * LANES];
            for (lanes, k) in panel.chunks_exact_mut(LANES).zip(&qkv[key_dim..2 * key_dim]) {
                lanes[t % LANES] = *k;
            }
            for (panel, v) in qkv[2 * key_dim..3 * key_dim].chunks(LANES).enumerate() {
                let lanes = &mut values[(panel * tokens + t) * LANES..][..LANES];
                lanes[..v.len()].copy_from_slice(v);
                lanes[v.len()..].fill(0.0);
            }
        }
        let taps = QUERY_KERNEL * QUERY_KERNEL * pad;
        let convolution = Depthwise {
            input: plane,
            height,
            width,
            channels: pad,
            kernel: QUERY_KERNEL,
            weights: &self.query[head * taps..(head + 1) * taps],
            bias: &self.query_bias[head * pad..(head + 1) * pad],
            residual: false,
        };
        depthwise::Run { args: &convolution, rows: 0..height, out: convolved }.run(s);
    }

    /// Scores, softmax and the weighted sum of the values.
    #[inline(always)]
    pub(super) fn attend<S: Simd>(&self, s: S, head: usize, scratch: &mut Scratch<'_>) {
        let (key_dim, tokens) = (self.shape.key_dim, self.shape.tokens());
        let (pad, padded) = (key_dim.next_multiple_of(LANES), tokens.next_multiple_of(LANES));
        let (keys, values) = scratch.packed.split_at(packed_len(key_dim, tokens));
        product(s, &scratch.query[tokens * pad..], pad, keys, None, scratch.scores, padded);
        let offsets = &scratch.offsets[head * tokens * padded..(head + 1) * tokens * padded];
        for (scores, offsets) in scratch.scores.chunks_exact_mut(padded).zip(offsets.chunks_exact(padded)) {
            softmax(s, scores, offsets, tokens, self.scale());
        }
        product(s, scratch.scores, padded, values, None, scratch.head, pad);
        let depth = self.shape.heads * key_dim;
        for (t, all) in scratch.heads.chunks_exact_mut(depth).enumerate() {
            let out = &scratch.head[t * pad..t * pad + key_dim];
            for (all, x) in all[head * key_dim..(head + 1) * key_dim].iter_mut().zip(out) {
                *all = relu(*x);
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
        let columns = channels.next_multiple_of(LANES);
        product(s, scratch.heads, heads * key_dim, self.proj, Some(self.proj_bias), scratch.proj, columns);
        for (t, y) in scratch.proj.chunks_exact(columns).enumerate() {
            let Some([row, column]) = self.position(rows, window, t) else { continue };
            let x = &self.input[((rows.start + row) * extent[1] + column) * channels..][..channels];
            let out = &mut out[(row * extent[1] + column) * channels..][..channels];
            for ((out, x), y) in out.chunks_mut(LANES).zip(x.chunks(LANES)).zip(y.chunks_exact(LANES)) {
                s.store_part(out, s.add(s.load_part(y), s.load_part(x)));
            }
        }
    }
}

/// `scores`, the dot products of a token with the keys, become probabilities. Lanes from `tokens` on become 0.
#[inline(always)]
fn softmax<S: Simd>(s: S, scores: &mut [f32], offsets: &[f32], tokens: usize, scale: f32) {
    for (score, offset) in scores.chunks_exact_mut(LANES).zip(offsets.chunks_exact(LANES)) {
        let y = s.mul_add(s.load_part(score), s.splat(scale), s.load_part(offset));
        s.store_part(score, y);
    }
    scores[tokens..].fill(f32::NEG_INFINITY);
    let mut max = s.splat(f32::NEG_INFINITY);
    for score in scores.chunks_exact(LANES) {
        max = s.max(s.load_part(score), max);
    }
    let max = s.splat(tree_max(s.lanes(max)));
    for score in scores.chunks_exact_mut(LANES) {
        let y = exp_v(s, s.sub(s.load_part(score), max));
        s.store_part(score, y);
    }
    scores[tokens..].fill(0.0);
    let mut sum = s.splat(0.0);
    for score in scores.chunks_exact(LANES) {
        sum = s.add(sum, s.load_part(score));
    }
    let sum = s.splat(tree_sum(s.lanes(sum)));
    for score in scores.chunks_exact_mut(LANES) {
        let y = s.div(s.load_part(score), sum);
        s.store_part(score, y);
    }
}

/// `out[r][n] = bias[n] + a[r][0] * w[0][n] + a[r][1] * w[1][n] + ...`, one chain, for all columns of the packed panels.
///
/// The rows of `a` are `stride` apart and may be longer than the depth. A row of `out` has `columns` numbers, a multiple
/// of 16; `weights` are `columns / 16` panels, which gives the depth. Without a bias the chain starts at 0.
#[inline(always)]
fn product<S: Simd>(
    s: S,
    a: &[f32],
    stride: usize,
    weights: &[f32],
    bias: Option<&[f32]>,
    out: &mut [f32],
    columns: usize,
) {
    let (panel_len, rows) = (weights.len() / columns * LANES, out.len() / columns);
    for (i, panel) in weights.chunks_exact(panel_len).enumerate() {
        let (panel, _) = panel.as_chunks::<LANES>();
        let start = bias.map_or(s.splat(0.0), |bias| s.load_part(&bias[i * LANES..]));
        let mut r = 0;
        while r < rows {
            if r + TILE <= rows {
                tile::<S, TILE>(
                    s,
                    &a[r * stride..],
                    stride,
                    panel,
                    start,
                    &mut out[r * columns + i * LANES..],
                    columns,
                );
                r += TILE;
            } else {
                tile::<S, 1>(s, &a[r * stride..], stride, panel, start, &mut out[r * columns + i * LANES..], columns);
                r += 1;
            }
        }
    }
}

/// `R` rows of one panel of [`product`]; `out` starts at the first row's first column.
#[inline(always)]
fn tile<S: Simd, const R: usize>(
    s: S,
    a: &[f32],
    stride: usize,
    panel: &[[f32; LANES]],
    start: S::V,
    out: &mut [f32],
    columns: usize,
) {
    let rows: [&[f32]; R] = std::array::from_fn(|r| &a[r * stride..][..panel.len()]);
    let mut sums = [start; R];
    for (k, w) in panel.iter().enumerate() {
        let w = s.load(w);
        for (sum, row) in sums.iter_mut().zip(rows) {
            *sum = s.mul_add(s.splat(row[k]), w, *sum);
        }
    }
    for (r, sum) in sums.into_iter().enumerate() {
        s.store_part(&mut out[r * columns..], sum);
    }
}

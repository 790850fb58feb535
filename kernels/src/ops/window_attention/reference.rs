//! The specification: plain loops, no panels but those of the stored weights.

use super::{QUERY_KERNEL, Scratch, Shape, WindowAttention, tree_max};
#[cfg(not(feature = "std"))]
use crate::math::Float as _;
use crate::math::exp;
use crate::matmul::layout::{packed_index, packed_len};
use crate::simd::{LANES, relu, tree_sum};
use core::ops::Range;

impl WindowAttention<'_> {
    /// The token's position in the plane as (row within the call's rows, column), or `None` if it is padding.
    #[inline(always)]
    fn position(&self, rows: &Range<usize>, window: usize, token: usize) -> Option<[usize; 2]> {
        let [_, width] = self.shape.window();
        let at = [token / width, window * width + token % width];
        (at[0] < rows.len() && at[1] < self.shape.extent[1]).then_some(at)
    }

    /// The offset between two tokens in head `head`.
    #[inline(always)]
    fn offset(&self, head: usize, t: usize, u: usize) -> f32 {
        let (side, [_, width]) = (self.shape.side(), self.shape.window());
        let (dx, dy) = ((t / width).abs_diff(u / width), (t % width).abs_diff(u % width));
        self.offsets[head * side * side + dx * side + dy]
    }

    /// One head of one window.
    #[inline(always)]
    pub(super) fn reference_head(&self, rows: &Range<usize>, window: usize, head: usize, scratch: &mut Scratch<'_>) {
        let Shape { extent, channels, heads, key_dim, .. } = self.shape;
        let (part, tokens, [height, width]) = (self.shape.part(), self.shape.tokens(), self.shape.window());
        let pad = key_dim.next_multiple_of(LANES);
        for t in 0..tokens {
            for i in 0..part {
                let x = self.position(rows, window, t).map_or(0.0, |[row, column]| {
                    self.input[((rows.start + row) * extent[1] + column) * channels + head * part + i]
                });
                scratch.window[t * part + i] = if head == 0 { x } else { x + scratch.head[t * key_dim + i] };
            }
        }
        let weights = &self.qkv[head * packed_len(part, 3 * key_dim)..];
        for t in 0..tokens {
            for n in 0..3 * key_dim {
                let mut sum = self.qkv_bias[head * (3 * key_dim).next_multiple_of(LANES) + n];
                for i in 0..part {
                    sum = scratch.window[t * part + i].mul_add(weights[packed_index(part, i, n)], sum);
                }
                scratch.qkv[t * 3 * key_dim + n] = sum;
            }
        }
        for (t, c) in (0..tokens).flat_map(|t| (0..key_dim).map(move |c| (t, c))) {
            let mut sum = self.query_bias[head * pad + c];
            for tap in 0..QUERY_KERNEL * QUERY_KERNEL {
                let x = (t / width + tap / QUERY_KERNEL).wrapping_sub(QUERY_KERNEL / 2);
                let y = (t % width + tap % QUERY_KERNEL).wrapping_sub(QUERY_KERNEL / 2);
                let q = if x < height && y < width { scratch.qkv[(x * width + y) * 3 * key_dim + c] } else { 0.0 };
                sum = q.mul_add(self.query[(head * QUERY_KERNEL * QUERY_KERNEL + tap) * pad + c], sum);
            }
            scratch.query[t * key_dim + c] = sum;
        }
        for t in 0..tokens {
            let scores = &mut scratch.scores[..tokens];
            for u in 0..tokens {
                let mut dot = 0.0;
                for c in 0..key_dim {
                    dot = scratch.query[t * key_dim + c].mul_add(scratch.qkv[(u * 3 + 1) * key_dim + c], dot);
                }
                scores[u] = dot.mul_add(self.scale(), self.offset(head, t, u));
            }
            softmax(scores);
            for c in 0..key_dim {
                let mut sum = 0.0;
                for u in 0..tokens {
                    sum = scores[u].mul_add(scratch.qkv[(u * 3 + 2) * key_dim + c], sum);
                }
                scratch.head[t * key_dim + c] = sum;
                scratch.heads[(t * heads + head) * key_dim + c] = relu(sum);
            }
        }
    }

    /// The last product and the residual, for the tokens that are not padding.
    #[inline(always)]
    pub(super) fn reference_projection(
        &self,
        rows: &Range<usize>,
        window: usize,
        scratch: &Scratch<'_>,
        out: &mut [f32],
    ) {
        let Shape { extent, channels, heads, key_dim, .. } = self.shape;
        let depth = heads * key_dim;
        for t in 0..self.shape.tokens() {
            let Some([row, column]) = self.position(rows, window, t) else { continue };
            for n in 0..channels {
                let mut sum = self.proj_bias[n];
                for k in 0..depth {
                    sum = scratch.heads[t * depth + k].mul_add(self.proj[packed_index(depth, k, n)], sum);
                }
                let input = self.input[((rows.start + row) * extent[1] + column) * channels + n];
                out[(row * extent[1] + column) * channels + n] = sum + input;
            }
        }
    }
}

#[inline(always)]
fn softmax(scores: &mut [f32]) {
    let mut max = [f32::NEG_INFINITY; LANES];
    for (u, &score) in scores.iter().enumerate() {
        max[u % LANES] = if score > max[u % LANES] { score } else { max[u % LANES] };
    }
    let max = tree_max(max);
    let mut sum = [0.0; LANES];
    for (u, score) in scores.iter_mut().enumerate() {
        *score = exp(*score - max);
        sum[u % LANES] += *score;
    }
    let sum = tree_sum(sum);
    for score in scores {
        *score /= sum;
    }
}

//! Cascaded group attention inside windows of a plane, with the residual around it.
//!
//! ```text
//! for each window, tokens t (row-major in the window), feature of head h:
//!     feature[t]  = in[t][part h]                                    h = 0
//!     feature[t]  = in[t][part h] + head[h - 1][t]                   h > 0: heads are cascaded
//!     q, k, v     = qkv_bias[h] + feature[t] * qkv[h]                one fma chain per value, from the bias
//!     q           = query_bias[h] + 5x5 depthwise of q               zero padding at the window's border
//!     score[t][u] = (0 + q[t] . k[u]) * (1 / sqrt(key_dim)) + offsets[h][|dx| * side + |dy|]
//!     p[t][u]     = exp(score - max over u) / sum over u             on 16 lanes, see below
//!     head[h][t]  = 0 + p[t][0] * v[0] + p[t][1] * v[1] + ...
//! out[t] = (proj_bias + relu(concatenated heads) * proj) + in[t]
//! ```
//!
//! The window's side is 7, or the plane's first extent if that is less. A plane that fits into one window both ways is
//! one window of its own size. Any other plane is padded with zeros at the end of both axes to whole windows. Padded
//! tokens are keys like any other (their k and v are not zero, for the biases); only their outputs are dropped.
//!
//! Order. Every product is one chain, k ascending; taps in the padding stay in the chain as 0. The score's scale and
//! offset are one fused multiply-add. Maximum and sum of a row: lane j takes keys j, j + 16, ... in turn, from -inf and
//! 0; then halves, quarters, eighths and pairs (`if x[i + half] > x[i]`, and `+`).
//!
//! What the body changes, none of which can change a bit:
//! 1. Keys (transposed) and values are packed into panels of 16 columns, so that the four products of a head run through the
//!    register tile of [`crate::matmul`].
//! 2. A head's output joins the next head's part in a copy of the window.
//! 3. Queries lie amid zeros, so that no tap of their convolution needs a test.
//! 4. The offsets are spread out to one row per token once per call; all windows of the call use them.
//! 5. Lanes beyond the last token hold -inf for the maximum and 0 for the sum: their offsets are -inf, and their exponentials are
//!    multiplied by 0.

mod body;
#[cfg(feature = "cases")]
pub(crate) mod cases;
mod reference;
#[cfg(test)]
mod tests;

use self::body::HALF;
use crate::isa::Isa;
#[cfg(not(feature = "std"))]
use crate::math::Float as _;
use crate::matmul::layout::packed_len;
use crate::simd::{Kernel, LANES, Simd, dispatch};
use core::ops::Range;

/// Side of a window in a plane that has room for it.
pub const SIDE: usize = 7;
/// Side of the depthwise kernel on q.
pub const QUERY_KERNEL: usize = 5;

/// The sizes of an attention, none of them 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Extent of the plane, first axis first.
    pub extent: [usize; 2],
    /// Channels of input and output, a multiple of the heads.
    pub channels: usize,
    /// Heads.
    pub heads: usize,
    /// Channels of q, of k and of v in each head. With more than one head it is `channels / heads`, because a head's
    /// output is added to the next one's input.
    pub key_dim: usize,
}

impl Shape {
    /// Side of a window, which also is the side of the table of offsets.
    pub fn side(&self) -> usize {
        SIDE.min(self.extent[0])
    }

    /// Extent of a window: a square, except for a plane that is one window.
    pub fn window(&self) -> [usize; 2] {
        let side = self.side();
        if self.extent.iter().all(|&extent| extent <= side) { self.extent } else { [side; 2] }
    }

    /// Rows of windows: the number of calls that make the whole plane.
    pub fn window_rows(&self) -> usize {
        self.extent[0].div_ceil(self.window()[0])
    }

    /// The plane's rows (first axis) that a row of windows covers.
    pub fn rows(&self, window_row: usize) -> Range<usize> {
        let side = self.window()[0];
        window_row * side..self.extent[0].min((window_row + 1) * side)
    }

    /// Input channels of one head.
    pub fn part(&self) -> usize {
        self.channels / self.heads
    }

    /// f32 of scratch that one call needs.
    pub fn scratch_len(&self) -> usize {
        self.regions().iter().sum()
    }

    fn tokens(&self) -> usize {
        self.window().iter().product()
    }

    /// Sizes of the parts of the scratch, in the order of [`Scratch`].
    fn regions(&self) -> [usize; 10] {
        let (tokens, padded) = (self.tokens(), self.tokens().next_multiple_of(LANES));
        let key_dim = self.key_dim.next_multiple_of(LANES);
        [
            self.heads * tokens * padded,
            tokens * self.channels,
            tokens * (3 * self.key_dim).next_multiple_of(LANES),
            (self.window()[0] + 2 * HALF) * (self.window()[1] + 2 * HALF) * key_dim,
            tokens * key_dim,
            packed_len(self.key_dim, tokens) + packed_len(tokens, self.key_dim),
            tokens * padded,
            tokens * key_dim,
            tokens * self.heads * self.key_dim,
            tokens * self.channels.next_multiple_of(LANES),
        ]
    }

    fn check(&self) {
        let sizes = [self.extent[0], self.extent[1], self.channels, self.heads, self.key_dim];
        assert!(sizes.iter().all(|&v| v > 0), "an extent is zero");
        assert!(self.channels.is_multiple_of(self.heads), "the heads do not divide the channels");
        assert!(self.heads == 1 || self.key_dim == self.part(), "cascaded heads need key_dim = channels / heads");
    }
}

/// An attention's arguments. Packed matrices are laid out as [`crate::panels`] says.
#[derive(Clone, Copy, Debug)]
pub struct WindowAttention<'a> {
    /// Sizes.
    pub shape: Shape,
    /// `[extent 0, extent 1, channels]`.
    pub input: &'a [f32],
    /// One packed matrix of `channels / heads` x `3 * key_dim` per head: the columns are q, then k, then v.
    pub qkv: &'a [f32],
    /// `3 * key_dim` values per head, each head's padded with anything to a multiple of 16.
    pub qkv_bias: &'a [f32],
    /// `[heads, 5, 5, key_dim]`, each tap's channels padded with anything to a multiple of 16.
    pub query: &'a [f32],
    /// `key_dim` values per head, padded likewise.
    pub query_bias: &'a [f32],
    /// `[heads, side * side]`, added to the score of two tokens (`dx`, `dy`) apart at `|dx| * side + |dy|`.
    pub offsets: &'a [f32],
    /// The packed matrix of `heads * key_dim` x `channels`.
    pub proj: &'a [f32],
    /// One value per channel, padded with anything to a multiple of 16.
    pub proj_bias: &'a [f32],
}

impl WindowAttention<'_> {
    fn check(&self, window_row: usize, scratch: &[f32], out: &[f32]) {
        let s = &self.shape;
        s.check();
        let (key_dim, columns) = (s.key_dim.next_multiple_of(LANES), (3 * s.key_dim).next_multiple_of(LANES));
        assert_eq!(self.input.len(), s.extent[0] * s.extent[1] * s.channels, "the input has another shape");
        assert_eq!(self.qkv.len(), s.heads * packed_len(s.part(), 3 * s.key_dim), "qkv has another shape");
        assert_eq!(self.qkv_bias.len(), s.heads * columns, "the bias of qkv has another length");
        assert_eq!(self.query.len(), s.heads * QUERY_KERNEL * QUERY_KERNEL * key_dim, "query has another shape");
        assert_eq!(self.query_bias.len(), s.heads * key_dim, "the bias of query has another length");
        assert_eq!(self.offsets.len(), s.heads * s.side() * s.side(), "the offsets have another shape");
        assert_eq!(self.proj.len(), packed_len(s.heads * s.key_dim, s.channels), "proj has another shape");
        assert_eq!(self.proj_bias.len(), s.channels.next_multiple_of(LANES), "the bias of proj has another length");
        assert!(window_row < s.window_rows(), "window row {window_row} of {}", s.window_rows());
        assert!(scratch.len() >= s.scratch_len(), "the scratch is too small");
        let rows = s.rows(window_row).len();
        assert_eq!(out.len(), rows * s.extent[1] * s.channels, "the output is not the size of its rows");
    }
}

/// Computes the windows of row `window_row` into `out`, `[rows, extent 1, channels]`: exactly the plane's rows
/// [`Shape::rows`]. `scratch` holds at least [`Shape::scratch_len`] values of any value.
///
/// # Panics
/// If there is no such row of windows, the heads do not fit the channels, or a slice does not have the size that the
/// shape asks for.
///
/// # Determinism
/// The same bits on every instruction set. Windows do not depend on each other, so rows of windows may be computed in
/// any order and on any thread.
pub fn window_attention(isa: Isa, args: &WindowAttention<'_>, window_row: usize, out: &mut [f32], scratch: &mut [f32]) {
    args.check(window_row, scratch, out);
    dispatch(isa, Run { args, window_row, scratch, out });
}

/// The parts of the scratch. The specification needs less of them and uses their beginnings.
struct Scratch<'a> {
    /// `[heads, tokens, padded tokens]`: the offset of every pair of tokens.
    offsets: &'a mut [f32],
    /// `[tokens, channels]`: the window, to whose parts the heads' outputs are added.
    window: &'a mut [f32],
    /// `[tokens, padded 3 * key_dim]`.
    qkv: &'a mut [f32],
    /// `[height + 4, width + 4, padded key_dim]`: q amid zeros.
    plane: &'a mut [f32],
    /// `[tokens, padded key_dim]`: q after its convolution.
    query: &'a mut [f32],
    /// Packed keys, transposed: `key_dim` x tokens; then packed values: tokens x `key_dim`.
    packed: &'a mut [f32],
    /// `[tokens, padded tokens]`.
    scores: &'a mut [f32],
    /// `[tokens, padded key_dim]`: the head's output.
    head: &'a mut [f32],
    /// `[tokens, heads * key_dim]`, after ReLU.
    heads: &'a mut [f32],
    /// `[tokens, padded channels]`.
    proj: &'a mut [f32],
}

impl<'a> Scratch<'a> {
    fn new(shape: &Shape, mut scratch: &'a mut [f32]) -> Self {
        let [offsets, window, qkv, plane, query, packed, scores, head, heads, proj] = shape.regions().map(|len| {
            let (part, rest) = core::mem::take(&mut scratch).split_at_mut(len);
            scratch = rest;
            part
        });
        Self { offsets, window, qkv, plane, query, packed, scores, head, heads, proj }
    }
}

/// One call whose arguments fit together.
struct Run<'a> {
    args: &'a WindowAttention<'a>,
    window_row: usize,
    scratch: &'a mut [f32],
    out: &'a mut [f32],
}

impl WindowAttention<'_> {
    /// The factor of the scores. Square root and division are correctly rounded everywhere.
    #[inline(always)]
    fn scale(&self) -> f32 {
        1.0 / (self.shape.key_dim as f32).sqrt()
    }
}

impl Kernel for Run<'_> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        let (args, rows) = (self.args, self.args.shape.rows(self.window_row));
        let mut scratch = Scratch::new(&args.shape, self.scratch);
        for window in 0..args.shape.extent[1].div_ceil(args.shape.window()[1]) {
            for head in 0..args.shape.heads {
                args.reference_head(&rows, window, head, &mut scratch);
            }
            args.reference_projection(&rows, window, &scratch, self.out);
        }
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let (args, rows) = (self.args, self.args.shape.rows(self.window_row));
        let mut scratch = Scratch::new(&args.shape, self.scratch);
        args.prepare(&mut scratch);
        for window in 0..args.shape.extent[1].div_ceil(args.shape.window()[1]) {
            args.load(&rows, window, scratch.window);
            for head in 0..args.shape.heads {
                args.queries_keys_values(s, head, &mut scratch);
                args.attend(s, head, &mut scratch);
            }
            args.project(s, &rows, window, &mut scratch, self.out);
        }
    }
}

/// The largest of 16 lanes by the tree of the sum; the earlier one where the comparison is false.
#[inline(always)]
fn tree_max(mut x: [f32; LANES]) -> f32 {
    for half in [8, 4, 2, 1] {
        for i in 0..half {
            x[i] = if x[i + half] > x[i] { x[i + half] } else { x[i] };
        }
    }
    x[0]
}

//! Depthwise two-dimensional convolution: every channel has its own k x k kernel.
//!
//! ```text
//! out[y][x][c] = bias[c] + sum over (ky, kx), in that order, of in[y + ky - k/2][x + kx - k/2][c] * weight[ky][kx][c]
//!                (+ in[y][x][c])
//! ```
//!
//! Stride 1, zero padding k/2, so the output has the shape of the input. The sum is one chain of fused multiply-adds
//! that starts at the bias; taps outside count as in = 0 and stay in the chain; the residual joins last.
//!
//! The body runs sixteen channels at a time and, where no tap leaves the row, as many neighbouring columns as a register
//! tile has rows, which share each load of weights. Neither touches the order of a chain.

use crate::isa::Isa;
#[cfg(not(feature = "std"))]
use crate::math::Float as _;
use crate::simd::{Kernel, LANES, Simd, TileRows, dispatch};
use core::ops::Range;

/// A depthwise convolution's arguments.
#[derive(Clone, Copy, Debug)]
pub struct Depthwise<'a, T = f32, B = f32> {
    /// `[height, width, channels]`.
    pub input: &'a [T],
    /// Rows of the input and of the output.
    pub height: usize,
    /// Columns of the input and of the output.
    pub width: usize,
    /// Channels.
    pub channels: usize,
    /// Side of the kernel, odd.
    pub kernel: usize,
    /// `[kernel, kernel, channels]`, each tap's channels padded with anything to a multiple of 16.
    pub weights: &'a [T],
    /// One value per channel, padded likewise.
    pub bias: &'a [B],
    /// Whether the input itself is added.
    pub residual: bool,
}

impl<T: Copy, B: Copy> Depthwise<'_, T, B> {
    pub(super) fn check(&self, rows: &Range<usize>, out: &[T]) {
        let padded = self.channels.next_multiple_of(LANES);
        assert!(self.channels > 0 && self.width > 0, "an extent is zero");
        assert!(self.kernel % 2 == 1, "the kernel's side is not odd");
        assert_eq!(self.input.len(), self.height * self.width * self.channels, "the input has another shape");
        assert_eq!(self.weights.len(), self.kernel * self.kernel * padded, "the weights have another shape");
        assert_eq!(self.bias.len(), padded, "the bias has another length");
        assert!(rows.start <= rows.end && rows.end <= self.height, "rows {rows:?} of {}", self.height);
        assert_eq!(out.len(), rows.len() * self.width * self.channels, "the output is not the size of its rows");
    }
}

/// Computes the output rows `rows` into `out`, `[rows, width, channels]`.
///
/// # Panics
/// If the kernel's side is even, `rows` leaves the image, or a slice does not have the size that the shapes ask for.
///
/// # Determinism
/// The same bits on every instruction set and for every division into rows.
pub fn depthwise(isa: Isa, args: &Depthwise<'_>, rows: Range<usize>, out: &mut [f32]) {
    args.check(&rows, out);
    dispatch(isa, Run { args, rows, out });
}

/// One call whose arguments fit together.
struct Run<'a> {
    args: &'a Depthwise<'a>,
    rows: Range<usize>,
    out: &'a mut [f32],
}

impl Kernel for Run<'_> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        let a = self.args;
        let padded = a.channels.next_multiple_of(LANES);
        for (i, out) in self.out.iter_mut().enumerate() {
            let (c, x) = (i % a.channels, i / a.channels % a.width);
            let y = self.rows.start + i / (a.channels * a.width);
            let mut sum = a.bias[c];
            for ky in 0..a.kernel {
                for kx in 0..a.kernel {
                    let input = a.offset(y + ky, x + kx).map_or(0.0, |at| a.input[at + c]);
                    sum = input.mul_add(a.weights[(ky * a.kernel + kx) * padded + c], sum);
                }
            }
            if a.residual {
                sum += a.input[(y * a.width + x) * a.channels + c];
            }
            *out = sum;
        }
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        self.args.rows(s, Chains, self.rows, self.out);
    }
}

/// What the body computes with: elements, and vectors of them and of their sums.
pub(super) trait Arithmetic<S: Simd, T, B>: Copy {
    /// Sixteen elements, weights or sums.
    type Lanes: Copy;
    /// Sixteen times zero.
    fn zero(self, s: S) -> Self::Lanes;
    /// Sixteen values of the bias.
    fn bias(self, s: S, bias: &[B; LANES]) -> Self::Lanes;
    /// Sixteen elements from `x` on.
    ///
    /// # Safety
    /// `x` must be valid for reading as many.
    unsafe fn load_ptr(self, s: S, x: *const T) -> Self::Lanes;
    /// Up to sixteen elements.
    fn load_part(self, s: S, x: &[T]) -> Self::Lanes;
    /// `x * w + sum`.
    fn mul_add(self, s: S, x: Self::Lanes, w: Self::Lanes, sum: Self::Lanes) -> Self::Lanes;
    /// Makes outputs of the sums of channels from `channel` on, whose inputs here are `x` if they are to be added.
    fn finish(self, s: S, channel: usize, sum: Self::Lanes, x: Option<Self::Lanes>, out: &mut [T]);
}

/// Chains of fused multiply-adds.
#[derive(Clone, Copy)]
struct Chains;

impl<S: Simd> Arithmetic<S, f32, f32> for Chains {
    type Lanes = S::V;
    #[inline(always)]
    fn zero(self, s: S) -> S::V {
        s.splat(0.0)
    }
    #[inline(always)]
    fn bias(self, s: S, bias: &[f32; LANES]) -> S::V {
        s.load(bias)
    }
    #[inline(always)]
    unsafe fn load_ptr(self, s: S, x: *const f32) -> S::V {
        // SAFETY: the caller's promise.
        unsafe { s.load_ptr(x) }
    }
    #[inline(always)]
    fn load_part(self, s: S, x: &[f32]) -> S::V {
        s.load_part(x)
    }
    #[inline(always)]
    fn mul_add(self, s: S, x: S::V, w: S::V, sum: S::V) -> S::V {
        s.mul_add(x, w, sum)
    }
    #[inline(always)]
    fn finish(self, s: S, _: usize, sum: S::V, x: Option<S::V>, out: &mut [f32]) {
        let sum = if let Some(x) = x { s.add(sum, x) } else { sum };
        s.store_part(out, sum);
    }
}

/// Up to 16 elements; all 16 if `WHOLE`.
#[inline(always)]
fn load<S: Simd, A: Arithmetic<S, T, B>, T, B, const WHOLE: bool>(s: S, arithmetic: A, x: &[T]) -> A::Lanes {
    if WHOLE {
        let x: &[T; LANES] = x.first_chunk().expect("16 channels");
        // SAFETY: the array holds 16 elements.
        unsafe { arithmetic.load_ptr(s, x.as_ptr()) }
    } else {
        arithmetic.load_part(s, x)
    }
}

/// All channels of some columns from `x` on in row `y`. If they are more than one, no tap may leave the row.
struct Columns<'a, A, T, B> {
    args: &'a Depthwise<'a, T, B>,
    arithmetic: A,
    y: usize,
    x: usize,
    out: &'a mut [T],
}

impl<S: Simd, A: Arithmetic<S, T, B>, T: Copy, B: Copy> TileRows<S> for Columns<'_, A, T, B> {
    #[inline(always)]
    fn run<const N: usize>(self, s: S) {
        let Self { args, arithmetic, y, x, out } = self;
        let whole = args.channels / LANES * LANES;
        for c in (0..whole).step_by(LANES) {
            args.tile::<S, A, N, true>(s, arithmetic, [y, x, c], out);
        }
        if whole < args.channels {
            args.tile::<S, A, N, false>(s, arithmetic, [y, x, whole], out);
        }
    }
}

impl<T: Copy, B: Copy> Depthwise<'_, T, B> {
    /// Where the pixel at (`y`, `x`) of the zero-padded input is stored, or `None` in the padding.
    #[inline(always)]
    pub(super) fn offset(&self, y: usize, x: usize) -> Option<usize> {
        let (y, x) = (y.wrapping_sub(self.kernel / 2), x.wrapping_sub(self.kernel / 2));
        (y < self.height && x < self.width).then(|| (y * self.width + x) * self.channels)
    }

    /// The body.
    #[inline(always)]
    pub(super) fn rows<S: Simd>(&self, s: S, arithmetic: impl Arithmetic<S, T, B>, rows: Range<usize>, out: &mut [T]) {
        let half = self.kernel / 2;
        for (y, out) in rows.zip(out.chunks_exact_mut(self.width * self.channels)) {
            let mut x = 0;
            while x < self.width {
                // Columns from here on, no tap of which leaves the row.
                let inside = if x >= half { self.width.saturating_sub(x + half) } else { 0 };
                x +=
                    s.rows(inside.max(1), Columns { args: self, arithmetic, y, x, out: &mut out[x * self.channels..] });
            }
        }
    }

    /// Up to 16 channels of [`Columns`], from `c` on; all 16 if `WHOLE`, which spares the accumulators the call
    /// that a part of a vector takes.
    #[inline(always)]
    fn tile<S: Simd, A: Arithmetic<S, T, B>, const N: usize, const WHOLE: bool>(
        &self,
        s: S,
        arithmetic: A,
        [y, x, c]: [usize; 3],
        out: &mut [T],
    ) {
        let padded = self.channels.next_multiple_of(LANES);
        let lanes = if WHOLE { LANES } else { self.channels - c };
        let mut sums = [arithmetic.bias(s, self.bias[c..].first_chunk().expect("padded channels")); N];
        for ky in 0..self.kernel {
            // Where no tap leaves the row, all of a row of taps are one piece of memory.
            let piece = if N > 1 { self.offset(y + ky, x) } else { None };
            let piece = piece.map(|at| &self.input[at + c..][..(N + self.kernel - 2) * self.channels + lanes]);
            for kx in 0..self.kernel {
                let w: &[T; LANES] =
                    self.weights[(ky * self.kernel + kx) * padded + c..].first_chunk().expect("padded channels");
                // SAFETY: the array holds 16 weights.
                let w = unsafe { arithmetic.load_ptr(s, w.as_ptr()) };
                match piece {
                    Some(piece) => {
                        for (i, sum) in sums.iter_mut().enumerate() {
                            let at = (kx + i) * self.channels;
                            let x = if WHOLE {
                                // SAFETY: kx < kernel and i < N, so these 16 elements end where the piece does, at most.
                                unsafe { arithmetic.load_ptr(s, piece.as_ptr().add(at)) }
                            } else {
                                arithmetic.load_part(s, &piece[at..][..lanes])
                            };
                            *sum = arithmetic.mul_add(s, x, w, *sum);
                        }
                    }
                    None => {
                        for (i, sum) in sums.iter_mut().enumerate() {
                            let x = match self.offset(y + ky, x + i + kx) {
                                Some(at) => load::<S, A, T, B, WHOLE>(s, arithmetic, &self.input[at + c..][..lanes]),
                                None => arithmetic.zero(s),
                            };
                            *sum = arithmetic.mul_add(s, x, w, *sum);
                        }
                    }
                }
            }
        }
        for (i, sum) in sums.into_iter().enumerate() {
            let x = if self.residual {
                let at = (y * self.width + x + i) * self.channels + c;
                Some(load::<S, A, T, B, WHOLE>(s, arithmetic, &self.input[at..][..lanes]))
            } else {
                None
            };
            arithmetic.finish(s, c, sum, x, &mut out[i * self.channels + c..][..lanes]);
        }
    }
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{Fill, Rng, assert_lively, assert_order_shows, assert_same_bits, pad_rows, reverse_rows};

    struct Case {
        shape: [usize; 3],
        kernel: usize,
        residual: bool,
        input: Vec<f32>,
        weights: Vec<f32>,
        bias: Vec<f32>,
    }

    impl Case {
        fn new(shape: [usize; 3], kernel: usize, residual: bool, seed: u64, fill: Fill) -> Self {
            let [h, w, c] = shape;
            let mut rng = Rng::new(seed);
            let input = fill(&mut rng, h * w * c);
            let weights = pad_rows(&rng.wide(kernel * kernel * c), c, f32::NAN);
            Self { shape, kernel, residual, input, weights, bias: pad_rows(&rng.wide(c), c, f32::NAN) }
        }

        fn args(&self) -> Depthwise<'_> {
            let [height, width, channels] = self.shape;
            let Self { kernel, residual, ref input, ref weights, ref bias, .. } = *self;
            Depthwise { input, height, width, channels, kernel, weights, bias, residual }
        }

        fn rows(&self, isa: Isa, rows: Range<usize>) -> Vec<f32> {
            let mut out = vec![f32::NAN; rows.len() * self.shape[1] * self.shape[2]];
            depthwise(isa, &self.args(), rows, &mut out);
            out
        }

        fn all(&self, isa: Isa) -> Vec<f32> {
            self.rows(isa, 0..self.shape[0])
        }
    }

    #[test]
    fn by_hand() {
        // A 2 x 3 image of ones, bias 100 and the weights 1 to 9: each output is the sum of the taps inside.
        let mut case = Case::new([2, 3, 1], 3, false, 0, Rng::ordinary);
        case.input = vec![1.0; 6];
        case.weights = pad_rows(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0], 1, 0.0);
        case.bias = pad_rows(&[100.0], 1, 0.0);
        for isa in Isa::available() {
            case.residual = false;
            assert_eq!(case.all(isa), [128.0, 139.0, 124.0, 116.0, 121.0, 112.0]);
            case.residual = true;
            assert_eq!(case.all(isa), [129.0, 140.0, 125.0, 117.0, 122.0, 113.0]);
        }
    }

    /// Channels around 16, widths around the kernel and the blocks; the last has one of each.
    const SHAPES: [([usize; 3], usize); 10] = [
        ([1, 1, 16], 3),
        ([3, 7, 1], 3),
        ([2, 6, 5], 5),
        ([4, 9, 15], 3),
        ([5, 5, 16], 1),
        ([7, 7, 16], 5),
        ([3, 13, 17], 7),
        ([6, 8, 33], 3),
        ([4, 12, 64], 5),
        ([2, 17, 19], 3),
    ];

    #[test]
    fn every_isa_gives_the_scalar_bits() {
        for (shape, kernel) in SHAPES {
            for (residual, fill) in [(false, Rng::wide as Fill), (true, Rng::wide), (true, Rng::special)] {
                let case = Case::new(shape, kernel, residual, 7, fill);
                let want = case.all(Isa::Scalar);
                assert_lively(&want, &format!("{shape:?}, kernel {kernel}"));
                for isa in Isa::available() {
                    assert_same_bits(&case.all(isa), &want, &format!("{isa:?} {shape:?}, kernel {kernel}"));
                }
            }
        }
    }

    #[test]
    fn padding_stays_in_the_chain() {
        // 0 * inf is NaN: a body that skips taps in the padding differs at the border.
        for isa in Isa::available() {
            let mut case = Case::new([3, 9, 16], 3, false, 1, Rng::ordinary);
            case.weights[3] = f32::INFINITY;
            let out = case.all(isa);
            assert!(out[3].is_nan());
            assert!(out[(9 + 1) * 16 + 3].is_infinite());
            assert!(out.iter().skip(4).step_by(16).all(|v| v.is_finite()));
        }
    }

    #[test]
    fn the_order_of_a_chain_shows() {
        for (shape, kernel) in SHAPES.into_iter().filter(|(shape, kernel)| *kernel > 1 && shape[0] > 1) {
            let c = shape[2];
            let mut case = Case::new(shape, kernel, false, 7, Rng::ordinary);
            case.weights = pad_rows(&Rng::new(8).ordinary(kernel * kernel * c), c, 0.0);
            let want = case.all(Isa::Scalar);
            // Half a turn of image and kernel turns the output, and the order of the taps.
            case.input = reverse_rows(&case.input, c);
            case.weights = reverse_rows(&case.weights, c.next_multiple_of(LANES));
            assert_order_shows(&reverse_rows(&case.all(Isa::Scalar), c), &want, &format!("{shape:?}, kernel {kernel}"));
        }
    }

    #[test]
    #[should_panic(expected = "the kernel's side is not odd")]
    fn even_kernel() {
        Case::new([3, 3, 4], 2, false, 0, Rng::ordinary).all(Isa::Scalar);
    }

    #[test]
    #[should_panic(expected = "the input has another shape")]
    fn short_input() {
        let mut case = Case::new([3, 3, 4], 3, false, 0, Rng::ordinary);
        case.input.pop();
        case.all(Isa::Scalar);
    }

    #[test]
    #[should_panic(expected = "the weights have another shape")]
    fn unpadded_weights() {
        let mut case = Case::new([3, 3, 4], 3, false, 0, Rng::ordinary);
        case.weights.truncate(36);
        case.all(Isa::Scalar);
    }

    #[test]
    #[should_panic(expected = "the bias has another length")]
    fn short_bias() {
        let mut case = Case::new([3, 3, 4], 3, false, 0, Rng::ordinary);
        case.bias.pop();
        case.all(Isa::Scalar);
    }

    #[test]
    #[should_panic(expected = "rows 2..4 of 3")]
    fn rows_outside() {
        Case::new([3, 3, 4], 3, false, 0, Rng::ordinary).rows(Isa::Scalar, 2..4);
    }

    #[test]
    #[should_panic(expected = "the output is not the size of its rows")]
    fn short_output() {
        let case = Case::new([3, 3, 4], 3, false, 0, Rng::ordinary);
        depthwise(Isa::Scalar, &case.args(), 0..2, &mut [0.0; 23]);
    }

    #[test]
    #[should_panic(expected = "an extent is zero")]
    fn no_channels() {
        let case = Case::new([3, 3, 1], 3, false, 0, Rng::ordinary);
        depthwise(Isa::Scalar, &Depthwise { channels: 0, ..case.args() }, 0..0, &mut []);
    }
}

//! Depthwise two-dimensional convolution in 8 bits: every channel has its own k x k kernel.
//!
//! ```text
//! sum          = bias[c] + sum over (ky, kx) of in[y + ky - k/2][x + kx - k/2][c] * weight[ky][kx][c]      exact
//!                (+ in[y][x][c] * residual[c])
//! out[y][x][c] = clamp(requantise(sum, multiplier[c]))                                                    rounded once
//! ```
//!
//! Stride 1, zero padding k/2. Bias and residual are in the units of the sum, `scale of the input * scale of the weights`; the
//! multiplier is `round(2^32 * unit of the sum / scale of the output)`. Who makes the weights proves
//! `|bias| + 127 * sum of |weight| + 127 * |residual| < 2^31` for each channel; a sum that leaves i32 nevertheless wraps around.
//!
//! The body is that of the floating-point convolution.

use super::depthwise::{Arithmetic, Depthwise};
use crate::isa::Isa;
use crate::quantised::{clamp, requantise};
use crate::simd::{Kernel, LANES, Simd, dispatch};
use core::ops::Range;

/// A depthwise convolution's arguments, and what becomes of its sums.
#[derive(Clone, Copy, Debug)]
pub struct DepthwiseI8<'a> {
    /// What is summed.
    pub convolution: Depthwise<'a, i8, i32>,
    /// What the input is multiplied by where it joins the sum: one value per channel, padded with anything to a multiple of
    /// 16. Empty if it does not join.
    pub residual: &'a [i32],
    /// From sums to the output, 0 and above: one value per channel, padded likewise.
    pub multiplier: &'a [i32],
}

impl DepthwiseI8<'_> {
    fn check(&self, rows: &Range<usize>, out: &[i8]) {
        self.convolution.check(rows, out);
        let padded = self.convolution.channels.next_multiple_of(LANES);
        assert_eq!(self.multiplier.len(), padded, "the multiplier has another length");
        let residual = if self.convolution.residual { padded } else { 0 };
        assert_eq!(self.residual.len(), residual, "the residual's multiplier has another length");
    }
}

/// Computes the output rows `rows` into `out`, `[rows, width, channels]`.
///
/// # Panics
/// If the kernel's side is even, `rows` leaves the image, or a slice does not have the size that the shapes ask for.
///
/// # Determinism
/// Exact but for one fixed rounding, so the same on every instruction set and for every division into rows.
pub fn depthwise_i8(isa: Isa, args: &DepthwiseI8<'_>, rows: Range<usize>, out: &mut [i8]) {
    args.check(&rows, out);
    dispatch(isa, Run { args, rows, out });
}

struct Run<'a> {
    args: &'a DepthwiseI8<'a>,
    rows: Range<usize>,
    out: &'a mut [i8],
}

impl Kernel for Run<'_> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        let a = &self.args.convolution;
        let padded = a.channels.next_multiple_of(LANES);
        for (i, out) in self.out.iter_mut().enumerate() {
            let (c, x) = (i % a.channels, i / a.channels % a.width);
            let y = self.rows.start + i / (a.channels * a.width);
            let mut sum = a.bias[c];
            for ky in 0..a.kernel {
                for kx in 0..a.kernel {
                    let input = a.offset(y + ky, x + kx).map_or(0, |at| i32::from(a.input[at + c]));
                    sum = sum.wrapping_add(input * i32::from(a.weights[(ky * a.kernel + kx) * padded + c]));
                }
            }
            if a.residual {
                let input = i32::from(a.input[(y * a.width + x) * a.channels + c]);
                sum = sum.wrapping_add(input.wrapping_mul(self.args.residual[c]));
            }
            *out = clamp(requantise(sum, self.args.multiplier[c]), false);
        }
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        self.args.convolution.rows(s, Integers(self.args), self.rows, self.out);
    }
}

/// Sums of integers.
#[derive(Clone, Copy)]
struct Integers<'a>(&'a DepthwiseI8<'a>);

impl<S: Simd> Arithmetic<S, i8, i32> for Integers<'_> {
    type Lanes = S::I;
    #[inline(always)]
    fn zero(self, s: S) -> S::I {
        s.splat_int(0)
    }
    #[inline(always)]
    fn bias(self, s: S, bias: &[i32; LANES]) -> S::I {
        s.load_int(bias)
    }
    #[inline(always)]
    unsafe fn load_ptr(self, s: S, x: *const i8) -> S::I {
        // SAFETY: the caller's promise.
        s.bytes_to_int(unsafe { s.load_bytes_ptr(x) })
    }
    #[inline(always)]
    fn load_part(self, s: S, x: &[i8]) -> S::I {
        s.bytes_to_int(s.load_bytes_part(x))
    }
    #[inline(always)]
    fn mul_add(self, s: S, x: S::I, w: S::I, sum: S::I) -> S::I {
        s.add_int(s.mul_short(x, w), sum)
    }
    #[inline(always)]
    fn finish(self, s: S, channel: usize, mut sum: S::I, x: Option<S::I>, out: &mut [i8]) {
        if let Some(x) = x {
            sum = s.add_int(sum, s.mul_int(x, columns(s, self.0.residual, channel)));
        }
        s.store_bytes_part(out, s.quantised(s.requantise(sum, columns(s, self.0.multiplier, channel)), false));
    }
}

/// The values of 16 channels.
#[inline(always)]
fn columns<S: Simd>(s: S, x: &[i32], channel: usize) -> S::I {
    s.load_int(x[channel..].first_chunk().expect("padded channels"))
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Rng;

    struct Case {
        shape: [usize; 3],
        kernel: usize,
        input: Vec<i8>,
        weights: Vec<i8>,
        bias: Vec<i32>,
        residual: Vec<i32>,
        multiplier: Vec<i32>,
    }

    impl Case {
        fn new(shape: [usize; 3], kernel: usize, residual: bool, seed: u64) -> Self {
            let [h, w, c] = shape;
            let padded = c.next_multiple_of(LANES);
            let mut rng = Rng::new(seed);
            let mut bytes = |n: usize| -> Vec<i8> { (0..n).map(|_| (rng.bits() as i8).max(-127)).collect() };
            let (input, weights) = (bytes(h * w * c), bytes(kernel * kernel * padded));
            let mut ints = |low: i32, high: i32, n: usize| -> Vec<i32> {
                (0..n).map(|_| low + (rng.bits() % (high - low) as u64) as i32).collect()
            };
            // Sums are about 74^2 times the kernel's side.
            let unit = (64.0 / 5500.0 / kernel as f64 * f64::from(1u32 << 31)) as i32;
            Self {
                shape,
                kernel,
                input,
                weights,
                bias: ints(-10_000, 10_000, padded),
                residual: ints(1, 300, if residual { padded } else { 0 }),
                multiplier: ints(unit, 2 * unit, padded),
            }
        }

        fn args(&self) -> DepthwiseI8<'_> {
            let [height, width, channels] = self.shape;
            let Self { kernel, ref input, ref weights, ref bias, .. } = *self;
            let residual = !self.residual.is_empty();
            DepthwiseI8 {
                convolution: Depthwise { input, height, width, channels, kernel, weights, bias, residual },
                residual: &self.residual,
                multiplier: &self.multiplier,
            }
        }

        fn all(&self, isa: Isa) -> Vec<i8> {
            let [height, width, channels] = self.shape;
            let mut out = vec![55; height * width * channels];
            let (top, bottom) = out.split_at_mut(height / 2 * width * channels);
            depthwise_i8(isa, &self.args(), 0..height / 2, top);
            depthwise_i8(isa, &self.args(), height / 2..height, bottom);
            out
        }
    }

    #[test]
    fn by_hand() {
        // A 2 x 3 image of ones, bias 100 and the weights 1 to 9: each sum is that of the taps inside; then a quarter of it,
        // halves upwards.
        let mut case = Case::new([2, 3, 1], 3, false, 0);
        case.input = vec![1; 6];
        case.weights = (1..10).flat_map(|w| [[w; 1].as_slice(), &[99; 15]].concat()).collect();
        (case.bias[0], case.multiplier[0]) = (100, 1 << 30);
        for isa in Isa::available() {
            case.residual.clear();
            // 128, 139, 124, 116, 121, 112.
            assert_eq!(case.all(isa), [32, 35, 31, 29, 30, 28]);
            case.residual = vec![-90; 16];
            // 38, 49, 34, 26, 31, 22.
            assert_eq!(case.all(isa), [10, 12, 9, 7, 8, 6]);
        }
    }

    /// Channels around 16, widths around the kernel and the blocks.
    const SHAPES: [([usize; 3], usize); 9] = [
        ([1, 1, 16], 3),
        ([3, 7, 1], 3),
        ([2, 6, 5], 5),
        ([4, 9, 15], 3),
        ([5, 5, 16], 1),
        ([7, 7, 16], 5),
        ([3, 13, 17], 7),
        ([4, 12, 64], 5),
        ([2, 17, 19], 3),
    ];

    #[test]
    fn every_isa_agrees_with_f64() {
        for (shape, kernel) in SHAPES {
            for residual in [false, true] {
                let case = Case::new(shape, kernel, residual, 3);
                let ([h, w, c], half) = (shape, kernel as isize / 2);
                let want = case.all(Isa::Scalar);
                for (i, got) in want.iter().enumerate() {
                    let (y, x, ch) = ((i / (w * c)) as isize, (i / c % w) as isize, i % c);
                    let mut sum = f64::from(case.bias[ch]);
                    if residual {
                        sum += f64::from(case.input[i]) * f64::from(case.residual[ch]);
                    }
                    for (dy, dx) in (-half..=half).flat_map(|dy| (-half..=half).map(move |dx| (dy, dx))) {
                        if (0..h as isize).contains(&(y + dy)) && (0..w as isize).contains(&(x + dx)) {
                            let at = ((y + dy) as usize * w + (x + dx) as usize) * c + ch;
                            let tap = ((dy + half) * kernel as isize + dx + half) as usize;
                            let weight = case.weights[tap * c.next_multiple_of(LANES) + ch];
                            sum += f64::from(case.input[at]) * f64::from(weight);
                        }
                    }
                    let exact = (sum * f64::from(case.multiplier[ch]) * 2f64.powi(-32)).clamp(-127.0, 127.0);
                    assert!((f64::from(*got) - exact).abs() <= 0.5, "{got} is not {exact}");
                }
                for isa in Isa::available() {
                    assert_eq!(case.all(isa), want, "{} {shape:?}, kernel {kernel}", isa.name());
                }
            }
        }
    }

    /// Sums at both ends of i32, and beyond, where all instruction sets wrap around alike.
    #[test]
    fn extremes() {
        for (x, w, bias) in
            [(127, 127, i32::MAX - 9 * 127 * 127), (-127, 127, i32::MIN + 9 * 127 * 127), (-128, -128, i32::MAX)]
        {
            let mut case = Case::new([5, 9, 21], 3, false, 1);
            case.input.fill(x);
            case.weights.fill(w);
            case.bias.fill(bias);
            case.multiplier.fill(200);
            let want = case.all(Isa::Scalar);
            let inside = want[(9 + 1) * 21];
            // i32::MAX * 200 / 2^32 is 100. The third sum leaves i32 at the upper end and comes back at the lower one.
            assert_eq!(inside, [100, -100][usize::from(x < 0)]);
            for isa in Isa::available() {
                assert_eq!(case.all(isa), want, "{}", isa.name());
            }
        }
    }

    #[test]
    #[should_panic(expected = "the multiplier has another length")]
    fn short_multiplier() {
        let mut case = Case::new([3, 3, 4], 3, false, 0);
        case.multiplier.pop();
        case.all(Isa::best());
    }

    #[test]
    #[should_panic(expected = "the residual's multiplier has another length")]
    fn a_multiplier_without_residual() {
        let case = Case::new([3, 3, 4], 3, false, 0);
        let args = DepthwiseI8 { residual: &[1; 16], ..case.args() };
        depthwise_i8(Isa::best(), &args, 0..3, &mut [0; 36]);
    }

    #[test]
    #[should_panic(expected = "the weights have another shape")]
    fn unpadded_weights() {
        let mut case = Case::new([3, 3, 4], 3, false, 0);
        case.weights.truncate(36);
        case.all(Isa::best());
    }
}

//! Global mean of an 8-bit image.
//!
//! ```text
//! sum[c] = in[0][c] + in[1][c] + ...                                                       exact
//! out[c] = clamp(floor((sum[c] * factor + rows * 2^23) / (rows * 2^24)))                   rounded once, halves upwards
//! ```
//!
//! `factor` is `round(2^24 * scale of the input / scale of the output)`, at most [`MAX_FACTOR`]: a ratio up to 4. Its rounding
//! changes a result by at most `127 * 2^-25` of a step. A sum of 2^24 elements of -128 is -2^31, the lowest i32; its product
//! with the factor is at most 2^57 in magnitude, and an i64.
//!
//! The way back, [`broadcast`](super::pool::broadcast), takes any element. The body sums sixty-four channels at a time.

use super::gather_i8::sum_bytes;
use super::pool::Mean;
use crate::isa::Isa;
use crate::quantised::clamp;
use crate::simd::{Kernel, LANES, Simd, dispatch};

/// Bits of the factor behind the binary point.
pub const FRACTION: u32 = 24;
/// The largest factor, for a ratio of scales of 4.
pub const MAX_FACTOR: i32 = 4 << FRACTION;

/// Vectors summed at once.
const VECTORS: usize = 4;

/// The mean over all rows into `out`, one value per channel.
///
/// # Panics
/// If `factor` is negative or above [`MAX_FACTOR`], there are no rows or more than 2^24, or a slice does not have the size
/// that the shapes ask for.
///
/// # Determinism
/// Exact but for one fixed rounding, so the same on every instruction set.
pub fn mean_i8(isa: Isa, args: &Mean<'_, i8>, factor: i32, out: &mut [i8]) {
    assert!((0..=MAX_FACTOR).contains(&factor), "the factor {factor} is out of range");
    args.check(out);
    dispatch(isa, Run { args, factor, out });
}

struct Run<'a> {
    args: &'a Mean<'a, i8>,
    factor: i32,
    out: &'a mut [i8],
}

/// The mean of a sum of `rows` elements.
#[inline(always)]
fn finish(sum: i32, factor: i32, rows: usize) -> i8 {
    let unit = (rows as i64) << FRACTION;
    let mean = (i64::from(sum) * i64::from(factor) + unit / 2).div_euclid(unit);
    // The sum is within -128 * rows..=127 * rows, so the mean is within -512..=508.
    clamp(mean as i32, false)
}

impl Kernel for Run<'_> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        for (c, out) in self.out.iter_mut().enumerate() {
            let sum = self.args.input.iter().skip(c).step_by(self.args.channels).map(|&x| i32::from(x)).sum();
            *out = finish(sum, self.factor, self.args.rows());
        }
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let (a, rows) = (self.args, self.args.rows());
        let mut channel = 0;
        while channel < a.channels {
            let left = a.channels - channel;
            let out = &mut self.out[channel..];
            let place = |row: usize| a.input.as_ptr().wrapping_add(row * a.channels + channel);
            let mut sums = [s.splat_int(0); VECTORS];
            let width = if left >= VECTORS * LANES {
                // SAFETY: the input has `rows` rows, and each as many channels from here on.
                unsafe { sum_bytes(s, rows, place, &mut sums) };
                VECTORS * LANES
            } else if left >= LANES {
                // SAFETY: as above.
                unsafe { sum_bytes(s, rows, place, sums.first_chunk_mut::<1>().expect("some vectors")) };
                LANES
            } else {
                for row in a.input.chunks_exact(a.channels) {
                    sums[0] = s.add_int(sums[0], s.bytes_to_int(s.load_bytes_part(&row[channel..])));
                }
                left
            };
            for (out, sums) in out[..width].chunks_mut(LANES).zip(sums) {
                for (out, sum) in out.iter_mut().zip(s.int_lanes(sums)) {
                    *out = finish(sum, self.factor, rows);
                }
            }
            channel += width;
        }
    }
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Rng;

    fn run(isa: Isa, input: &[i8], channels: usize, factor: i32) -> Vec<i8> {
        let mut out = vec![55; channels];
        mean_i8(isa, &Mean { input, channels }, factor, &mut out);
        out
    }

    #[test]
    fn by_hand() {
        for isa in Isa::available() {
            assert_eq!(run(isa, &[1, 10, 2, -21, 6, 10], 2, 1 << FRACTION), [3, 0]);
            // 1.5 and -1.5: halves go upwards.
            assert_eq!(run(isa, &[1, -1, 2, -2], 2, 1 << FRACTION), [2, -1]);
            assert_eq!(run(isa, &[1, -1, 2, -2], 2, MAX_FACTOR), [6, -6]);
            assert_eq!(run(isa, &[100, -100], 2, MAX_FACTOR), [127, -127]);
        }
    }

    /// Channels around a vector and around four, rows around what 16 bits can sum.
    #[test]
    fn every_isa_agrees_with_f64() {
        for channels in [1, 5, 15, 16, 17, 33, 63, 64, 65, 80, 128, 200] {
            for (rows, factor) in
                [(1, 1 << FRACTION), (7, 12_345_678), (255, MAX_FACTOR), (256, 9_000_001), (600, 1 << 23)]
            {
                let mut rng = Rng::new(rows as u64);
                let input: Vec<i8> = (0..rows * channels).map(|_| rng.bits() as i8 / 2 + 20).collect();
                let want = run(Isa::Scalar, &input, channels, factor);
                for (c, got) in want.iter().enumerate() {
                    let sum: f64 = input.iter().skip(c).step_by(channels).map(|&x| f64::from(x)).sum();
                    let exact = (sum / rows as f64 * f64::from(factor) / f64::from(1 << FRACTION)).clamp(-127.0, 127.0);
                    assert!((f64::from(*got) - exact).abs() <= 0.5 + 1e-9, "{got} is not {exact}");
                }
                for isa in Isa::available() {
                    assert_eq!(run(isa, &input, channels, factor), want, "{} {rows} x {channels}", isa.name());
                }
            }
        }
    }

    #[test]
    fn extremes() {
        for x in [127, -127, -128] {
            let input = vec![x; 70_000 * 17];
            for isa in Isa::available() {
                assert_eq!(run(isa, &input, 17, 1 << FRACTION), [x.max(-127); 17]);
                assert_eq!(run(isa, &input, 17, 1 << (FRACTION - 1)), [if x > 0 { 64 } else { x / 2 }; 17]);
            }
        }
    }

    #[test]
    #[should_panic(expected = "the factor -1 is out of range")]
    fn a_negative_factor() {
        run(Isa::best(), &[0; 4], 2, -1);
    }

    #[test]
    #[should_panic(expected = "the mean of 0 rows")]
    fn no_rows() {
        run(Isa::best(), &[], 3, 1);
    }

    #[test]
    #[should_panic(expected = "the input is not whole rows")]
    fn part_of_a_row() {
        run(Isa::best(), &[0; 7], 3, 1);
    }
}

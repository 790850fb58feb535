//! Nearest-neighbour enlargement of a small 8-bit image, added to a large one in place.
//!
//! ```text
//! x = out[y][x][c]; l = low[y * low_height / height][x * low_width / width][c]          integer division
//! out[y][x][c] = clamp((x * factors[0] + l * factors[1] + 2^12) >> 13)                  rounded once, halves upwards
//! ```
//!
//! A factor is `round(2^13 * scale of the image / scale of the sum)`, from 0 to 2^15 - 1: a ratio below 4. The rounding of
//! factors changes a sum by at most `2 * 127 * 2^-14` of a step, less than 1/64. The sum of products is at most
//! `2 * 128 * (2^15 - 1) + 2^12 < 2^24` in magnitude, far inside i32.
//!
//! The body does sixteen channels at a time.

use super::upsample_add::UpsampleAdd;
use crate::isa::Isa;
use crate::quantised::clamp;
use crate::simd::{Kernel, LANES, Simd, dispatch};
use core::ops::Range;

/// Bits of a factor behind the binary point.
pub const FRACTION: u32 = 13;

/// What makes the nearest integer of the part in front of the point.
const HALF: i32 = 1 << (FRACTION - 1);

/// Adds to the rows `rows` of the large image, which `out` holds as `[rows, width, channels]`. `factors` are those of the
/// large image and of the small one.
///
/// # Panics
/// If a factor is negative, an extent is zero, `rows` leaves the image, or a slice does not have the size that the shapes ask
/// for.
///
/// # Determinism
/// Exact but for one fixed rounding, so the same on every instruction set and for every division into rows.
pub fn upsample_add_i8(isa: Isa, args: &UpsampleAdd<'_, i8>, factors: [i16; 2], rows: Range<usize>, out: &mut [i8]) {
    assert!(factors.iter().all(|&factor| factor >= 0), "factors {factors:?}");
    args.check(&rows, out);
    dispatch(isa, Run { args, factors: factors.map(i32::from), rows, out });
}

struct Run<'a> {
    args: &'a UpsampleAdd<'a, i8>,
    factors: [i32; 2],
    rows: Range<usize>,
    out: &'a mut [i8],
}

impl Kernel for Run<'_> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        let (a, [own, other]) = (self.args, self.factors);
        for (i, out) in self.out.iter_mut().enumerate() {
            let y = self.rows.start + i / (a.channels * a.width);
            let low = a.low[a.offset(y, i / a.channels % a.width) + i % a.channels];
            *out = clamp((i32::from(*out) * own + i32::from(low) * other + HALF) >> FRACTION, false);
        }
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let a = self.args;
        let [own, other] = self.factors;
        let (own, other) = (s.splat_int(own.cast_unsigned()), s.splat_int(other.cast_unsigned()));
        let half = s.splat_int(HALF.cast_unsigned());
        for (y, row) in self.rows.zip(self.out.chunks_exact_mut(a.width * a.channels)) {
            for (x, out) in row.chunks_exact_mut(a.channels).enumerate() {
                let low = &a.low[a.offset(y, x)..][..a.channels];
                for (out, low) in out.chunks_mut(LANES).zip(low.chunks(LANES)) {
                    let (x, low) = (s.load_bytes_part(out), s.load_bytes_part(low));
                    let low = s.mul_short(s.bytes_to_int(low), other);
                    let sum = s.add_int(s.mul_short(s.bytes_to_int(x), own), s.add_int(low, half));
                    s.store_bytes_part(out, s.quantised(s.shift_right_signed(sum, FRACTION), false));
                }
            }
        }
    }
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Rng;

    fn args(
        low: &[i8],
        [low_height, low_width]: [usize; 2],
        [height, width, channels]: [usize; 3],
    ) -> UpsampleAdd<'_, i8> {
        UpsampleAdd { low, low_height, low_width, height, width, channels }
    }

    fn all(isa: Isa, args: &UpsampleAdd<'_, i8>, factors: [i16; 2], high: &[i8]) -> Vec<i8> {
        let mut out = high.to_vec();
        let (top, bottom) = out.split_at_mut(args.height / 2 * args.width * args.channels);
        upsample_add_i8(isa, args, factors, 0..args.height / 2, top);
        upsample_add_i8(isa, args, factors, args.height / 2..args.height, bottom);
        out
    }

    #[test]
    fn by_hand() {
        for isa in Isa::available() {
            // 1/2 * 9 + 2 * low: 6.5, 8.5, 4.5 - 2, and halves go upwards.
            let factors = [1 << 12, 1 << 14];
            let args = args(&[1, 2, -1, -2], [2, 2], [2, 4, 1]);
            assert_eq!(all(isa, &args, factors, &[9; 8]), [7, 7, 9, 9, 3, 3, 1, 1]);
            // Nothing leaves -127..=127.
            let args = UpsampleAdd { low: &[127, -127, -128, 127], ..args };
            assert_eq!(
                all(isa, &args, [i16::MAX; 2], &[127, 0, 0, -127, -128, 127, 0, 1]),
                [127, 127, -127, -127, -127, -4, 127, 127]
            );
        }
    }

    /// Channels around a vector. The error is half a step, and what the factors' rounding adds.
    #[test]
    fn every_isa_agrees_with_f64() {
        for channels in [1, 5, 15, 16, 17, 33, 64] {
            let mut rng = Rng::new(channels as u64);
            let mut bytes =
                |n: usize| -> Vec<i8> { (0..n).map(|_| (rng.bits() % 255) as i8).map(|x| x.max(-127)).collect() };
            let (low, high) = (bytes(2 * 3 * channels), bytes(5 * 6 * channels));
            let ratios = [0.731, 1.0 / 3.0];
            let factors = ratios.map(|ratio: f64| (ratio * 8192.0).round() as i16);
            let args = args(&low, [2, 3], [5, 6, channels]);
            let want = all(Isa::Scalar, &args, factors, &high);
            for (i, got) in want.iter().enumerate() {
                let (y, x, c) = (i / channels / 6, i / channels % 6, i % channels);
                let low = f64::from(low[(y * 2 / 5 * 3 + x * 3 / 6) * channels + c]);
                let exact = (f64::from(high[i]) * ratios[0] + low * ratios[1]).clamp(-127.0, 127.0);
                assert!((f64::from(*got) - exact).abs() < 0.5 + 1.0 / 64.0, "{got} is not {exact}");
            }
            for isa in Isa::available() {
                assert_eq!(all(isa, &args, factors, &high), want, "{} {channels}", isa.name());
            }
        }
    }

    #[test]
    #[should_panic(expected = "factors [-1, 0]")]
    fn a_negative_factor() {
        all(Isa::best(), &args(&[0; 1], [1, 1], [2, 2, 1]), [-1, 0], &[0; 4]);
    }

    #[test]
    #[should_panic(expected = "the input has another shape")]
    fn short_input() {
        all(Isa::best(), &args(&[0; 3], [2, 2], [2, 2, 1]), [1, 1], &[0; 4]);
    }
}

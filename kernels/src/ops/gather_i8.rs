//! Mean of 8-bit camera features per voxel or bird's-eye-view cell.
//!
//! ```text
//! n         = max(1, entries of row r that no mask leaves out)
//! sum[c]    = x[col[ptr[r]]][c] + x[col[ptr[r] + 1]][c] + ...            exact
//! mult      = (factor + n / 2) / n                                       integer divisions
//! out[r][c] = clamp((sum[c] * mult + bias[c] + 2^20) >> 21)              rounded once, halves upwards
//! ```
//!
//! `factor` is `round(2^21 * scale of the features / scale of the output)`, at most [`MAX_FACTOR`]: a ratio up to 2. The bias is
//! in units of 2^-21 steps of the output, at most [`MAX_BIAS`] in magnitude. Rounding `factor` and `mult` changes a result by
//! at most `127 * (n + 1) / 2 * 2^-21` of a step: 1/1000 for 30 entries, 1/30 for 1000.
//!
//! No sum leaves i32 where n is at most [`MAX_ENTRIES`], which is more than the cameras have pixels, and elements are within
//! -127..=127: `|sum| <= 127 n`, `mult <= factor / n + 1/2`, so
//! `|sum * mult + bias + 2^20| <= 127 * 2^22 + 127 / 2 * 2^22 + 2^30 + 2^20 = 1 873 805 312 < 2^31`.
//! Beyond, sums wrap around on every instruction set alike.
//!
//! The body adds bytes in 16 bits, sixty-four channels at a time (a cache line), and goes over to 32 bits after as many
//! pixels as cannot overflow. That all pixels of a row exist is checked before, so that nothing else is done meanwhile.

use super::gather::Gather;
use crate::isa::Isa;
use crate::quantised::clamp;
use crate::simd::{Kernel, LANES, Simd, dispatch};
use core::ops::Range;

/// Bits of the factor and of the bias behind the binary point.
pub const FRACTION: u32 = 21;
/// The largest factor, for a ratio of scales of 2.
pub const MAX_FACTOR: i32 = 2 << FRACTION;
/// The largest magnitude of a bias: 512 steps of the output.
pub const MAX_BIAS: i32 = 1 << 30;
/// Entries of a row up to which sums are exact.
pub const MAX_ENTRIES: usize = 1 << 22;

/// What makes the nearest integer of the part in front of the point.
const HALF: i32 = 1 << (FRACTION - 1);
/// Vectors summed at once.
const VECTORS: usize = 4;
/// Bytes of any value whose sum fits into 16 bits.
const RUN: usize = 255;

/// Gathers the rows `rows` into `out`, which holds exactly those, densely.
///
/// # Panics
/// If `factor` is negative or above [`MAX_FACTOR`], or `ptr`, `col` or a slice's size breaks the rules of [`Gather`].
///
/// # Determinism
/// Exact but for one fixed rounding, so the same on every instruction set and for every division into rows.
pub fn gather_i8(isa: Isa, args: &Gather<'_, i8, i32>, factor: i32, rows: Range<usize>, out: &mut [i8]) {
    assert!((0..=MAX_FACTOR).contains(&factor), "the factor {factor} is out of range");
    args.check(&rows, out);
    dispatch(isa, Run { args, factor, rows, out });
}

struct Run<'a> {
    args: &'a Gather<'a, i8, i32>,
    factor: i32,
    rows: Range<usize>,
    out: &'a mut [i8],
}

/// What a sum of `entries` pixels is multiplied by.
#[inline(always)]
fn multiplier(factor: i32, entries: usize) -> i32 {
    let n = u32::try_from(entries.max(1)).unwrap_or(u32::MAX);
    // A factor is at most 2^22 and half of n below 2^31, so the sum fits into 32 bits.
    ((factor.cast_unsigned() + n / 2) / n).cast_signed()
}

impl Kernel for Run<'_> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        let a = self.args;
        for (row, out) in self.rows.zip(self.out.chunks_exact_mut(a.channels.max(1))) {
            let row = a.row(row);
            row.clone().for_each(|cols| a.check_pixels(cols));
            let multiplier = multiplier(self.factor, row.clone().columns());
            for (c, out) in out.iter_mut().enumerate() {
                let elements = row.clone().flatten().map(|&col| i32::from(a.features[a.offset(col, c)]));
                let sum = elements.fold(0, i32::wrapping_add);
                let bias = a.bias.map_or(0, |bias| bias[c]);
                let scaled = sum.wrapping_mul(multiplier).wrapping_add(bias).wrapping_add(HALF);
                *out = clamp(scaled >> FRACTION, a.relu);
            }
        }
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let a = self.args;
        for (row, out) in self.rows.zip(self.out.chunks_exact_mut(a.channels.max(1))) {
            let row = a.row(row);
            row.clone().for_each(|cols| a.check_pixels(cols));
            let multiplier = s.splat_int(multiplier(self.factor, row.clone().columns()).cast_unsigned());
            let mut channel = 0;
            while channel < a.channels {
                let left = a.channels - channel;
                let out = &mut out[channel..];
                let place = |cols: &[u32], i: usize| a.features.as_ptr().wrapping_add(a.offset(cols[i], channel));
                if left >= VECTORS * LANES {
                    let mut sums = [s.splat_int(0); VECTORS];
                    for cols in row.clone() {
                        // SAFETY: these pixels exist, and with them all channels that are gathered, of which these are some.
                        unsafe { sum_bytes(s, cols.len(), |i| place(cols, i), &mut sums) };
                    }
                    for v in 0..VECTORS {
                        let at = v * LANES;
                        finish(s, a, channel + at, multiplier, sums[v], &mut out[at..at + LANES]);
                    }
                    channel += VECTORS * LANES;
                } else {
                    let width = left.min(LANES);
                    let mut sums = [s.splat_int(0)];
                    for cols in row.clone() {
                        if width == LANES {
                            // SAFETY: as above.
                            unsafe { sum_bytes(s, cols.len(), |i| place(cols, i), &mut sums) };
                        } else {
                            for &col in cols {
                                let x = s.load_bytes_part(&a.features[a.offset(col, channel)..][..width]);
                                sums[0] = s.add_int(sums[0], s.bytes_to_int(x));
                            }
                        }
                    }
                    finish(s, a, channel, multiplier, sums[0], &mut out[..width]);
                    channel += width;
                }
            }
        }
    }
}

/// Adds to `sums` the bytes of `N` vectors at each of `count` places.
///
/// # Safety
/// What `place` returns for numbers below `count` must be valid for reading `N` times [`LANES`] bytes.
#[inline(always)]
pub(super) unsafe fn sum_bytes<S: Simd, const N: usize>(
    s: S,
    count: usize,
    place: impl Fn(usize) -> *const i8,
    sums: &mut [S::I; N],
) {
    let mut start = 0;
    while start < count {
        let end = count.min(start + RUN);
        let mut short = [s.bytes_to_short(s.splat_bytes(0)); N];
        for i in start..end {
            let at = place(i);
            for v in 0..N {
                // SAFETY: i is below `count`, so the caller's promise holds; v is below N.
                let x = unsafe { s.load_bytes_ptr(at.add(v * LANES)) };
                short[v] = s.add_short(short[v], s.bytes_to_short(x));
            }
        }
        for v in 0..N {
            sums[v] = s.add_int(sums[v], s.short_to_int(short[v]));
        }
        start = end;
    }
}

/// Multiplies, adds the bias, rounds and stores up to 16 channels.
#[inline(always)]
fn finish<S: Simd>(s: S, a: &Gather<'_, i8, i32>, channel: usize, multiplier: S::I, sum: S::I, out: &mut [i8]) {
    let mut value = s.add_int(s.mul_int(sum, multiplier), s.splat_int(HALF.cast_unsigned()));
    if let Some(bias) = a.bias {
        value = s.add_int(value, s.load_int_part(&bias[channel..channel + out.len()]));
    }
    s.store_bytes_part(out, s.quantised(s.shift_right_signed(value, FRACTION), a.relu));
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests {
    use super::super::gather::Mask;
    use super::*;
    use crate::testing::Rng;

    struct Case {
        ptr: Vec<u32>,
        col: Vec<u32>,
        features: Vec<i8>,
        stride: usize,
        first_channel: usize,
        channels: usize,
        bias: Option<Vec<i32>>,
        relu: bool,
        factor: i32,
    }

    impl Case {
        /// Rows of these lengths over `pixels` pixels, with values from -127 on.
        fn new(lengths: &[usize], pixels: usize, channels: usize, [bias, relu]: [bool; 2], seed: u64) -> Self {
            let mut rng = Rng::new(seed);
            let (first_channel, stride) = (3, channels + 5);
            let mut ptr = vec![0];
            ptr.extend(lengths.iter().scan(0, |end, len| {
                *end += *len as u32;
                Some(*end)
            }));
            Self {
                col: (0..*ptr.last().unwrap()).map(|_| (rng.bits() % pixels as u64) as u32).collect(),
                ptr,
                features: (0..pixels * stride).map(|_| (rng.bits() as i8).max(-127)).collect(),
                stride,
                first_channel,
                channels,
                bias: bias.then(|| (0..channels).map(|_| (rng.bits() as i32) >> 5).collect()),
                relu,
                factor: 1 << FRACTION,
            }
        }

        fn args(&self) -> Gather<'_, i8, i32> {
            Gather {
                ptr: &self.ptr,
                col: &self.col,
                mask: None,
                features: &self.features,
                stride: self.stride,
                first_channel: self.first_channel,
                channels: self.channels,
                bias: self.bias.as_deref(),
                relu: self.relu,
            }
        }

        fn all(&self, isa: Isa) -> Vec<i8> {
            let rows = self.ptr.len() - 1;
            let mut out = vec![55; rows * self.channels];
            let (left, right) = out.split_at_mut(rows / 2 * self.channels);
            gather_i8(isa, &self.args(), self.factor, 0..rows / 2, left);
            gather_i8(isa, &self.args(), self.factor, rows / 2..rows, right);
            out
        }

        /// The mean in f64, and how far a result may be from it.
        fn naive(&self) -> Vec<(f64, f64)> {
            let unit = f64::from(1 << FRACTION);
            (0..(self.ptr.len() - 1) * self.channels)
                .map(|i| {
                    let (row, c) = (i / self.channels, i % self.channels);
                    let cols = &self.col[self.ptr[row] as usize..self.ptr[row + 1] as usize];
                    let x = |&col: &u32| f64::from(self.features[col as usize * self.stride + self.first_channel + c]);
                    let n = cols.len().max(1) as f64;
                    let bias = self.bias.as_ref().map_or(0.0, |bias| f64::from(bias[c]) / unit);
                    let mean = cols.iter().map(x).sum::<f64>() / n * f64::from(self.factor) / unit + bias;
                    let low = if self.relu { 0.0 } else { -127.0 };
                    (mean.clamp(low, 127.0), 0.5 + 127.0 * (n + 1.0) / 2.0 / unit)
                })
                .collect()
        }
    }

    #[test]
    fn by_hand() {
        let ones = 1 << FRACTION;
        let mut case = Case::new(&[2, 0, 3], 4, 2, [false; 2], 0);
        (case.features, case.stride, case.first_channel) = (vec![1, -10, 2, 20, 7, -30, 100, 127], 2, 0);
        case.col = vec![0, 1, 0, 1, 2];
        for isa in Isa::available() {
            // Means 1.5 and 5, nothing, 10/3 and -20/3.
            (case.factor, case.bias, case.relu) = (ones, None, false);
            assert_eq!(case.all(isa), [2, 5, 0, 0, 3, -7]);
            // Twice that, less 1 and plus 20.
            (case.factor, case.bias) = (2 * ones, Some(vec![-ones, 20 * ones]));
            assert_eq!(case.all(isa), [2, 30, -1, 20, 6, 7]);
            case.relu = true;
            assert_eq!(case.all(isa), [2, 30, 0, 20, 6, 7]);
        }
    }

    /// Channels around a vector and around four, rows around what 16 bits can sum.
    #[test]
    fn every_isa_agrees_with_f64() {
        let lengths = [3, 0, 1, 27, 254, 255, 256, 257, 0, 800];
        for channels in [1, 15, 16, 17, 32, 63, 64, 65, 80, 128, 150] {
            for (end, factor) in
                [([false, false], 1 << FRACTION), ([true, false], 1_234_567), ([true, true], MAX_FACTOR)]
            {
                let mut case = Case::new(&lengths, 40, channels, end, 3);
                case.factor = factor;
                let want = case.all(Isa::Scalar);
                for (got, (exact, error)) in want.iter().zip(case.naive()) {
                    assert!((f64::from(*got) - exact).abs() <= error, "{got} is not {exact}");
                }
                for isa in Isa::available() {
                    assert_eq!(case.all(isa), want, "{} {channels} {end:?}", isa.name());
                }
            }
        }
    }

    /// Only values at the ends, the largest factor and the largest bias.
    #[test]
    fn extremes_stay_inside_of_i32() {
        for sign in [1, -1] {
            let mut case = Case::new(&[1, 256, 10_000], 40, 81, [false; 2], 1);
            case.features.fill(127 * sign);
            case.factor = MAX_FACTOR;
            case.bias = Some((0..81).map(|c| if c % 2 == 0 { MAX_BIAS } else { -MAX_BIAS }).collect());
            let want: Vec<i8> = case.naive().into_iter().map(|(exact, _)| exact as i8).collect();
            assert!(want.contains(&127) && want.contains(&-127));
            for isa in Isa::available() {
                assert_eq!(case.all(isa), want, "{}", isa.name());
            }
        }
        let exact = 127 * i64::from(MAX_FACTOR) + 127 * MAX_ENTRIES as i64 / 2 + i64::from(MAX_BIAS) + i64::from(HALF);
        assert_eq!(exact, 1_873_805_312);
        assert!(exact < 1 << 31);
    }

    #[test]
    fn a_masked_camera_is_as_if_its_entries_were_not_there() {
        let masked = [false, true, false, true];
        let mut case = Case::new(&[9, 0, 40, 3, 300, 1], 7 * masked.len(), 67, [true, false], 5);
        case.ptr.clone().windows(2).for_each(|row| case.col[row[0] as usize..row[1] as usize].sort_unstable());
        let (mut ptr, mut col) = (vec![0], vec![]);
        for row in case.ptr.windows(2) {
            let row = &case.col[row[0] as usize..row[1] as usize];
            col.extend(row.iter().filter(|&&pixel| !masked[pixel as usize / 7]));
            ptr.push(col.len() as u32);
        }
        let fewer = Case { ptr, col, features: case.features.clone(), bias: case.bias.clone(), ..case };
        let want = fewer.all(Isa::Scalar);
        for isa in Isa::available() {
            let mut out = vec![55; want.len()];
            let args = Gather { mask: Some(Mask { pixels: 7, masked: &masked }), ..case.args() };
            gather_i8(isa, &args, case.factor, 0..6, &mut out);
            assert_eq!(out, want, "{}", isa.name());
        }
    }

    #[test]
    #[should_panic(expected = "the factor 4194305 is out of range")]
    fn a_factor_too_large() {
        let mut case = Case::new(&[2, 0, 3], 10, 4, [true, false], 0);
        case.factor = MAX_FACTOR + 1;
        case.all(Isa::best());
    }

    #[test]
    #[should_panic(expected = "out of range")]
    fn a_pixel_that_is_not_there() {
        let mut case = Case::new(&[2, 0, 3], 10, 64, [true, false], 0);
        case.col[4] = 10;
        case.all(Isa::best());
    }

    #[test]
    #[should_panic(expected = "the bias is shorter than the channels")]
    fn short_bias() {
        let mut case = Case::new(&[2, 0, 3], 10, 4, [true, false], 0);
        case.bias = Some(vec![0; 3]);
        case.all(Isa::best());
    }
}

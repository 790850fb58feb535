//! Fusion of a volume with its bird's-eye view in 8 bits: each voxel decides how much of its column's BEV feature to take.
//!
//! ```text
//! for each column xy, for each z:
//!     sum   = bias + volume[xy][z][0] * w[0] + volume[xy][z][1] * w[1] + ...                     exact
//!     gate  = sigmoid_q10(requantise(sum, multiplier))                                           0..=1024
//!     volume[xy][z][c] = clamp((volume[xy][z][c] * factors[0] + bev[xy][c] * gate * factors[1] + 2^20) >> 21)
//! ```
//!
//! The logit is in units of 1/64: `multiplier` is `round(2^32 * 64 * scale of the volume * scale of the weights)`, the bias in
//! units of the sum. Factors are `round(2^21 * scale of the volume / scale of the result)` and
//! `round(2^11 * scale of the BEV / scale of the result)`, for ratios up to 4. With `q` the BEV's part of the result, at most
//! 508 steps, errors are: of the logit's and the table's rounding at most `q / 512 + q / 2048`; of the factors' at most
//! `127 * (1 + 1024) * 2^-22 < 1/32` of a step; of the result's at most 1/2 step.
//!
//! Who makes the weights proves `|bias| + 127 * sum of |w| < 2^31`. The result's sum is at most
//! `127 * 2^23 + 127 * 2^10 * 2^13 + 2^20 = 2 131 755 008 < 2^31` in magnitude.
//!
//! The body takes sixteen voxels at a time, so that their logits are one vector.

use crate::isa::Isa;
use crate::quantised::{clamp, requantise, sigmoid_q10};
use crate::simd::{Kernel, LANES, Simd, dispatch};

/// Bits of the volume's factor behind the binary point. The BEV's has ten less, which the gate brings.
pub const FRACTION: u32 = 21;
/// The largest factors, for ratios of scales of 4.
pub const MAX_FACTORS: [i32; 2] = [4 << FRACTION, 4 << (FRACTION - 10)];

/// What makes the nearest integer of the part in front of the point.
const HALF: i32 = 1 << (FRACTION - 1);

/// A gate's arguments.
#[derive(Clone, Copy, Debug)]
pub struct GateI8<'a> {
    /// `[columns, channels]`.
    pub bev: &'a [i8],
    /// Voxels per column.
    pub depth: usize,
    /// Channels of both tensors.
    pub channels: usize,
    /// One weight per channel, padded with zeros to a multiple of 16.
    pub weights: &'a [i8],
    /// Where the dot product starts.
    pub bias: i32,
    /// From the dot product to a logit in units of 1/64.
    pub multiplier: i32,
    /// Of the volume and of the BEV.
    pub factors: [i32; 2],
}

impl GateI8<'_> {
    fn check(&self, volume: &[i8]) {
        let factors = self.factors.iter().zip(MAX_FACTORS);
        assert!(factors.into_iter().all(|(factor, max)| (0..=max).contains(factor)), "factors {:?}", self.factors);
        assert!(self.channels > 0 && self.depth > 0, "an extent is zero");
        assert!(self.bev.len().is_multiple_of(self.channels), "the BEV is not whole rows");
        assert_eq!(self.weights.len(), self.channels.next_multiple_of(LANES), "the weights have another length");
        assert_eq!(volume.len(), self.bev.len() * self.depth, "the volume has another shape");
    }

    /// What the BEV's features are multiplied by, of a voxel with this dot product.
    #[inline(always)]
    fn gate(&self, logit: i32) -> i32 {
        sigmoid_q10(logit) * self.factors[1]
    }
}

/// Changes `volume`, `[columns, depth, channels]`, in place. To divide columns among threads, divide the BEV alike.
///
/// # Panics
/// If a factor is out of range, an extent is zero or a slice does not have the size that the shapes ask for.
///
/// # Determinism
/// Integers with fixed roundings, so the same on every instruction set and for every division into columns.
pub fn gate_i8(isa: Isa, args: &GateI8<'_>, volume: &mut [i8]) {
    args.check(volume);
    dispatch(isa, Run { args, volume });
}

struct Run<'a> {
    args: &'a GateI8<'a>,
    volume: &'a mut [i8],
}

impl Kernel for Run<'_> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        let a = self.args;
        for (i, voxel) in self.volume.chunks_exact_mut(a.channels).enumerate() {
            let products = voxel.iter().zip(a.weights).map(|(x, w)| i32::from(*x) * i32::from(*w));
            let gate = a.gate(requantise(products.fold(a.bias, i32::wrapping_add), a.multiplier));
            for (c, x) in voxel.iter_mut().enumerate() {
                let bev = i32::from(a.bev[i / a.depth * a.channels + c]).wrapping_mul(gate);
                let sum = i32::from(*x).wrapping_mul(a.factors[0]).wrapping_add(bev).wrapping_add(HALF);
                *x = clamp(sum >> FRACTION, false);
            }
        }
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let a = self.args;
        let (bias, multiplier) = (s.splat_int(a.bias.cast_unsigned()), s.splat_int(a.multiplier.cast_unsigned()));
        let (own, half) = (s.splat_int(a.factors[0].cast_unsigned()), s.splat_int(HALF.cast_unsigned()));
        for (block, voxels) in self.volume.chunks_mut(LANES * a.channels).enumerate() {
            let mut dots = [0; LANES];
            for (dot, voxel) in dots.iter_mut().zip(voxels.chunks_exact(a.channels)) {
                let mut sum = s.splat_int(0);
                for (x, w) in voxel.chunks(LANES).zip(a.weights.chunks_exact(LANES)) {
                    sum = s.add_int(sum, s.mul_short(load(s, x), load(s, w)));
                }
                *dot = s.int_lanes(sum).into_iter().fold(0, i32::wrapping_add);
            }
            let logits = s.int_lanes(s.requantise(s.add_int(s.load_int(&dots), bias), multiplier));
            for (i, voxel) in voxels.chunks_exact_mut(a.channels).enumerate() {
                let gate = s.splat_int(a.gate(logits[i]).cast_unsigned());
                let bev = &a.bev[(block * LANES + i) / a.depth * a.channels..][..a.channels];
                for (x, bev) in voxel.chunks_mut(LANES).zip(bev.chunks(LANES)) {
                    let sum = s.add_int(s.mul_int(load(s, x), own), s.mul_int(load(s, bev), gate));
                    let sum = s.shift_right_signed(s.add_int(sum, half), FRACTION);
                    s.store_bytes_part(x, s.quantised(sum, false));
                }
            }
        }
    }
}

/// Up to 16 elements as integers.
#[inline(always)]
fn load<S: Simd>(s: S, x: &[i8]) -> S::I {
    s.bytes_to_int(s.load_bytes_part(x))
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Rng;

    struct Case {
        shape: [usize; 3],
        volume: Vec<i8>,
        bev: Vec<i8>,
        weights: Vec<i8>,
        bias: i32,
        multiplier: i32,
        factors: [i32; 2],
    }

    impl Case {
        fn new(shape: [usize; 3], seed: u64) -> Self {
            let [columns, depth, channels] = shape;
            let mut rng = Rng::new(seed);
            let mut bytes = |n: usize| -> Vec<i8> { (0..n).map(|_| (rng.bits() as i8).max(-127)).collect() };
            let (volume, bev, mut weights) =
                (bytes(columns * depth * channels), bytes(columns * channels), bytes(channels));
            weights.resize(channels.next_multiple_of(LANES), 0);
            // A logit of about 1 (64 units) where the sum is about 74^2 times the square root of the channels.
            let multiplier = (64.0 / 5500.0 / (channels as f64).sqrt() * f64::from(1u32 << 31) * 2.0) as i32;
            Self { shape, volume, bev, weights, bias: 1000, multiplier, factors: [1 << 20, 1 << 10] }
        }

        fn args(&self) -> GateI8<'_> {
            let [_, depth, channels] = self.shape;
            let Self { bias, multiplier, factors, .. } = *self;
            GateI8 { bev: &self.bev, depth, channels, weights: &self.weights, bias, multiplier, factors }
        }

        fn all(&self, isa: Isa) -> Vec<i8> {
            let [columns, depth, channels] = self.shape;
            let (mut volume, split) = (self.volume.clone(), columns / 2 * channels);
            let (left, right) = volume.split_at_mut(split * depth);
            gate_i8(isa, &GateI8 { bev: &self.bev[..split], ..self.args() }, left);
            gate_i8(isa, &GateI8 { bev: &self.bev[split..], ..self.args() }, right);
            volume
        }
    }

    #[test]
    fn by_hand() {
        // Dot products 2 * 1 - 1 * 2 = 0, 100 and -100.
        let mut case = Case::new([3, 1, 2], 0);
        case.volume = vec![1, 2, 100, 100, 0, 100];
        case.bev = vec![10, 21, 1, 2, 1, 2];
        (case.weights[0], case.weights[1]) = (2, -1);
        (case.bias, case.multiplier, case.factors) = (0, 8 << 24, [1 << 21, 1 << 11]);
        // Logits of 0, 3 and -3 units of 1/64: all gates are about a half.
        for isa in Isa::available() {
            assert_eq!(case.all(isa), [6, 13, 101, 101, 0, 101]);
        }
        // The largest multiplier halves: 0, 50 and -50 units, gates 0.5, 0.686 and 0.314.
        case.multiplier = i32::MAX;
        for isa in Isa::available() {
            assert_eq!(case.all(isa), [6, 13, 101, 101, 0, 101]);
        }
        // Logits of -981, 950 and -1050 units: gates 0, 1 and 0. The volume is halved, halves go upwards; the BEV thrice.
        (case.bias, case.weights[0], case.factors) = (-2000, 40, [1 << 20, 3 << 11]);
        for isa in Isa::available() {
            assert_eq!(case.all(isa), [1, 1, 53, 56, 0, 50]);
        }
    }

    /// Channels around 16, voxels around a block of 16 and columns that straddle blocks.
    #[test]
    fn every_isa_agrees_with_f64() {
        for shape in [[1, 1, 16], [3, 5, 1], [2, 8, 5], [17, 1, 16], [2, 7, 17], [5, 3, 33], [3, 16, 64], [1, 33, 64]] {
            let case = Case::new(shape, 12);
            let [_, depth, c] = shape;
            let want = case.all(Isa::Scalar);
            let mut gates = vec![];
            for (i, got) in want.iter().enumerate() {
                let voxel = &case.volume[i / c * c..][..c];
                let products = voxel.iter().zip(&case.weights).map(|(x, w)| f64::from(*x) * f64::from(*w));
                let sum = products.sum::<f64>() + f64::from(case.bias);
                let logit = sum * f64::from(case.multiplier) * 2f64.powi(-32) / 64.0;
                let gate = 1.0 / (1.0 + (-logit).exp());
                let bev = f64::from(case.bev[i / (c * depth) * c + i % c]) * 0.5;
                let exact = f64::from(case.volume[i]) * 0.5 + gate * bev;
                assert!(
                    (f64::from(*got) - exact).abs() <= 0.5 + bev.abs() * (1.0 / 512.0 + 1.0 / 2048.0) + 1e-9,
                    "{got} {exact}"
                );
                gates.push(gate);
            }
            let spread = gates.iter().copied().fold(0.0, f64::max) - gates.iter().copied().fold(1.0, f64::min);
            assert!(spread > 0.25 || shape == [1, 1, 16], "gates of {shape:?} spread over {spread}");
            for isa in Isa::available() {
                assert_eq!(case.all(isa), want, "{} {shape:?}", isa.name());
            }
        }
    }

    /// Only values at the ends and the largest factors: the sum before the shift is the largest of the proof.
    #[test]
    fn extremes_stay_inside_of_i32() {
        for (volume, bev, want) in [(127, 127, 127), (-127, -127, -127), (127, -127, 0), (-127, 127, 0)] {
            let mut case = Case::new([2, 3, 40], 0);
            case.volume.fill(volume);
            case.bev.fill(bev);
            (case.bias, case.multiplier, case.factors) = (1 << 30, i32::MAX, MAX_FACTORS);
            for isa in Isa::available() {
                assert_eq!(case.all(isa), [want; 240], "{}", isa.name());
            }
        }
        assert!(127 * i64::from(MAX_FACTORS[0]) + 127 * 1024 * i64::from(MAX_FACTORS[1]) + i64::from(HALF) < 1 << 31);
    }

    #[test]
    #[should_panic(expected = "factors [8388609, 0]")]
    fn a_factor_too_large() {
        let case = Case::new([3, 2, 4], 0);
        gate_i8(Isa::best(), &GateI8 { factors: [MAX_FACTORS[0] + 1, 0], ..case.args() }, &mut [0; 24]);
    }

    #[test]
    #[should_panic(expected = "the weights have another length")]
    fn unpadded_weights() {
        gate_i8(Isa::best(), &GateI8 { weights: &[0; 4], ..Case::new([3, 2, 4], 0).args() }, &mut [0; 24]);
    }

    #[test]
    #[should_panic(expected = "the volume has another shape")]
    fn short_volume() {
        gate_i8(Isa::best(), &Case::new([3, 2, 4], 0).args(), &mut [0; 20]);
    }
}

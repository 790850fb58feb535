//! How sure a head is: of the softmax of its logits, the probability that the voxel is occupied and that of its class.
//!
//! ```text
//! e[k] = exp((logits[k] - logits[class]) * scale)                     k from 0 on; e[class] is 1
//! occupied = ((e[1] + e[2]) + e[3]) + ...,  total = occupied + e[0]
//! 255 * occupied / total and 255 * 1 / total, to the nearest integer, ties to even
//! ```
//!
//! Lanes are voxels, so that the sum of a voxel is one chain on every instruction set. Class 0 is empty. Where a logit is NaN,
//! or the largest is infinite, nothing is known, and both are 0.

use crate::math::{exp, exp_v};
use crate::simd::{LANES, Simd};
use core::ops::Range;

#[cfg(not(feature = "std"))]
use crate::math::Float as _;

/// The largest code, which stands for 1.
const ONE: f32 = 255.0;

/// Where a head writes how sure it is, 0 to 255 for probabilities from 0 to 1.
#[derive(Debug)]
pub struct Confidence<'a> {
    /// What logits are multiplied by: the inverse of the softmax's temperature. Positive and finite.
    pub scale: f32,
    /// The probability that each voxel is of any class but 0.
    pub occupied: &'a mut [u8],
    /// The probability of each voxel's class.
    pub class: &'a mut [u8],
}

impl Confidence<'_> {
    /// Checks that there is room for `rows` rows.
    pub(super) fn check(&self, rows: usize) {
        assert!(self.scale > 0.0 && self.scale.is_finite(), "the confidence's scale is {}", self.scale);
        let lengths = [self.occupied.len(), self.class.len()];
        assert_eq!(lengths, [rows; 2], "the confidence does not hold the rows");
    }

    /// That of some of the rows.
    #[inline(always)]
    pub(crate) fn part(&mut self, rows: Range<usize>) -> Confidence<'_> {
        Confidence { scale: self.scale, occupied: &mut self.occupied[rows.clone()], class: &mut self.class[rows] }
    }

    /// Writes the confidence of voxels whose classes are `chosen`. `value` makes logits of `sums`, of which each voxel has one
    /// for each of `classes`.
    #[inline(always)]
    pub(crate) fn reference<T: Copy>(self, classes: usize, chosen: &[u8], sums: &[T], value: impl Fn(T) -> f32) {
        let logit = |voxel: usize, k: usize| value(sums[voxel * classes + k]);
        for (voxel, &class) in chosen.iter().enumerate() {
            let largest = logit(voxel, usize::from(class));
            let e = |k: usize| exp((logit(voxel, k) - largest) * self.scale);
            let occupied = (1..classes).fold(0.0, |sum, k| sum + e(k));
            let total = occupied + e(0);
            // A cast makes NaN 0.
            self.occupied[voxel] = (ONE * occupied / total).round_ties_even() as u8;
            self.class[voxel] = (ONE / total).round_ties_even() as u8;
        }
    }

    /// [`Confidence::reference`] of as many voxels at a time as there are lanes.
    #[inline(always)]
    pub(crate) fn run<S: Simd, T: Copy>(
        self,
        s: S,
        classes: usize,
        chosen: &[u8],
        sums: &[T],
        value: impl Fn(T) -> f32,
    ) {
        let (one, scale) = (s.splat(ONE), s.splat(self.scale));
        for (chosen, first) in chosen.chunks(LANES).zip((0..).step_by(LANES)) {
            let mut lanes = [0.0; LANES];
            for (i, (lane, &class)) in lanes.iter_mut().zip(chosen).enumerate() {
                *lane = value(sums[(first + i) * classes + usize::from(class)]);
            }
            let largest = s.load(&lanes);
            // Not a closure: it would not be compiled for the instruction set.
            let (mut occupied, mut empty) = (s.splat(0.0), s.splat(0.0));
            for k in 0..classes {
                for (i, lane) in lanes[..chosen.len()].iter_mut().enumerate() {
                    *lane = value(sums[(first + i) * classes + k]);
                }
                let e = exp_v(s, s.mul(s.sub(s.load(&lanes), largest), scale));
                if k == 0 {
                    empty = e;
                } else {
                    occupied = s.add(occupied, e);
                }
            }
            let total = s.add(occupied, empty);
            let rows = first..first + chosen.len();
            let codes = s.lanes(s.round(s.div(s.mul(one, occupied), total)));
            self.occupied[rows.clone()].iter_mut().zip(codes).for_each(|(out, code)| *out = code as u8);
            let codes = s.lanes(s.round(s.div(one, total)));
            self.class[rows].iter_mut().zip(codes).for_each(|(out, code)| *out = code as u8);
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::isa::Isa;
    use crate::simd::{Kernel, dispatch};
    use crate::testing::Rng;
    use core::convert::identity;
    use proptest::prelude::*;
    use proptest::test_runner::{Config, TestRunner};

    struct Sure<'a> {
        logits: &'a [f32],
        classes: usize,
        chosen: &'a [u8],
        confidence: Confidence<'a>,
    }

    impl Kernel for Sure<'_> {
        type Output = ();

        #[inline(always)]
        fn reference(self) {
            let Self { logits, classes, chosen, confidence } = self;
            confidence.reference(classes, chosen, logits, identity);
        }

        #[inline(always)]
        fn run<S: Simd>(self, s: S) {
            let Self { logits, classes, chosen, confidence } = self;
            confidence.run(s, classes, chosen, logits, identity);
        }
    }

    /// Codes of "occupied" and of the classes `chosen`.
    pub(crate) fn sure(isa: Isa, logits: &[f32], chosen: &[u8], scale: f32) -> [Vec<u8>; 2] {
        let (mut occupied, mut class) = (vec![77; chosen.len()], vec![78; chosen.len()]);
        let confidence = Confidence { scale, occupied: &mut occupied, class: &mut class };
        let classes = logits.len().checked_div(chosen.len()).unwrap_or(1);
        dispatch(isa, Sure { logits, classes, chosen, confidence });
        [occupied, class]
    }

    fn largest(logits: &[f32], classes: usize) -> Vec<u8> {
        logits.chunks_exact(classes).map(crate::ops::head::largest).collect()
    }

    /// 255 times the two probabilities in f64.
    fn naive(logits: &[f32], class: u8, scale: f32) -> [f64; 2] {
        let scaled = |logit: f32| f64::from(logit) * f64::from(scale);
        let most = logits.iter().copied().map(scaled).fold(f64::NEG_INFINITY, f64::max);
        let e: Vec<f64> = logits.iter().map(|&logit| (scaled(logit) - most).exp()).collect();
        let total: f64 = e.iter().sum();
        [1.0 - e[0] / total, e[usize::from(class)] / total].map(|p| 255.0 * p)
    }

    #[test]
    fn by_hand() {
        let ln2 = core::f32::consts::LN_2;
        // Shares of 1 : 2 : 1, of 1 : 4 : 1 at half the temperature, and of a voxel that is empty.
        let logits = [0.0, ln2, 0.0, 0.0, -100.0, -100.0];
        for isa in Isa::available() {
            // 191.25 and 127.5, which is a tie or just beside one; 212.5 and 170.
            let [occupied, class] = sure(isa, &logits, &[1, 0], 1.0);
            assert_eq!((occupied, class[0].abs_diff(127) < 2, class[1]), (vec![191, 0], true, 255), "{}", isa.name());
            let [occupied, class] = sure(isa, &logits, &[1, 0], 2.0);
            assert_eq!((occupied[0].abs_diff(212) < 2, class), (true, vec![170, 255]), "{}", isa.name());
        }
        let one = sure(Isa::Scalar, &[3.0, -3.0], &[0, 0], 1.0);
        assert_eq!(one, [[0, 0], [255, 255]], "of one class, all is empty");
    }

    #[test]
    fn what_is_not_finite_is_not_known() {
        const INF: f32 = f32::INFINITY;
        let known = [0.0f32, 1.0, 2.0];
        for (logits, expected) in [
            ([f32::NAN, 1.0, 2.0], [0, 0]),
            ([0.0, f32::NAN, 2.0], [0, 0]),
            ([0.0, INF, 2.0], [0, 0]),
            ([-INF, -INF, -INF], [0, 0]),
            ([-INF, 1.0, -INF], [255, 255]),
            ([f32::MAX, f32::MIN, 0.0], [0, 255]),
            ([f32::MIN, f32::MAX, f32::MAX], [255, 128]),
        ] {
            // Among others, so that lanes do not touch each other.
            let all = [known, logits, known].concat();
            let chosen = largest(&all, 3);
            for isa in Isa::available() {
                let [occupied, class] = sure(isa, &all, &chosen, 1.0);
                assert_eq!([occupied[1], class[1]], expected, "{} {logits:?}", isa.name());
                assert_eq!([occupied[0], class[0]], [occupied[2], class[2]], "{}", isa.name());
                assert_eq!([occupied[0], class[0]], [232, 170], "{}", isa.name());
            }
        }
    }

    #[test]
    fn any_logits_give_the_scalar_bits_and_are_close_to_f64() {
        let run = |(voxels, classes, seed, temperature, range): (usize, usize, u64, f32, f32)| {
            let mut rng = Rng::new(seed);
            let logits: Vec<f32> = rng.ordinary(voxels * classes).into_iter().map(|x| range * x).collect();
            let (chosen, scale) = (largest(&logits, classes), 1.0 / temperature);
            let want = sure(Isa::Scalar, &logits, &chosen, scale);
            for isa in Isa::available() {
                prop_assert_eq!(&sure(isa, &logits, &chosen, scale), &want, "{}", isa.name());
            }
            for (voxel, logits) in logits.chunks_exact(classes).enumerate() {
                let exact = naive(logits, chosen[voxel], scale);
                for (got, exact) in [want[0][voxel], want[1][voxel]].into_iter().zip(exact) {
                    prop_assert!((f64::from(got) - exact).abs() < 0.501, "{} for {}", got, exact);
                }
            }
            Ok(())
        };
        let drawn = (0usize..80, 1usize..40, any::<u64>(), 0.2f32..5.0, 0.0f32..12.0);
        TestRunner::new(Config { cases: 128, ..Config::default() }).run(&drawn, run).unwrap();
    }

    #[test]
    fn special_logits_give_the_scalar_bits() {
        for seed in 0..40 {
            let logits = Rng::new(seed).special(17 * 33);
            let chosen = largest(&logits, 17);
            let want = sure(Isa::Scalar, &logits, &chosen, 0.7);
            for isa in Isa::available() {
                assert_eq!(sure(isa, &logits, &chosen, 0.7), want, "{}", isa.name());
            }
        }
    }
}

//! The machine's own ceiling: fused multiply-adds that never leave the registers.

use crate::isa::Isa;
use crate::simd::{Kernel, LANES, Simd, dispatch};

/// Independent chains: enough to cover the latency of every vector unit, few enough to stay in registers.
const CHAINS: usize = 6;

/// Runs `rounds` rounds of register-only multiply-adds and returns how many it did. The caller takes the time; what is
/// returned beside the count only keeps the work from being optimised away.
pub fn multiply_adds(isa: Isa, rounds: usize) -> (u64, f32) {
    dispatch(isa, Rounds(rounds))
}

struct Rounds(usize);

impl Kernel for Rounds {
    type Output = (u64, f32);

    fn reference(self) -> (u64, f32) {
        let mut sums = [0.5f32; CHAINS];
        for _ in 0..self.0 {
            sums.iter_mut().for_each(|s| *s = s.mul_add(0.999, 0.001));
        }
        ((self.0 * CHAINS) as u64, sums.iter().sum())
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> (u64, f32) {
        let (scale, shift) = (s.splat(0.999), s.splat(0.001));
        let mut sums = [s.splat(0.5); CHAINS];
        for _ in 0..self.0 {
            for sum in &mut sums {
                *sum = s.mul_add(*sum, scale, shift);
            }
        }
        let total = sums.iter().fold(s.splat(0.0), |a, b| s.add(a, *b));
        ((self.0 * CHAINS * LANES) as u64, s.lanes(total)[0])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_isa_counts_and_converges() {
        for isa in Isa::available() {
            let (count, value) = multiply_adds(isa, 20_000);
            assert!(count >= 120_000);
            assert!((value - CHAINS as f32).abs() < 0.1, "{value}");
        }
    }
}

//! The machine's own ceiling: fused multiply-adds that never leave the registers.

use crate::isa::Isa;
#[cfg(not(feature = "std"))]
use crate::math::Float as _;
use crate::simd::{Kernel, LANES, Simd, TileRows, dispatch, tree_sum};

/// Independent chains of the specification: enough to cover the latency of every unit.
const CHAINS: usize = 6;

/// Where lane `i` of chain `c` starts. All differ, or the compiler would compute equal registers once.
fn start(c: usize) -> [f32; LANES] {
    core::array::from_fn(|i| 0.25 + 0.01 * (c * LANES + i) as f32)
}

/// Runs `rounds` rounds of register-only multiply-adds and returns how many it did. The caller takes the time; what is
/// returned beside the count only keeps the work from being optimised away.
pub fn multiply_adds(isa: Isa, rounds: usize) -> (u64, f32) {
    dispatch(isa, Rounds(rounds))
}

struct Rounds(usize);

impl Kernel for Rounds {
    type Output = (u64, f32);

    #[inline(always)]
    fn reference(self) -> (u64, f32) {
        let mut sums: [f32; CHAINS] = core::array::from_fn(|c| start(c)[0]);
        for _ in 0..self.0 {
            sums = sums.map(|sum| sum.mul_add(0.999, 0.001));
        }
        ((self.0 * CHAINS) as u64, sums.iter().sum::<f32>() / CHAINS as f32)
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> (u64, f32) {
        let mut result = (0, 0.0);
        s.rows(usize::MAX, Chains { rounds: self.0, result: &mut result });
        result
    }
}

/// As many independent chains as a register tile has rows: enough to cover the latency of every vector unit, few enough
/// to stay in registers.
struct Chains<'a> {
    rounds: usize,
    result: &'a mut (u64, f32),
}

impl<S: Simd> TileRows<S> for Chains<'_> {
    #[inline(always)]
    fn run<const N: usize>(self, s: S) {
        let (scale, shift) = (s.splat(0.999), s.splat(0.001));
        let mut sums: [S::V; N] = core::array::from_fn(|c| s.load(&start(c)));
        for _ in 0..self.rounds {
            for sum in &mut sums {
                *sum = s.mul_add(*sum, scale, shift);
            }
        }
        let total = sums.iter().fold(s.splat(0.0), |a, b| s.add(a, *b));
        let lanes = N * LANES;
        *self.result = ((self.rounds * lanes) as u64, tree_sum(s.lanes(total)) / lanes as f32);
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
            assert!((value - 1.0).abs() < 0.02, "{value}");
        }
    }
}

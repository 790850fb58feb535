//! Seeded random numbers that are the same on every machine.
//!
//! Only integer arithmetic and exact conversions are used, so a seed fixes every bit of what follows from it. The
//! generator is SplitMix64 (Steele, Lea and Flood, OOPSLA 2014): fast and well distributed, and not for secrets.

/// A stream of random numbers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Random {
    state: u64,
}

impl Random {
    /// The stream of `seed`. Streams of different seeds, also of neighbouring ones, look independent.
    pub fn new(seed: u64) -> Self {
        Self { state: seed }
    }

    /// The next 64 bits.
    pub fn next_u64(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.state ^ (self.state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Uniform in [0, 1): a multiple of 2^-24, so that every value is exact.
    pub fn next_f32(&mut self) -> f32 {
        (self.next_u64() >> 40) as f32 * (1.0 / (1u32 << 24) as f32)
    }

    /// Uniform from `low` to `high`, for finite bounds. Rounding may return `high` itself.
    pub fn range(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.next_f32()
    }

    /// Uniform in `0..n`, and 0 for `n` = 0. The bias is below `n` / 2^64.
    pub fn below(&mut self, n: usize) -> usize {
        ((u128::from(self.next_u64()) * n as u128) >> 64) as usize
    }

    /// Close to a standard normal: mean 0, variance 1 within 1e-9, magnitude below 6.
    ///
    /// It is the sum of twelve 16-bit uniforms (Irwin-Hall). The sum is an integer and its conversion exact, which the
    /// logarithm and cosine of the usual methods would not be on every machine.
    pub fn normal(&mut self) -> f32 {
        let mut sum = 0i32;
        for _ in 0..3 {
            let bits = self.next_u64();
            for part in 0..4 {
                sum += ((bits >> (16 * part)) & 0xffff) as i32;
            }
        }
        // Twelve times the mean, 65535 / 2, is an integer.
        (sum - 6 * 65_535) as f32 * (1.0 / 65_536.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stream_is_the_published_splitmix64() {
        let mut random = Random::new(1_234_567);
        let expected = [6_457_827_717_110_365_317, 3_203_168_211_198_807_973, 9_817_491_932_198_370_423];
        assert_eq!([random.next_u64(), random.next_u64(), random.next_u64()], expected);
    }

    #[test]
    fn moments_and_ranges_are_right() {
        let mut random = Random::new(7);
        let (mut mean, mut square, mut uniform) = (0.0f64, 0.0f64, 0.0f64);
        let n = 100_000;
        for _ in 0..n {
            let v = f64::from(random.normal());
            assert!(v.abs() < 6.0);
            mean += v;
            square += v * v;
            let u = random.next_f32();
            assert!((0.0..1.0).contains(&u));
            uniform += f64::from(u);
            assert!(random.below(5) < 5);
            assert!((-2.0..=3.0).contains(&random.range(-2.0, 3.0)));
        }
        let n = f64::from(n);
        assert!((mean / n).abs() < 0.015, "mean {}", mean / n);
        assert!((square / n - 1.0).abs() < 0.02, "variance {}", square / n);
        assert!((uniform / n - 0.5).abs() < 0.005, "uniform {}", uniform / n);
        assert_eq!(random.below(0), 0);
    }
}

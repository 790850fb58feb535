//! How often magnitudes occur in a tensor, and the threshold at which 127 steps represent it best.

use crate::graph::scale::LEVELS;

/// Bins of a histogram: at least 16 for each of the 127 steps, as the limit is at most twice the largest value.
const BINS: usize = 4096;

/// Thresholds that are tried: parts of the largest magnitude in units of 1/256, the largest first.
const PARTS: std::ops::RangeInclusive<usize> = 32..=256;

/// Counts of the magnitudes of a tensor's elements. Zeros, which every scale represents, are not counted.
#[derive(Clone, Debug)]
pub struct Histogram {
    counts: Vec<u64>,
    /// Where the last bin ends: a power of two above every magnitude, 0 while there was none.
    limit: f64,
    max: f32,
}

impl Default for Histogram {
    fn default() -> Self {
        Self { counts: vec![0; BINS], limit: 0.0, max: 0.0 }
    }
}

impl Histogram {
    /// Counts `values`. False, and nothing is counted, if one is not finite.
    pub fn add(&mut self, values: &[f32]) -> bool {
        // Infinities and NaN have the largest bits of all magnitudes.
        let bits = values.iter().fold(0, |most, value| most.max(value.to_bits() & !(1 << 31)));
        let max = f32::from_bits(bits);
        if !max.is_finite() {
            return false;
        }
        self.grow(max);
        if self.limit > 0.0 {
            let per_unit = BINS as f64 / self.limit;
            for value in values.iter().filter(|value| **value != 0.0) {
                self.counts[(f64::from(value.abs()) * per_unit) as usize] += 1;
            }
        }
        true
    }

    /// Widens the bins until `max` fits.
    fn grow(&mut self, max: f32) {
        self.max = self.max.max(max);
        let max = f64::from(max);
        if self.limit == 0.0 && max > 0.0 {
            // The power of two in its exponent.
            let power = f32::from_bits((max as f32).to_bits() & f32::INFINITY.to_bits());
            self.limit = f64::from(power.max(f32::MIN_POSITIVE));
        }
        while max > 0.0 && max >= self.limit {
            self.limit *= 2.0;
            for bin in 0..BINS / 2 {
                self.counts[bin] = self.counts[2 * bin] + self.counts[2 * bin + 1];
            }
            self.counts[BINS / 2..].fill(0);
        }
    }

    /// The largest magnitude; 0 if all were 0.
    pub fn max(&self) -> f64 {
        f64::from(self.max)
    }

    /// The threshold whose 127 steps leave the smallest sum of squared errors, where magnitudes are spread evenly within
    /// their bins; of equals the largest. 0 if all were 0.
    pub fn threshold(&self) -> f64 {
        let candidates = PARTS.rev().map(|part| self.max() * part as f64 / *PARTS.end() as f64);
        let best = candidates
            .map(|threshold| (self.error(threshold), threshold))
            .reduce(|best, next| if next.0 < best.0 { next } else { best });
        best.map_or(0.0, |(_, threshold)| threshold)
    }

    /// The sum of squared errors of a threshold.
    fn error(&self, threshold: f64) -> f64 {
        let (step, width) = (threshold / LEVELS, self.limit / BINS as f64);
        if step == 0.0 {
            return 0.0;
        }
        let occupied = self.counts.iter().enumerate().filter(|(_, count)| **count > 0);
        let mean = |bin: usize| (squares(bin as f64 * width + width, step) - squares(bin as f64 * width, step)) / width;
        occupied.map(|(bin, &count)| count as f64 * mean(bin)).sum()
    }
}

/// The integral of the squared error of rounding to multiples of `step`, at most 127 of them, from 0 to `x`.
fn squares(x: f64, step: f64) -> f64 {
    let level = (x / step + 0.5).floor().min(LEVELS);
    let rest = x - level * step;
    level * (step * step * step) / 12.0 + rest * rest * rest / 3.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::random::Random;

    fn histogram(values: &[f32]) -> Histogram {
        let mut histogram = Histogram::default();
        assert!(histogram.add(values));
        histogram
    }

    #[test]
    fn bins_widen_and_keep_their_counts() {
        let mut found = histogram(&[0.0, 0.75, -0.5, 0.125]);
        assert_eq!((found.limit, found.max(), found.counts.iter().sum::<u64>()), (1.0, 0.75, 3));
        assert_eq!((found.counts[BINS / 8], found.counts[BINS / 2], found.counts[BINS * 3 / 4]), (1, 1, 1));
        assert!(found.add(&[-5.0]));
        assert_eq!((found.limit, found.max()), (8.0, 5.0));
        assert_eq!((found.counts[BINS / 64], found.counts[BINS / 16], found.counts[BINS * 5 / 8]), (1, 1, 1));
        assert!(found.add(&[1.0]) && found.add(&[]));
        assert_eq!(found.counts.iter().sum::<u64>(), 5);
        assert_eq!(histogram(&[1.0]).limit, 2.0, "the last bin ends above the largest");
    }

    #[test]
    fn what_is_not_finite_is_not_counted() {
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let mut found = histogram(&[1.0]);
            assert!(!found.add(&[0.5, bad]));
            assert_eq!(found.counts.iter().sum::<u64>(), 1);
        }
        assert_eq!((histogram(&[0.0, -0.0]).threshold(), Histogram::default().threshold()), (0.0, 0.0));
    }

    #[test]
    fn squares_are_the_integral() {
        let (step, samples) = (0.5, 200_000);
        for end in [0.1, 0.25, 0.4, 3.3, 63.5, 70.0] {
            let width = end / f64::from(samples);
            let error = |i: i32| {
                let x = (f64::from(i) + 0.5) * width;
                (x - (x / step).round().min(LEVELS) * step).powi(2) * width
            };
            let expected: f64 = (0..samples).map(error).sum();
            assert!((squares(end, step) - expected).abs() < 1e-3 * expected, "{end}");
        }
    }

    #[test]
    fn the_threshold_has_the_smallest_error() {
        let mut random = Random::new(1);
        let mut values: Vec<f32> = (0..50_000).map(|_| random.normal()).collect();
        let measured = |values: &[f32], threshold: f64| {
            let step = threshold / LEVELS;
            let one = |v: f32| {
                let v = f64::from(v);
                (v - (v / step).round().clamp(-LEVELS, LEVELS) * step).powi(2)
            };
            values.iter().map(|&v| one(v)).sum::<f64>()
        };
        // One value far away is worth clipping: the sum of 50,000 (t / 127)^2 / 12 and (30 - t)^2 is least at 23.8.
        values.push(30.0);
        let found = histogram(&values);
        let threshold = found.threshold();
        assert!((threshold - 23.8).abs() < 0.5, "{threshold}");
        let least = measured(&values, threshold);
        for part in PARTS {
            let other = 30.0 * part as f64 / 256.0;
            assert!(least <= 1.02 * measured(&values, other), "{threshold} {other}");
        }
        // Where all values are as large, none is clipped.
        assert_eq!(histogram(&[3.0; 100]).threshold(), 3.0);
    }
}

//! How far a network's probabilities can be trusted: how often what it calls so likely comes true.

use super::table::{Table, percent};
use serde_json::{Value, json};

/// Codes of a probability, 0 to 255 for 0 to 1.
pub const CODES: usize = 256;

/// Bins of equal width of the calibration error and of the diagram (Guo et al., arXiv 1706.04599, have as many).
pub const BINS: usize = 15;

/// Steps of the thresholds in the tables: 1/20, 2/20, ... 19/20.
const STEPS: u64 = 20;

/// Voxels, counted by the code of a probability and by whether it came true.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Reliability {
    /// For each code, how many voxels it came false for and how many it came true for.
    counts: Vec<[u64; 2]>,
}

/// A bin of a reliability diagram.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bin {
    /// Its voxels.
    pub voxels: u64,
    /// The mean probability of its voxels.
    pub said: f64,
    /// The share of its voxels for which it came true.
    pub found: f64,
}

impl Default for Reliability {
    fn default() -> Self {
        Self { counts: vec![[0; 2]; CODES] }
    }
}

impl Reliability {
    /// Counts a voxel.
    pub fn add(&mut self, code: u8, came_true: bool) {
        self.counts[usize::from(code)][usize::from(came_true)] += 1;
    }

    /// Adds the counts of another.
    pub fn merge(&mut self, other: &Self) {
        for (own, other) in self.counts.iter_mut().zip(&other.counts) {
            own.iter_mut().zip(other).for_each(|(own, other)| *own += other);
        }
    }

    /// For each code, how many voxels it came false for and how many it came true for.
    pub fn counts(&self) -> &[[u64; 2]] {
        &self.counts
    }

    /// Counts in the order of [`Reliability::counts`]; none if they are not of as many codes.
    pub fn from_counts(counts: Vec<[u64; 2]>) -> Option<Self> {
        (counts.len() == CODES).then_some(Self { counts })
    }

    /// Voxels in all.
    pub fn voxels(&self) -> u64 {
        self.counts.as_flattened().iter().sum()
    }

    /// The bins of equal width, those without voxels left out.
    pub fn bins(&self) -> Vec<Bin> {
        let mut sums = [[0u64; 3]; BINS];
        for (code, &[not, is]) in self.counts.iter().enumerate() {
            let [voxels, codes, found] = &mut sums[code * BINS / CODES];
            (*voxels, *found) = (*voxels + not + is, *found + is);
            *codes += code as u64 * (not + is);
        }
        let bin = |[voxels, codes, found]: [u64; 3]| {
            let share = |part: u64| part as f64 / voxels as f64;
            Bin { voxels, said: share(codes) / (CODES - 1) as f64, found: share(found) }
        };
        sums.into_iter().filter(|sums| sums[0] > 0).map(bin).collect()
    }

    /// The expected calibration error: over the bins, the mean of the difference between what was said and what was found,
    /// weighted by voxels. None without voxels.
    pub fn expected_error(&self) -> Option<f64> {
        let voxels = self.voxels();
        let sum: f64 = self.bins().iter().map(|bin| bin.voxels as f64 * (bin.said - bin.found).abs()).sum();
        (voxels > 0).then(|| sum / voxels as f64)
    }

    /// Precision and recall where what is at least `step` twentieths likely is taken for true; none for 0 / 0.
    fn at_least(&self, step: u64) -> [Option<f64>; 2] {
        let likely = |code: usize| code as u64 * STEPS >= step * (CODES as u64 - 1);
        let taken = self.counts.iter().enumerate().filter(|(code, _)| likely(*code));
        let [not, is] = taken.fold([0, 0], |[not, is], (_, counts)| [not + counts[0], is + counts[1]]);
        let all: u64 = self.counts.iter().map(|counts| counts[1]).sum();
        [not + is, all].map(|whole| (whole > 0).then(|| is as f64 / whole as f64))
    }
}

/// The reliability of both probabilities that a network gives, in one region.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Calibration {
    /// That the voxel is occupied.
    pub occupied: Reliability,
    /// That it is of its class.
    pub class: Reliability,
}

impl Calibration {
    /// Counts a voxel.
    pub fn add(&mut self, [occupied, class]: [u8; 2], label: u8, predicted: u8) {
        self.occupied.add(occupied, label != 0);
        self.class.add(class, label == predicted);
    }

    /// Adds the counts of another.
    pub fn merge(&mut self, other: &Self) {
        self.occupied.merge(&other.occupied);
        self.class.merge(&other.class);
    }
}

/// The calibration error of each region, and of "occupied" precision and recall at each threshold.
pub(super) fn tables(regions: &[&str], calibration: &[Calibration]) -> [Table; 2] {
    let names = regions.iter().map(|&name| name.to_owned());
    let errors = |name: &str, of: fn(&Calibration) -> &Reliability| {
        let cells = calibration.iter().map(|calibration| percent(of(calibration).expected_error()));
        std::iter::once(name.to_owned()).chain(cells).collect()
    };
    let head = std::iter::once("calibration error".to_owned()).chain(names).collect();
    let rows = vec![errors("occupied", |c| &c.occupied), errors("class", |c| &c.class)];
    let by_region = Table { head, rows };
    let columns = regions.iter().flat_map(|name| [format!("{name} precision"), "recall".to_owned()]);
    let head = std::iter::once("occupied from".to_owned()).chain(columns).collect();
    let row = |step: u64| {
        let cells = calibration.iter().flat_map(|calibration| calibration.occupied.at_least(step).map(percent));
        std::iter::once(format!("{:.2}", step as f64 / STEPS as f64)).chain(cells).collect()
    };
    [by_region, Table { head, rows: (1..STEPS).map(row).collect() }]
}

/// Error, counts, and precision and recall at each threshold, for each region.
pub(super) fn json(regions: &[&str], calibration: &[Calibration]) -> Value {
    let of = |reliability: &Reliability| json!({ "expected_error": reliability.expected_error(), "counts": reliability.counts() });
    let threshold = |reliability: &Reliability, step: u64| {
        let [precision, recall] = reliability.at_least(step);
        json!({ "from": step as f64 / STEPS as f64, "precision": precision, "recall": recall })
    };
    let region = |Calibration { occupied, class }: &Calibration| {
        let thresholds: Vec<Value> = (1..STEPS).map(|step| threshold(occupied, step)).collect();
        let mut value = json!({ "occupied": of(occupied), "class": of(class) });
        value["occupied"]["thresholds"] = json!(thresholds);
        value
    };
    let named = regions.iter().zip(calibration).map(|(&name, calibration)| (name.to_owned(), region(calibration)));
    Value::Object(named.collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_and_thresholds_by_hand() {
        let mut reliability = Reliability::default();
        assert_eq!((reliability.expected_error(), reliability.bins().len()), (None, 0));
        // In the first bin 3 voxels at 0, one of them occupied; in the last one at 1 and one at 0.8 of 255, both occupied.
        for (code, came_true) in [(0, false), (0, true), (0, false), (255, true), (204, true), (204, false)] {
            reliability.add(code, came_true);
        }
        let bins = reliability.bins();
        assert_eq!(bins.iter().map(|bin| bin.voxels).collect::<Vec<_>>(), [3, 2, 1]);
        assert_eq!((bins[1].said, bins[1].found), (0.8, 0.5));
        // |0 - 1/3| * 3, |0.8 - 0.5| * 2, |1 - 1| * 1, of 6.
        let error = reliability.expected_error().expect("voxels");
        assert!((error - 1.6 / 6.0).abs() < 1e-12, "{error}");
        // From 0.8 on: 204 is exactly that.
        assert_eq!(reliability.at_least(16), [Some(2.0 / 3.0), Some(2.0 / 3.0)]);
        assert_eq!(reliability.at_least(17), [Some(1.0), Some(1.0 / 3.0)]);
        let mut twice = reliability.clone();
        twice.merge(&reliability);
        assert_eq!((twice.voxels(), twice.expected_error()), (12, Some(error)));
        assert_eq!(Reliability::default().at_least(10), [None, None]);
    }

    #[test]
    fn a_voxel_counts_for_both_probabilities() {
        let mut calibration = Calibration::default();
        calibration.add([200, 100], 3, 2);
        calibration.add([10, 240], 0, 0);
        assert_eq!((calibration.occupied.counts()[200], calibration.occupied.counts()[10]), ([0, 1], [1, 0]));
        assert_eq!((calibration.class.counts()[100], calibration.class.counts()[240]), ([1, 0], [0, 1]));
        let [errors, thresholds] = tables(&["all"], &[calibration.clone()]);
        assert_eq!((errors.rows.len(), thresholds.rows.len(), thresholds.head.len()), (2, 19, 3));
        let value = json(&["all"], &[calibration]);
        assert_eq!(value["all"]["occupied"]["thresholds"][9]["recall"], 1.0);
        assert_eq!(value["all"]["class"]["counts"][240], json!([0, 1]));
    }
}

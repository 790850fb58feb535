//! Adding up what frames scored, as it comes.

use super::{Confusion, Kind, LossSum, Score};
use crate::base::digest;

/// What was found about one frame, or the total of many.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameScore {
    /// XXH3-64 of the classes that each predictor said; of a total, of these digests in the order of the set, as
    /// little-endian bytes. Whoever predicts the same frames elsewhere gets the same.
    pub digests: Vec<u64>,
    /// The score of each predictor.
    pub scores: Vec<Score>,
    /// Of two predictors, how often each class of the first was taken for each by the second, over all voxels of the
    /// data set's grid, with labels or without.
    pub agreement: Option<Confusion>,
}

/// The sum over frames that arrive in any order; it does not depend on that order, and takes a few bytes for each frame.
#[derive(Clone, Debug)]
pub struct Totals {
    sums: Vec<Score>,
    agreement: Option<Confusion>,
    /// Per frame, once it has arrived, what keeps the order of the set: digests and losses of each predictor. Sums of floats
    /// depend on their order.
    ordered: Vec<Option<Vec<(u64, LossSum)>>>,
}

impl Totals {
    /// Nothing yet of `frames` frames, scored for `predictors` predictors, two at most of which are compared.
    pub fn new(kind: Kind, predictors: usize, frames: usize) -> Self {
        let agreement = (predictors == 2).then(|| Confusion::new(kind.classes));
        Self { sums: vec![Score::new(kind); predictors], agreement, ordered: vec![None; frames] }
    }

    /// Counts frame `index`.
    ///
    /// # Panics
    /// If there is no such frame, it has been counted, or its score is of another kind.
    pub fn add(&mut self, index: usize, frame: FrameScore) {
        assert!(self.ordered[index].is_none(), "a frame counts once");
        assert_eq!([frame.scores.len(), frame.digests.len()], [self.sums.len(); 2], "predictors");
        let mut ordered = Vec::with_capacity(self.sums.len());
        for ((sum, mut score), digest) in self.sums.iter_mut().zip(frame.scores).zip(frame.digests) {
            ordered.push((digest, std::mem::take(&mut score.losses)));
            sum.merge(&score);
        }
        if let (Some(sum), Some(agreement)) = (&mut self.agreement, &frame.agreement) {
            sum.merge(agreement);
        }
        self.ordered[index] = Some(ordered);
    }

    /// Whether frame `index` has been counted.
    ///
    /// # Panics
    /// If there is no such frame.
    pub fn has(&self, index: usize) -> bool {
        self.ordered[index].is_some()
    }

    /// Frames of which these are the totals, counted or not.
    pub fn frames(&self) -> usize {
        self.ordered.len()
    }

    /// Frames that have been counted.
    pub fn counted(&self) -> usize {
        self.ordered.iter().flatten().count()
    }

    /// The sum of each predictor, and the agreement of two.
    pub fn finish(mut self) -> FrameScore {
        let mut digests = vec![Vec::new(); self.sums.len()];
        for frame in self.ordered.into_iter().flatten() {
            for ((sum, digests), (digest, losses)) in self.sums.iter_mut().zip(&mut digests).zip(frame) {
                sum.losses.merge(&losses);
                digests.extend(digest.to_le_bytes());
            }
        }
        let digests = digests.iter().map(|bytes| digest::bytes(bytes)).collect();
        FrameScore { digests, scores: self.sums, agreement: self.agreement }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::losses::Losses;

    const KIND: Kind = Kind { classes: 3, regions: 2, rings: 1 };

    fn frame(seed: u8) -> FrameScore {
        let mut scores = vec![Score::new(KIND), Score::new(KIND)];
        let mut agreement = Confusion::new(3);
        for (score, shift) in scores.iter_mut().zip([0, 1]) {
            score.regions[0][0].add(seed % 3, (seed + shift) % 3);
            score.rays.labelled[1] += u64::from(seed);
            let value = 0.1 + f64::from(seed) / 3.0;
            score.losses.add(&Losses { focal: value, lovasz: 2.0 * value, geometric: 0.7, semantic: value * value });
        }
        agreement.add(seed % 3, (seed + 1) % 3);
        FrameScore { digests: vec![u64::from(seed), 7], scores, agreement: Some(agreement) }
    }

    #[test]
    fn order_of_arrival_does_not_matter() {
        let total = |order: [usize; 5]| {
            let mut totals = Totals::new(KIND, 2, 5);
            for index in order {
                assert!(!totals.has(index));
                totals.add(index, frame(index as u8));
                assert!(totals.has(index));
            }
            totals.finish()
        };
        let first = total([0, 1, 2, 3, 4]);
        assert_eq!(first.scores[0].losses.frames, 5);
        assert_eq!(first.scores[0].rays.labelled[1], 10);
        assert_eq!(first.agreement.as_ref().map(Confusion::voxels), Some(5));
        let expected: Vec<u8> = (0u64..5).flat_map(u64::to_le_bytes).collect();
        assert_eq!(first.digests[0], digest::bytes(&expected));
        // Sums of floats would differ in their last bit if they followed the order of arrival.
        assert_eq!(first, total([4, 2, 0, 3, 1]));
    }
}

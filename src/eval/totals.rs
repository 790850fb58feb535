//! Adding up what frames scored, as it comes.

use super::{Confusion, Kind, LossSum, Score};

/// What was found about one frame.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameScore {
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
    /// Per frame, once it has arrived, the losses of each predictor: sums of floats keep the order of the set.
    losses: Vec<Option<Vec<LossSum>>>,
}

impl Totals {
    /// Nothing yet of `frames` frames, scored for `predictors` predictors, two at most of which are compared.
    pub fn new(kind: Kind, predictors: usize, frames: usize) -> Self {
        let agreement = (predictors == 2).then(|| Confusion::new(kind.classes));
        Self { sums: vec![Score::new(kind); predictors], agreement, losses: vec![None; frames] }
    }

    /// Counts frame `index`.
    ///
    /// # Panics
    /// If there is no such frame, it has been counted, or its score is of another kind.
    pub fn add(&mut self, index: usize, frame: FrameScore) {
        assert!(self.losses[index].is_none(), "a frame counts once");
        assert_eq!(frame.scores.len(), self.sums.len(), "predictors");
        let mut losses = Vec::with_capacity(self.sums.len());
        for (sum, mut score) in self.sums.iter_mut().zip(frame.scores) {
            losses.push(std::mem::take(&mut score.losses));
            sum.merge(&score);
        }
        if let (Some(sum), Some(agreement)) = (&mut self.agreement, &frame.agreement) {
            sum.merge(agreement);
        }
        self.losses[index] = Some(losses);
    }

    /// Whether frame `index` has been counted.
    ///
    /// # Panics
    /// If there is no such frame.
    pub fn has(&self, index: usize) -> bool {
        self.losses[index].is_some()
    }

    /// The sum of each predictor, and the agreement of two.
    pub fn finish(mut self) -> FrameScore {
        for losses in self.losses.into_iter().flatten() {
            self.sums.iter_mut().zip(&losses).for_each(|(sum, losses)| sum.losses.merge(losses));
        }
        FrameScore { scores: self.sums, agreement: self.agreement }
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
        FrameScore { scores, agreement: Some(agreement) }
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
        // Sums of floats would differ in their last bit if they followed the order of arrival.
        assert_eq!(first, total([4, 2, 0, 3, 1]));
    }
}

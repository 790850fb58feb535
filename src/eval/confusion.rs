//! How often each class was taken for each.

/// A confusion matrix: voxels by true class and predicted class.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Confusion {
    classes: usize,
    /// `[truth, prediction]`.
    counts: Vec<u64>,
}

impl Confusion {
    /// Zeros, for `classes` classes, the empty class 0 among them.
    pub fn new(classes: usize) -> Self {
        Self { classes, counts: vec![0; classes * classes] }
    }

    /// The matrix of these counts, `[truth, prediction]`; none if they are not `classes` x `classes`.
    pub fn from_counts(classes: usize, counts: Vec<u64>) -> Option<Self> {
        (classes.checked_mul(classes) == Some(counts.len())).then_some(Self { classes, counts })
    }

    /// Counts a voxel.
    ///
    /// # Panics
    /// If a class is not below the number of classes.
    pub fn add(&mut self, truth: u8, prediction: u8) {
        let (truth, prediction) = (usize::from(truth), usize::from(prediction));
        assert!(truth < self.classes && prediction < self.classes, "a class of the matrix");
        self.counts[truth * self.classes + prediction] += 1;
    }

    /// Adds another matrix of as many classes.
    ///
    /// # Panics
    /// If it has others.
    pub fn merge(&mut self, other: &Confusion) {
        assert_eq!(self.classes, other.classes, "classes");
        self.counts.iter_mut().zip(&other.counts).for_each(|(own, other)| *own += other);
    }

    /// Number of classes.
    pub fn classes(&self) -> usize {
        self.classes
    }

    /// All counts, `[truth, prediction]`.
    pub fn counts(&self) -> &[u64] {
        &self.counts
    }

    /// Voxels of class `truth` that were taken for `prediction`.
    ///
    /// # Panics
    /// If a class is not below the number of classes.
    pub fn count(&self, truth: usize, prediction: usize) -> u64 {
        assert!(prediction < self.classes, "a class of the matrix");
        self.counts[truth * self.classes + prediction]
    }

    /// Voxels counted.
    pub fn voxels(&self) -> u64 {
        self.counts.iter().sum()
    }

    /// Voxels of which `class` is the truth.
    pub fn labelled(&self, class: usize) -> u64 {
        self.counts[class * self.classes..][..self.classes].iter().sum()
    }

    /// Voxels that were taken for `class`.
    pub fn predicted(&self, class: usize) -> u64 {
        self.counts[class..].iter().step_by(self.classes).sum()
    }

    /// TP / (TP + FP + FN) of a class. None where the class is neither labelled nor predicted: 0 / 0.
    pub fn class_iou(&self, class: usize) -> Option<f64> {
        let hits = self.count(class, class);
        ratio(hits, self.labelled(class) + self.predicted(class) - hits)
    }

    /// TP / (TP + FP + FN) of "occupied": all classes but 0 as one. None where nothing is occupied.
    pub fn iou(&self) -> Option<f64> {
        let union = self.voxels() - self.counts[0];
        let hits = union + self.counts[0] - (self.labelled(0) + self.predicted(0) - self.counts[0]);
        ratio(hits, union)
    }

    /// The mean of [`Confusion::class_iou`] over the classes from 1 on that have one. None where none has.
    pub fn mean_iou(&self) -> Option<f64> {
        let ious: Vec<f64> = (1..self.classes).filter_map(|class| self.class_iou(class)).collect();
        (!ious.is_empty()).then(|| ious.iter().sum::<f64>() / ious.len() as f64)
    }

    /// Share of the voxels whose class is right. None where there are none.
    pub fn accuracy(&self) -> Option<f64> {
        ratio((0..self.classes).map(|class| self.count(class, class)).sum(), self.voxels())
    }
}

fn ratio(part: u64, whole: u64) -> Option<f64> {
    (whole > 0).then(|| part as f64 / whole as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ratios_by_hand() {
        // Rows are the truth: 50 empty voxels, of which 4 are taken for class 1 and 1 for class 2, and so on.
        let counts = vec![45, 4, 1, 6, 20, 4, 3, 2, 15];
        let confusion = Confusion::from_counts(3, counts).expect("3 x 3");
        assert_eq!((confusion.voxels(), confusion.labelled(1), confusion.predicted(1)), (100, 30, 26));
        assert_eq!(confusion.class_iou(1), Some(20.0 / 36.0));
        assert_eq!(confusion.class_iou(2), Some(15.0 / 25.0));
        assert_eq!(confusion.mean_iou(), Some((20.0 / 36.0 + 15.0 / 25.0) / 2.0));
        // Occupied and said so: 20 + 4 + 2 + 15. Not both empty: 100 - 45.
        assert_eq!(confusion.iou(), Some(41.0 / 55.0));
        assert_eq!(confusion.accuracy(), Some(0.8));
    }

    #[test]
    fn classes_that_are_not_there_count_nowhere() {
        let mut confusion = Confusion::new(4);
        assert_eq!((confusion.iou(), confusion.mean_iou(), confusion.accuracy()), (None, None, None));
        confusion.add(0, 0);
        assert_eq!((confusion.iou(), confusion.mean_iou(), confusion.accuracy()), (None, None, Some(1.0)));
        // A class that is predicted and nowhere true has an IoU of 0.
        confusion.add(0, 2);
        confusion.add(1, 1);
        assert_eq!(confusion.class_iou(2), Some(0.0));
        assert_eq!((confusion.class_iou(3), confusion.mean_iou()), (None, Some(0.5)));
    }

    #[test]
    fn merging_is_adding() {
        let (mut one, mut other, mut both) = (Confusion::new(3), Confusion::new(3), Confusion::new(3));
        for (truth, prediction) in [(0, 1), (2, 2), (1, 0)] {
            one.add(truth, prediction);
            both.add(truth, prediction);
        }
        for (truth, prediction) in [(0, 1), (2, 1)] {
            other.add(truth, prediction);
            both.add(truth, prediction);
        }
        one.merge(&other);
        assert_eq!(one, both);
        assert_eq!(Confusion::from_counts(3, vec![0; 8]), None);
    }
}

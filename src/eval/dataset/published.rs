//! What a data set's own evaluation would say, where that differs from what is counted here.

use super::{Axes, Grid, IGNORED, OTHERS, Truth};
use crate::eval::Confusion;
use serde::{Deserialize, Serialize};

/// How the published evaluation of a set counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Published {
    /// As Occ3D's: over the voxels of the mask of this number, and [`OTHERS`] is a class like the others, which no network
    /// here predicts. Classes that do not occur are left out of the mean.
    WithOthers {
        /// Number of the mask in the set's.
        mask: usize,
    },
    /// As InverseMatrixVT3D's on SurroundOcc: the labels are brought to the grid of the prediction, each of its voxels i
    /// taking label floor(i * labels / predictions) along every axis. Classes that do not occur count as 0 in the mean.
    LabelsBrought,
}

impl Published {
    /// A name for tables.
    pub fn name(self) -> &'static str {
        match self {
            Published::WithOthers { .. } => "Occ3D: \"others\" too, where cameras see",
            Published::LabelsBrought => "InverseMatrixVT3D: labels on the network's grid",
        }
    }

    /// Whether it is defined for a prediction on `prediction`, with labels on `truth`.
    pub fn applies(self, truth: &Grid, prediction: &Grid) -> bool {
        match self {
            Published::WithOthers { .. } => true,
            Published::LabelsBrought => {
                truth.bounds == prediction.bounds && truth.axes == Axes::Lidar && prediction.axes == Axes::Lidar
            }
        }
    }

    /// The mean of the IoUs of all classes but the empty one.
    pub fn mean_iou(self, confusion: &Confusion) -> Option<f64> {
        match self {
            Published::WithOthers { .. } => confusion.mean_iou(),
            Published::LabelsBrought => {
                // The last class is "others", which these labels do not have.
                let classes = 1..confusion.classes() - 1;
                let count = classes.len();
                let sum: f64 = classes.filter_map(|class| confusion.class_iou(class)).sum();
                (count > 0 && confusion.voxels() > 0).then(|| sum / count as f64)
            }
        }
    }

    /// Counts a frame: classes, and [`OTHERS`] as one more. `predicted` are classes on the grid `prediction`, `resampled` the
    /// same on `truth`'s.
    pub(crate) fn count(
        self,
        classes: usize,
        labels: &Truth,
        [truth, prediction]: [&Grid; 2],
        [predicted, resampled]: [&[u8]; 2],
    ) -> Confusion {
        let mut confusion = Confusion::new(classes + 1);
        let mut add = |label: u8, class: u8| match label {
            IGNORED => {}
            OTHERS => confusion.add(classes as u8, class),
            label => confusion.add(label, class),
        };
        match self {
            Published::WithOthers { mask } => {
                let voxels = labels.labels.iter().zip(resampled).zip(&labels.masks[mask]);
                voxels.filter(|(_, inside)| **inside != 0).for_each(|((&label, &class), _)| add(label, class));
            }
            Published::LabelsBrought => {
                let from = |axis: usize| -> Vec<usize> {
                    let scale = truth.size[axis] as f32 / prediction.size[axis] as f32;
                    let last = truth.size[axis] - 1;
                    (0..prediction.size[axis]).map(|i| ((i as f32 * scale).floor() as usize).min(last)).collect()
                };
                let [along_x, along_y, along_z] = [from(0), from(1), from(2)];
                let [_, ny, nz] = truth.size;
                let rows = along_x.iter().flat_map(|x| along_y.iter().map(move |y| (x * ny + y) * nz));
                let places = rows.flat_map(|row| along_z.iter().map(move |z| row + z));
                places.zip(predicted).for_each(|(at, &class)| add(labels.labels[at], class));
            }
        }
        confusion
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::dataset::Pose;
    use crate::eval::{Options, Prediction, Scorer};

    const TRUTH: Grid = Grid { size: [4, 4, 2], bounds: [[-4.0, 4.0], [-4.0, 4.0], [-1.0, 1.0]], axes: Axes::Lidar };

    fn truth(labels: Vec<u8>) -> Truth {
        let mask = (0..labels.len()).map(|at| u8::from(at % 2 == 0)).collect();
        Truth { labels, masks: vec![mask], origins: vec![], grid_to_lidar: Pose::IDENTITY }
    }

    fn score(
        grid: Grid,
        published: Published,
        labels: &[u8],
        classes: &[u8],
    ) -> (Option<Published>, Confusion, Confusion) {
        let scorer =
            Scorer::new(4, 1, TRUTH, grid, &Options::default()).expect("sound").with_published(Some(published));
        let prediction = Prediction { classes, support: None, logits: None, confidence: None };
        let score = scorer.score(&truth(labels.to_vec()), &prediction).expect("a score");
        (scorer.published(), score.region(1), score.published)
    }

    #[test]
    fn others_count_where_the_mask_is() {
        let mut labels = vec![0; 32];
        // Even places are in the mask: a hit, a confusion, others taken for 1 and for empty, what counts nowhere.
        (labels[0], labels[2], labels[4], labels[6], labels[8]) = (1, 2, OTHERS, OTHERS, IGNORED);
        (labels[1], labels[3]) = (3, OTHERS);
        let mut classes = vec![0; 32];
        (classes[0], classes[2], classes[4], classes[8], classes[3]) = (1, 1, 1, 2, 3);
        let (_, ours, counts) = score(TRUTH, Published::WithOthers { mask: 0 }, &labels, &classes);
        // Ours: 1 of {1, and the 2 that was taken for 1}, 0 of 2; the mean of two classes.
        assert_eq!((ours.class_iou(1), ours.class_iou(2), ours.class_iou(3)), (Some(0.5), Some(0.0), None));
        assert_eq!(ours.mean_iou(), Some(0.25));
        // With others: one more voxel was wrongly taken for 1, and others themselves have two and no hit.
        assert_eq!([1, 2, 3, 4].map(|class| counts.class_iou(class)), [Some(1.0 / 3.0), Some(0.0), None, Some(0.0)]);
        assert_eq!(counts.voxels(), 15);
        let found = Published::WithOthers { mask: 0 }.mean_iou(&counts).expect("some");
        assert!((found - 1.0 / 9.0).abs() < 1e-15, "{found}");
    }

    #[test]
    fn labels_are_brought_to_the_finer_grid() {
        let fine = Grid { size: [5, 4, 4], ..TRUTH };
        // Along x, voxel i of 5 takes label floor(0.8 i): 0, 0, 1, 2, 3. Centres would give 0, 1, 2, 2, 3.
        let labels: Vec<u8> = (0..32).map(|at| [1, 2, 3, 0][at / 8]).collect();
        let classes: Vec<u8> = (0..80).map(|at| [1, 1, 2, 3, 2][at / 16]).collect();
        let (published, _, counts) = score(fine, Published::LabelsBrought, &labels, &classes);
        assert_eq!(published, Some(Published::LabelsBrought));
        assert_eq!([1, 2, 3].map(|class| counts.class_iou(class)), [Some(1.0), Some(0.5), Some(1.0)]);
        assert_eq!((counts.count(0, 2), counts.voxels()), (16, 80));
        // A class that is nowhere counts as 0.
        let (_, _, counts) = score(fine, Published::LabelsBrought, &[1; 32], &[1; 80]);
        assert_eq!((counts.mean_iou(), Published::LabelsBrought.mean_iou(&counts)), (Some(1.0), Some(1.0 / 3.0)));
        let moved = Grid { bounds: [[-4.0, 4.0], [-4.0, 4.0], [-1.5, 0.5]], ..fine };
        let (published, _, counts) = score(moved, Published::LabelsBrought, &labels, &classes);
        assert_eq!((published, counts.voxels()), (None, 0), "only for grids over the same place");
    }
}

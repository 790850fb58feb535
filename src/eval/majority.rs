//! The image-blind baseline: what mostly stands in each voxel, whatever the cameras see.

use crate::base::error::{Error, ErrorKind, Result};
use crate::eval::dataset::{DataSet, is_class};

/// The class that most frames of `set` have in each voxel; of equally frequent ones the first. Voxels that no frame has a
/// label for are empty. The voxels are those of `set`'s grid, with its axes. `done` is told how many frames were read.
///
/// # Errors
/// Those of [`DataSet::truth`]; [`ErrorKind::TooLarge`] if there is no memory for a count per voxel and class.
pub fn majority(set: &dyn DataSet, done: &mut dyn FnMut(usize)) -> Result<Vec<u8>> {
    let (voxels, classes) = (set.grid().voxels(), set.classes().len());
    let too_large =
        || Error::new(ErrorKind::TooLarge, format!("no memory to count {classes} classes in {voxels} voxels"));
    let length = voxels.checked_mul(classes).ok_or_else(too_large)?;
    let mut counts: Vec<u32> = Vec::new();
    counts.try_reserve_exact(length).map_err(|_| too_large())?;
    counts.resize(length, 0);
    for index in 0..set.len() {
        let truth = set.truth(index)?;
        for (counts, &label) in counts.chunks_exact_mut(classes).zip(&truth.labels) {
            if is_class(label) {
                counts[usize::from(label)] += 1;
            }
        }
        done(index + 1);
    }
    let first_largest = |counts: &[u32]| (0..classes).rev().max_by_key(|&class| counts[class]).unwrap_or(0);
    Ok(counts.chunks_exact(classes).map(|counts| first_largest(counts) as u8).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::note::Note;
    use crate::eval::dataset::{Axes, Grid, Pose, Truth};
    use crate::scene::Scene;

    /// Labels of three frames of five voxels.
    struct Three;

    impl DataSet for Three {
        fn classes(&self) -> &[&'static str] {
            &["empty", "one", "two"]
        }

        fn grid(&self) -> Grid {
            Grid { size: [5, 1, 1], bounds: [[0.0, 5.0], [0.0, 1.0], [0.0, 1.0]], axes: Axes::Lidar }
        }

        fn len(&self) -> usize {
            3
        }

        fn id(&self, index: usize) -> &str {
            ["a", "b", "c"][index]
        }

        fn scene(&self, _index: usize) -> Result<(Scene, Vec<Note>)> {
            Err(Error::format("images are not needed"))
        }

        fn truth(&self, index: usize) -> Result<Truth> {
            let labels = [[2, 1, 255, 255, 0], [2, 2, 255, 2, 1], [0, 255, 255, 255, 2]][index].to_vec();
            Ok(Truth { labels, masks: vec![], origins: vec![], grid_to_lidar: Pose::IDENTITY })
        }
    }

    #[test]
    fn most_frequent_and_first_of_equals() {
        let mut read = vec![];
        assert_eq!(majority(&Three, &mut |done| read.push(done)).expect("labels"), [2, 1, 0, 2, 0]);
        assert_eq!(read, [1, 2, 3]);
    }
}

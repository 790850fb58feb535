//! Frames out of the images of several cameras, by their stamps.

use super::Stamp;

/// Images of one moment: of each camera the number of its image, if it has one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Join {
    /// Half way between the first and the last of their stamps, rounded down.
    pub(super) time: Stamp,
    pub(super) images: Vec<Option<usize>>,
}

/// Joins images to frames. `stamps` are those of each camera, ascending.
///
/// The earliest image that is left begins a frame, and the next image of every other camera joins it if its stamp is at most
/// `tolerance` nanoseconds later. A frame needs images of at least half of the cameras; what does not come to one is left
/// out, and counted in the second result.
pub(super) fn join(stamps: &[Vec<Stamp>], tolerance: Stamp) -> (Vec<Join>, usize) {
    let mut next = vec![0; stamps.len()];
    let (mut joins, mut left_out) = (Vec::new(), 0);
    loop {
        let first = stamps.iter().zip(&next).filter_map(|(stamps, &next)| stamps.get(next)).min();
        let Some(&first) = first else { return (joins, left_out) };
        let last = first.saturating_add(tolerance);
        let mut images = vec![None; stamps.len()];
        let mut latest = first;
        for ((image, stamps), next) in images.iter_mut().zip(stamps).zip(&mut next) {
            if let Some(&stamp) = stamps.get(*next).filter(|&&stamp| stamp <= last) {
                *image = Some(*next);
                *next += 1;
                latest = latest.max(stamp);
            }
        }
        let found = images.iter().flatten().count();
        if 2 * found >= stamps.len() {
            joins.push(Join { time: first + (latest - first) / 2, images });
        } else {
            left_out += found;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_by_hand() {
        // Three cameras at 10 Hz, in milliseconds; the second misses one, the third has a stray image.
        let stamps = [vec![0, 100, 200, 300], vec![20, 220, 321], vec![40, 141, 170, 240]];
        let (joins, left_out) = join(&stamps, 50);
        let expected = [
            (20, [Some(0), Some(0), Some(0)]),
            (120, [Some(1), None, Some(1)]),
            // 170 begins a frame that 200 and 220 join.
            (195, [Some(2), Some(1), Some(2)]),
        ];
        assert_eq!(joins.len(), 4);
        for (join, (time, images)) in joins.iter().zip(expected) {
            assert_eq!((join.time, &join.images[..]), (time, &images[..]));
        }
        assert_eq!(joins[3].images, [Some(3), Some(2), None]);
        assert_eq!(left_out, 1, "the image of 240");
    }

    #[test]
    fn one_camera_and_none() {
        let (joins, left_out) = join(&[vec![5, 5, 7]], 0);
        assert_eq!((joins.len(), left_out), (3, 0));
        assert_eq!(join(&[], 50), (vec![], 0));
        assert_eq!(join(&[vec![], vec![1]], 50).0.len(), 1, "half of the cameras are enough");
        assert_eq!(join(&[vec![], vec![], vec![u64::MAX]], 50), (vec![], 1));
    }
}

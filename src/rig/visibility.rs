//! How much of the grid cameras see, and whether that can be.

use super::Rig;
use crate::base::note::Note;
use crate::network::Network;

/// Below this share of the voxels, all cameras together see too little for the rig to be what was meant.
const LEAST_SEEN: f64 = 0.10;

/// Below this share of the voxels, one camera sees too little.
const LEAST_OF_A_CAMERA: f64 = 0.02;

/// The share of level 1's voxels that cameras see, from 0 to 1.
///
/// A rig can be built from any matrix. Of real ones, each camera sees some tenth of the grid or more; cameras that look along
/// another axis, a translation in millimetres or the intrinsic of another image size leave next to nothing.
#[derive(Clone, Debug, PartialEq)]
pub struct Visibility {
    /// Seen by a camera at least.
    pub seen: f64,
    /// Seen by each camera.
    pub cameras: Vec<f64>,
}

impl Rig {
    /// What the cameras of this rig see of the grid of `network`, which it belongs to.
    pub fn visibility(&self, network: &Network) -> Visibility {
        let volume = self.level(0).volume;
        let pixels = network.feature_pixels(0).max(1);
        let (mut seen, mut cameras) = (0usize, vec![0usize; self.cameras()]);
        for row in volume.ptr.windows(2) {
            let mut columns = &volume.col[row[0] as usize..row[1] as usize];
            seen += usize::from(!columns.is_empty());
            // Columns ascend, and so do their cameras.
            while let Some(&first) = columns.first() {
                let camera = first as usize / pixels;
                if let Some(count) = cameras.get_mut(camera) {
                    *count += 1;
                }
                columns = &columns[columns.partition_point(|&c| c as usize / pixels <= camera)..];
            }
        }
        let rows = (volume.ptr.len() - 1).max(1) as f64;
        Visibility { seen: seen as f64 / rows, cameras: cameras.into_iter().map(|n| n as f64 / rows).collect() }
    }
}

impl Visibility {
    /// What is not plausible about it, for people: all cameras together see less than a tenth of the voxels, or one camera
    /// less than a fiftieth. `names` are those of the cameras; their numbers stand in for names that are missing.
    pub fn notes(&self, names: &[String]) -> Vec<Note> {
        let percent = |share: f64| format!("{:.1} %", 100.0 * share);
        let mut notes = Vec::new();
        if self.seen < LEAST_SEEN {
            notes.push(Note::new(format!(
                "cameras see {} of the voxels, expected at least {}; are axes, metres, intrinsics and sizes those of the images?",
                percent(self.seen),
                percent(LEAST_SEEN)
            )));
        }
        let few = self.cameras.iter().enumerate().filter(|&(_, &share)| share < LEAST_OF_A_CAMERA);
        let few: Vec<String> = few
            .map(|(i, &share)| {
                let name = names.get(i).cloned().unwrap_or_else(|| format!("camera {i}"));
                format!("{} sees {}", name.escape_debug(), percent(share))
            })
            .collect();
        if !few.is_empty() {
            let least = percent(LEAST_OF_A_CAMERA);
            notes
                .push(Note::new(format!("{} of the voxels, expected at least {least} of each camera", few.join(", "))));
        }
        notes
    }
}

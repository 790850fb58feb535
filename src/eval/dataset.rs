//! Data sets to evaluate on: frames of images with the class of every voxel, from the files as they are published.
//!
//! A [`DataSet`] is a list of frames that can be read in any order, from several threads at once; nothing is kept between
//! frames but the index. Labels are classes of the network's training, [`IGNORED`] where there is no truth.

mod arrays;
mod kitti;
mod named;
pub mod nuscenes;
pub mod occ3d_waymo;
mod published;
pub mod semantickitti;
pub mod sscbench;
mod synthetic;
pub mod uniocc;

pub use crate::base::pose::Pose;
pub use named::{FORMS, Named};
pub use nuscenes::NuScenes;
pub use occ3d_waymo::Occ3dWaymo;
pub use published::Published;
pub use semantickitti::SemanticKitti;
pub use sscbench::SscBench;
pub use synthetic::Synthetic;
pub use uniocc::UniOcc;

pub use crate::network::{Axes, Grid};

use crate::base::digest::Digest;
use crate::base::error::{Error, Result};
use crate::base::note::Note;
use crate::scene::Scene;
use std::path::{Component, Path};

/// Label of a voxel about which nothing is known, or which no score counts.
pub const IGNORED: u8 = crate::file::labels::UNLABELLED;

/// Label of a voxel of a class that networks do not have. It counts in the set's [`Published`] score alone.
pub const OTHERS: u8 = IGNORED - 1;

/// Whether a label is a class, rather than [`IGNORED`] or [`OTHERS`].
pub(crate) fn is_class(label: u8) -> bool {
    label < OTHERS
}

/// What is known about a frame's voxels, `[x, y, z]`, z fastest.
#[derive(Clone, Debug, PartialEq)]
pub struct Truth {
    /// Class of each voxel, 0 is empty; [`IGNORED`] counts nowhere, [`OTHERS`] in the [`Published`] score alone.
    pub labels: Vec<u8>,
    /// For each of [`DataSet::masks`], 1 for the voxels that belong to it, else 0.
    pub masks: Vec<Vec<u8>>,
    /// Where the rays of [`ray_iou`](crate::eval::ray_iou) begin, in metres of the grid.
    pub origins: Vec<[f64; 3]>,
    /// The frame of the grid in that of the lidar. It matters where the grid has other axes than the lidar's.
    pub grid_to_lidar: Pose,
}

impl Truth {
    /// XXH3-64 of all of it. What has another digest gives another score, or might.
    pub fn digest(&self) -> u64 {
        let mut digest = Digest::new();
        let mut part = |bytes: &[u8]| {
            digest.add(&(bytes.len() as u64).to_le_bytes());
            digest.add(bytes);
        };
        part(&self.labels);
        self.masks.iter().for_each(|mask| part(mask));
        let numbers = self.origins.as_flattened().iter().copied().chain(self.grid_to_lidar.numbers());
        part(&numbers.flat_map(f64::to_le_bytes).collect::<Vec<u8>>());
        digest.finish()
    }

    /// Labels without masks in the lidar's frame: the lidar is where its metres begin.
    fn of_lidar(labels: Vec<u8>) -> Self {
        Self { labels, masks: vec![], origins: vec![[0.0; 3]], grid_to_lidar: Pose::IDENTITY }
    }
}

/// A frame: what a network gets, and what it should say.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Images and calibration.
    pub scene: Scene,
    /// The labels.
    pub truth: Truth,
    /// What is to be said of the images ([`DataSet::scene`]).
    pub notes: Vec<Note>,
}

/// Frames with labels.
pub trait DataSet: Send + Sync {
    /// Names of the classes, in order; 0 is empty.
    fn classes(&self) -> &[&'static str];

    /// Where the labelled voxels lie.
    fn grid(&self) -> Grid;

    /// Names of the masks that every frame has: parts of the grid to be scored by themselves.
    fn masks(&self) -> &[&'static str] {
        &[]
    }

    /// How the set's own evaluation counts, where that differs.
    fn published(&self) -> Option<Published> {
        None
    }

    /// Number of frames.
    fn len(&self) -> usize;

    /// Whether there are none.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// What the data set calls frame `index`; unique in the set.
    ///
    /// # Panics
    /// If there is no such frame.
    fn id(&self, index: usize) -> &str;

    /// Reads frame `index`.
    ///
    /// # Errors
    /// Names the file that is missing or malformed.
    ///
    /// # Panics
    /// If there is no such frame.
    fn frame(&self, index: usize) -> Result<Frame> {
        let (scene, notes) = self.scene(index)?;
        Ok(Frame { scene, truth: self.truth(index)?, notes })
    }

    /// Reads images and calibration of frame `index` alone, and notes what in them is not obeyed or hardly ever meant, as
    /// [`Scene::open_with_notes`] does.
    ///
    /// # Errors
    /// As [`DataSet::frame`].
    ///
    /// # Panics
    /// If there is no such frame.
    fn scene(&self, index: usize) -> Result<(Scene, Vec<Note>)>;

    /// Reads the labels of frame `index` alone.
    ///
    /// # Errors
    /// As [`DataSet::frame`].
    ///
    /// # Panics
    /// If there is no such frame.
    fn truth(&self, index: usize) -> Result<Truth>;
}

/// Refuses labels that are neither a class nor [`IGNORED`].
fn check_labels(labels: &[u8], classes: usize) -> Result<()> {
    match labels.iter().position(|&label| usize::from(label) >= classes && label != IGNORED) {
        None => Ok(()),
        Some(at) => {
            let found = labels[at];
            Err(Error::format(format!("voxel {at} has label {found}, expected 0 to {} or {IGNORED}", classes - 1)))
        }
    }
}

/// Whether `text` names a file below the directory that it is joined to, so that a table that came from elsewhere cannot
/// make the program read what lies elsewhere.
fn is_inside(text: &str) -> bool {
    let normal = Path::new(text).components().all(|c| matches!(c, Component::Normal(_)));
    normal && !text.is_empty() && !text.contains(['\\', '\0'])
}

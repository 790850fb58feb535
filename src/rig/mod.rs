//! The rig: per level, the two projection matrices from camera pixels to voxels and to bird's-eye-view cells.
//!
//! [`RigBuilder`] makes one from calibrations, [`Rig::open`] maps one that [`Rig::save`] or another program wrote.

mod axis;
mod build;
mod calibration;
mod file;
mod frustum;
mod level;
mod rows;
#[cfg(test)]
mod tests;
mod visibility;

pub use crate::graph::{Csr, Level};
pub use build::RigBuilder;
pub use visibility::Visibility;

use crate::base::error::Result;
use crate::file::container::Container;
use calibration::Calibration;
use std::ops::Range;

/// Per level: volume ptr and col, then BEV ptr and col.
type Tensors<T> = [[T; 4]; 3];

/// Where the matrices lie.
enum Storage {
    Owned(Tensors<Vec<u32>>),
    /// Ranges of the container's bytes; `file` proved that they cast to u32.
    Mapped(Container, Tensors<Range<usize>>),
}

/// The six projection matrices of a network's three levels for one set of cameras.
///
/// Every rule of [`Csr`] holds, and every column is below `cameras * H * W` of its level.
pub struct Rig {
    storage: Storage,
    cameras: usize,
    calibration: Calibration,
}

impl Rig {
    /// The matrices of level index 0..3 (levels 1 to 3).
    ///
    /// # Panics
    /// If `level` is not below 3.
    pub fn level(&self, level: usize) -> Level<'_> {
        let [volume_ptr, volume_col, bev_ptr, bev_col] = match &self.storage {
            Storage::Owned(words) => words[level].each_ref().map(Vec::as_slice),
            Storage::Mapped(container, ranges) => {
                ranges[level].each_ref().map(|r| bytemuck::cast_slice(&container.bytes()[r.clone()]))
            }
        };
        Level { volume: Csr { ptr: volume_ptr, col: volume_col }, bev: Csr { ptr: bev_ptr, col: bev_col } }
    }

    /// Number of cameras that the columns count through.
    pub fn cameras(&self) -> usize {
        self.cameras
    }

    /// Whether the rig is that of these cameras, in this order: true if it was built from the same `lidar2img`, false if
    /// it does not say from which, as the plain rigs of other programs do not.
    ///
    /// Sessions do not ask: a rig of another calibration gathers other pixels than the scene's, without an error. Ask
    /// where the calibration of the images is at hand.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) if it was built from others: it says whether cameras have
    /// another order or which of them have another calibration.
    pub fn check_calibration(&self, lidar2img: &[[f32; 16]]) -> Result<bool> {
        self.calibration.check(lidar2img)
    }

    /// Whether the matrices lie in a mapped file rather than in memory of their own.
    pub fn is_mapped(&self) -> bool {
        matches!(self.storage, Storage::Mapped(..))
    }
}

impl PartialEq for Rig {
    /// Equal matrices and cameras, wherever they are stored.
    fn eq(&self, other: &Self) -> bool {
        self.cameras == other.cameras && (0..3).all(|l| self.level(l) == other.level(l))
    }
}

impl std::fmt::Debug for Rig {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let entries: [[usize; 2]; 3] =
            std::array::from_fn(|l| [self.level(l).volume.col.len(), self.level(l).bev.col.len()]);
        f.debug_struct("Rig")
            .field("cameras", &self.cameras)
            .field("mapped", &self.is_mapped())
            .field("entries", &entries)
            .finish()
    }
}

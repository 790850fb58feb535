//! Labels for nuScenes: those of SurroundOcc and of Occ3D, from the files as they are published.

use super::super::arrays::Arrays;
use super::super::{Axes, Grid, OTHERS};
use crate::base::error::Result;
use crate::file::labels::read_rows;
use crate::synth::CLASSES;
use std::path::Path;

pub(super) const SURROUNDOCC: Grid =
    Grid { size: [200, 200, 16], bounds: [[-50.0, 50.0], [-50.0, 50.0], [-5.0, 3.0]], axes: Axes::Lidar };

pub(super) const OCC3D: Grid =
    Grid { size: [200, 200, 16], bounds: [[-40.0, 40.0], [-40.0, 40.0], [-1.0, 5.4]], axes: Axes::Ego };

/// Occ3D's class of a voxel in which nothing is.
const FREE: u8 = 17;

/// Labels of SurroundOcc: rows (x, y, z, class) of the voxels that are not empty. Class 0 is noise and counts nowhere. Of
/// several rows for one voxel, the last holds.
///
/// # Errors
/// Those of [`read_rows`].
pub(super) fn read_surroundocc(path: &Path) -> Result<Vec<u8>> {
    read_rows(path, SURROUNDOCC.size, CLASSES.len())
}

/// Labels of Occ3D, and its masks of what the lidar has observed and of what the cameras have. "Others" (0) becomes [`OTHERS`].
///
/// # Errors
/// Those of [`read_npz`]; [`ErrorKind::Format`](crate::ErrorKind::Format) for a missing array and for one of another type,
/// shape or range.
pub(super) fn read_occ3d(path: &Path) -> Result<(Vec<u8>, Vec<Vec<u8>>)> {
    let mut arrays = Arrays::read(path)?;
    let mut labels = arrays.take("semantics", OCC3D.size, FREE)?;
    for label in &mut labels {
        *label = match *label {
            0 => OTHERS,
            FREE => 0,
            class => class,
        };
    }
    let masks = ["mask_lidar", "mask_camera"].map(|name| arrays.take(name, OCC3D.size, 1));
    Ok((labels, masks.into_iter().collect::<Result<_>>()?))
}

/// Classes of OpenOcc v2 in the order of [`CLASSES`], by the number that its labels give them; the last is free.
const OPENOCC: [u8; 17] = [4, 10, 9, 3, 5, 2, 6, 7, 8, 1, 11, 12, 13, 14, 15, 16, 0];

/// The number that OpenOcc's labels give a class.
///
/// # Panics
/// If there is no such class.
pub(super) fn openocc_label(class: u8) -> u8 {
    let label = OPENOCC.iter().position(|&known| known == class);
    assert!(label.is_some(), "class {class}, expected one of {}", OPENOCC.len());
    label.unwrap_or(0) as u8
}

/// Labels of OpenOcc v2: `semantics` of Occ3D's grid, in an order of its own. The flow is not read.
///
/// # Errors
/// As [`read_occ3d`].
pub(super) fn read_openocc(path: &Path) -> Result<Vec<u8>> {
    let labels = Arrays::read(path)?.take("semantics", OCC3D.size, OPENOCC.len() as u8 - 1)?;
    Ok(labels.into_iter().map(|label| OPENOCC[usize::from(label)]).collect())
}

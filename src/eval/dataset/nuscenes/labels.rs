//! Labels for nuScenes: those of SurroundOcc and of Occ3D, from the files as they are published.

use super::super::{Axes, Grid, IGNORED};
use crate::base::error::{Error, Result};
use crate::file::labels::read_rows;
use crate::file::npz::{OwnedElements, read_npz};
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

/// Labels of Occ3D, and its masks of what the lidar has observed and of what the cameras have. "Others" (0) counts nowhere.
///
/// # Errors
/// Those of [`read_npz`]; [`ErrorKind::Format`](crate::ErrorKind::Format) for a missing array and for one of another type,
/// shape or range.
pub(super) fn read_occ3d(path: &Path) -> Result<(Vec<u8>, Vec<Vec<u8>>)> {
    let mut arrays = read_npz(path)?;
    let mut take = |name: &str, largest: u8| {
        let expected = format!("u8 {:?}", OCC3D.size);
        let failed = |message: String| Error::format(message).in_file(path);
        let Some(at) = arrays.iter().position(|array| array.name == name) else {
            return Err(failed(format!("no array \"{name}\", expected {expected}")));
        };
        let array = arrays.swap_remove(at);
        let OwnedElements::U8(values) = array.elements else {
            return Err(failed(format!("array \"{name}\" is {}, expected {expected}", array.elements.kind())));
        };
        if array.shape != OCC3D.size {
            return Err(failed(format!("array \"{name}\" has shape {:?}, expected {expected}", array.shape)));
        }
        match values.iter().position(|&value| value > largest) {
            Some(at) => Err(failed(format!("array \"{name}\": voxel {at} is {}, expected 0 to {largest}", values[at]))),
            None => Ok(values),
        }
    };
    let mut labels = take("semantics", FREE)?;
    for label in &mut labels {
        *label = match *label {
            0 => IGNORED,
            FREE => 0,
            class => class,
        };
    }
    Ok((labels, vec![take("mask_lidar", 1)?, take("mask_camera", 1)?]))
}

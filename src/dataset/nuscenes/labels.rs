//! Labels for nuScenes: those of SurroundOcc and of Occ3D, from the files as they are published.

use super::super::{Axes, Grid, IGNORED};
use crate::error::{Error, Result};
use crate::npz::{OwnedElements, read_npy_integers, read_npz};
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
/// Those of [`read_npy_integers`]; [`ErrorKind::Format`](crate::ErrorKind::Format) for another shape and for what is
/// outside the grid or the classes.
pub(super) fn read_surroundocc(path: &Path) -> Result<Vec<u8>> {
    let (shape, numbers) = read_npy_integers(path)?;
    let failed = |message: String| Error::format(message).in_file(path);
    if !matches!(shape[..], [_, 4]) {
        return Err(failed(format!("array of shape {shape:?}, expected [N, 4]")));
    }
    let mut labels = vec![0; SURROUNDOCC.voxels()];
    let [nx, ny, nz] = SURROUNDOCC.size;
    for (row, &[x, y, z, class]) in numbers.as_chunks::<4>().0.iter().enumerate() {
        let index = |value: i64, end: usize| usize::try_from(value).ok().filter(|&i| i < end);
        let (Some(x), Some(y), Some(z)) = (index(x, nx), index(y, ny), index(z, nz)) else {
            return Err(failed(format!("row {row} is voxel ({x}, {y}, {z}), expected one of {nx} x {ny} x {nz}")));
        };
        let Some(class) = index(class, CLASSES.len()) else {
            return Err(failed(format!("row {row} has class {class}, expected 0 to {}", CLASSES.len() - 1)));
        };
        labels[(x * ny + y) * nz + z] = if class == 0 { IGNORED } else { class as u8 };
    }
    Ok(labels)
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
            return Err(failed(format!("array \"{name}\" has elements of another type, expected {expected}")));
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

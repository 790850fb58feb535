//! Ground truth from files: the class of every voxel, in either of the two forms that `voxcast synth` writes.

use crate::base::error::{Error, Result};
use crate::file::npz::{OwnedElements, read_npy_integers, read_npz};
use std::path::Path;

/// The class of voxels without a label.
pub const UNLABELLED: u8 = 255;

/// Reads the class of every voxel of `grid` = [X, Y, Z], z fastest: an `.npz` with `classes` u8 [X, Y, Z], or an `.npy` of
/// integer rows x, y, z, class as SurroundOcc publishes them.
///
/// Voxels that no row names are empty. A row of class 0, which SurroundOcc gives to what it could not name, makes its voxel
/// [`UNLABELLED`]. Of two rows with the same voxel the later one counts.
///
/// # Errors
/// [`ErrorKind::Io`](crate::ErrorKind::Io) when the file cannot be read; [`ErrorKind::Format`](crate::ErrorKind::Format) when it is malformed, has no `classes`, or a row
/// names a voxel outside the grid or a class beyond 255; [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) for `classes` of another grid;
/// [`ErrorKind::Unsupported`](crate::ErrorKind::Unsupported) for elements that are not integers.
pub fn read_labels(path: &Path, grid: [usize; 3]) -> Result<Vec<u8>> {
    if path.extension().is_some_and(|e| e == "npy") {
        return read_rows(path, grid, 256);
    }
    let classes = read_npz(path)?.into_iter().find(|a| a.name == "classes");
    let Some(classes) = classes else {
        return Err(Error::format("no array \"classes\", expected u8 [X, Y, Z]").in_file(path));
    };
    if classes.shape != grid {
        let message = format!("array \"classes\" has shape {:?}, expected {grid:?}", classes.shape);
        return Err(Error::mismatch(message).in_file(path));
    }
    match classes.elements {
        OwnedElements::U8(classes) => Ok(classes),
        other => {
            let message = format!("array \"classes\" is {}, expected u8 [X, Y, Z]", other.kind());
            Err(Error::format(message).in_file(path))
        }
    }
}

/// Reads rows (x, y, z, class) of the voxels of `grid` that are not empty, of classes below `classes`, as [`read_labels`]
/// says.
pub(crate) fn read_rows(path: &Path, grid: [usize; 3], classes: usize) -> Result<Vec<u8>> {
    let (shape, numbers) = read_npy_integers(path)?;
    let failed = |message: String| Error::format(message).in_file(path);
    if !matches!(shape[..], [_, 4]) {
        return Err(failed(format!("shape {shape:?}, expected rows x, y, z, class: [n, 4]")));
    }
    let mut labels = vec![0; grid.iter().product()];
    let [nx, ny, nz] = grid;
    for (row, &[x, y, z, class]) in numbers.as_chunks::<4>().0.iter().enumerate() {
        let index = |value: i64, end: usize| usize::try_from(value).ok().filter(|&i| i < end);
        let (Some(x), Some(y), Some(z)) = (index(x, nx), index(y, ny), index(z, nz)) else {
            return Err(failed(format!("row {row} is voxel ({x}, {y}, {z}), expected one of {nx} x {ny} x {nz}")));
        };
        let Some(class) = index(class, classes).and_then(|class| u8::try_from(class).ok()) else {
            return Err(failed(format!("row {row} has class {class}, expected 0 to {}", classes - 1)));
        };
        labels[(x * ny + y) * nz + z] = if class == 0 { UNLABELLED } else { class };
    }
    Ok(labels)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::error::ErrorKind;
    use crate::file::npz::{Array, Elements, write_npz};

    const GRID: [usize; 3] = [2, 3, 2];

    fn npy(descr: &str, shape: &str, bytes: &[u8]) -> Vec<u8> {
        let header = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n");
        let mut npy = b"\x93NUMPY\x01\x00".to_vec();
        npy.extend((header.len() as u16).to_le_bytes());
        npy.extend(header.as_bytes());
        npy.extend(bytes);
        npy
    }

    fn read(npy: &[u8]) -> Result<Vec<u8>> {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("labels.npy");
        std::fs::write(&path, npy).unwrap();
        read_labels(&path, GRID)
    }

    #[test]
    fn rows_by_hand_in_every_integer_type() {
        let rows = [[0u8, 0, 1, 4], [1, 2, 0, 16], [0, 1, 1, 0], [1, 2, 0, 7]];
        let expected = [0, 4, 0, 255, 0, 0, 0, 0, 0, 0, 7, 0];
        for descr in ["|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8"] {
            let width = usize::from(descr.as_bytes()[2] - b'0');
            let wide = |&v: &u8| (0..width).map(move |i| if i == 0 { v } else { 0 });
            let bytes: Vec<u8> = rows.as_flattened().iter().flat_map(wide).collect();
            assert_eq!(read(&npy(descr, "(4, 4)", &bytes)).unwrap(), expected, "{descr}");
        }
        assert_eq!(read(&npy("<i8", "(0, 4)", &[])).unwrap(), [0; 12]);
    }

    #[cfg(feature = "images")]
    #[test]
    fn what_synth_writes_is_read_back() {
        let directory = tempfile::tempdir().unwrap();
        let network = crate::Network::built_in("edge").unwrap();
        let frame = crate::synth::Synthesiser::new(&network).unwrap().frame(3);
        let grid = crate::network::Grid::of(&network);
        frame.save_scene(directory.path(), grid).unwrap();
        for file in ["labels.npz", "labels.npy"] {
            assert!(read_labels(&directory.path().join(file), grid.size).unwrap() == frame.labels, "{file}");
        }
    }

    #[test]
    fn rows_that_are_wrong_are_refused() {
        let row = |row: [i8; 4]| npy("|i1", "(1, 4)", &row.map(|v| v as u8));
        for (npy, expected) in [
            (b"nothing".to_vec(), "cannot be read"),
            (b"no numpy at all".to_vec(), "expected \\x93NUMPY"),
            (npy("<f4", "(1, 4)", &[0; 16]), "\"<f4\", expected little-endian integers"),
            (npy(">i8", "(1, 4)", &[0; 32]), "\">i8\", expected little-endian integers"),
            (npy("|u1", "(4,)", &[0; 4]), "shape [4], expected rows"),
            (npy("|u1", "(2, 4)", &[0; 7]), "shape [2, 4] of 1 bytes"),
            (npy("|u1", "(2, 4)", &[0; 9]), "shape [2, 4] of 1 bytes"),
            (npy("<i8", "(4611686018427387904, 4)", &[0; 9]), "expected shape [4611686018427387904, 4]"),
            (row([2, 0, 0, 1]), "row 0 is voxel (2, 0, 0), expected one of 2 x 3 x 2"),
            (row([0, 0, -1, 1]), "row 0 is voxel (0, 0, -1)"),
            (row([0, 0, 0, -1]), "row 0 has class -1, expected 0 to 255"),
        ] {
            let error = read(&npy).expect_err(expected);
            assert!(error.path().is_some() && error.message().contains(expected), "{error}");
        }
    }

    #[test]
    fn arrays_that_are_wrong_are_refused() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("labels.npz");
        let bytes = Elements::U8(&[0; 12]);
        let wide = Elements::U16(&[0; 12]);
        for (name, shape, elements, expected) in [
            ("labels", [2, 3, 2], bytes, "no array \"classes\""),
            ("classes", [3, 2, 2], bytes, "shape [3, 2, 2], expected [2, 3, 2]"),
            ("classes", [2, 3, 2], wide, "is u16, expected u8"),
        ] {
            write_npz(&path, &[Array { name, shape: &shape, elements }]).unwrap();
            let error = read_labels(&path, GRID).expect_err(expected);
            assert!(error.path() == Some(&path) && error.message().contains(expected), "{error}");
        }
        assert_eq!(read_labels(&directory.path().join("none.npz"), GRID).unwrap_err().kind(), ErrorKind::Io);
    }
}

//! The arrays of a file of labels.

use crate::base::error::{Error, Result};
use crate::file::npz::{OwnedArray, OwnedElements, read_npz};
use std::path::{Path, PathBuf};

/// Arrays of an `.npz`, to be taken by name.
pub(super) struct Arrays {
    path: PathBuf,
    arrays: Vec<OwnedArray>,
}

impl Arrays {
    /// # Errors
    /// Those of [`read_npz`].
    pub(super) fn read(path: &Path) -> Result<Self> {
        Ok(Self { path: path.to_owned(), arrays: read_npz(path)? })
    }

    /// The bytes of an array.
    ///
    /// # Errors
    /// [`ErrorKind::Format`](crate::ErrorKind::Format), naming file and array, if it is missing, of another type or shape,
    /// or has a value above `largest`.
    pub(super) fn take(&mut self, name: &str, shape: [usize; 3], largest: u8) -> Result<Vec<u8>> {
        let expected = format!("u8 {shape:?}");
        let failed = |message: String| Error::format(message).in_file(&self.path);
        let Some(at) = self.arrays.iter().position(|array| array.name == name) else {
            return Err(failed(format!("no array \"{name}\", expected {expected}")));
        };
        let array = self.arrays.swap_remove(at);
        let OwnedElements::U8(values) = array.elements else {
            return Err(failed(format!("array \"{name}\" is {}, expected {expected}", array.elements.kind())));
        };
        if array.shape != shape {
            return Err(failed(format!("array \"{name}\" has shape {:?}, expected {expected}", array.shape)));
        }
        match values.iter().position(|&value| value > largest) {
            Some(at) => Err(failed(format!("array \"{name}\": voxel {at} is {}, expected 0 to {largest}", values[at]))),
            None => Ok(values),
        }
    }
}

//! Files that are read whole, up to a length.

use crate::base::error::{Error, ErrorKind, Result};
use crate::file::regular::open_regular;
use std::io::Read;
use std::path::Path;

/// The whole file, if it is not longer than `limit` bytes.
pub(crate) fn read_bounded(path: &Path, limit: u64) -> Result<Vec<u8>> {
    let (file, length) = open_regular(path)?;
    if length > limit {
        let message = format!("file of {length} bytes, expected at most {limit}");
        return Err(Error::new(ErrorKind::TooLarge, message).in_file(path));
    }
    let mut bytes = Vec::new();
    // A file that grows meanwhile is not followed.
    file.take(length).read_to_end(&mut bytes).map_err(|e| Error::io(path, "read", &e))?;
    Ok(bytes)
}

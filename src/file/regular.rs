//! Regular files. Anything else that a path may name cannot be mapped or sought in, and opening a pipe waits for its writer.

use crate::base::error::{Error, ErrorKind, Result};
use std::fs::{self, File};
use std::path::Path;

/// Opens a regular file, and says how long it is.
pub(crate) fn open_regular(path: &Path) -> Result<(File, u64)> {
    let failed = |e: std::io::Error| Error::io(path, "open", &e);
    // Asked before opening.
    if !fs::metadata(path).map_err(failed)?.is_file() {
        return Err(Error::new(ErrorKind::Io, "cannot open: not a regular file").in_file(path));
    }
    let file = File::open(path).map_err(failed)?;
    let length = file.metadata().map_err(failed)?.len();
    Ok((file, length))
}

//! Writing files so that a reader sees the old bytes or the new ones, never a part.

use crate::error::{Error, Result};
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

/// Writes `path` through a temporary file beside it, which takes its name once all bytes are down.
///
/// On failure the temporary file is removed and an existing `path` keeps its bytes.
///
/// # Errors
/// [`ErrorKind::Io`](crate::ErrorKind::Io) naming `path`.
pub(crate) fn replace_file(path: &Path, write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>) -> Result<()> {
    let temporary = temporary_beside(path)
        .ok_or_else(|| Error::io(path, "write", &io::Error::new(io::ErrorKind::InvalidInput, "not a file name")))?;
    let written = File::create(&temporary).and_then(|file| {
        let mut out = BufWriter::with_capacity(1 << 18, file);
        write(&mut out)?;
        out.flush()?;
        drop(out);
        fs::rename(&temporary, path)
    });
    written.map_err(|e| {
        // The first failure is the one to tell; a leftover that cannot be removed changes nothing about it.
        let _ = fs::remove_file(&temporary);
        Error::io(path, "write", &e)
    })
}

/// A name that two processes do not share and that a listing hides.
fn temporary_beside(path: &Path) -> Option<PathBuf> {
    let mut name = std::ffi::OsString::from(".");
    name.push(path.file_name()?);
    name.push(format!(".{}.tmp", std::process::id()));
    Some(path.with_file_name(name))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn failure_keeps_the_old_file_and_leaves_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.bin");
        replace_file(&path, |w| w.write_all(b"old")).unwrap();
        let error = replace_file(&path, |w| {
            w.write_all(b"half")?;
            Err(io::Error::other("full"))
        });
        assert_eq!(error.unwrap_err().to_string(), format!("{}: cannot write: full", path.display()));
        assert_eq!(fs::read(&path).unwrap(), b"old");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn missing_directory_is_an_error() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("no/such/place.bin");
        let error = replace_file(&path, |w| w.write_all(b"x")).unwrap_err();
        assert_eq!(error.path(), Some(path.as_path()));
        assert!(replace_file(Path::new("/"), |_| Ok(())).is_err());
    }
}

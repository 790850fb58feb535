//! Writing files so that a reader sees the old bytes or the new ones, never a part.

use crate::base::error::{Error, ErrorKind, Result};
use std::ffi::OsString;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

/// Writes `path` through a temporary file beside it, which takes its name once all bytes are down.
///
/// On failure the temporary file is removed and an existing `path` keeps its bytes.
///
/// # Errors
/// [`ErrorKind::Io`] naming `path`.
pub(crate) fn replace_file(path: &Path, write: impl FnOnce(&mut BufWriter<&File>) -> io::Result<()>) -> Result<()> {
    let replacement = Replacement::create(path)?;
    let mut out = BufWriter::with_capacity(1 << 18, &replacement.file);
    write(&mut out).and_then(|()| out.flush()).map_err(|e| Error::io(path, "write", &e))?;
    drop(out);
    replacement.commit(path)
}

/// A file in the making that takes the place of another, or vanishes.
pub(crate) struct Replacement {
    /// The temporary file beside the target.
    pub(crate) file: File,
    temporary: PathBuf,
    target: PathBuf,
    done: bool,
}

impl Replacement {
    /// # Errors
    /// [`ErrorKind::Io`] if `path` is there and is no regular file, or no file can be made beside it.
    pub(crate) fn create(path: &Path) -> Result<Self> {
        // A link stays one: its target is what gets replaced.
        let target = fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
        if fs::metadata(&target).is_ok_and(|m| !m.is_file()) {
            return Err(Error::new(ErrorKind::Io, "cannot write: not a regular file").in_file(path));
        }
        let Some(name) = target.file_name() else {
            return Err(Error::new(ErrorKind::Io, "cannot write: the path names no file").in_file(path));
        };
        // Another thread's file, or one left by a killed process of the same id, is there already: take the next number.
        for number in 0u32.. {
            let mut temporary = OsString::from(".");
            temporary.push(name);
            temporary.push(format!(".{}-{}.tmp", std::process::id(), number));
            let temporary = target.with_file_name(temporary);
            match OpenOptions::new().write(true).create_new(true).open(&temporary) {
                Ok(file) => return Ok(Self { file, temporary, target, done: false }),
                Err(e) if e.kind() == io::ErrorKind::AlreadyExists => {}
                Err(e) => return Err(Error::io(path, "write", &e)),
            }
        }
        Err(Error::new(ErrorKind::Io, "cannot write: no temporary name is free").in_file(path))
    }

    /// Gives the file its name once its bytes are on disk.
    pub(crate) fn commit(mut self, path: &Path) -> Result<()> {
        // The name must not reach the disk before the bytes.
        self.file.sync_all().map_err(|e| Error::io(path, "write", &e))?;
        fs::rename(&self.temporary, &self.target).map_err(|e| Error::io(path, "write", &e))?;
        self.done = true;
        Ok(())
    }
}

impl Drop for Replacement {
    fn drop(&mut self) {
        if !self.done {
            // Nothing is left to report to: the error that brought us here is on its way.
            let _ = fs::remove_file(&self.temporary);
        }
    }
}

#[cfg(all(test, any(feature = "npz", feature = "images")))]
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

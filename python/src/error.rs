//! From the library's errors to exceptions with the same one line.

use pyo3::prelude::*;
use std::ffi::CString;
use voxcast::{Error, ErrorKind, Note};

/// Why a call fails.
pub(crate) enum Failure {
    /// The library says so.
    Library(Error),
    /// Another call has the object.
    Busy(&'static str),
    /// Python says so.
    Python(PyErr),
}

/// What a call comes to.
pub(crate) type Outcome<T = ()> = Result<T, Failure>;

impl From<Error> for Failure {
    fn from(error: Error) -> Self {
        Self::Library(error)
    }
}

impl From<PyErr> for Failure {
    fn from(error: PyErr) -> Self {
        Self::Python(error)
    }
}

impl From<Failure> for PyErr {
    fn from(failure: Failure) -> Self {
        match failure {
            Failure::Library(error) => {
                let class = match error.kind() {
                    ErrorKind::Io => "FileError",
                    ErrorKind::Format => "FormatError",
                    ErrorKind::Mismatch => "MismatchError",
                    ErrorKind::Unsupported => "UnsupportedError",
                    ErrorKind::TooLarge => "TooLargeError",
                    _ => "Error",
                };
                let path = error.path().map(|path| path.display().to_string());
                exception(class, &error.to_string(), path)
            }
            Failure::Busy(what) => {
                exception("BusyError", &format!("another thread is using the {what}: one at a time, please"), None)
            }
            Failure::Python(error) => error,
        }
    }
}

/// The exception `class` of `voxcast._errors`.
fn exception(class: &str, line: &str, path: Option<String>) -> PyErr {
    Python::attach(|py| {
        let made = py
            .import("voxcast._errors")
            .and_then(|module| module.getattr(class))
            .and_then(|class| class.call1((line, path)));
        match made {
            Ok(value) => PyErr::from_value(value),
            Err(error) => error,
        }
    })
}

/// What `mutex` guards, unless another thread has it.
pub(crate) fn own<'a, T>(mutex: &'a std::sync::Mutex<T>, what: &'static str) -> Outcome<std::sync::MutexGuard<'a, T>> {
    use std::sync::TryLockError;
    match mutex.try_lock() {
        Ok(guard) => Ok(guard),
        Err(TryLockError::WouldBlock) => Err(Failure::Busy(what)),
        Err(TryLockError::Poisoned(_)) => {
            let message = format!("an earlier call failed inside the {what}; make another");
            Err(Error::new(ErrorKind::Unsupported, message).into())
        }
    }
}

/// Warns of notes, with the category `voxcast.Note`. The caller is `level` frames of Python away, 1 for who called the
/// function itself. Where warnings are errors, the first one is raised.
pub(crate) fn warn(py: Python<'_>, notes: &[Note], level: i32) -> PyResult<()> {
    if notes.is_empty() {
        return Ok(());
    }
    let category = py.import("voxcast._errors")?.getattr("Note")?;
    for note in notes {
        let line = CString::new(note.to_string().replace('\0', "\u{fffd}"))?;
        PyErr::warn(py, &category, &line, level)?;
    }
    Ok(())
}

//! The one error type of the library: what went wrong, in which file, and what was expected.

use std::fmt;
use std::path::{Path, PathBuf};

/// What kind of thing went wrong, for programs that decide on it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum ErrorKind {
    /// The operating system refused a read, a write or a mapping.
    Io,
    /// The bytes are not what the format says: truncated, corrupt, wrong type, out of range.
    Format,
    /// The bytes are well formed, but belong to something else: a rig of another network, an image of another size.
    Mismatch,
    /// The request is understood and not supported, by this build or this machine.
    Unsupported,
    /// The request needs more memory than there is, or more than the formats can address.
    TooLarge,
}

/// An error with its kind, the file it concerns (where there is one) and one line of explanation.
///
/// The line says what was found and what was expected, in lower case and without a full stop.
#[derive(Debug)]
pub struct Error {
    kind: ErrorKind,
    path: Option<PathBuf>,
    message: String,
}

/// A result of this library.
pub type Result<T> = std::result::Result<T, Error>;

impl Error {
    /// An error of `kind` that is explained by `message`.
    pub fn new(kind: ErrorKind, message: impl Into<String>) -> Self {
        Self { kind, path: None, message: message.into() }
    }

    /// Malformed bytes.
    pub fn format(message: impl Into<String>) -> Self {
        Self::new(ErrorKind::Format, message)
    }

    /// Well-formed input that does not belong here.
    pub fn mismatch(message: impl Into<String>) -> Self {
        Self::new(ErrorKind::Mismatch, message)
    }

    /// A failed system call on `path`; `doing` is the verb, such as "open" or "write".
    pub fn io(path: &Path, doing: &str, source: &std::io::Error) -> Self {
        Self { kind: ErrorKind::Io, path: Some(path.to_owned()), message: format!("cannot {doing}: {source}") }
    }

    /// The same error, said of the file `path`. A file that is already named stays.
    #[must_use]
    pub fn in_file(mut self, path: &Path) -> Self {
        self.path.get_or_insert_with(|| path.to_owned());
        self
    }

    /// What kind of thing went wrong.
    pub fn kind(&self) -> ErrorKind {
        self.kind
    }

    /// The file that the error concerns, if any.
    pub fn path(&self) -> Option<&Path> {
        self.path.as_deref()
    }

    /// The explanation without the file name.
    pub fn message(&self) -> &str {
        &self.message
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.path {
            Some(path) => write!(f, "{}: {}", path.display(), self.message),
            None => f.write_str(&self.message),
        }
    }
}

impl std::error::Error for Error {}

//! What was read, is no error, and was not obeyed or does not look right.

use std::fmt;
use std::path::{Path, PathBuf};

/// One line about a file: something in it that would change the result if it were obeyed and that is not, or something
/// that is allowed and hardly ever meant.
///
/// The library never prints; who calls it decides what becomes of its notes. The program prints them on standard error.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Note {
    path: Option<PathBuf>,
    message: String,
}

impl Note {
    /// A note that says `message`: lower case, without a full stop.
    pub fn new(message: impl Into<String>) -> Self {
        Self { path: None, message: message.into() }
    }

    /// The same note, of the file `path`. A file that is already named stays.
    #[must_use]
    pub fn in_file(mut self, path: &Path) -> Self {
        self.path.get_or_insert_with(|| path.to_owned());
        self
    }

    /// The file that it concerns, if any.
    pub fn path(&self) -> Option<&Path> {
        self.path.as_deref()
    }

    /// The line without the file name.
    pub fn message(&self) -> &str {
        &self.message
    }
}

impl fmt::Display for Note {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.path {
            Some(path) => write!(f, "{}: {}", path.display(), self.message),
            None => f.write_str(&self.message),
        }
    }
}

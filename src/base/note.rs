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

/// What has been said so far: the same holds of most frames of a drive or a data set, and is said of the first.
#[derive(Clone, Debug, Default)]
pub struct Said {
    notes: Vec<Note>,
}

impl Said {
    /// Those of `notes` whose message has not been said of any file. They count as said from here on.
    pub fn fresh(&mut self, notes: Vec<Note>) -> &[Note] {
        let known = self.notes.len();
        for note in notes {
            if self.notes.iter().all(|other| other.message() != note.message()) {
                self.notes.push(note);
            }
        }
        &self.notes[known..]
    }

    /// All that has been said, in its order.
    pub fn notes(&self) -> &[Note] {
        &self.notes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_is_said_of_the_first_file() {
        let note = |file: &str, message: &str| Note::new(message).in_file(Path::new(file));
        let mut said = Said::default();
        assert_eq!(said.fresh(vec![note("a", "x"), note("a", "x"), note("b", "y")]), [note("a", "x"), note("b", "y")]);
        assert_eq!(said.fresh(vec![note("c", "y"), Note::new("z")]), [Note::new("z")]);
        assert!(said.fresh(vec![]).is_empty());
        assert_eq!(said.notes(), [note("a", "x"), note("b", "y"), Note::new("z")]);
    }
}

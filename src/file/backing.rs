//! Where the bytes of an open file are: mapped, in the program, or copied to memory that nobody else can change.

use crate::base::error::{Error, ErrorKind, Result};
use crate::file::regular::open_regular;
use bytemuck::{Pod, Zeroable};
use memmap2::Mmap;
use std::borrow::Cow;
use std::fs::File;
use std::io::Read;
use std::ops::Deref;
use std::path::Path;

/// Files of tensors have them, and their data as a whole, start on multiples of this many bytes: a cache line.
pub const ALIGNMENT: usize = 64;

/// The strictest alignment of an element that is read in place.
const ELEMENT: usize = align_of::<f32>();

/// As many bytes as files of tensors are aligned to.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C, align(64))]
pub(crate) struct Line([u8; ALIGNMENT]);

/// The bytes of a file, the first of them at a multiple of [`ELEMENT`].
pub(crate) enum Backing {
    Mapped(Mmap),
    Bytes(Cow<'static, [u8]>),
    Copied { lines: Vec<Line>, len: usize },
}

impl Deref for Backing {
    type Target = [u8];
    fn deref(&self) -> &[u8] {
        match self {
            Backing::Mapped(map) => map,
            Backing::Bytes(bytes) => bytes,
            Backing::Copied { lines, len } => &bytemuck::cast_slice(lines)[..*len],
        }
    }
}

impl Backing {
    /// Maps the file at `path`, which should be `what` and which nobody may change or cut short from then on.
    pub(crate) fn map(path: &Path, what: &str) -> Result<Self> {
        let (file, _) = open(path, what)?;
        // SAFETY: the map is read-only, and the doc comment passes on the one rule a type cannot hold: nobody shortens
        // or rewrites the file while it is mapped. `container::write` never does; it renames a new file over the name.
        let map = unsafe { Mmap::map(&file) }.map_err(|e| Error::io(path, "map", &e))?;
        Ok(Self::Mapped(map))
    }

    /// Lets go of the mapped pages that a look at the whole file has brought in, so that what nothing uses takes no memory. Those
    /// that are used come back from the system's cache.
    pub(crate) fn release(&self) {
        #[cfg(unix)]
        if let Backing::Mapped(map) = self {
            // SAFETY: the map is read-only and shared with a file that nobody changes ([`Backing::map`]), so pages that come
            // back hold what they held. A refusal changes nothing.
            let _ = unsafe { map.unchecked_advise(memmap2::UncheckedAdvice::DontNeed) };
        }
    }

    /// Copies the file at `path`, which should be `what`.
    pub(crate) fn read(path: &Path, what: &str) -> Result<Self> {
        let (mut file, len) = open(path, what)?;
        Self::fill(len, |bytes| file.read_exact(bytes).map_err(|e| Error::io(path, "read", &e)))
            .map_err(|e| e.in_file(path))
    }

    /// Takes the bytes as they are, or copies them if they start between elements.
    pub(crate) fn from_bytes(bytes: Cow<'static, [u8]>) -> Result<Self> {
        if bytes.as_ptr().addr().is_multiple_of(ELEMENT) {
            return Ok(Self::Bytes(bytes));
        }
        Self::fill(bytes.len() as u64, |copy| {
            copy.copy_from_slice(&bytes);
            Ok(())
        })
    }

    fn fill(len: u64, write: impl FnOnce(&mut [u8]) -> Result<()>) -> Result<Self> {
        let no_memory = || Error::new(ErrorKind::TooLarge, format!("the system has no {len} bytes for a copy"));
        let len = usize::try_from(len).map_err(|_| no_memory())?;
        let mut lines = Vec::new();
        lines.try_reserve_exact(len.div_ceil(ALIGNMENT)).map_err(|_| no_memory())?;
        lines.resize(len.div_ceil(ALIGNMENT), Line([0; ALIGNMENT]));
        write(&mut bytemuck::cast_slice_mut(&mut lines)[..len])?;
        Ok(Self::Copied { lines, len })
    }
}

/// A regular file that is not empty, and its length. It should be `what`.
fn open(path: &Path, what: &str) -> Result<(File, u64)> {
    let (file, len) = open_regular(path)?;
    if len == 0 {
        return Err(Error::format(format!("the file is empty, expected {what}")).in_file(path));
    }
    Ok((file, len))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn bytes_of_any_alignment_start_at_an_element() {
        static BYTES: [u8; 100] =
            *b"0123456789012345678901234567890123456789012345678901234567890123456789012345678901234567890123456789";
        let mut copies = 0;
        for (from, to) in (0..8).flat_map(|from| [(from, 100), (from, 72), (from, from)]) {
            let part = &BYTES[from..to];
            let backing = Backing::from_bytes(Cow::Borrowed(part)).unwrap();
            assert_eq!(backing[..], *part);
            assert!(backing.as_ptr().addr().is_multiple_of(ELEMENT), "{from}..{to}");
            copies += usize::from(matches!(backing, Backing::Copied { .. }));
        }
        assert_eq!(copies, 18, "three of four places are between elements");
    }

    #[test]
    fn pages_that_were_let_go_come_back() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("file");
        let bytes: Vec<u8> = (0..100_000).map(|i| (i / 7) as u8).collect();
        fs::write(&path, &bytes).unwrap();
        let mapped = Backing::map(&path, "bytes").unwrap();
        for _ in 0..2 {
            assert_eq!(mapped[..], bytes);
            mapped.release();
        }
        assert_eq!(mapped[..], bytes);
    }

    #[test]
    fn a_copy_outlives_its_file() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("file");
        let bytes: Vec<u8> = (0..1000).map(|i| i as u8).collect();
        fs::write(&path, &bytes).unwrap();
        let (mapped, copied) = (Backing::map(&path, "bytes").unwrap(), Backing::read(&path, "bytes").unwrap());
        assert_eq!((&mapped[..], &copied[..]), (&bytes[..], &bytes[..]));
        assert!(copied.as_ptr().addr().is_multiple_of(ALIGNMENT));
        drop(mapped);
        fs::write(&path, "short").unwrap();
        assert_eq!(copied[..], bytes);
    }
}

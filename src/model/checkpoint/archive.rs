//! The zip around a `.pth`: which bytes of the file belong to which entry, and their checksums.

use crate::base::error::{Error, ErrorKind, Result};
use std::borrow::Cow;
use std::io::{Cursor, Read};
use std::ops::Range;
use std::sync::OnceLock;
use zip::CompressionMethod;
use zip::read::{ArchiveOffset, Config, ZipArchive};

/// All deflated entries together may grow to so many times the file (weights hardly shrink at all), and ...
const INFLATE_RATIO: u64 = 16;

/// ... so many bytes more, which lets a tiny file of zeros through.
const INFLATE_SLACK: u64 = 1 << 20;

/// The raw elements behind one or more tensors.
pub(super) enum Storage {
    /// A range of the file.
    Mapped { range: Range<usize>, crc: Option<u32>, verified: OnceLock<bool> },
    /// An entry that was compressed; its checksum has been verified.
    Inflated(Vec<u8>),
}

impl Storage {
    /// A range that lies in the file and has no checksum.
    pub(super) fn unchecked(range: Range<usize>) -> Self {
        Self::Mapped { range, crc: None, verified: OnceLock::new() }
    }

    /// Length in bytes.
    pub(super) fn len(&self) -> usize {
        match self {
            Self::Mapped { range, .. } => range.len(),
            Self::Inflated(bytes) => bytes.len(),
        }
    }

    /// The bytes, out of the `file` that the storage was found in. The first call verifies the checksum.
    pub(super) fn bytes<'a>(&'a self, file: &'a [u8]) -> std::result::Result<&'a [u8], String> {
        match self {
            Self::Inflated(bytes) => Ok(bytes),
            Self::Mapped { range, crc, verified } => {
                let bytes = &file[range.clone()];
                let right = crc.is_none_or(|crc| *verified.get_or_init(|| crc32fast::hash(bytes) == crc));
                if right { Ok(bytes) } else { Err("its bytes do not have the CRC-32 that the archive states".into()) }
            }
        }
    }
}

/// The entries of a zip file, whose headers agree with each other.
pub(super) struct Archive<'a> {
    file: &'a [u8],
    zip: ZipArchive<Cursor<&'a [u8]>>,
    /// Bytes that entries may still inflate to.
    budget: u64,
}

impl<'a> Archive<'a> {
    /// Reads the directory of the zip that fills `file`.
    ///
    /// Local and central headers must agree, and no name may come twice and no byte belong to two entries: then all
    /// readers of the file see the same entries.
    pub(super) fn open(file: &'a [u8]) -> Result<Self> {
        let malformed = |e: zip::result::ZipError| Error::format(format!("zip: {e}"));
        let config = Config { archive_offset: ArchiveOffset::Known(0) };
        let mut zip = ZipArchive::with_config(config, Cursor::new(file)).map_err(malformed)?;
        if zip.has_duplicate_names() {
            return Err(Error::format("zip: two entries have one name"));
        }
        zip.validate_header_consistency().map_err(malformed)?;
        let budget = (file.len() as u64).saturating_mul(INFLATE_RATIO).saturating_add(INFLATE_SLACK);
        Ok(Self { file, zip, budget })
    }

    /// Names of all entries, in the order of the directory; those that are not UTF-8 are left out.
    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        self.zip.file_names_raw().filter_map(|name| std::str::from_utf8(name).ok())
    }

    /// The entry called `name`, or `None` where there is none. Its checksum is verified when its bytes are asked for.
    pub(super) fn entry(&mut self, name: &str) -> Result<Option<Storage>> {
        let Some(index) = self.zip.index_for_name_raw(name.as_bytes()) else { return Ok(None) };
        let wrong = |what: String| Error::format(format!("zip entry {name:?}: {what}"));
        let unsupported = |what: String| Error::new(ErrorKind::Unsupported, format!("zip entry {name:?}: {what}"));
        let entry = self.zip.by_index_raw(index).map_err(|e| wrong(e.to_string()))?;
        if entry.encrypted() {
            return Err(unsupported("encrypted, expected plain".into()));
        }
        let (packed, size, crc) = (entry.compressed_size(), entry.size(), entry.crc32());
        match entry.compression() {
            CompressionMethod::Stored => {
                if packed != size {
                    return Err(wrong(format!("stored in {packed} bytes, but {size} long")));
                }
                let start = entry.data_start().ok_or_else(|| wrong("no data".into()))?;
                let range = start
                    .checked_add(size)
                    .filter(|end| *end <= self.file.len() as u64)
                    .map(|end| start as usize..end as usize)
                    .ok_or_else(|| wrong(format!("{size} bytes at {start}, beyond the end of the file")))?;
                Ok(Some(Storage::Mapped { range, crc: Some(crc), verified: OnceLock::new() }))
            }
            CompressionMethod::Deflated => {
                drop(entry);
                self.budget = self.budget.checked_sub(size).ok_or_else(|| {
                    let file = self.file.len();
                    let what = format!("inflates to {size} bytes; a file of {file} may grow {INFLATE_RATIO} times");
                    Error::new(ErrorKind::TooLarge, format!("zip entry {name:?}: {what}"))
                })?;
                Ok(Some(Storage::Inflated(self.inflate(index, size).map_err(wrong)?)))
            }
            other => Err(unsupported(format!("compression {other}, expected none or deflate"))),
        }
    }

    /// Exactly `size` bytes of a deflated entry; the zip reader verifies its checksum at the end.
    fn inflate(&mut self, index: usize, size: u64) -> std::result::Result<Vec<u8>, String> {
        let entry = self.zip.by_index(index).map_err(|e| e.to_string())?;
        let mut bytes = Vec::with_capacity(size as usize);
        // One byte more than declared: asking for it makes the reader see the end, or shows that there is more.
        entry.take(size + 1).read_to_end(&mut bytes).map_err(|e| e.to_string())?;
        if bytes.len() as u64 != size {
            return Err(format!("inflates to {} bytes or more, {size} declared", bytes.len()));
        }
        Ok(bytes)
    }

    /// The verified bytes of the entry called `name`, or `None` where there is none.
    pub(super) fn bytes(&mut self, name: &str) -> Result<Option<Cow<'a, [u8]>>> {
        let Some(storage) = self.entry(name)? else { return Ok(None) };
        if let Storage::Inflated(bytes) = storage {
            return Ok(Some(Cow::Owned(bytes)));
        }
        storage.bytes(self.file).map_err(|e| Error::format(format!("zip entry {name:?}: {e}")))?;
        let Storage::Mapped { range, .. } = storage else { return Ok(None) };
        Ok(Some(Cow::Borrowed(&self.file[range])))
    }
}

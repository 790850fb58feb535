//! Files of named tensors: safetensors with aligned data and a checksum, written whole or not at all, read by mapping.
//!
//! ```text
//! u64 little-endian   n, the bytes of the header
//! n bytes             JSON: "__metadata__" (string to string), then one entry per tensor: dtype, shape, data_offsets;
//!                     padded with spaces so that the data starts on a multiple of 64
//! the rest            tensor data, in header order, without holes
//! ```
//!
//! [`write()`] adds the metadata key `"checksum"`: `xxh3-64:` and 16 lower-case hexadecimal digits, the XXH3-64 of the
//! whole file with those digits as `0`. Whoever has the key must be right; files whose `"format"` starts with `voxcast-`
//! must have the key, so that no damage can hide it. Other safetensors files need neither.

use crate::base::error::{Error, ErrorKind, Result};
pub use crate::file::backing::ALIGNMENT;

use crate::file::backing::Backing;
use crate::file::replace::Replacement;
use safetensors::Dtype;
use safetensors::tensor::Metadata;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::path::Path;
use xxhash_rust::xxh3::Xxh3;

/// No header may be longer. A thousand tensors need a tenth of a mebibyte.
const MAX_HEADER: u64 = 64 << 20;

/// Bytes of the header's length.
const LENGTH: usize = 8;

/// What precedes the digits. Both quotes of the key are unescaped, so no string of the header can contain it.
const CHECKSUM_KEY: &str = "\"checksum\":\"xxh3-64:";

/// Metadata key of the checksum.
const CHECKSUM: &str = "checksum";

/// The digits while the checksum is computed.
const ZEROS: &str = "0000000000000000";

/// Metadata key that names the format; values of this program start with [`FORMAT_PREFIX`].
pub const FORMAT: &str = "format";

/// Start of the `"format"` of every file that [`write()`] is to protect.
pub const FORMAT_PREFIX: &str = "voxcast-";

/// Whether every tensor starts on a multiple of [`ALIGNMENT`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// Each does. As the format has no holes, each tensor's bytes must be a multiple of [`ALIGNMENT`].
    Aligned,
    /// Only the first does. Tensors follow each other without regard to alignment.
    Packed,
}

/// Where a tensor's bytes come from.
pub enum Data<'a> {
    /// They are there.
    Bytes(&'a [u8]),
    /// They are made when their turn comes, so that one tensor at a time is in memory.
    Make(Box<dyn FnOnce() -> Result<Vec<u8>> + 'a>),
}

/// A tensor to write.
pub struct Tensor<'a> {
    /// Its name, unique in the file, not `__metadata__`.
    pub name: String,
    /// Type of its elements, whose bits fill whole bytes.
    pub dtype: Dtype,
    /// Dimensions, outermost first; the last is contiguous.
    pub shape: Vec<usize>,
    /// Exactly as many little-endian bytes as dtype and shape need.
    pub data: Data<'a>,
}

impl Tensor<'_> {
    /// Bytes that dtype and shape need.
    fn size(&self) -> Result<usize> {
        let too_large =
            || Error::new(ErrorKind::TooLarge, format!("tensor {}: shape {:?} overflows", self.name, self.shape));
        let elements = self.shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d)).ok_or_else(too_large)?;
        let bits = elements.checked_mul(self.dtype.bitsize()).ok_or_else(too_large)?;
        if bits % 8 != 0 {
            return Err(Error::format(format!("tensor {}: {bits} bits are no whole bytes", self.name)));
        }
        Ok(bits / 8)
    }
}

/// Writes `tensors` in their order and `metadata`, with a checksum, to `path`.
///
/// The bytes go to a temporary file beside `path` that takes its name when they are complete and on disk: a file that
/// was there stays whole until then, and after an error. The same arguments give the same bytes. A symbolic link is
/// followed.
///
/// # Errors
/// [`ErrorKind::Io`] if the system refuses or `path` is there and is no regular file; [`ErrorKind::Format`] if a name
/// appears twice, a tensor's bytes are not those of its shape, or break the rule of `layout`; whatever
/// [`Data::Make`] returns.
pub fn write(path: &Path, tensors: Vec<Tensor<'_>>, metadata: &BTreeMap<String, String>, layout: Layout) -> Result<()> {
    let (header, digits) = header(&tensors, metadata, layout).map_err(|e| e.in_file(path))?;
    let mut file = Replacement::create(path)?;
    let failed = |e: &io::Error| Error::io(path, "write", e);
    let mut out = BufWriter::with_capacity(1 << 16, &file.file);
    let checksum = put(&header, tensors, Some(path), &mut |bytes| out.write_all(bytes).map_err(|e| failed(&e)))?;
    out.flush().map_err(|e| failed(&e))?;
    drop(out);
    file.file.seek(SeekFrom::Start(digits as u64)).map_err(|e| failed(&e))?;
    file.file.write_all(checksum.as_bytes()).map_err(|e| failed(&e))?;
    file.commit(path)
}

/// The bytes of the file that [`write()`] would write.
///
/// # Errors
/// Those of [`write()`] that are not about the file.
pub fn to_bytes(tensors: Vec<Tensor<'_>>, metadata: &BTreeMap<String, String>, layout: Layout) -> Result<Vec<u8>> {
    let (header, digits) = header(&tensors, metadata, layout)?;
    let mut out = Vec::new();
    let checksum = put(&header, tensors, None, &mut |bytes| {
        let full = |_| Error::new(ErrorKind::TooLarge, "the system has no memory for the file");
        out.try_reserve(bytes.len()).map_err(full)?;
        out.extend_from_slice(bytes);
        Ok(())
    })?;
    out[digits..][..ZEROS.len()].copy_from_slice(checksum.as_bytes());
    Ok(out)
}

/// Hands header and data over in order. Returns the digits of the checksum. `path` is what errors of shapes are said of; those of
/// [`Data::Make`] speak of where the data comes from.
fn put(
    header: &[u8],
    tensors: Vec<Tensor<'_>>,
    path: Option<&Path>,
    out: &mut dyn FnMut(&[u8]) -> Result<()>,
) -> Result<String> {
    let said = |e: Error| match path {
        Some(path) => e.in_file(path),
        None => e,
    };
    let mut hash = Xxh3::new();
    hash.update(header);
    out(header)?;
    for tensor in tensors {
        let expected = tensor.size().map_err(said)?;
        let bytes = match tensor.data {
            Data::Bytes(bytes) => Cow::Borrowed(bytes),
            Data::Make(make) => Cow::Owned(make()?),
        };
        if bytes.len() != expected {
            let found = bytes.len();
            let message = format!("tensor {}: {found} bytes given, its shape needs {expected}", tensor.name);
            return Err(said(Error::format(message)));
        }
        hash.update(&bytes);
        out(&bytes)?;
    }
    Ok(format!("{:016x}", hash.digest()))
}

/// Length and JSON, padded, with a checksum of zeros; and where in the file its digits lie.
fn header(tensors: &[Tensor<'_>], metadata: &BTreeMap<String, String>, layout: Layout) -> Result<(Vec<u8>, usize)> {
    let mut metadata = metadata.clone();
    metadata.insert(CHECKSUM.into(), format!("xxh3-64:{ZEROS}"));
    let json = |value: serde_json::Value| value.to_string();
    // Written entry by entry: the order of the tensors is part of the format, a JSON map would sort them.
    let mut text = format!("{{\"__metadata__\":{}", json(serde_json::json!(metadata)));
    let mut seen = std::collections::HashSet::new();
    let mut at = 0usize;
    for tensor in tensors {
        if tensor.name == "__metadata__" || !seen.insert(&tensor.name) {
            return Err(Error::format(format!("tensor {}: the name is taken", tensor.name)));
        }
        let size = tensor.size()?;
        if layout == Layout::Aligned && size % ALIGNMENT != 0 {
            let message = format!("tensor {}: {size} bytes, expected a multiple of {ALIGNMENT}", tensor.name);
            return Err(Error::format(message));
        }
        let end =
            at.checked_add(size).ok_or_else(|| Error::new(ErrorKind::TooLarge, "tensors overflow the file size"))?;
        let entry = serde_json::json!({"dtype": tensor.dtype, "shape": tensor.shape, "data_offsets": [at, end]});
        text += &format!(",{}:{}", json(serde_json::json!(tensor.name)), json(entry));
        at = end;
    }
    text.push('}');
    let padded = (LENGTH + text.len()).next_multiple_of(ALIGNMENT) - LENGTH;
    if padded as u64 > MAX_HEADER {
        return Err(Error::new(
            ErrorKind::TooLarge,
            format!("header of {padded} bytes, at most {MAX_HEADER} are allowed"),
        ));
    }
    text.extend(std::iter::repeat_n(' ', padded - text.len()));
    let mut bytes = (padded as u64).to_le_bytes().to_vec();
    bytes.extend(text.as_bytes());
    let digits = checksum_digits(&bytes).ok_or_else(|| Error::format("the header lost its checksum"))?;
    Ok((bytes, digits))
}

/// Where the 16 digits start, if the key is there in the form that [`write()`] gives it.
fn checksum_digits(header: &[u8]) -> Option<usize> {
    let at = header.windows(CHECKSUM_KEY.len()).position(|w| w == CHECKSUM_KEY.as_bytes())? + CHECKSUM_KEY.len();
    (header.get(at + ZEROS.len()) == Some(&b'"')).then_some(at)
}

/// A read file: header parsed and checked, checksum verified, data in place.
///
/// Every tensor lies inside the file, has the bytes of its dtype and shape, and overlaps no other.
pub struct Container {
    bytes: Backing,
    header: Metadata,
    /// Where the data starts.
    start: usize,
    metadata: BTreeMap<String, String>,
    checksum: Option<u64>,
}

impl std::fmt::Debug for Container {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Container").field("bytes", &self.bytes.len()).field("metadata", &self.metadata).finish()
    }
}

impl Container {
    /// Maps the file at `path` and checks it.
    ///
    /// The file must not be changed or cut short while the container lives; replacing it, as [`write()`] does, is fine.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if it cannot be opened or is no regular file, else as [`Container::from_bytes`]; each names
    /// the file.
    pub fn open(path: &Path) -> Result<Self> {
        let container = Self::new(Backing::map(path, "safetensors")?).map_err(|e| e.in_file(path))?;
        container.bytes.release();
        Ok(container)
    }

    /// Copies the file at `path` into memory and checks the copy: nothing that happens to the file later matters.
    ///
    /// # Errors
    /// As [`Container::open`]; [`ErrorKind::TooLarge`] if the system has no memory for it.
    pub fn read(path: &Path) -> Result<Self> {
        Self::new(Backing::read(path, "safetensors")?).map_err(|e| e.in_file(path))
    }

    /// Checks bytes that are in memory already, such as a file built into the program.
    ///
    /// They are used in place if they start on a multiple of 4, as a `Vec` does with the usual allocators, and copied
    /// otherwise. Bytes that are built in start anywhere, unless they are a field of a `#[repr(align(64))]` type.
    ///
    /// # Errors
    /// [`ErrorKind::Format`] if the bytes are no safetensors or the checksum is wrong, missing or of an unknown kind;
    /// [`ErrorKind::TooLarge`] if they must be copied and the system has no memory for it.
    pub fn from_bytes(bytes: impl Into<Cow<'static, [u8]>>) -> Result<Self> {
        Self::new(Backing::from_bytes(bytes.into())?)
    }

    fn new(bytes: Backing) -> Result<Self> {
        let (header, start) = parse(&bytes)?;
        let metadata: BTreeMap<String, String> =
            header.metadata().iter().flatten().map(|(k, v)| (k.clone(), v.clone())).collect();
        let checksum = verify(&bytes, start, &metadata)?;
        Ok(Self { bytes, header, start, metadata, checksum })
    }

    /// The tensor `name`: element type, dimensions, little-endian bytes. `None` if there is none of that name.
    pub fn tensor(&self, name: &str) -> Option<(Dtype, &[usize], &[u8])> {
        let info = self.header.info(name)?;
        let (from, to) = info.data_offsets;
        Some((info.dtype, &info.shape, &self.bytes[self.start + from..self.start + to]))
    }

    /// The bytes of the whole file.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Names of the tensors, in the order of their data.
    pub fn names(&self) -> Vec<String> {
        self.header.offset_keys()
    }

    /// The file's metadata, the checksum among it; empty if it has none.
    pub fn metadata(&self) -> &BTreeMap<String, String> {
        &self.metadata
    }

    /// The checksum, which was found right; `None` for a file that has none.
    pub fn checksum(&self) -> Option<u64> {
        self.checksum
    }
}

/// The header and where the data starts.
fn parse(bytes: &[u8]) -> Result<(Metadata, usize)> {
    let Some(length) = bytes.first_chunk::<LENGTH>() else {
        return Err(Error::format(format!("{} bytes, expected safetensors of at least {LENGTH}", bytes.len())));
    };
    let length = u64::from_le_bytes(*length);
    let rest = (bytes.len() - LENGTH) as u64;
    if length > rest.min(MAX_HEADER) {
        return Err(Error::format(format!(
            "not safetensors: a header of {length} bytes is announced, {rest} follow and {MAX_HEADER} are allowed"
        )));
    }
    let start = LENGTH + length as usize;
    // The length is compared here, by subtraction: the offsets of a hostile header can add up past 64 bits.
    let header: Metadata = serde_json::from_slice(&bytes[LENGTH..start])
        .map_err(|e| Error::format(format!("not safetensors: the header does not parse: {e}")))?;
    if header.data_len() != bytes.len() - start {
        let (found, expected) = (bytes.len() - start, header.data_len());
        return Err(Error::format(format!("{found} bytes of tensor data, the header needs {expected}")));
    }
    Ok((header, start))
}

/// The checksum of a file that has one, if it is right.
fn verify(bytes: &[u8], start: usize, metadata: &BTreeMap<String, String>) -> Result<Option<u64>> {
    let Some(stated) = metadata.get(CHECKSUM) else {
        if metadata.get(FORMAT).is_some_and(|f| f.starts_with(FORMAT_PREFIX)) {
            return Err(Error::format("the metadata has no \"checksum\", which this format always has"));
        }
        return Ok(None);
    };
    let digits = stated.strip_prefix("xxh3-64:").filter(|d| d.len() == ZEROS.len());
    let at = checksum_digits(&bytes[..start]);
    let (Some(digits), Some(at)) = (digits, at) else {
        return Err(Error::format(format!("checksum {stated:?}, expected \"xxh3-64:\" and 16 digits")));
    };
    let mut hash = Xxh3::new();
    hash.update(&bytes[..at]);
    hash.update(ZEROS.as_bytes());
    hash.update(&bytes[at + ZEROS.len()..]);
    let sum = hash.digest();
    // As text, for damage can turn a digit into the same digit in upper case.
    if digits != format!("{sum:016x}") || &bytes[at..at + ZEROS.len()] != digits.as_bytes() {
        return Err(Error::format(format!("checksum {sum:016x}, the file says {digits}: the file is damaged")));
    }
    Ok(Some(sum))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    fn tensor<'a>(name: &str, dtype: Dtype, shape: &[usize], bytes: &'a [u8]) -> Tensor<'a> {
        Tensor { name: name.into(), dtype, shape: shape.into(), data: Data::Bytes(bytes) }
    }

    fn metadata() -> BTreeMap<String, String> {
        [(FORMAT, "voxcast-test-1"), ("note", "quotes \" and \\ and \"checksum\":\"xxh3-64:")]
            .map(|(k, v)| (k.to_owned(), v.to_owned()))
            .into()
    }

    const A: [u8; 64] = [7; 64];

    fn sample(path: &Path) -> Result<()> {
        let made = Box::new(|| Ok((0..128).collect()));
        let b = Tensor { name: "b".into(), dtype: Dtype::F32, shape: vec![2, 16], data: Data::Make(made) };
        let empty = tensor("empty", Dtype::F32, &[0, 3], &[]);
        write(path, vec![tensor("z", Dtype::U8, &[64], &A), empty, b], &metadata(), Layout::Aligned)
    }

    #[test]
    fn round_trip_keeps_order_alignment_and_metadata() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.safetensors");
        sample(&path).unwrap();
        let made = vec![tensor("z", Dtype::U8, &[64], &A)];
        write(&path, made, &metadata(), Layout::Aligned).unwrap();
        let same = to_bytes(vec![tensor("z", Dtype::U8, &[64], &A)], &metadata(), Layout::Aligned).unwrap();
        assert_eq!(fs::read(&path).unwrap(), same);
        sample(&path).unwrap();
        let c = Container::open(&path).unwrap();
        assert_eq!(c.names()[2], "b");
        assert_eq!(c.tensor("z"), Some((Dtype::U8, &[64][..], &A[..])));
        assert_eq!(c.tensor("empty"), Some((Dtype::F32, &[0, 3][..], &[][..])));
        let (dtype, shape, bytes) = c.tensor("b").unwrap();
        assert_eq!((dtype, shape), (Dtype::F32, &[2, 16][..]));
        assert!(bytes.iter().copied().eq(0..128));
        for name in ["z", "b"] {
            assert_eq!(c.tensor(name).unwrap().2.as_ptr() as usize % ALIGNMENT, 0, "{name}");
        }
        assert_eq!(c.tensor("nothing"), None);
        assert_eq!(c.metadata()["note"], metadata()["note"]);
        assert_eq!(c.metadata()[CHECKSUM], format!("xxh3-64:{:016x}", c.checksum().unwrap()));
        let bytes = fs::read(&path).unwrap();
        assert_eq!(c.bytes(), bytes);
        assert!(safetensors::SafeTensors::deserialize(&bytes).is_ok(), "the reference reader takes it");
        sample(&path).unwrap();
        assert_eq!(fs::read(&path).unwrap(), bytes, "the same arguments give the same bytes");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1, "no temporary file is left");
    }

    #[test]
    fn failed_writes_leave_what_was_there() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a");
        fs::write(&path, "before").unwrap();
        let refused = |tensors, layout, expected: &str| {
            let e = write(&path, tensors, &metadata(), layout).unwrap_err();
            assert!(e.message().contains(expected), "{e}");
            assert_eq!(e.path(), Some(&*path));
            assert_eq!(fs::read(&path).unwrap(), b"before");
            assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
        };
        let z = || tensor("z", Dtype::U8, &[64], &A);
        refused(vec![z(), z()], Layout::Packed, "tensor z: the name is taken");
        refused(vec![tensor("__metadata__", Dtype::U8, &[64], &A)], Layout::Packed, "the name is taken");
        refused(vec![tensor("y", Dtype::U8, &[63], &A[..63])], Layout::Aligned, "63 bytes, expected a multiple of 64");
        refused(vec![tensor("y", Dtype::U8, &[65], &A)], Layout::Packed, "64 bytes given, its shape needs 65");
        refused(vec![tensor("y", Dtype::F32, &[usize::MAX, 2], &A)], Layout::Packed, "overflows");
        refused(vec![tensor("y", Dtype::F4, &[3], &A)], Layout::Packed, "no whole bytes");
        let make = Data::Make(Box::new(|| Err(Error::mismatch("no such weight").in_file(&path))));
        refused(vec![z(), Tensor { data: make, ..z() }], Layout::Packed, "name is taken");
        let make = Data::Make(Box::new(|| Err(Error::mismatch("no such weight").in_file(&path))));
        refused(vec![Tensor { data: make, ..z() }], Layout::Packed, "no such weight");
    }

    #[test]
    fn only_regular_files_are_read_or_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let e = Container::open(dir.path()).unwrap_err();
        assert_eq!((e.kind(), e.message()), (ErrorKind::Io, "cannot open: not a regular file"));
        assert!(sample(dir.path()).unwrap_err().message().contains("not a regular file"));
        let e = Container::open(&dir.path().join("nothing")).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::Io);
        assert!(sample(&dir.path().join("no/such/dir")).is_err());
        let empty = dir.path().join("empty");
        fs::write(&empty, "").unwrap();
        assert!(Container::open(&empty).unwrap_err().message().contains("empty"));
    }

    #[cfg(unix)]
    #[test]
    fn a_link_stays_a_link() {
        let dir = tempfile::tempdir().unwrap();
        let (real, link) = (dir.path().join("real"), dir.path().join("link"));
        fs::write(&real, "old").unwrap();
        std::os::unix::fs::symlink(&real, &link).unwrap();
        sample(&link).unwrap();
        assert!(fs::symlink_metadata(&link).unwrap().is_symlink());
        assert!(Container::open(&real).is_ok());
    }

    #[test]
    fn every_truncation_extension_and_bit_flip_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a");
        sample(&path).unwrap();
        let bytes = fs::read(&path).unwrap();
        assert!(Container::from_bytes(bytes.clone()).is_ok());
        for n in 0..bytes.len() {
            assert!(Container::from_bytes(bytes[..n].to_vec()).is_err(), "cut to {n} bytes");
        }
        for bit in 0..bytes.len() * 8 {
            let mut damaged = bytes.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            assert!(Container::from_bytes(damaged).is_err(), "bit {bit} flipped");
        }
        let mut longer = bytes;
        longer.push(0);
        assert!(Container::from_bytes(longer).is_err());
    }

    fn raw(header: &str, data: usize) -> Vec<u8> {
        let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
        bytes.extend(header.as_bytes());
        bytes.extend(std::iter::repeat_n(1, data));
        bytes
    }

    #[test]
    fn plain_safetensors_need_no_checksum() {
        let c = Container::from_bytes(raw(r#"{"a":{"dtype":"U8","shape":[3],"data_offsets":[0,3]}}"#, 3)).unwrap();
        assert_eq!(c.tensor("a"), Some((Dtype::U8, &[3][..], &[1, 1, 1][..])));
        assert_eq!((c.checksum(), c.metadata().len()), (None, 0));
        let other = r#"{"__metadata__":{"format":"pt"},"a":{"dtype":"U8","shape":[3],"data_offsets":[0,3]}}"#;
        assert!(Container::from_bytes(raw(other, 3)).is_ok());
    }

    #[test]
    fn hostile_headers_are_refused() {
        let half = 1usize << (usize::BITS - 4);
        let huge: Vec<String> = (0..16)
            .map(|i: usize| {
                let end = if i == 15 { usize::MAX } else { (i + 1) * half };
                let n = end - i * half;
                format!(r#""t{i:02}":{{"dtype":"U8","shape":[{n}],"data_offsets":[{},{end}]}}"#, i * half)
            })
            .collect();
        for (header, data) in [
            (format!("{{{}}}", huge.join(",")), 7),
            (r#"{"a":{"dtype":"U8","shape":[3],"data_offsets":[1,4]}}"#.into(), 4),
            (r#"{"a":{"dtype":"U8","shape":[3],"data_offsets":[3,0]}}"#.into(), 3),
            (r#"{"a":{"dtype":"U8","shape":[4],"data_offsets":[0,3]}}"#.into(), 3),
            (r#"{"a":{"dtype":"U9","shape":[3],"data_offsets":[0,3]}}"#.into(), 3),
            (r#"{"a":{"dtype":"U8","shape":[4294967296,4294967296],"data_offsets":[0,0]}}"#.into(), 0),
            (r#"{"__metadata__":{"format":"voxcast-rig-1"}}"#.into(), 0),
            (r#"{"__metadata__":{"checksum":"xxh3-64:00"}}"#.into(), 0),
            (r#"{"__metadata__":{"checksum":"md5:0000000000000000"}}"#.into(), 0),
            (r#"{"__metadata__":{"checksum":"xxh3-64:0000000000000000"}}"#.into(), 0),
            (r#"{"__metadata__":{"checksum":"xxh3-64:\u0030000000000000000"}}"#.into(), 0),
            ("[".repeat(100_000), 0),
            ("".into(), 0),
        ] {
            let e = Container::from_bytes(raw(&header, data)).unwrap_err();
            assert_eq!(e.kind(), ErrorKind::Format, "{e}");
        }
        let mut announced = raw("{}", 0);
        announced[..8].copy_from_slice(&u64::MAX.to_le_bytes());
        assert!(Container::from_bytes(announced).unwrap_err().message().contains("18446744073709551615"));
    }
}

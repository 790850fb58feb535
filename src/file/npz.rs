//! NumPy's `.npz`: named arrays of bytes and floats, written and read without NumPy.
//!
//! An `.npz` is a zip of `NAME.npy` entries. Written here are version 1.0 headers, C order and little endian; bytes are
//! deflated (classes shrink a hundredfold), floats are stored as they are (logits do not shrink, and deflating them would
//! take longer than the disk). Equal arrays give equal files: entries carry no time.

use crate::base::error::{Error, ErrorKind, Result};
use crate::file::regular::open_regular;
use crate::file::replace::replace_file;
use std::collections::BTreeSet;
use std::io::{self, BufReader, Read, Seek, Write};
use std::path::Path;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

/// Elements to write, in C order (the last axis fastest).
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Elements<'a> {
    /// Unsigned bytes, NumPy's `uint8`.
    U8(&'a [u8]),
    /// Unsigned 16-bit integers, NumPy's `uint16`.
    U16(&'a [u16]),
    /// Single precision floats, NumPy's `float32`.
    F32(&'a [f32]),
}

/// An array to write.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Array<'a> {
    /// Name under which `numpy.load(path)[name]` finds it.
    pub name: &'a str,
    /// Lengths of the axes, slowest first. Their product is the number of elements.
    pub shape: &'a [usize],
    /// The elements.
    pub elements: Elements<'a>,
}

/// Elements that were read, in C order.
#[derive(Clone, Debug, PartialEq)]
pub enum OwnedElements {
    /// Unsigned bytes.
    U8(Vec<u8>),
    /// Unsigned 16-bit integers.
    U16(Vec<u16>),
    /// Single precision floats, bit for bit as stored.
    F32(Vec<f32>),
    /// Elements of another type or order, which are not read: what they are, for a message. The entry is whole.
    Unread(String),
}

impl OwnedElements {
    /// What they are, for a message that they should be something else.
    pub fn kind(&self) -> &str {
        match self {
            OwnedElements::U8(_) => "u8",
            OwnedElements::U16(_) => "u16",
            OwnedElements::F32(_) => "f32",
            OwnedElements::Unread(what) => what,
        }
    }
}

/// An array that was read.
#[derive(Clone, Debug, PartialEq)]
pub struct OwnedArray {
    /// Its name, without `.npy`.
    pub name: String,
    /// Lengths of the axes, slowest first; none where the elements are not read and their header says no lengths.
    pub shape: Vec<usize>,
    /// As many elements as the shape says, if they are read.
    pub elements: OwnedElements,
}

/// Axes that an array may have; NumPy's own limit.
const MAX_AXES: usize = 32;

/// Arrays that a file may hold.
const MAX_ARRAYS: usize = 1024;

/// Longest array name in bytes.
const MAX_NAME: usize = 256;

/// Deflate cannot shrink by more than 1032: a file whose entries claim more than this times its size lies.
const MAX_RATIO: u64 = 1040;

/// Writes `arrays` to `path`, in their order. The file appears whole or not at all.
///
/// # Errors
/// [`ErrorKind::Format`] for a name that is empty, repeated, longer than 256 bytes or holds a slash, backslash or
/// control character, and for a shape whose product is not the number of elements; [`ErrorKind::Io`] when writing fails.
pub fn write_npz(path: &Path, arrays: &[Array<'_>]) -> Result<()> {
    check_arrays(arrays).map_err(|e| e.in_file(path))?;
    replace_file(path, |out| {
        let mut zip = ZipWriter::new(out);
        for array in arrays {
            write_array(&mut zip, array)?;
        }
        zip.finish()?;
        Ok(())
    })
}

fn check_arrays(arrays: &[Array<'_>]) -> Result<()> {
    let mut seen = BTreeSet::new();
    if arrays.len() > MAX_ARRAYS {
        return Err(Error::format(format!("{} arrays, expected at most {MAX_ARRAYS}", arrays.len())));
    }
    for array in arrays {
        let bad = |c: char| c == '/' || c == '\\' || c.is_control();
        if array.name.is_empty() || array.name.len() > MAX_NAME || array.name.contains(bad) {
            let message = format!("array name {:?}, expected 1 to {MAX_NAME} bytes without slashes", array.name);
            return Err(Error::format(message));
        }
        if !seen.insert(array.name) {
            return Err(Error::format(format!("array name {:?} is given twice", array.name)));
        }
        let found = match array.elements {
            Elements::U8(v) => v.len(),
            Elements::U16(v) => v.len(),
            Elements::F32(v) => v.len(),
        };
        if array.shape.len() > MAX_AXES || product(array.shape) != Some(found) {
            let message = format!("array {:?} has {found} elements, expected shape {:?}", array.name, array.shape);
            return Err(Error::format(message));
        }
    }
    Ok(())
}

fn product(shape: &[usize]) -> Option<usize> {
    shape.iter().try_fold(1usize, |n, &v| n.checked_mul(v))
}

fn write_array<W: Write + Seek>(zip: &mut ZipWriter<W>, array: &Array<'_>) -> io::Result<()> {
    let (descr, method, bytes) = match array.elements {
        Elements::U8(v) => ("|u1", CompressionMethod::Deflated, v.len() as u64),
        Elements::U16(v) => ("<u2", CompressionMethod::Deflated, 2 * v.len() as u64),
        Elements::F32(v) => ("<f4", CompressionMethod::Stored, 4 * v.len() as u64),
    };
    let header = npy_header(descr, array.shape);
    let options = SimpleFileOptions::default()
        .compression_method(method)
        .last_modified_time(zip::DateTime::default())
        .unix_permissions(0o644)
        .large_file(bytes + header.len() as u64 >= u64::from(u32::MAX));
    zip.start_file(format!("{}.npy", array.name), options)?;
    zip.write_all(&header)?;
    match array.elements {
        Elements::U8(v) => zip.write_all(v),
        Elements::U16(v) => write_elements(zip, v, |n| n.to_le_bytes()),
        Elements::F32(v) => write_elements(zip, v, |n| n.to_le_bytes()),
    }
}

/// Writes elements through a small buffer, as the bytes that `bytes` makes of each.
fn write_elements<T: Copy, const N: usize>(
    out: &mut impl Write,
    elements: &[T],
    bytes: impl Fn(T) -> [u8; N],
) -> io::Result<()> {
    let mut buffer = Vec::with_capacity(1 << 16);
    for part in elements.chunks((1 << 16) / N) {
        buffer.clear();
        buffer.extend(part.iter().flat_map(|&n| bytes(n)));
        out.write_all(&buffer)?;
    }
    Ok(())
}

/// Magic, version, length and the Python literal, padded so that the elements start at a multiple of 64.
fn npy_header(descr: &str, shape: &[usize]) -> Vec<u8> {
    let mut axes: String = shape.iter().map(|v| format!("{v}, ")).collect();
    axes.truncate(axes.len().saturating_sub(if shape.len() == 1 { 1 } else { 2 }));
    let mut literal = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({axes}), }}");
    while !(10 + literal.len() + 1).is_multiple_of(64) {
        literal.push(' ');
    }
    literal.push('\n');
    let mut header = b"\x93NUMPY\x01\x00".to_vec();
    header.extend((literal.len() as u16).to_le_bytes());
    header.extend(literal.as_bytes());
    header
}

/// Reads every array of the `.npz` at `path`: `uint8`, `bool` (as bytes), little-endian `uint16` and `float32`, in C order.
///
/// Files of other programs hold other arrays beside those that matter here. One of another element type or in Fortran
/// order is [`OwnedElements::Unread`]: it is an error only for who needs it. Entries that are no `.npy` are left out.
/// Memory is taken as elements arrive, never for what a header merely claims.
///
/// # Errors
/// [`ErrorKind::Io`] when the file cannot be opened; [`ErrorKind::Format`] when it is no zip, an `.npy` does not begin as one,
/// the shape and the length of an array disagree, a checksum fails, or an entry claims more than its compressed size can
/// hold.
pub fn read_npz(path: &Path) -> Result<Vec<OwnedArray>> {
    let (file, length) = open_regular(path)?;
    read_from(BufReader::new(file), length).map_err(|e| e.in_file(path))
}

fn read_from(reader: impl Read + Seek, length: u64) -> Result<Vec<OwnedArray>> {
    let mut arrays = Vec::new();
    each_entry(reader, length, |name, entry, size| {
        let (shape, elements) = read_array(entry, size)?;
        arrays.push(OwnedArray { name: name.to_owned(), shape, elements });
        Ok(())
    })?;
    Ok(arrays)
}

/// Hands on every `.npy` of an archive of `length` bytes: its name, its bytes and how many they are.
fn each_entry(
    reader: impl Read + Seek,
    length: u64,
    mut read: impl FnMut(&str, &mut dyn Read, u64) -> Result<()>,
) -> Result<()> {
    let mut zip = ZipArchive::new(reader).map_err(|e| Error::format(format!("not an .npz: {e}")))?;
    if zip.len() > MAX_ARRAYS {
        return Err(Error::format(format!("{} entries, expected at most {MAX_ARRAYS}", zip.len())));
    }
    let mut budget = length.saturating_mul(MAX_RATIO);
    for index in 0..zip.len() {
        let mut entry = zip.by_index(index).map_err(|e| Error::format(format!("entry {index}: {e}")))?;
        let full_name = entry.name().map_err(|e| Error::format(format!("entry {index}: {e}")))?.into_owned();
        let size = entry.size();
        if size > budget {
            return Err(Error::format(format!("entry {full_name:?} claims {size} bytes, expected at most {budget}")));
        }
        budget -= size;
        let Some(name) = full_name.strip_suffix(".npy") else { continue };
        read(name, &mut entry, size).map_err(|e| {
            // The kind stays; the entry's name goes in front, as the path does later.
            Error::new(e.kind(), format!("entry {full_name:?}: {}", e.message()))
        })?;
    }
    Ok(())
}

/// An array as it is stored, of any type of elements.
#[cfg(feature = "eval")]
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct RawArray {
    /// Its name, without `.npy`.
    pub(crate) name: String,
    /// The type of the elements, such as `<f4`; `|O` for objects.
    pub(crate) descr: String,
    /// Whether the first axis is the fastest.
    pub(crate) fortran: bool,
    /// Lengths of the axes, slowest first.
    pub(crate) shape: Vec<usize>,
    /// The elements; those of objects are a pickle.
    pub(crate) bytes: Vec<u8>,
}

#[cfg(feature = "eval")]
impl RawArray {
    /// The elements of an array of integers or truth values, in C order.
    ///
    /// # Errors
    /// Those of [`read_npy_integers`] for its elements and their order.
    pub(crate) fn integers(&self) -> Result<Vec<i64>> {
        // A truth value is a byte.
        let descr = if self.descr == "|b1" { "|u1" } else { &self.descr };
        let kind = IntegerKind::of(descr, self.fortran, &self.shape)?;
        if product(&self.shape).and_then(|n| n.checked_mul(kind.item)) != Some(self.bytes.len()) {
            let (found, shape, item) = (self.bytes.len(), &self.shape, kind.item);
            return Err(Error::format(format!("{found} bytes, expected shape {shape:?} of {item} bytes each")));
        }
        kind.integers(&self.bytes)
    }
}

/// Reads those arrays of the `.npz` at `path` that are called one of `names`, as they are stored.
///
/// # Errors
/// As [`read_npz`].
#[cfg(feature = "eval")]
pub(crate) fn read_npz_raw(path: &Path, names: &[&str]) -> Result<Vec<RawArray>> {
    let read = || {
        let (file, length) = open_regular(path)?;
        let mut arrays = Vec::new();
        each_entry(BufReader::new(file), length, |name, entry, size| {
            if !names.contains(&name) {
                return Ok(());
            }
            let (literal, header) = read_header(entry)?;
            let (descr, fortran, shape) = parse_header(&literal)?;
            let bytes = read_rest(entry, header, size)?;
            arrays.push(RawArray { name: name.to_owned(), descr: descr.to_owned(), fortran, shape, bytes });
            Ok(())
        })?;
        Ok(arrays)
    };
    read().map_err(|e: Error| e.in_file(path))
}

fn read_array(entry: &mut (impl Read + ?Sized), size: u64) -> Result<(Vec<usize>, OwnedElements)> {
    let (literal, header) = read_header(entry)?;
    // Records have a list for a type. They are well formed, and nobody needs them here.
    let (descr, fortran, shape) = match parse_header(&literal) {
        Err(_) if literal.contains("'descr': [") => ("records", false, Vec::new()),
        parsed => parsed?,
    };
    let item = match descr {
        _ if fortran && shape.len() > 1 => Err("in Fortran order".to_owned()),
        "|u1" | "u1" | "<u1" | "|b1" => Ok(1),
        "<u2" => Ok(2),
        "<f4" => Ok(4),
        other => Err(format!("of type {other:?}")),
    };
    let item = match item {
        Ok(item) => item,
        Err(what) => {
            // The end is looked for, so that the checksum is compared.
            let rest = io::copy(&mut entry.take(size + 1), &mut io::sink()).map_err(unreadable)?;
            if size.checked_sub(header) != Some(rest) {
                return Err(Error::format(format!("{rest} bytes of elements in {size} bytes, expected them whole")));
            }
            return Ok((shape, OwnedElements::Unread(what)));
        }
    };
    let bytes = read_elements(entry, &shape, item, header, size)?;
    let elements = match item {
        1 => OwnedElements::U8(bytes),
        2 => OwnedElements::U16(bytes.as_chunks().0.iter().map(|&b| u16::from_le_bytes(b)).collect()),
        _ => OwnedElements::F32(bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()),
    };
    Ok((shape, elements))
}

/// The literal at the start of an `.npy`, and the bytes up to the elements.
fn read_header(entry: &mut (impl Read + ?Sized)) -> Result<(String, u64)> {
    let mut start = [0u8; 8];
    entry.read_exact(&mut start).map_err(unreadable)?;
    if &start[..6] != b"\x93NUMPY" || !(1..=3).contains(&start[6]) {
        return Err(Error::format(format!("starts with {start:02x?}, expected \\x93NUMPY and version 1 to 3")));
    }
    let wide = if start[6] == 1 { 2 } else { 4 };
    let mut length = [0u8; 4];
    entry.read_exact(&mut length[..wide]).map_err(unreadable)?;
    let length = u64::from(u32::from_le_bytes(length));
    if length > 1 << 16 {
        return Err(Error::format(format!("header of {length} bytes, expected at most 65536")));
    }
    let mut literal = Vec::new();
    entry.take(length).read_to_end(&mut literal).map_err(unreadable)?;
    let literal = String::from_utf8(literal).map_err(|_| Error::format("header is not text"))?;
    Ok((literal, 8 + wide as u64 + length))
}

/// The elements of `item` bytes behind a header of `header` bytes, in an entry of `size`.
fn read_elements(
    entry: &mut (impl Read + ?Sized),
    shape: &[usize],
    item: usize,
    header: u64,
    size: u64,
) -> Result<Vec<u8>> {
    let expected = product(shape).and_then(|n| n.checked_mul(item)).map(|n| n as u64);
    if expected.is_none_or(|n| Some(header) != size.checked_sub(n)) {
        return Err(Error::format(format!("{size} bytes, expected shape {shape:?} of {item} bytes each")));
    }
    read_rest(entry, header, size)
}

/// What is behind a header of `header` bytes, in an entry of `size`.
fn read_rest(entry: &mut (impl Read + ?Sized), header: u64, size: u64) -> Result<Vec<u8>> {
    let expected =
        size.checked_sub(header).ok_or_else(|| Error::format(format!("{size} bytes, less than its header")))?;
    // One byte more than expected is asked for, so that the end of the entry is seen and its checksum compared.
    let mut bytes = Vec::new();
    entry.take(expected + 1).read_to_end(&mut bytes).map_err(unreadable)?;
    if bytes.len() as u64 != expected {
        return Err(Error::format(format!("{} bytes of elements, expected {expected}", bytes.len())));
    }
    Ok(bytes)
}

fn unreadable(e: io::Error) -> Error {
    Error::format(format!("cannot be read: {e}"))
}

/// Reads the shape and the elements of the `.npy` at `path`, of any integer type of up to 64 bits, little endian and in C
/// order.
///
/// # Errors
/// [`ErrorKind::Io`] when the file cannot be opened; [`ErrorKind::Format`] when it is no `.npy`, its shape and its length
/// disagree, or an element exceeds an `i64`; [`ErrorKind::Unsupported`] for elements that are no such integers and for
/// Fortran order.
pub fn read_npy_integers(path: &Path) -> Result<(Vec<usize>, Vec<i64>)> {
    let (file, length) = open_regular(path)?;
    read_integers(&mut BufReader::new(file), length).map_err(|e| e.in_file(path))
}

fn read_integers(file: &mut impl Read, size: u64) -> Result<(Vec<usize>, Vec<i64>)> {
    let (literal, header) = read_header(file)?;
    let (descr, fortran, shape) = parse_header(&literal)?;
    let kind = IntegerKind::of(descr, fortran, &shape)?;
    let bytes = read_elements(file, &shape, kind.item, header, size)?;
    Ok((shape, kind.integers(&bytes)?))
}

/// A type of integers.
struct IntegerKind {
    /// Its bytes.
    item: usize,
    signed: bool,
}

impl IntegerKind {
    fn of(descr: &str, fortran: bool, shape: &[usize]) -> Result<Self> {
        // The order of one axis, and of none, is both.
        if fortran && shape.len() > 1 {
            return Err(Error::new(ErrorKind::Unsupported, "Fortran order, expected C order"));
        }
        let unsupported = || {
            let message = format!("elements of type {descr:?}, expected little-endian integers such as \"<i8\"");
            Error::new(ErrorKind::Unsupported, message)
        };
        let (order, kind) = descr.split_at_checked(1).ok_or_else(unsupported)?;
        let item = match kind {
            "i1" | "u1" if "|<".contains(order) => 1,
            "i2" | "u2" if order == "<" => 2,
            "i4" | "u4" if order == "<" => 4,
            "i8" | "u8" if order == "<" => 8,
            _ => return Err(unsupported()),
        };
        Ok(Self { item, signed: kind.starts_with('i') })
    }

    fn integers(&self, bytes: &[u8]) -> Result<Vec<i64>> {
        let integer = |bytes: &[u8]| {
            let negative = self.signed && bytes[self.item - 1] >= 0x80;
            let mut wide = [if negative { 0xff } else { 0 }; 8];
            wide[..self.item].copy_from_slice(bytes);
            let number = i64::from_le_bytes(wide);
            if !self.signed && number < 0 {
                return Err(Error::format(format!("element {}, expected at most {}", number as u64, i64::MAX)));
            }
            Ok(number)
        };
        bytes.chunks_exact(self.item).map(integer).collect()
    }
}

/// The element type, whether the order is Fortran's, and the shape of a header such as `{'descr': '<f4', 'fortran_order': False, 'shape': (2, 3), }`.
fn parse_header(literal: &str) -> Result<(&str, bool, Vec<usize>)> {
    let malformed = || Error::format(format!("header {:?}, expected descr, fortran_order and shape", literal.trim()));
    let after = |key: &str| literal.split_once(key).map(|(_, rest)| rest.trim_start()).ok_or_else(malformed);
    let descr = after("'descr':")?;
    let descr = descr.strip_prefix('\'').and_then(|d| d.split_once('\'')).ok_or_else(malformed)?.0;
    let order = after("'fortran_order':")?;
    let fortran = order.starts_with("True");
    if !fortran && !order.starts_with("False") {
        return Err(malformed());
    }
    let shape = after("'shape':")?;
    let shape = shape.strip_prefix('(').and_then(|s| s.split_once(')')).ok_or_else(malformed)?.0;
    let shape = shape.strip_suffix(',').unwrap_or(shape);
    let axes: Vec<usize> = match shape.trim() {
        "" => Vec::new(),
        some => some.split(',').map(|v| v.trim().parse().map_err(|_| malformed())).collect::<Result<_>>()?,
    };
    if axes.len() > MAX_AXES {
        return Err(Error::format(format!("{} axes, expected at most {MAX_AXES}", axes.len())));
    }
    Ok((descr, fortran, axes))
}

#[cfg(test)]
mod tests;

//! `torch.save` without a zip: what it wrote before 1.6, and writes for `_use_new_zipfile_serialization=False` with any torch.
//!
//! ```text
//! pickle     a number that no other file begins with
//! pickle     1001, the version
//! pickle     {"little_endian": True, ...}
//! pickle     the object; its storages are ('storage', class, key, location, length, None)
//! pickle     a list of the storages' keys
//! per key    i64 length in elements, then the elements
//! ```
//!
//! There are no checksums. The file must end where its last storage does.

use super::Contents;
use super::calls::{Object, Torch};
use super::pth::{self, Records, Source};
use crate::base::error::{Error, ErrorKind, Result};
use crate::file::pickle::{Pickle, Value};
use std::collections::HashMap;

/// The number that the first pickle is of, as the pickle writes it.
const MAGIC: &[u8] = &[0x8a, 10, 0x6c, 0xfc, 0x9c, 0x46, 0xf9, 0x20, 0x6a, 0xa8, 0x50, 0x19];

/// The version that there is.
const VERSION: i64 = 1001;

/// Whether `bytes` begin as such a file does: a pickle of the number, of any protocol, which may put a frame around it.
pub(super) fn is_legacy(bytes: &[u8]) -> bool {
    let head = &bytes[..bytes.len().min(2 + 9 + MAGIC.len())];
    head.starts_with(&[0x80]) && head.windows(MAGIC.len()).any(|window| window == MAGIC)
}

/// Lists the tensors of the file `bytes`, of which [`is_legacy`] has seen the beginning.
pub(super) fn read(bytes: &[u8]) -> Result<Contents> {
    let mut at = 0;
    let mut next = |what| {
        let (pickle, used) = Pickle::parse_first(&bytes[at..], what)?;
        at += used;
        Ok::<_, Error>(pickle)
    };
    next("the pickle of the magic number")?;
    match next("the pickle of the version")?.root() {
        Value::Int(VERSION) => {}
        Value::Int(other) => return unsupported(format!("version {other} of torch.save's format, expected {VERSION}")),
        other => return Err(Error::format(format!("the version is {}, expected {VERSION}", other.kind()))),
    }
    check_machine(&next("the pickle of the machine")?)?;
    let pickle = next("the pickle of the tensors")?;
    let keys = next("the pickle of the storages' keys")?;
    let records = records(bytes, at, &pickle, &keys)?;
    pth::list(&pickle, Source::Records(records))
}

fn unsupported<T>(what: String) -> Result<T> {
    Err(Error::new(ErrorKind::Unsupported, what))
}

/// Refuses elements of the other byte order.
fn check_machine(pickle: &Pickle<'_, Torch>) -> Result<()> {
    let Value::Dict(facts) = pickle.root() else {
        return Err(Error::format(format!("the machine is {}, expected a dict", pickle.root().kind())));
    };
    match pickle.under(facts, "little_endian").map(|value| pickle.get(value)) {
        Some(Value::Bool(true)) => Ok(()),
        Some(Value::Bool(false)) => {
            unsupported("little_endian is False, expected True; re-save on a little-endian machine".into())
        }
        _ => Err(Error::format("the machine does not say its byte order, expected little_endian")),
    }
}

/// Where the storages lie that `keys` lists, from byte `at` on.
fn records(bytes: &[u8], mut at: usize, pickle: &Pickle<'_, Torch>, keys: &Pickle<'_, Torch>) -> Result<Records> {
    let mut sizes = HashMap::new();
    let storages = pickle.objects().filter_map(|object| match object {
        Object::Storage(storage) => Some(storage),
        Object::Tensor(_) => None,
    });
    for storage in storages {
        let (key, size) = (pickle.text(storage.key), storage.element.size);
        if *sizes.entry(key).or_insert(size) != size {
            return Err(Error::format(format!("storage {} has elements of two sizes", shown(key))));
        }
    }
    let Value::List(list) = keys.root() else {
        return Err(Error::format(format!("the storages' keys are {}, expected a list", keys.root().kind())));
    };
    let mut records = Records::new();
    for &id in list {
        let Value::Str(key) = keys.get(id) else {
            return Err(Error::format(format!("a storage's key is {}, expected a string", keys.get(id).kind())));
        };
        let key = keys.text(*key);
        let wrong = |what: String| Error::format(format!("storage {}: {what}", shown(key)));
        let &size = sizes.get(key).ok_or_else(|| wrong("no tensor has it, so its length is not known".into()))?;
        let rest = &bytes[at..];
        let Some(&length) = rest.first_chunk() else {
            return Err(wrong(format!("{} bytes are left, expected its length", rest.len())));
        };
        let elements = i64::from_le_bytes(length);
        let length = usize::try_from(elements).ok().and_then(|n| n.checked_mul(usize::from(size)));
        let Some(length) = length.filter(|&n| n <= rest.len() - 8) else {
            let left = rest.len() - 8;
            return Err(wrong(format!("{elements} elements of {size} bytes, {left} bytes are left")));
        };
        let start = at + 8;
        at = start + length;
        if records.insert(key.to_vec(), start..at).is_some() {
            return Err(wrong("it is there twice".into()));
        }
    }
    match bytes.len() - at {
        0 => Ok(records),
        rest => Err(Error::format(format!("{rest} bytes behind the last storage, expected the end"))),
    }
}

/// A key, for a message.
fn shown(key: &[u8]) -> String {
    format!("{:?}", String::from_utf8_lossy(&key[..key.len().min(40)]))
}

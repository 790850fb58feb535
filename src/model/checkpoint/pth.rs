//! The `.pth` reader: the pickle's state dict and where its tensors lie, in an archive or (`legacy`) behind the pickle.

use super::Contents;
use super::archive::{Archive, Storage};
use super::calls::{Object, TensorRef, Torch};
use super::tensor::{MAX_DIMS, Tensor};
use crate::base::error::{Error, ErrorKind, Result};
use crate::file::pickle::{Id, Pickle, Value};
use std::collections::HashMap;
use std::ops::Range;

/// Newest archive version; `torch.save` writes 3, and nothing yet more than this.
const MAX_VERSION: u32 = 10;

/// Lists the tensors of the archive that fills `file`.
pub(super) fn read(file: &[u8]) -> Result<Contents> {
    let mut archive = Archive::open(file)?;
    let folder = folder(&archive)?;
    check_kind(&mut archive, &folder)?;
    let entry = format!("{folder}data.pkl");
    let bytes = archive.bytes(&entry)?.ok_or_else(|| Error::format(format!("no zip entry {entry:?}")))?;
    let pickle = Pickle::parse(&bytes, "data.pkl")?;
    list(&pickle, Source::Archive(archive, folder))
}

/// Lists the tensors of a pickle's state dict, whose storages `source` has.
pub(super) fn list(pickle: &Pickle<'_, Torch>, source: Source<'_>) -> Result<Contents> {
    let (dict, notes) = state_dict(pickle)?;
    let mut reader = Reader {
        pickle,
        source,
        contents: Contents { notes, ..Contents::default() },
        keys: HashMap::new(),
        ids: HashMap::new(),
    };
    for &(key, value) in dict {
        if let (&Value::Str(name), Value::Object(Object::Tensor(tensor))) = (pickle.get(key), pickle.get(value)) {
            let name = std::str::from_utf8(pickle.text(name))
                .map_err(|_| Error::format("the state dict has a name that is not UTF-8"))?;
            reader.add(name, value, tensor)?;
        }
    }
    let contents = reader.contents;
    if contents.names.is_empty() {
        return Err(Error::format(format!("the state dict holds no tensors; {}", keys(pickle, dict))));
    }
    Ok(contents)
}

/// Bytes of a file that each storage has, by its key.
pub(super) type Records = HashMap<Vec<u8>, Range<usize>>;

/// Where the storages of a pickle lie.
pub(super) enum Source<'a> {
    /// In entries of an archive, in this folder.
    Archive(Archive<'a>, String),
    /// Behind the pickle.
    Records(Records),
}

impl Source<'_> {
    /// The storage that `key` names.
    fn storage(&mut self, key: &[u8]) -> Result<Storage> {
        let shown = String::from_utf8_lossy(&key[..key.len().min(40)]);
        match self {
            Source::Archive(archive, folder) => {
                let missing = || Error::format(format!("no zip entry \"{folder}data/{shown}\" for its storage"));
                let name = std::str::from_utf8(key).map_err(|_| missing())?;
                archive.entry(&format!("{folder}data/{name}"))?.ok_or_else(missing)
            }
            Source::Records(records) => {
                let found =
                    records.get(key).ok_or_else(|| Error::format(format!("no storage {shown:?} behind the pickle")));
                found.map(|range| Storage::unchecked(range.clone()))
            }
        }
    }
}

/// The one top folder with its slash; `torch.save` names it after the file.
fn folder(archive: &Archive<'_>) -> Result<String> {
    let mut pickles = archive.names().filter_map(|name| name.strip_suffix("data.pkl"));
    let mut top = pickles.by_ref().filter(|folder| folder.matches('/').count() == 1 && folder.ends_with('/'));
    match (top.next(), top.next()) {
        (Some(folder), None) => Ok(folder.to_owned()),
        (None, _) => Err(Error::format("a zip without a folder that holds data.pkl, so not from torch.save")),
        (Some(a), Some(b)) => Err(Error::format(format!("two pickles, in {a:?} and in {b:?}, expected one"))),
    }
}

/// Refuses what only looks like the output of `torch.save`, or is of a kind that is not read.
fn check_kind(archive: &mut Archive<'_>, folder: &str) -> Result<()> {
    let unsupported = |what: String| Err(Error::new(ErrorKind::Unsupported, what));
    let script = [format!("{folder}constants.pkl"), format!("{folder}code/")];
    if archive.names().any(|name| name == script[0] || name.starts_with(&script[1])) {
        return unsupported("a TorchScript archive; save the model's state_dict with torch.save".into());
    }
    if let Some(order) = archive.bytes(&format!("{folder}byteorder"))?
        && *order != *b"little"
    {
        let order = String::from_utf8_lossy(&order[..order.len().min(20)]).into_owned();
        return unsupported(format!("byteorder is {order:?}, expected \"little\"; re-save on a little-endian machine"));
    }
    if let Some(version) = archive.bytes(&format!("{folder}version"))? {
        let text = String::from_utf8_lossy(&version[..version.len().min(20)]).into_owned();
        if !text.trim_end().parse::<u32>().is_ok_and(|v| (1..=MAX_VERSION).contains(&v)) {
            return unsupported(format!("archive version {text:?}, expected 1 to {MAX_VERSION}"));
        }
    }
    Ok(())
}

/// Keys under which frameworks put a dict of tensors, the one that counts first in front.
const STATE_DICTS: [&str; 8] =
    ["state_dict", "model_state_dict", "model", "module", "net", "ema_state_dict", "state_dict_ema", "model_ema"];

/// The entries of a dict, and what is to be said of its choice.
type Chosen<'p> = (&'p [(Id, Id)], Vec<String>);

/// The dict of tensors: under a key of [`STATE_DICTS`] at the top, or the top itself.
fn state_dict<'p>(pickle: &'p Pickle<'_, Torch>) -> Result<Chosen<'p>> {
    let Value::Dict(top) = pickle.root() else {
        return Err(Error::format(format!("the checkpoint is {}, expected a dict", pickle.root().kind())));
    };
    let under = |name: &str| pickle.under(top, name).map(|value| pickle.get(value));
    match under("state_dict") {
        None | Some(Value::Dict(_)) => {}
        Some(other) => return Err(Error::format(format!("state_dict is {}, expected a dict", other.kind()))),
    }
    let is_tensor = |&(_, value): &(Id, Id)| matches!(pickle.get(value), Value::Object(Object::Tensor(_)));
    if under("state_dict").is_none() && top.iter().any(is_tensor) {
        return Ok((top, Vec::new()));
    }
    let dicts: Vec<_> = STATE_DICTS
        .iter()
        .filter_map(|&name| match under(name) {
            Some(Value::Dict(dict)) if name == "state_dict" || dict.iter().any(is_tensor) => Some((name, dict)),
            _ => None,
        })
        .collect();
    let Some((&(used, dict), others)) = dicts.split_first() else {
        let found = keys(pickle, top);
        return Err(Error::format(format!("no state_dict; {found}, expected state_dict or tensors by name")));
    };
    let others: Vec<&str> = others.iter().map(|&(name, _)| name).collect();
    let note = match (used, others.is_empty()) {
        ("state_dict", true) => None,
        (_, true) => Some(format!("the tensors are those under {used:?}")),
        (_, false) => Some(format!("the tensors are those under {used:?}; not used: {}", others.join(", "))),
    };
    Ok((dict, Vec::from_iter(note)))
}

/// The first few keys of a dict, for a message.
fn keys(pickle: &Pickle<'_, Torch>, dict: &[(Id, Id)]) -> String {
    let names = dict.iter().filter_map(|&(key, _)| match pickle.get(key) {
        Value::Str(text) => {
            let bytes = pickle.text(*text);
            Some(format!("{:?}", String::from_utf8_lossy(&bytes[..bytes.len().min(40)])))
        }
        _ => None,
    });
    let names: Vec<_> = names.take(6).collect();
    if names.is_empty() { "it has no named keys".into() } else { format!("its keys begin with {}", names.join(", ")) }
}

struct Reader<'p, 'a> {
    pickle: &'p Pickle<'p, Torch>,
    source: Source<'a>,
    contents: Contents,
    /// Storages by their key.
    keys: HashMap<&'p [u8], usize>,
    /// Tensors by their value, for one may have several names.
    ids: HashMap<Id, usize>,
}

impl<'p> Reader<'p, '_> {
    fn add(&mut self, name: &str, id: Id, tensor: &TensorRef) -> Result<()> {
        let index = match self.ids.get(&id) {
            Some(&index) => index,
            None => {
                let wrong = |e: Error| Error::new(e.kind(), format!("tensor {name:?}: {}", e.message()));
                let tensor = self.tensor(tensor).map_err(wrong)?;
                self.contents.tensors.push(tensor);
                self.ids.insert(id, self.contents.tensors.len() - 1);
                self.contents.tensors.len() - 1
            }
        };
        match self.contents.names.insert(name.to_owned(), index) {
            Some(_) => Err(Error::format(format!("two tensors are called {name:?}"))),
            None => Ok(()),
        }
    }

    /// The tensor, with its storage found and its bounds checked.
    fn tensor(&mut self, tensor: &TensorRef) -> Result<Tensor> {
        let (shape, stride) = (self.sizes(tensor.size)?, self.sizes(tensor.stride)?);
        if shape.len() != stride.len() {
            return Err(Error::format(format!("shape {shape:?} and strides {stride:?} have different lengths")));
        }
        let Ok(offset) = usize::try_from(tensor.offset) else {
            return Err(Error::format(format!("offset {}, expected 0 or more", tensor.offset)));
        };
        let storage = self.storage(tensor.storage)?;
        let stored = self.contents.storages[storage].len() / usize::from(tensor.element.size.max(1));
        let tensor = Tensor { element: tensor.element, shape, stride, offset, storage };
        tensor.check(stored).map_err(Error::format)?;
        Ok(tensor)
    }

    fn sizes(&self, id: Id) -> Result<Box<[usize]>> {
        let sizes = self.pickle.sequence(id).unwrap_or_default();
        if sizes.len() > MAX_DIMS {
            return Err(Error::format(format!("{} dimensions, expected at most {MAX_DIMS}", sizes.len())));
        }
        let size = |&id: &Id| match self.pickle.get(id) {
            Value::Int(n) => usize::try_from(*n).map_err(|_| format!("a size or stride of {n}, expected 0 or more")),
            other => Err(format!("a size or stride that is {}, expected an int", other.kind())),
        };
        sizes.iter().map(size).collect::<std::result::Result<_, _>>().map_err(Error::format)
    }

    /// Index of the storage, which has exactly the declared length.
    fn storage(&mut self, id: Id) -> Result<usize> {
        let Value::Object(Object::Storage(storage)) = self.pickle.get(id) else {
            return Err(Error::format(format!("its storage is {}", self.pickle.get(id).kind())));
        };
        let key = self.pickle.text(storage.key);
        let index = match self.keys.get(key) {
            Some(&index) => index,
            None => {
                let found = self.source.storage(key)?;
                self.contents.storages.push(found);
                self.keys.insert(key, self.contents.storages.len() - 1);
                self.contents.storages.len() - 1
            }
        };
        let found = self.contents.storages[index].len();
        let (numel, size) = (storage.numel, storage.element.size);
        if numel.checked_mul(u64::from(size)) != Some(found as u64) {
            return Err(Error::format(format!(
                "its storage has {found} bytes, declared are {numel} elements of {size}"
            )));
        }
        Ok(index)
    }
}

//! Training checkpoints: a `.pth` as `torch.save` writes it, or a `.safetensors` file.
//!
//! A file is mapped, its tensors are listed and checked, and nothing is converted before it is asked for:
//!
//! ```no_run
//! # fn main() -> voxcast::Result<()> {
//! let checkpoint = voxcast::checkpoint::Checkpoint::open("epoch_24.pth")?;
//! for name in checkpoint.names() {
//!     let tensor = checkpoint.get(name).expect("a listed name");
//!     assert_eq!(tensor.to_f32()?.len(), tensor.len());
//! }
//! # Ok(())
//! # }
//! ```
//!
//! A `.pth` holds a pickle, which is a program. The machine that reads it here can build tensors and plain containers
//! and has no instruction that calls anything: a pickle that tries is refused, and the error names what it would have
//! called. See [`Checkpoint::from_bytes`] for everything that is checked.

mod archive;
mod calls;
mod globals;
mod legacy;
mod names;
mod plain;
mod pth;
mod tensor;

pub use tensor::{Dtype, TensorView};

use crate::base::error::{Error, Result};
use crate::base::note::Note;
use crate::file::regular::open_regular;
use archive::Storage;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use tensor::Tensor;

/// The tensors of a checkpoint by name.
///
/// Names are those of the state dict without what wrappers put in front, name by name: `module.` (`DataParallel`, moving
/// averages), `_orig_mod.` (`torch.compile`, wherever it stands) and `model.`, also several. Where two tensors would get
/// one name so, both keep theirs. Values of the state dict that are not tensors are not listed.
pub struct Checkpoint {
    bytes: Bytes,
    contents: Contents,
    /// Which tensors were asked for.
    asked: Vec<AtomicBool>,
    path: Option<PathBuf>,
}

/// What a reader of one of the formats finds.
#[derive(Default)]
struct Contents {
    storages: Vec<Storage>,
    tensors: Vec<Tensor>,
    /// Index into `tensors`; several names may share one.
    names: BTreeMap<String, usize>,
    /// What is to be said.
    notes: Vec<String>,
}

enum Bytes {
    Mapped(memmap2::Mmap),
    Owned(Vec<u8>),
}

impl std::ops::Deref for Bytes {
    type Target = [u8];
    fn deref(&self) -> &[u8] {
        match self {
            Bytes::Mapped(map) => map,
            Bytes::Owned(bytes) => bytes,
        }
    }
}

impl Checkpoint {
    /// Maps and checks the checkpoint at `path`. Its content, not its extension, decides how it is read.
    ///
    /// The file must not change while the checkpoint lives: the tensors are views of it.
    ///
    /// # Errors
    /// [`ErrorKind::Io`](crate::ErrorKind::Io) where the file cannot be opened or mapped, else as [`Checkpoint::from_bytes`].
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let (file, length) = open_regular(path)?;
        if length == 0 {
            return Err(Error::format("the file is empty, expected a .pth or .safetensors checkpoint").in_file(path));
        }
        // SAFETY: the mapping is private and read-only, and it is only ever read as plain bytes, each value of which is
        // valid. That nobody shortens or rewrites the file meanwhile is the caller's part, stated above; no map can
        // enforce it.
        let map = unsafe { memmap2::Mmap::map(&file) }.map_err(|e| Error::io(path, "map", &e))?;
        let checkpoint = Self::new(Bytes::Mapped(map)).map_err(|e| e.in_file(path))?;
        Ok(Self { path: Some(path.to_owned()), ..checkpoint })
    }

    /// Reads a checkpoint that is in memory.
    ///
    /// Every tensor is checked here: its storage exists, has the declared size, and holds every element that shape,
    /// strides and offset reach. The bytes of a tensor in a zip are checked against their CRC-32 when they are first
    /// converted; a `.safetensors` file and a `.pth` without a zip have no checksums.
    ///
    /// # Errors
    /// - [`ErrorKind::Format`](crate::ErrorKind::Format): truncated, corrupt or inconsistent bytes; a pickle that would call
    ///   something.
    /// - [`ErrorKind::Unsupported`](crate::ErrorKind::Unsupported): a TorchScript archive, big-endian tensors, tensors of
    ///   another class or marked to be negated, storages that are parts of others, encrypted entries, compression other
    ///   than deflate.
    /// - [`ErrorKind::TooLarge`](crate::ErrorKind::TooLarge): more values or compressed bytes than a file of its size can
    ///   justify.
    pub fn from_bytes(bytes: Vec<u8>) -> Result<Self> {
        Self::new(Bytes::Owned(bytes))
    }

    fn new(bytes: Bytes) -> Result<Self> {
        let mut contents = if bytes.starts_with(b"PK\x03\x04") {
            pth::read(&bytes)?
        } else if legacy::is_legacy(&bytes) {
            legacy::read(&bytes)?
        } else if plain::is_plain(&bytes) {
            plain::read(&bytes)?
        } else {
            let head = &bytes[..bytes.len().min(8)];
            return Err(Error::format(format!(
                "begins with bytes {head:02x?}, expected a zip as torch.save writes it (PK\\x03\\x04), its older format, or a \
                 safetensors header"
            )));
        };
        let (names, replaced) = names::unwrap_all(contents.names);
        contents.names = names;
        if replaced > 0 {
            contents.notes.push(format!("{replaced} names without module., _orig_mod. or model. in front"));
        }
        let asked = contents.tensors.iter().map(|_| AtomicBool::new(false)).collect();
        Ok(Self { bytes, contents, asked, path: None })
    }

    /// What is to be said of the file: under which key its tensors are, if under another than `state_dict`, which other
    /// states it has, and how many names had something in front.
    pub fn notes(&self) -> Vec<Note> {
        self.contents.notes.iter().map(|message| self.note(message)).collect()
    }

    /// Names that [`Checkpoint::get`] was never asked for, in ascending order: after an import, what the model does not have.
    pub fn unused(&self) -> impl Iterator<Item = &str> {
        let names = self.contents.names.iter();
        names.filter(|&(_, &index)| !self.asked[index].load(Ordering::Relaxed)).map(|(name, _)| name.as_str())
    }

    /// What is to be said of [`Checkpoint::unused`] after an import: tensors that would change the result if the network had
    /// them. Counters of batch norms and of moving averages are none.
    pub fn unused_note(&self) -> Option<Note> {
        const COUNTERS: [&str; 3] = ["num_batches_tracked", "steps", "n_averaged"];
        let is_counter = |name: &str| COUNTERS.contains(&name.rsplit('.').next().unwrap_or(name));
        let unused: Vec<&str> = self.unused().filter(|name| !is_counter(name)).collect();
        let shown: Vec<String> = unused.iter().take(3).map(|name| format!("{name:?}")).collect();
        let more = if unused.len() > 3 { ", ..." } else { "" };
        let message = format!("{} tensors that the network does not have: {}{more}", unused.len(), shown.join(", "));
        (!unused.is_empty()).then(|| self.note(&message))
    }

    /// A note on the file.
    fn note(&self, message: &str) -> Note {
        let note = Note::new(message);
        match &self.path {
            Some(path) => note.in_file(path),
            None => note,
        }
    }

    /// Up to three names that are most like `name`, for a message that it is missing.
    pub fn nearest(&self, name: &str) -> Vec<&str> {
        names::nearest(name, self.names())
    }

    /// Names of the tensors in ascending order of their bytes.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.contents.names.keys().map(String::as_str)
    }

    /// How many names there are.
    pub fn len(&self) -> usize {
        self.contents.names.len()
    }

    /// Whether there is no tensor at all. A `.pth` without one is refused, a `.safetensors` file may be empty.
    pub fn is_empty(&self) -> bool {
        self.contents.names.is_empty()
    }

    /// The tensor called `name`.
    pub fn get(&self, name: &str) -> Option<TensorView<'_>> {
        let (name, &index) = self.contents.names.get_key_value(name)?;
        self.asked[index].store(true, Ordering::Relaxed);
        let tensor = &self.contents.tensors[index];
        let storage = &self.contents.storages[tensor.storage];
        Some(TensorView { name, tensor, storage, file: &self.bytes })
    }
}

impl std::fmt::Debug for Checkpoint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Checkpoint").field("bytes", &self.bytes.len()).field("tensors", &self.len()).finish()
    }
}

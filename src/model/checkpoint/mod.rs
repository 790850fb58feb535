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
mod globals;
mod pickle;
mod plain;
mod pth;
mod tensor;

pub use tensor::{Dtype, TensorView};

use crate::base::error::{Error, ErrorKind, Result};
use archive::Storage;
use std::collections::BTreeMap;
use std::fs::File;
use std::path::Path;
use tensor::Tensor;

/// The tensors of a checkpoint by name.
///
/// Names are those of the state dict. A `module.` in front of *every* name, which `DataParallel` puts there, is dropped.
/// Values of the state dict that are not tensors are not listed.
pub struct Checkpoint {
    bytes: Bytes,
    contents: Contents,
}

/// What a reader of one of the formats finds.
struct Contents {
    storages: Vec<Storage>,
    tensors: Vec<Tensor>,
    /// Index into `tensors`; several names may share one.
    names: BTreeMap<String, usize>,
}

/// What `DataParallel` puts in front of every name.
const PREFIX: &str = "module.";

impl Contents {
    fn without_prefix(mut self) -> Self {
        if self.names.keys().all(|name| name.len() > PREFIX.len() && name.starts_with(PREFIX)) {
            self.names = self.names.into_iter().map(|(name, i)| (name[PREFIX.len()..].to_owned(), i)).collect();
        }
        self
    }
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

/// How a pickle file that is not in a zip begins: protocol 2 and the number that `torch.save` wrote before 1.6.
const LEGACY_MAGIC: &[u8] = &[0x80, 2, 0x8a, 10, 0x6c, 0xfc, 0x9c, 0x46, 0xf9, 0x20, 0x6a, 0xa8, 0x50, 0x19];

impl Checkpoint {
    /// Maps and checks the checkpoint at `path`. Its content, not its extension, decides how it is read.
    ///
    /// The file must not change while the checkpoint lives: the tensors are views of it.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] where the file cannot be opened or mapped, else as [`Checkpoint::from_bytes`].
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let io = |doing| move |e: std::io::Error| Error::io(path, doing, &e);
        let file = File::open(path).map_err(io("open"))?;
        let meta = file.metadata().map_err(io("open"))?;
        if meta.is_file() && meta.len() == 0 {
            return Err(Error::format("the file is empty, expected a .pth or .safetensors checkpoint").in_file(path));
        }
        // SAFETY: the mapping is private and read-only, and it is only ever read as plain bytes, each value of which is
        // valid. That nobody shortens or rewrites the file meanwhile is the caller's part, stated above; no map can
        // enforce it.
        let map = unsafe { memmap2::Mmap::map(&file) }.map_err(io("map"))?;
        Self::new(Bytes::Mapped(map)).map_err(|e| e.in_file(path))
    }

    /// Reads a checkpoint that is in memory.
    ///
    /// Every tensor is checked here: its storage exists, has the declared size, and holds every element that shape,
    /// strides and offset reach. The bytes of a `.pth` tensor are checked against their CRC-32 when they are first
    /// converted; a `.safetensors` file has no checksums.
    ///
    /// # Errors
    /// - [`ErrorKind::Format`]: truncated, corrupt or inconsistent bytes; a pickle that would call something.
    /// - [`ErrorKind::Unsupported`]: a file of `torch.save` before 1.6, a TorchScript archive, big-endian tensors,
    ///   encrypted entries, compression other than deflate.
    /// - [`ErrorKind::TooLarge`]: more values or compressed bytes than a file of its size can justify.
    pub fn from_bytes(bytes: Vec<u8>) -> Result<Self> {
        Self::new(Bytes::Owned(bytes))
    }

    fn new(bytes: Bytes) -> Result<Self> {
        let contents = if bytes.starts_with(b"PK\x03\x04") {
            pth::read(&bytes)?
        } else if bytes.starts_with(LEGACY_MAGIC) {
            return Err(Error::new(ErrorKind::Unsupported, "legacy torch.save pickle; re-save with torch >= 1.6"));
        } else if plain::is_plain(&bytes) {
            plain::read(&bytes)?
        } else {
            let head = &bytes[..bytes.len().min(8)];
            return Err(Error::format(format!(
                "begins with bytes {head:02x?}, expected a zip as torch.save writes it (PK\\x03\\x04) or a safetensors header"
            )));
        };
        Ok(Self { bytes, contents: contents.without_prefix() })
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

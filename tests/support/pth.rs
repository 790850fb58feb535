//! Writes archives as `torch.save` does, and such as it never would.

/// A pickle under construction: each method appends an instruction.
#[derive(Clone, Default)]
pub(crate) struct Pickle(pub(crate) Vec<u8>);

impl Pickle {
    /// Begins with the protocol's version.
    pub(crate) fn new(protocol: u8) -> Self {
        Self(vec![0x80, protocol])
    }

    pub(crate) fn raw(mut self, bytes: &[u8]) -> Self {
        self.0.extend_from_slice(bytes);
        self
    }

    /// A string, with the instruction of protocol 4 where it is short.
    pub(crate) fn text(self, text: &str) -> Self {
        match (u8::try_from(text.len()), self.0[1] >= 4) {
            (Ok(len), true) => self.raw(&[0x8c, len]),
            _ => self.raw(b"X").raw(&(text.len() as u32).to_le_bytes()),
        }
        .raw(text.as_bytes())
    }

    pub(crate) fn int(self, n: i64) -> Self {
        match n {
            0..=255 => self.raw(&[b'K', n as u8]),
            256..=65535 => self.raw(b"M").raw(&(n as u16).to_le_bytes()),
            _ => match i32::try_from(n) {
                Ok(n) => self.raw(b"J").raw(&n.to_le_bytes()),
                Err(_) => self.raw(&[0x8a, 8]).raw(&n.to_le_bytes()),
            },
        }
    }

    /// Mentions a class or function.
    pub(crate) fn global(self, module: &str, name: &str) -> Self {
        match self.0[1] >= 4 {
            true => self.text(module).text(name).raw(&[0x93]),
            false => self.raw(format!("c{module}\n{name}\n").as_bytes()),
        }
    }

    pub(crate) fn ints(self, ints: &[i64]) -> Self {
        ints.iter().fold(self.raw(b"("), |p, &n| p.int(n)).raw(b"t")
    }

    /// A storage by its persistent id.
    pub(crate) fn storage(self, class: &str, key: &str, numel: i64) -> Self {
        let module = if class == "UntypedStorage" { "torch.storage" } else { "torch" };
        self.raw(b"(").text("storage").global(module, class).text(key).text("cpu").int(numel).raw(b"tQ")
    }

    pub(crate) fn ordered_dict(self) -> Self {
        self.global("collections", "OrderedDict").raw(b")R")
    }

    /// A tensor as `torch.Tensor.__reduce_ex__` writes it; `key` names its storage.
    pub(crate) fn tensor(self, key: &str, t: &Tensor) -> Self {
        let p =
            self.global("torch._utils", "_rebuild_tensor_v2").raw(b"(").storage(t.class, key, t.numel).int(t.offset);
        p.ints(&t.shape).ints(&t.stride).raw(b"\x89").ordered_dict().raw(b"tR")
    }

    pub(crate) fn stop(self) -> Vec<u8> {
        self.raw(b".").0
    }
}

/// A tensor with a storage of its own.
#[derive(Clone, Debug)]
pub(crate) struct Tensor {
    pub(crate) class: &'static str,
    pub(crate) bytes: Vec<u8>,
    /// Length of the storage that the pickle declares, in elements.
    pub(crate) numel: i64,
    pub(crate) offset: i64,
    pub(crate) shape: Vec<i64>,
    pub(crate) stride: Vec<i64>,
}

impl Tensor {
    /// A contiguous f32 tensor.
    pub(crate) fn f32(shape: &[i64], values: &[f32]) -> Self {
        Self::new("FloatStorage", shape, values.len(), values.iter().flat_map(|v| v.to_le_bytes()).collect())
    }

    /// A contiguous tensor whose `numel` elements have the `bytes`.
    pub(crate) fn new(class: &'static str, shape: &[i64], numel: usize, bytes: Vec<u8>) -> Self {
        let mut stride = vec![1; shape.len()];
        for d in (1..shape.len()).rev() {
            stride[d - 1] = stride[d] * shape[d];
        }
        Self { class, bytes, numel: numel as i64, offset: 0, shape: shape.to_vec(), stride }
    }
}

/// How a state dict is wrapped.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Wrap {
    /// An `OrderedDict` with its metadata, under `state_dict`, between other keys.
    Runner,
    /// The same, alone.
    Bare,
    /// A plain dict, alone.
    Dict,
}

/// The pickle of a state dict whose storages are `data/0`, `data/1`, ... in order.
pub(crate) fn pickle(protocol: u8, wrap: Wrap, tensors: &[(&str, Tensor)]) -> Vec<u8> {
    let mut p = Pickle::new(protocol);
    if wrap == Wrap::Runner {
        p = p.raw(b"}(").text("meta").raw(b"}").text("epoch").int(24).raw(b"s").text("state_dict");
    }
    p = if wrap == Wrap::Dict { p.raw(b"}") } else { p.ordered_dict() }.raw(b"(");
    for (i, (name, tensor)) in tensors.iter().enumerate() {
        p = p.text(name).tensor(&i.to_string(), tensor);
    }
    p = p.raw(b"u");
    if wrap != Wrap::Dict {
        // The versions of the modules: state of the dict object, {"_metadata": OrderedDict()}.
        p = p.raw(b"}").text("_metadata").ordered_dict().raw(b"sb");
    }
    if wrap == Wrap::Runner {
        p = p.text("optimizer").raw(b"N").raw(b"u");
    }
    p.stop()
}

/// The entries of an archive of `pickle` and the tensors' storages.
pub(crate) fn entries<'a>(pickle: Vec<u8>, tensors: impl IntoIterator<Item = &'a Tensor>) -> Vec<Entry> {
    let mut entries = vec![Entry::new("archive/data.pkl", pickle), Entry::new("archive/byteorder", b"little".to_vec())];
    let storages = tensors.into_iter().enumerate();
    entries.extend(storages.map(|(i, t)| Entry::new(&format!("archive/data/{i}"), t.bytes.clone())));
    entries.push(Entry::new("archive/version", b"3\n".to_vec()));
    entries
}

/// A whole `.pth`.
pub(crate) fn pth(protocol: u8, wrap: Wrap, tensors: &[(&str, Tensor)]) -> Vec<u8> {
    zip(&entries(pickle(protocol, wrap, tensors), tensors.iter().map(|(_, t)| t)))
}

/// The first three pickles of a file without a zip: the number that it begins with, its version, and the machine.
pub(crate) fn legacy_head() -> Vec<u8> {
    let magic = Pickle::new(2).raw(b"\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19").stop();
    let machine = Pickle::new(2).raw(b"}(").text("protocol_version").int(1001).text("little_endian").raw(b"\x88");
    let sizes = ["short", "int", "long"].iter().fold(machine.text("type_sizes").raw(b"}("), |p, t| p.text(t).int(4));
    [magic, Pickle::new(2).int(1001).stop(), sizes.raw(b"uu").stop()].concat()
}

/// A file without a zip: a pickle, and storages by key, size of an element and bytes.
pub(crate) fn legacy_of(pickle: Vec<u8>, storages: &[(&str, usize, Vec<u8>)]) -> Vec<u8> {
    let keys = storages.iter().fold(Pickle::new(2).raw(b"]("), |p, (key, ..)| p.text(key)).raw(b"e").stop();
    let mut file = [legacy_head(), pickle, keys].concat();
    for (_, size, bytes) in storages {
        file.extend(((bytes.len() / size) as i64).to_le_bytes());
        file.extend(bytes);
    }
    file
}

/// The file without a zip that `torch.save(..., _use_new_zipfile_serialization=False)` writes of these tensors.
pub(crate) fn legacy(wrap: Wrap, tensors: &[(&str, Tensor)]) -> Vec<u8> {
    let keys: Vec<String> = (0..tensors.len()).map(|i| i.to_string()).collect();
    let storage = |(key, (_, t)): (&String, &(&str, Tensor))| {
        (key.clone(), t.bytes.len() / (t.numel as usize).max(1), t.bytes.clone())
    };
    let storages: Vec<_> = keys.iter().zip(tensors).map(storage).collect();
    let storages: Vec<_> = storages.iter().map(|(key, size, bytes)| (key.as_str(), *size, bytes.clone())).collect();
    legacy_of(pickle(2, wrap, tensors), &storages)
}

/// A `.pth` of any pickle and of 64 zero bytes under each of the given keys.
pub(crate) fn pth_of(pickle: Vec<u8>, keys: &[&str]) -> Vec<u8> {
    let mut all = entries(pickle, []);
    all.extend(keys.iter().map(|key| Entry::new(&format!("archive/data/{key}"), vec![0; 64])));
    zip(&all)
}

/// One entry of a zip; every field can be made a lie.
#[derive(Clone)]
pub(crate) struct Entry {
    pub(crate) name: String,
    /// What lies in the file.
    pub(crate) bytes: Vec<u8>,
    pub(crate) method: u16,
    pub(crate) flags: u16,
    pub(crate) crc: u32,
    /// The declared length after decompression.
    pub(crate) size: u32,
    /// The declared length in the file.
    pub(crate) packed: u32,
    /// Where the directory says that the entry begins, if not where it does.
    pub(crate) offset: Option<u32>,
}

impl Entry {
    /// An honest entry, stored.
    pub(crate) fn new(name: &str, bytes: Vec<u8>) -> Self {
        let len = bytes.len() as u32;
        Self {
            name: name.into(),
            crc: crc32(&bytes),
            bytes,
            method: 0,
            flags: 0x800,
            size: len,
            packed: len,
            offset: None,
        }
    }

    /// `bytes` as deflate without compression, in blocks of up to 65535 bytes.
    pub(crate) fn deflated(name: &str, bytes: &[u8]) -> Self {
        let mut packed = Vec::new();
        let blocks = bytes.chunks(0xffff).count().max(1);
        for i in 0..blocks {
            let block = bytes.chunks(0xffff).nth(i).unwrap_or_default();
            packed.push(u8::from(i + 1 == blocks));
            packed.extend((block.len() as u16).to_le_bytes());
            packed.extend((!(block.len() as u16)).to_le_bytes());
            packed.extend(block);
        }
        let len = packed.len() as u32;
        Self { method: 8, crc: crc32(bytes), size: bytes.len() as u32, packed: len, ..Self::new(name, packed) }
    }

    /// What the local and the central header have in common.
    fn header(&self) -> Vec<u8> {
        let mut out = Vec::new();
        for half in [20, self.flags, self.method, 0, 0x21] {
            out.extend(half.to_le_bytes());
        }
        for word in [self.crc, self.packed, self.size] {
            out.extend(word.to_le_bytes());
        }
        out.extend((self.name.len() as u32).to_le_bytes()); // and no extra field
        out
    }
}

/// A zip file of the entries in order.
pub(crate) fn zip(entries: &[Entry]) -> Vec<u8> {
    let (mut out, mut directory) = (Vec::new(), Vec::new());
    for entry in entries {
        let offset = entry.offset.unwrap_or(out.len() as u32);
        out.extend(b"PK\x03\x04");
        out.extend(entry.header());
        out.extend(entry.name.as_bytes());
        out.extend(&entry.bytes);
        directory.extend(b"PK\x01\x02\x14\x00");
        directory.extend(entry.header());
        directory.extend([0; 10]);
        directory.extend(offset.to_le_bytes());
        directory.extend(entry.name.as_bytes());
    }
    let start = out.len() as u32;
    out.extend(&directory);
    out.extend(b"PK\x05\x06\0\0\0\0");
    out.extend((entries.len() as u16).to_le_bytes());
    out.extend((entries.len() as u16).to_le_bytes());
    out.extend((directory.len() as u32).to_le_bytes());
    out.extend(start.to_le_bytes());
    out.extend([0; 2]);
    out
}

/// The CRC-32 of zip, one bit at a time.
pub(crate) fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0, |crc, &byte| {
        (0..8).fold(crc ^ u32::from(byte), |crc, _| (crc >> 1) ^ (0xedb8_8320 & (crc & 1).wrapping_neg()))
    })
}

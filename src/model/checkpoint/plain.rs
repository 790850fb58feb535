//! The `.safetensors` reader: the format's own crate parses and checks the header.

use super::Contents;
use super::archive::Storage;
use super::tensor::{Dtype, Element, MAX_DIMS, Tensor};
use crate::base::error::{Error, ErrorKind, Result};

/// Longest header that is read. Parsed JSON takes some ten times its text, and a name with its entry some 150 bytes.
const MAX_HEADER: u64 = 16 << 20;

/// Whether `bytes` begin as safetensors does: the header's length, then JSON.
pub(super) fn is_plain(bytes: &[u8]) -> bool {
    bytes.get(8) == Some(&b'{')
}

/// Lists the tensors of the whole file `bytes`, whose first nine bytes [`is_plain`] has seen.
pub(super) fn read(bytes: &[u8]) -> Result<Contents> {
    let header = bytes.first_chunk().map_or(0, |n| u64::from_le_bytes(*n));
    if header > MAX_HEADER {
        let message = format!("safetensors header of {header} bytes, expected at most {MAX_HEADER}");
        return Err(Error::new(ErrorKind::TooLarge, message));
    }
    let malformed = |e: safetensors::SafeTensorError| Error::format(format!("safetensors: {e}"));
    let (header, metadata) = safetensors::SafeTensors::read_metadata(bytes).map_err(malformed)?;
    let start = header + 8;
    let mut contents = Contents::default();
    for (name, info) in metadata.tensors() {
        if info.shape.len() > MAX_DIMS {
            let dims = info.shape.len();
            return Err(Error::format(format!("tensor {name:?} has {dims} dimensions, expected at most {MAX_DIMS}")));
        }
        // `read_metadata` proved that the ranges fill the file behind the header, and that each has its shape's size.
        let (from, to) = info.data_offsets;
        contents.names.insert(name, contents.tensors.len());
        contents.tensors.push(Tensor {
            element: element(info.dtype),
            shape: info.shape.clone().into(),
            stride: Tensor::contiguous(&info.shape),
            offset: 0,
            storage: contents.storages.len(),
        });
        contents.storages.push(Storage::unchecked(start + from..start + to));
    }
    Ok(contents)
}

fn element(dtype: safetensors::Dtype) -> Element {
    use safetensors::Dtype as S;
    let (dtype, size) = match dtype {
        S::F64 => (Dtype::F64, 8),
        S::F32 => (Dtype::F32, 4),
        S::F16 => (Dtype::F16, 2),
        S::BF16 => (Dtype::Bf16, 2),
        S::I64 => (Dtype::I64, 8),
        S::I32 => (Dtype::I32, 4),
        S::I16 => (Dtype::I16, 2),
        S::I8 => (Dtype::I8, 1),
        S::U64 => (Dtype::U64, 8),
        S::U32 => (Dtype::U32, 4),
        S::U16 => (Dtype::U16, 2),
        S::U8 => (Dtype::U8, 1),
        S::BOOL => (Dtype::Bool, 1),
        _ => (Dtype::Other, 0),
    };
    Element { dtype, size }
}

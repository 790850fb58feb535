//! One tensor of a checkpoint: where its elements lie, and their conversion to `f32` and `f64`.

use super::archive::Storage;
use crate::base::error::{Error, ErrorKind, Result};
use half::{bf16, f16};

/// Most dimensions of a tensor. Networks have five at most; the bound keeps shapes from outweighing the file.
pub(super) const MAX_DIMS: usize = 16;

/// Most elements of a tensor that has more of them than its storage, as an expanded view has.
const MAX_EXPANDED: usize = 1 << 16;

/// Element type of a stored tensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Dtype {
    /// IEEE 754 binary64.
    F64,
    /// IEEE 754 binary32.
    F32,
    /// IEEE 754 binary16.
    F16,
    /// The upper half of a binary32.
    Bf16,
    /// Signed, 64 bits.
    I64,
    /// Signed, 32 bits.
    I32,
    /// Signed, 16 bits.
    I16,
    /// Signed, 8 bits.
    I8,
    /// Unsigned, 64 bits.
    U64,
    /// Unsigned, 32 bits.
    U32,
    /// Unsigned, 16 bits.
    U16,
    /// Unsigned, 8 bits.
    U8,
    /// One byte, 0 or not.
    Bool,
    /// Complex, quantised or 8-bit float elements. They are listed and cannot be converted.
    Other,
}

/// An element type with its size in bytes. The size is 0 where no whole number of bytes makes an element.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Element {
    pub(super) dtype: Dtype,
    pub(super) size: u8,
}

/// Shape, strides and offset are in elements.
#[derive(Debug)]
pub(super) struct Tensor {
    pub(super) element: Element,
    pub(super) shape: Box<[usize]>,
    pub(super) stride: Box<[usize]>,
    pub(super) offset: usize,
    /// Index of the storage.
    pub(super) storage: usize,
}

impl Tensor {
    /// Row-major strides of `shape`; saturating, so that a check of the bounds refuses what does not fit.
    pub(super) fn contiguous(shape: &[usize]) -> Box<[usize]> {
        let mut stride = vec![1usize; shape.len()];
        for d in (1..shape.len()).rev() {
            stride[d - 1] = stride[d].saturating_mul(shape[d].max(1));
        }
        stride.into()
    }

    /// Checks that all elements lie in a storage of `stored` elements; says what is wrong if not.
    pub(super) fn check(&self, stored: usize) -> std::result::Result<(), String> {
        let Tensor { shape, stride, offset, .. } = self;
        if shape.contains(&0) {
            return Ok(());
        }
        let outside =
            || format!("shape {shape:?}, strides {stride:?}, offset {offset} leave its storage of {stored} elements");
        let last = shape
            .iter()
            .zip(stride)
            .try_fold(*offset, |at, (&n, &step)| at.checked_add(step.checked_mul(n - 1)?))
            .ok_or_else(outside)?;
        if last >= stored {
            return Err(outside());
        }
        let numel = shape.iter().try_fold(1usize, |all, &n| all.checked_mul(n));
        if numel.is_none_or(|n| n > stored.max(MAX_EXPANDED)) {
            return Err(format!(
                "shape {shape:?} has more elements than its storage, {stored}, and than an expanded view may have, {MAX_EXPANDED}"
            ));
        }
        Ok(())
    }

    /// Elements of a tensor that passed [`Tensor::check`].
    fn len(&self) -> usize {
        // A zero may stand beside sizes whose product does not fit.
        if self.shape.contains(&0) { 0 } else { self.shape.iter().product() }
    }

    /// `value` of the `N` bytes of every element, the last dimension fastest.
    ///
    /// `check` has proved that the elements lie in the storage, whose `bytes` these are.
    fn decode<const N: usize, T>(&self, bytes: &[u8], value: impl Fn([u8; N]) -> T) -> Vec<T> {
        let (stored, _) = bytes.as_chunks::<N>();
        let len = self.len();
        if len == 0 {
            return Vec::new();
        }
        if *self.stride == *Self::contiguous(&self.shape) {
            return stored[self.offset..self.offset + len].iter().map(|&e| value(e)).collect();
        }
        let mut out = Vec::with_capacity(len);
        // A scalar has no strides and is contiguous, so there is a last dimension here.
        let inner = self.shape.len() - 1;
        let mut index = vec![0usize; inner];
        for _ in 0..len / self.shape[inner] {
            let start: usize = self.offset + index.iter().zip(&self.stride).map(|(i, s)| i * s).sum::<usize>();
            out.extend((0..self.shape[inner]).map(|i| value(stored[start + i * self.stride[inner]])));
            for d in (0..inner).rev() {
                index[d] += 1;
                if index[d] < self.shape[d] {
                    break;
                }
                index[d] = 0;
            }
        }
        out
    }

    /// Index of the element that is `at`-th in row-major order.
    fn unravel(&self, mut at: usize) -> Vec<usize> {
        let mut index = vec![0; self.shape.len()];
        for d in (0..index.len()).rev() {
            index[d] = at % self.shape[d];
            at /= self.shape[d];
        }
        index
    }
}

/// One tensor of a [`Checkpoint`](super::Checkpoint): a view of its bytes.
#[derive(Clone, Copy)]
pub struct TensorView<'a> {
    pub(super) name: &'a str,
    pub(super) tensor: &'a Tensor,
    pub(super) storage: &'a Storage,
    pub(super) file: &'a [u8],
}

/// Elements of `$view` in row-major order, each cast to `$t`.
macro_rules! convert {
    ($view:expr, $bytes:expr, $t:ty) => {{
        let (tensor, bytes) = ($view.tensor, $bytes);
        let out: Vec<$t> = match tensor.element.dtype {
            Dtype::F64 => tensor.decode(bytes, |b| f64::from_le_bytes(b) as $t),
            Dtype::F32 => tensor.decode(bytes, |b| f32::from_le_bytes(b) as $t),
            Dtype::F16 => tensor.decode(bytes, |b| f16::from_le_bytes(b).to_f32() as $t),
            Dtype::Bf16 => tensor.decode(bytes, |b| bf16::from_le_bytes(b).to_f32() as $t),
            Dtype::I64 => tensor.decode(bytes, |b| i64::from_le_bytes(b) as $t),
            Dtype::I32 => tensor.decode(bytes, |b| i32::from_le_bytes(b) as $t),
            Dtype::I16 => tensor.decode(bytes, |b| i16::from_le_bytes(b) as $t),
            Dtype::I8 => tensor.decode(bytes, |b| i8::from_le_bytes(b) as $t),
            Dtype::U64 => tensor.decode(bytes, |b| u64::from_le_bytes(b) as $t),
            Dtype::U32 => tensor.decode(bytes, |b| u32::from_le_bytes(b) as $t),
            Dtype::U16 => tensor.decode(bytes, |b| u16::from_le_bytes(b) as $t),
            Dtype::U8 => tensor.decode(bytes, |b| u8::from_le_bytes(b) as $t),
            Dtype::Bool => tensor.decode(bytes, |b| (u8::from_le_bytes(b) != 0) as u8 as $t),
            Dtype::Other => return Err($view.not_numbers()),
        };
        match out.iter().position(|v| !v.is_finite()) {
            Some(at) => Err($view.not_finite(bytes, at, out[at] as f64)),
            None => Ok(out),
        }
    }};
}

impl<'a> TensorView<'a> {
    /// The name under which the checkpoint lists it.
    pub fn name(&self) -> &'a str {
        self.name
    }

    /// Sizes of the dimensions, outermost first; empty for a scalar.
    pub fn shape(&self) -> &'a [usize] {
        &self.tensor.shape
    }

    /// The stored element type.
    pub fn dtype(&self) -> Dtype {
        self.tensor.element.dtype
    }

    /// Number of elements, the product of the shape.
    pub fn len(&self) -> usize {
        self.tensor.len()
    }

    /// Whether some dimension is 0.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The elements in row-major order, whatever the strides in the file. Values that `f32` does not have are rounded to
    /// nearest, ties to even; a bool gives 0 or 1.
    ///
    /// # Errors
    /// - [`ErrorKind::Format`] where the stored bytes do not have their CRC-32, or an element is NaN, infinite or beyond
    ///   `f32`; the first such element is named.
    /// - [`ErrorKind::Unsupported`] for [`Dtype::Other`].
    pub fn to_f32(&self) -> Result<Vec<f32>> {
        convert!(self, self.bytes()?, f32)
    }

    /// As [`TensorView::to_f32`], in `f64`. Only 64-bit integers can be rounded.
    ///
    /// # Errors
    /// As [`TensorView::to_f32`], except that every finite value fits.
    pub fn to_f64(&self) -> Result<Vec<f64>> {
        convert!(self, self.bytes()?, f64)
    }

    fn bytes(&self) -> Result<&'a [u8]> {
        self.storage.bytes(self.file).map_err(|e| Error::format(format!("tensor {:?}: {e}", self.name)))
    }

    fn not_numbers(&self) -> Error {
        let message =
            format!("tensor {:?}: elements are complex, quantised or 8-bit floats, expected real numbers", self.name);
        Error::new(ErrorKind::Unsupported, message)
    }

    /// `found` is what became of the element; a stored f64 may itself be finite.
    fn not_finite(&self, bytes: &[u8], at: usize, found: f64) -> Error {
        let stored = match self.dtype() {
            Dtype::F64 => self.tensor.decode(bytes, f64::from_le_bytes)[at],
            _ => found,
        };
        let beyond = if stored.is_finite() { ", beyond the range of f32" } else { "" };
        let index = self.tensor.unravel(at);
        Error::format(format!("tensor {:?}: element {index:?} is {stored:?}{beyond}", self.name))
    }
}

impl std::fmt::Debug for TensorView<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("TensorView")
            .field("name", &self.name)
            .field("dtype", &self.dtype())
            .field("shape", &self.shape())
            .finish()
    }
}

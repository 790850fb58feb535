//! Arrays that show memory of an object of this module, without copying it.

use numpy::ndarray::{ArrayView, Dimension};
use numpy::{Element, PyArray};
use pyo3::prelude::*;
use voxcast::Error;

use crate::error::Outcome;

/// `values` of `owner` as a read-only array of `shape`. The array keeps the owner alive.
///
/// # Safety
/// `values` must lie in memory that stays where it is, and as it is, as long as `owner` lives.
pub(crate) unsafe fn lend<'py, T: Element, D: Dimension>(
    values: &[T],
    shape: impl Into<numpy::ndarray::StrideShape<D>>,
    owner: &Bound<'py, PyAny>,
) -> Outcome<Bound<'py, PyArray<T, D>>> {
    let view = ArrayView::from_shape(shape, values).map_err(|e| Error::mismatch(e.to_string()))?;
    // SAFETY: this function's own condition; the array holds a reference to the owner. Nobody can write through the array:
    // it is made read-only before anyone sees it, and NumPy refuses to undo that because its base offers no buffer to
    // write to.
    let array = unsafe { PyArray::borrow_from_array(&view, owner.clone()) };
    array.as_any().call_method1("setflags", (false,))?;
    Ok(array)
}

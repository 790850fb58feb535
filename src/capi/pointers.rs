//! What a C program hands over: strings, arrays, structs and room for results. All reading and writing through its raw
//! pointers is here.
//!
//! Pointers to handles and to single results do not come here. They are `Option<&Handle>` and
//! `Option<&mut MaybeUninit<T>>` in the functions' signatures, which are nullable pointers to C.

use super::status::{Failure, Outcome, invalid};
use super::types::Status;
use std::ffi::{CStr, c_char};
use std::mem::MaybeUninit;
use std::path::Path;

/// Larger than any struct of the header will ever be: a size beyond is not one.
const MAX_STRUCT: usize = 4096;

/// A string that ends with NUL, if it is UTF-8.
///
/// # Safety
/// `text` is null or points to such a string, which stays as it is for `'a`.
pub(super) unsafe fn text<'a>(text: *const c_char, name: &str) -> Outcome<Option<&'a str>> {
    if text.is_null() {
        return Ok(None);
    }
    // SAFETY: it is not null, and the rest is this function's own condition.
    let text = unsafe { CStr::from_ptr(text) };
    text.to_str().map(Some).map_err(|_| invalid(format!("{name} is not UTF-8")))
}

/// A file's name. On Unix any bytes are one, elsewhere it is UTF-8.
///
/// # Safety
/// As [`text`].
pub(super) unsafe fn path<'a>(path: *const c_char) -> Outcome<&'a Path> {
    if path.is_null() {
        return Err(invalid("path is NULL"));
    }
    #[cfg(unix)]
    {
        use std::os::unix::ffi::OsStrExt;
        // SAFETY: it is not null, and the rest is this function's own condition.
        let bytes = unsafe { CStr::from_ptr(path) }.to_bytes();
        Ok(Path::new(std::ffi::OsStr::from_bytes(bytes)))
    }
    #[cfg(not(unix))]
    {
        // SAFETY: this function's own condition.
        let text = unsafe { text(path, "path") }?;
        Ok(Path::new(text.unwrap_or_default()))
    }
}

/// `length` values at `start`.
///
/// # Safety
/// `start` is null, misaligned, or points to `length` values that stay as they are for `'a`; any bits are a `T`.
pub(super) unsafe fn array<'a, T>(start: *const T, length: usize, name: &str) -> Outcome<&'a [T]> {
    if length == 0 {
        return Ok(&[]);
    }
    check::<T>(start, length, name)?;
    // SAFETY: `check` has seen that the pointer is not null and aligned and that the length can be one, and the rest is
    // this function's own condition.
    Ok(unsafe { std::slice::from_raw_parts(start, length) })
}

/// Refuses what cannot be an array of `length` values.
fn check<T>(start: *const T, length: usize, name: &str) -> Outcome {
    if start.is_null() {
        return Err(invalid(format!("{name} is NULL, expected {length} values")));
    }
    if !start.is_aligned() {
        return Err(invalid(format!("{name} is not aligned to {} bytes", align_of::<T>())));
    }
    if length.checked_mul(size_of::<T>()).is_none_or(|bytes| isize::try_from(bytes).is_err()) {
        return Err(invalid(format!("{name}: {length} values are more than there can be")));
    }
    Ok(())
}

/// Room for an array, or the wish to know how long it is.
pub(super) struct Room<'a, T> {
    start: *mut T,
    capacity: usize,
    length: Option<&'a mut MaybeUninit<usize>>,
}

impl<'a, T> Room<'a, T> {
    /// The room for `capacity` values at `start`; a null `start` asks for the length only. `length` takes it.
    ///
    /// # Safety
    /// `start` is null, misaligned, or `capacity` values from it may be written as long as the room lives.
    pub(super) unsafe fn new(start: *mut T, capacity: usize, length: Option<&'a mut MaybeUninit<usize>>) -> Self {
        Self { start, capacity, length }
    }

    /// Tells the length, and lets `write` fill as many values if they were asked for.
    pub(super) fn fill(self, length: usize, write: impl FnOnce(&mut [MaybeUninit<T>]) -> Outcome) -> Outcome {
        let query = self.start.is_null();
        match self.length {
            Some(place) => _ = place.write(length),
            None if query => return Err(invalid("neither a buffer nor a place for its length")),
            None => {}
        }
        if query {
            return Ok(());
        }
        check(self.start, self.capacity, "the buffer")?;
        if self.capacity < length {
            let text = format!("room for {} values, {length} are needed", self.capacity);
            return Err(Failure::new(Status::BufferTooSmall, text));
        }
        // SAFETY: `check` has seen that the pointer is not null and aligned; `length` is at most the capacity, which
        // `new`'s caller lets be written. Nothing is assumed of what is there.
        write(unsafe { std::slice::from_raw_parts_mut(self.start.cast(), length) })
    }
}

/// A struct that begins with its own size, as a caller of this or an older header fills it: what lies beyond the
/// caller's is 0. A caller of a newer one is refused if it asks for anything that this library does not know. `least` is the
/// size of the struct's first version.
///
/// # Safety
/// `place` is null, misaligned, or points to a `usize` and as many bytes, that one's among them, as it says. All zeros are
/// a `T`, and so are any bits.
pub(super) unsafe fn sized<T: Copy>(place: *const T, least: usize, name: &str) -> Outcome<Option<T>> {
    if place.is_null() {
        return Ok(None);
    }
    // SAFETY: this function's own condition.
    let size = unsafe { struct_size(place, least, name) }?;
    let known = size.min(size_of::<T>());
    let mut value = MaybeUninit::<T>::zeroed();
    // SAFETY: `known` bytes are in both, and `value` is new. It is all zeros where nothing is copied to.
    let value = unsafe {
        std::ptr::copy_nonoverlapping(place.cast::<u8>(), value.as_mut_ptr().cast::<u8>(), known);
        value.assume_init()
    };
    // SAFETY: the struct has `size` bytes, of which those from `known` on are looked at.
    let rest = unsafe { std::slice::from_raw_parts(place.cast::<u8>().add(known), size - known) };
    if rest.iter().any(|&byte| byte != 0) {
        return Err(invalid(format!("{name} asks for something that this version of the library does not know")));
    }
    Ok(Some(value))
}

/// Writes `value` to a struct that begins with its own size, which stays: as much as the caller's has room for.
///
/// # Safety
/// As [`sized`], and the bytes may be written.
pub(super) unsafe fn write_sized<T: Copy>(place: *mut T, value: &T, name: &str) -> Outcome {
    if place.is_null() {
        return Err(invalid(format!("{name} is NULL")));
    }
    // SAFETY: this function's own condition.
    let size = unsafe { struct_size(place, size_of::<T>(), name) }?;
    let (head, known) = (size_of::<usize>(), size.min(size_of::<T>()));
    // SAFETY: `known` bytes are in both, the first of them the size; what the caller has more becomes 0.
    unsafe {
        let (from, to) = (std::ptr::from_ref(value).cast::<u8>(), place.cast::<u8>());
        std::ptr::copy_nonoverlapping(from.add(head), to.add(head), known - head);
        std::ptr::write_bytes(to.add(known), 0, size - known);
    }
    Ok(())
}

/// The size that a struct says it has, if that can be: `least` or more.
///
/// # Safety
/// `place` is misaligned, or points to a `usize`.
unsafe fn struct_size<T>(place: *const T, least: usize, name: &str) -> Outcome<usize> {
    if !place.is_aligned() {
        return Err(invalid(format!("{name} is not aligned to {} bytes", align_of::<T>())));
    }
    // SAFETY: it is aligned for a struct that begins with a `usize`, and the rest is this function's own condition.
    let size = unsafe { place.cast::<usize>().read() };
    if !(least..=MAX_STRUCT).contains(&size) {
        return Err(invalid(format!("{name}: size is {size}, expected sizeof, {least} or more")));
    }
    Ok(size)
}

//! From what happens in the library to what a C function returns: a status, and a line of text.

use super::text::Text;
use super::types::Status;
use crate::base::error::{Error, ErrorKind};
use std::any::Any;
use std::borrow::Cow;
use std::ffi::c_char;
use std::mem::MaybeUninit;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Mutex, MutexGuard, TryLockError};

/// Why a call fails.
pub(super) struct Failure {
    status: Status,
    text: Cow<'static, str>,
}

/// What a call comes to.
pub(super) type Outcome<T = ()> = Result<T, Failure>;

impl Failure {
    pub(super) fn new(status: Status, text: impl Into<Cow<'static, str>>) -> Self {
        Self { status, text: text.into() }
    }
}

impl From<Error> for Failure {
    fn from(error: Error) -> Self {
        let status = match error.kind() {
            ErrorKind::Io => Status::Io,
            ErrorKind::Format => Status::Format,
            ErrorKind::Mismatch => Status::Mismatch,
            ErrorKind::Unsupported => Status::Unsupported,
            ErrorKind::TooLarge => Status::TooLarge,
        };
        Self::new(status, error.to_string())
    }
}

/// An argument that no caller should pass.
pub(super) fn invalid(text: impl Into<Cow<'static, str>>) -> Failure {
    Failure::new(Status::InvalidArgument, text)
}

/// A pointer that must not be null.
pub(super) fn given<T>(pointer: Option<T>, name: &str) -> Outcome<T> {
    pointer.ok_or_else(|| invalid(format!("{name} is NULL")))
}

/// What a handle guards, unless another call has it or a panic has left it half changed.
pub(super) fn own<'a, T>(state: &'a Mutex<T>, name: &str) -> Outcome<MutexGuard<'a, T>> {
    state.try_lock().map_err(|error| match error {
        TryLockError::WouldBlock => {
            Failure::new(Status::Busy, format!("another call is using the {name}: one at a time, please"))
        }
        TryLockError::Poisoned(_) => {
            Failure::new(Status::Poisoned, format!("an earlier call failed inside the {name}; it can only be freed"))
        }
    })
}

/// Runs a function's body: nothing unwinds out of it, and what fails becomes a status with its text in `message`.
///
/// # Safety
/// `message` is null, or `capacity` bytes from it may be written.
pub(super) unsafe fn call(message: *mut c_char, capacity: usize, body: impl FnOnce() -> Outcome) -> i32 {
    // SAFETY: this function's own condition.
    let message = unsafe { Text::new(message, capacity) };
    // What a panic leaves half changed is behind a mutex, which it poisons.
    let outcome = catch_unwind(AssertUnwindSafe(body));
    let (status, text) = match outcome {
        Ok(Ok(())) => (Status::Ok, Cow::Borrowed("")),
        Ok(Err(Failure { status, text })) => (status, text),
        Err(panic) => (Status::Internal, format!("a bug in voxcast: {}", said(&*panic)).into()),
    };
    message.write(&text);
    status as i32
}

/// [`call`] of a function that makes a handle: `place` has it, or null where it fails.
///
/// # Safety
/// As [`call`].
pub(super) unsafe fn make<T>(
    place: Option<&mut MaybeUninit<Option<Box<T>>>>,
    message: *mut c_char,
    capacity: usize,
    body: impl FnOnce() -> Outcome<T>,
) -> i32 {
    let body = || {
        let place = given(place, "the place for the handle")?.write(None);
        *place = Some(Box::new(body()?));
        Ok(())
    };
    // SAFETY: this function's own condition.
    unsafe { call(message, capacity, body) }
}

/// Frees a handle. A null pointer is none.
pub(super) fn free<T>(handle: Option<Box<T>>) {
    // There is nobody to tell of a panic.
    let _ = catch_unwind(AssertUnwindSafe(|| drop(handle)));
}

/// What a panic said.
fn said(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("a panic without words")
}

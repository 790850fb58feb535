//! The library for C: the functions that `include/voxcast.h` declares and explains.
//!
//! ```text
//! types     constants and structs, as the header has them
//! pointers  what a caller hands over by raw pointer, read and written
//! status    errors and panics to a status and a line of text; handles, one call at a time
//! options, model, rig, session, result
//!           the functions, each: check what was given, call the library, report
//! ```
//!
//! A handle is a `Box`; C holds its pointer and gives it back to be freed. What can change is behind a mutex: a call that
//! finds it locked says so instead of waiting, and a panic inside of a call poisons it.

mod model;
mod options;
mod pointers;
mod result;
mod rig;
mod session;
mod status;
#[cfg(test)]
mod tests;
mod text;
mod types;

use std::ffi::{CStr, c_char};
use types::{ABI, Status};

/// The package's version, as C holds strings.
const VERSION: &CStr = match CStr::from_bytes_with_nul(concat!(env!("CARGO_PKG_VERSION"), "\0").as_bytes()) {
    Ok(version) => version,
    Err(_) => panic!("the version is a number"),
};

#[unsafe(no_mangle)]
extern "C" fn voxcast_abi() -> u32 {
    ABI
}

#[unsafe(no_mangle)]
extern "C" fn voxcast_version() -> *const c_char {
    VERSION.as_ptr()
}

#[unsafe(no_mangle)]
extern "C" fn voxcast_status_name(status: i32) -> *const c_char {
    let known = Status::NAMES.into_iter().find(|&(known, _)| known as i32 == status);
    known.map_or(c"unknown", |(_, name)| name).as_ptr()
}

//! How a session or a rig builder is to run.

use super::pointers::{sized, text};
use super::status::{Failure, Outcome, invalid};
use super::types::{MAX_THREADS, Options, Status};
use crate::base::threads::Threads;
use crate::runtime::session::SessionOptions;
use std::mem::offset_of;
use voxcast_kernels::{Isa, IsaError};

/// The options at `options`, the default ones if it is null.
///
/// # Safety
/// `options` is null or as [`sized`] demands, and its strings are null or end with NUL.
pub(super) unsafe fn read(options: *const Options) -> Outcome<SessionOptions> {
    let default = SessionOptions::default();
    // SAFETY: this function's own condition. Any bits are an `Options`.
    let Some(Options { isa, threads, logits, slice_cost, confidence, reserved, .. }) =
        (unsafe { sized(options, offset_of!(Options, confidence), "options") })?
    else {
        return Ok(default);
    };
    if reserved != 0 {
        return Err(invalid("options: reserved is not 0"));
    }
    if threads > MAX_THREADS {
        return Err(invalid(format!("options: {threads} threads, at most {MAX_THREADS}")));
    }
    // SAFETY: this function's own condition.
    let isa = match unsafe { text(isa, "options: isa") }? {
        None => default.isa,
        Some(name) => Isa::parse(name).map_err(|e| match e {
            IsaError::Unknown(_) => invalid(format!("options: {e}")),
            IsaError::Unavailable(_) => Failure::new(Status::Unsupported, e.to_string()),
        })?,
    };
    Ok(SessionOptions {
        isa,
        threads: Threads::new(threads as usize)?,
        logits: logits != 0,
        confidence: confidence != 0,
        slice_cost: if slice_cost == 0 { default.slice_cost } else { slice_cost },
        ..default
    })
}

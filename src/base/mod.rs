//! What every other room may use: errors, notes, digests, poses, seeded random numbers, threads.

pub mod digest;
pub mod error;
pub(crate) mod json;
pub mod note;
#[cfg(any(feature = "eval", feature = "mcap"))]
pub mod pose;
pub mod random;
pub mod threads;

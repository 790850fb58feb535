//! What every other room may use: errors, notes, digests, seeded random numbers, threads.

pub mod digest;
pub mod error;
pub(crate) mod json;
pub mod note;
pub mod random;
pub mod threads;

//! What every other room may use: errors, digests, poses, seeded random numbers, threads.

pub mod digest;
pub mod error;
#[cfg(any(feature = "eval", feature = "mcap"))]
pub mod pose;
pub mod random;
pub mod threads;

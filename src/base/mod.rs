//! What every other room may use: errors, digests, seeded random numbers, threads.

pub mod digest;
pub mod error;
pub mod random;
pub mod threads;

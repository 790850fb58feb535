//! The arithmetic of voxcast.

pub mod project;

//! The arithmetic of voxcast.

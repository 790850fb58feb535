//! voxcast turns a ring of camera images into a semantic voxel grid on a plain CPU.

pub mod camera;
pub mod container;
pub mod error;
pub mod network;
pub mod rig;
pub mod scene;

pub use error::{Error, ErrorKind, Result};
pub use network::Network;

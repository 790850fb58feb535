//! voxcast turns a ring of camera images into a semantic voxel grid on a plain CPU.

pub mod camera;
pub mod demo;
pub mod error;
pub mod network;
#[cfg(feature = "npz")]
pub mod npz;
#[cfg(feature = "images")]
pub mod picture;
pub mod random;
#[cfg(any(feature = "npz", feature = "images"))]
mod replace;
pub mod rig;
pub mod scene;

pub use error::{Error, ErrorKind, Result};
pub use network::Network;

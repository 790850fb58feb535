//! voxcast turns a ring of camera images into a semantic voxel grid on a plain CPU.

mod arena;
pub mod camera;
#[cfg(feature = "import")]
pub mod checkpoint;
pub mod container;
pub mod demo;
pub mod error;
mod exec;
pub mod graph;
pub mod import;
pub mod model;
pub mod network;
#[cfg(feature = "npz")]
pub mod npz;
#[cfg(feature = "images")]
pub mod picture;
pub mod plan;
pub mod random;
#[cfg(any(feature = "npz", feature = "images"))]
mod replace;
pub mod rig;
pub mod scene;
pub mod seeded;
pub mod session;
pub mod threads;
pub mod weights;

pub use error::{Error, ErrorKind, Result};
pub use model::Model;
pub use network::Network;
pub use rig::Rig;
pub use scene::Scene;
pub use session::{ImageView, Occupancy, Session, SessionOptions};
pub use threads::Threads;
pub use voxcast_kernels::{Isa, IsaError};

//! The arithmetic of voxcast: scalar specification and SIMD bodies that agree in bits.
//!
//! Every kernel takes an [`Isa`] value and borrowed slices; none does I/O, allocates, starts threads or keeps state.
//! Tensors are channels last.

pub mod conv;
pub mod deconv3d;
pub mod deform_conv2d;
pub mod gather;
pub mod head;
pub mod isa;
pub mod math;
pub mod normalise;
pub mod panels;
pub mod peak;
pub mod product;
mod simd;
#[cfg(test)]
mod testing;

pub use isa::{Isa, IsaError};
pub use panels::Panels;
pub use simd::{LANES, relu};

//! The arithmetic of voxcast: scalar specification and SIMD bodies that agree in bits.
//!
//! Every kernel takes an [`Isa`] value and borrowed slices; none does I/O, allocates, starts threads or keeps state.
//! Tensors are channels last.
//!
//! - [`isa`]: which instructions there are, as values that prove it.
//! - `simd`: sixteen virtual lanes, a file per instruction set.
//! - [`matmul`]: the matrix product and the layout of its weights.
//! - [`ops`]: a file per operation. Each is also at the root of the crate.
//! - [`math`], [`peak`]: exp and sigmoid, and the machine's own ceiling.
//!
//! Without the default feature `std` the crate needs `core` alone.
#![cfg_attr(not(any(test, feature = "std")), no_std)]

#[cfg(feature = "cases")]
pub mod cases;
pub mod isa;
pub mod math;
pub mod matmul;
pub mod ops;
pub mod peak;
mod simd;
#[cfg(test)]
mod testing;

pub use isa::{Isa, IsaError};
pub use matmul::{self as product, Panels, layout as panels};
pub use ops::*;
pub use simd::{LANES, Tile, relu};

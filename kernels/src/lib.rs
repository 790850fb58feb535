//! The arithmetic of voxcast: scalar specification and SIMD bodies that agree in bits.
//!
//! Every kernel takes an [`Isa`] value and borrowed slices; none does I/O, allocates, starts threads or keeps state.
//! Tensors are channels last.
//!
//! - [`isa`]: which instructions there are, as values that prove it.
//! - `simd`: sixteen virtual lanes, a file per instruction set.
//! - [`matmul`]: the matrix product and the layout of its weights.
//! - [`ops`]: a file per operation. Each is also at the root of the crate.
//! - [`math`], [`quantised`], [`peak`]: exp and sigmoid, the rules of 8-bit tensors, and the machine's own ceiling.
//!
//! Without the default feature `std` the crate needs `core` alone.
#![cfg_attr(not(any(test, feature = "std")), no_std)]
#![cfg_attr(
    not(any(target_arch = "x86_64", target_arch = "aarch64")),
    allow(dead_code, reason = "without vector instructions only the specification runs")
)]

#[cfg(feature = "cases")]
pub mod cases;
pub mod isa;
pub mod math;
pub mod matmul;
pub mod ops;
pub mod peak;
pub mod quantised;
mod simd;
#[cfg(test)]
mod testing;

pub use isa::{Isa, IsaError};
pub use matmul::{self as product, Panels, layout as panels};
pub use ops::*;
pub use simd::{LANES, Tile, relu};

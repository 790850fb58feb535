//! The matrix product that convolutions, linear layers and attention are made of, on a virtual left matrix.
//!
//! ```text
//! out[row][n] = end(start(n) + a[row][0] * w[0][n] + a[row][1] * w[1][n] + ...)      one fma chain, k ascending
//! ```
//!
//! Four parts, each of which knows nothing of the others' choices:
//! - [`layout`]: how weights are packed.
//! - `driver`: how rows, k and columns are cut into blocks, and where the elements of the left matrix lie.
//! - `tile`: the loop in registers. Which values it multiplies and sums is an `Arithmetic`.
//! - `epilogue`: what happens at both ends of the chains, and the type of the outputs.
//!
//! [`Product`] puts them together for f32, [`ProductI8`] for 8-bit integers.

pub(crate) mod driver;
pub(crate) mod epilogue;
pub mod int8;
pub mod layout;
pub(crate) mod product;
#[cfg(test)]
mod tests;
pub(crate) mod tile;

pub use driver::BLOCK_ROWS;
pub use epilogue::Residual;
pub use int8::{ProductI8, ResidualI8};
pub use layout::Panels;
pub use product::{Product, SCRATCH};

//! The matrix product that convolutions, linear layers and attention are made of.
//!
//! [`layout`] says how weights are packed, `driver` cuts a product into blocks and tiles.

pub(crate) mod driver;
pub mod layout;
#[cfg(test)]
mod tests;

pub use driver::{BLOCK_ROWS, Product, Residual, SCRATCH};
pub use layout::Panels;

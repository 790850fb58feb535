//! Files as bytes: the container of models and rigs, mapped or read; NumPy arrays; label files; replacing a file whole.

pub(crate) mod backing;
pub(crate) mod bounded;
pub mod container;
#[cfg(feature = "npz")]
pub mod labels;
#[cfg(feature = "npz")]
pub mod npz;
pub(crate) mod replace;

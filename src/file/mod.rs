//! Files as bytes: the container of models and rigs, mapped or read; NumPy arrays; label files; pickles; replacing a file whole.

pub(crate) mod backing;
pub(crate) mod bounded;
pub mod container;
#[cfg(feature = "npz")]
pub mod labels;
#[cfg(feature = "npz")]
pub mod npz;
#[cfg(any(feature = "eval", feature = "import"))]
pub(crate) mod pickle;
pub(crate) mod regular;
pub(crate) mod replace;

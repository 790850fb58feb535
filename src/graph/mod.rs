//! The network as a small typed graph of operations, in the order in which they run.
//!
//! [`Graph::build`] writes down the published network literally, batch norms and all. [`Graph::fold_batch_norm`] and
//! [`Graph::fold_projection`] rewrite it into one that gives the same result with less work. A graph holds shapes and the
//! checkpoint names that weights come from, never weights: [`crate::model::import`] evaluates them once, and at run
//! time the same graph is rebuilt from the network's parameters, so that nothing in a model file can change what runs.
//!
//! What an operation is stands in one place, its [`Description`](ops::Description) in [`ops`].

mod backbone;
mod build;
mod builder;
mod call;
mod element;
mod head;
mod hidden;
mod matrices;
mod neck;
mod operation;
pub mod ops;
mod options;
pub mod parts;
mod quantise;
mod recipe;
mod rewrite;
pub mod scale;
mod site;
pub mod temperature;
mod tensor;
#[cfg(test)]
mod tests;
mod view;
pub mod weights;

pub use call::{Added, Call, MAX_INPUTS, MAX_OUTPUTS, Moment, Tile};
pub use element::{Element, Elements, Scalar};
pub use hidden::hidden_layers;
pub use matrices::{Csr, Level, Matrix};
pub use operation::{Graph, Operation};
pub use ops::Op;
pub use options::{Results, Rewrites};
pub use quantise::Quantisation;
pub use recipe::{ConvNames, Recipe};
pub(crate) use scale::LEVELS;
pub use scale::Scale;
pub use site::{Residual, Site};
pub use temperature::Temperature;
pub use tensor::{Branch, Lifetime, Scope, Section, Space, Tensor, TensorId};

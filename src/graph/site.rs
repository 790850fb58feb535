//! Where an operation stands in its graph: all that a description knows of its surroundings.

use super::recipe::Recipe;
use super::tensor::{Tensor, TensorId};

/// A tensor that is added to the result.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Residual {
    /// What is added; it has the shape of the output.
    pub tensor: TensorId,
    /// Whether it is added after the ReLU instead of before.
    pub after: bool,
}

/// Where an operation stands.
#[derive(Clone, Copy, Debug)]
pub struct Site<'a> {
    pub(super) tensors: &'a [Tensor],
    /// Tensors read, in the order that the description says.
    pub inputs: &'a [TensorId],
    /// Tensors written, in the order that the description says.
    pub outputs: &'a [TensorId],
    /// First channel written: branches that are concatenated share one tensor.
    pub first_channel: usize,
    /// Channels written of the first output.
    pub channels: usize,
    /// Whether negative results become 0.
    pub relu: bool,
    /// What is added.
    pub residual: Option<Residual>,
    /// Where the weights come from.
    pub recipe: &'a Recipe,
}

impl<'a> Site<'a> {
    /// Input `i`.
    ///
    /// # Panics
    /// If there is none.
    pub fn input(&self, i: usize) -> &'a Tensor {
        &self.tensors[self.inputs[i].0]
    }

    /// The first output, whose positions are what tiles are cut from.
    ///
    /// # Panics
    /// If there is none.
    pub fn output(&self) -> &'a Tensor {
        &self.tensors[self.outputs[0].0]
    }

    /// The tensor that is added, if there is one.
    pub fn added(&self) -> Option<&'a Tensor> {
        self.residual.map(|residual| &self.tensors[residual.tensor.0])
    }

    /// Positions of the output.
    pub fn rows(&self) -> usize {
        self.output().rows()
    }

    /// Every tensor read.
    pub fn reads(&self) -> impl Iterator<Item = &'a Tensor> + '_ {
        self.inputs.iter().copied().chain(self.residual.map(|r| r.tensor)).map(|id| &self.tensors[id.0])
    }
}

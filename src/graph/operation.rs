//! The graph: operations in running order, and the tensors between them.

use super::ops::Op;
use super::recipe::Recipe;
use super::site::{Residual, Site};
use super::tensor::{Tensor, TensorId};
use crate::network::Network;

/// One operation.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Operation {
    /// Unique; the checkpoint's name where there is one.
    pub name: String,
    /// What is computed.
    pub op: Op,
    /// Tensors read, in the order that the operation's description says.
    pub inputs: Vec<TensorId>,
    /// Tensors written, in the order that the operation's description says.
    pub outputs: Vec<TensorId>,
    /// First channel written: branches that are concatenated share one tensor.
    pub first_channel: usize,
    /// Channels written of the first output.
    pub channels: usize,
    /// Whether negative results become 0.
    pub relu: bool,
    /// What is added.
    pub residual: Option<Residual>,
    /// Where the weights come from.
    pub recipe: Recipe,
    /// Name under which `--dump` and the golden cases know the result.
    pub stage: Option<String>,
}

impl Operation {
    /// Every tensor read.
    pub fn reads(&self) -> impl Iterator<Item = TensorId> + '_ {
        self.inputs.iter().copied().chain(self.residual.map(|r| r.tensor))
    }

    /// The tensor whose positions its tiles are cut from.
    pub fn output(&self) -> TensorId {
        self.outputs[0]
    }

    /// The tensor that observers see: the last that it writes, which of a head are the logits if there are any.
    pub fn result(&self) -> TensorId {
        self.outputs[self.outputs.len() - 1]
    }

    /// The input that the result overwrites, for operations that work in place.
    pub fn in_place(&self) -> Option<TensorId> {
        self.op.description().in_place().map(|input| self.inputs[input])
    }

    /// Bytes that it takes from the allocator.
    fn heap_bytes(&self) -> usize {
        let tensors = (self.inputs.capacity() + self.outputs.capacity()) * size_of::<TensorId>();
        let stage = self.stage.as_ref().map_or(0, String::capacity);
        self.name.capacity() + tensors + self.recipe.heap_bytes() + stage
    }
}

/// Operations in running order, and the tensors between them.
#[derive(Clone, Debug, PartialEq)]
pub struct Graph {
    /// The architecture that the graph was built from.
    pub network: Network,
    /// All tensors that operations name.
    pub tensors: Vec<Tensor>,
    /// First those of a camera's pass, then those of the frame.
    pub operations: Vec<Operation>,
    /// Operations of a camera's pass.
    pub camera_operations: usize,
}

impl Graph {
    /// The tensor `id`.
    pub fn tensor(&self, id: TensorId) -> &Tensor {
        &self.tensors[id.0]
    }

    /// The tensors' identifiers.
    pub fn ids(&self) -> impl Iterator<Item = TensorId> + use<> {
        (0..self.tensors.len()).map(TensorId)
    }

    /// Where `operation` stands in this graph.
    pub fn site<'a>(&'a self, operation: &'a Operation) -> Site<'a> {
        Site {
            tensors: &self.tensors,
            inputs: &operation.inputs,
            outputs: &operation.outputs,
            first_channel: operation.first_channel,
            channels: operation.channels,
            relu: operation.relu,
            residual: operation.residual,
            recipe: &operation.recipe,
        }
    }

    /// Names under which results can be dumped, in running order.
    pub fn stages(&self) -> impl Iterator<Item = &str> {
        self.operations.iter().filter_map(|o| o.stage.as_deref())
    }

    /// Multiply-adds of `operation` as the network's definition has it, of one camera where it runs per camera. Operations
    /// that only move or add elements count 0, and a gather counts none because its cost is memory. [`u64::MAX`] stands
    /// for more than that.
    pub fn multiply_adds(&self, operation: &Operation) -> u64 {
        let count = operation.op.description().multiply_adds(&self.site(operation));
        u64::try_from(count).unwrap_or(u64::MAX)
    }

    /// Multiply-adds that the kernel of `operation` executes, counted as [`Graph::multiply_adds`].
    pub fn executed_multiply_adds(&self, operation: &Operation) -> u64 {
        let count = operation.op.description().executed_multiply_adds(&self.site(operation));
        u64::try_from(count).unwrap_or(u64::MAX)
    }

    /// Bytes that the graph takes from the allocator.
    pub(crate) fn heap_bytes(&self) -> usize {
        let names: usize = self.tensors.iter().map(|t| t.name.capacity()).sum();
        let operations: usize = self.operations.iter().map(Operation::heap_bytes).sum();
        self.tensors.capacity() * size_of::<Tensor>()
            + self.operations.capacity() * size_of::<Operation>()
            + names
            + operations
    }
}

//! How many bytes of the heap a value holds beside its own, so that a session's memory is known to the byte.

use crate::graph::{ConvNames, Graph, Operation, Recipe};

/// A vector of values that hold nothing themselves.
pub(crate) fn vector<T>(vector: &Vec<T>) -> usize {
    vector.capacity() * size_of::<T>()
}

/// A graph.
pub(crate) fn graph(graph: &Graph) -> usize {
    let names: usize = graph.tensors.iter().map(|t| t.name.capacity()).sum();
    let operations: usize = graph.operations.iter().map(operation).sum();
    vector(&graph.tensors) + names + vector(&graph.operations) + operations
}

fn operation(operation: &Operation) -> usize {
    let conv = |names: &ConvNames| names.prefix.capacity() + names.norm.as_ref().map_or(0, String::capacity);
    let recipe = match &operation.recipe {
        Recipe::None => 0,
        Recipe::Conv(names) | Recipe::Bias(names) => conv(names),
        Recipe::Projection { pixel, volume, bev } => conv(pixel) + conv(volume) + conv(bev),
        Recipe::BatchNorm(name) | Recipe::Attention(name) | Recipe::Head(name) => name.capacity(),
    };
    let stage = operation.stage.as_ref().map_or(0, String::capacity);
    operation.name.capacity() + vector(&operation.inputs) + recipe + stage
}

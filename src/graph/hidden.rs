//! The head's hidden layers as operations of their own, for whoever measures them.

use super::element::Element;
use super::operation::{Graph, Operation};
use super::ops::{Conv, Op};
use super::recipe::Recipe;
use super::tensor::{Scope, Tensor, TensorId};
use voxcast_kernels::conv::Geometry;

/// The names of the hidden layers of head `name`: of the operations of [`Graph::with_hidden_layers`], and of the tensors
/// that they write.
pub fn hidden_layers(name: &str) -> [String; 2] {
    ["0", "1"].map(|layer| format!("{name}.{layer}"))
}

impl Graph {
    /// The graph with the two hidden layers of every head computed apart, too, before the head: 1x1x1 convolutions that
    /// read the head's own stored parts. Nothing but observers reads what they write.
    #[must_use]
    pub fn with_hidden_layers(mut self) -> Self {
        let mut operations = Vec::with_capacity(self.operations.len());
        for operation in std::mem::take(&mut self.operations) {
            if matches!(operation.op, Op::Head(_)) {
                let mut input = operation.inputs[0];
                for name in hidden_layers(&operation.name) {
                    let layer = self.layer(name, input);
                    input = layer.output();
                    operations.push(layer);
                }
            }
            operations.push(operation);
        }
        self.operations = operations;
        self
    }

    /// A hidden layer, which has the channels of what it reads.
    fn layer(&mut self, name: String, input: TensorId) -> Operation {
        let x = self.tensor(input).clone();
        let (extent, channels) = (x.extent, x.channels);
        self.tensors.push(Tensor { name: name.clone(), element: Element::F32, scope: Scope::Inner, ..x });
        let one = [1; 3];
        let geometry = Geometry {
            input: extent,
            channels,
            kernel: one,
            stride: one,
            dilation: one,
            padding: [0; 3],
            output: extent,
        };
        Operation {
            name,
            op: Conv { geometry }.into(),
            inputs: vec![input],
            outputs: vec![TensorId(self.tensors.len() - 1)],
            first_channel: 0,
            channels,
            relu: true,
            residual: None,
            recipe: Recipe::None,
            stage: None,
        }
    }
}

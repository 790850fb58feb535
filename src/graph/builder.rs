//! Writes a graph one operation at a time.

use super::element::Element;
use super::operation::{Graph, Operation};
use super::ops::{BatchNorm, Conv, Op};
use super::recipe::{ConvNames, Recipe};
use super::site::Residual;
use super::tensor::{Lifetime, Scope, Section, Space, Tensor, TensorId};
use crate::network::Network;
use voxcast_kernels::conv::Geometry;

/// Writes a graph one operation at a time.
pub(super) struct Builder {
    pub(super) graph: Graph,
    /// Of the tensors that are made from now on.
    pub(super) lifetime: Lifetime,
    /// Of the tensors that are made from now on.
    pub(super) section: Section,
}

/// What the `conv` family of builder calls needs beside the input and the output.
#[derive(Clone, Copy)]
pub(super) struct ConvShape {
    space: Space,
    kernel: [usize; 3],
    stride: [usize; 3],
    dilation: [usize; 3],
    channels: usize,
}

impl ConvShape {
    /// A square kernel over height and width.
    pub(super) fn image(side: usize, stride: usize, channels: usize) -> Self {
        let (kernel, stride) = ([1, side, side], [1, stride, stride]);
        Self { space: Space::Image, kernel, stride, dilation: [1; 3], channels }
    }

    /// A square kernel over x and y.
    pub(super) fn plane(side: usize, dilation: usize, channels: usize) -> Self {
        let (kernel, dilation) = ([1, side, side], [1, dilation, dilation]);
        Self { space: Space::Plane, kernel, stride: [1; 3], dilation, channels }
    }

    /// A cube.
    pub(super) fn volume(side: usize, channels: usize) -> Self {
        Self { space: Space::Volume, kernel: [side; 3], stride: [1; 3], dilation: [1; 3], channels }
    }

    /// Padding that keeps the size at stride 1.
    fn padding(&self) -> [usize; 3] {
        std::array::from_fn(|a| self.dilation[a] * (self.kernel[a] / 2))
    }

    pub(super) fn geometry(&self, x: &Tensor) -> Geometry {
        let padding = self.padding();
        let output = std::array::from_fn(|a| {
            (x.extent[a] + 2 * padding[a] - self.dilation[a] * (self.kernel[a] - 1) - 1) / self.stride[a] + 1
        });
        Geometry {
            input: x.extent,
            channels: x.channels,
            kernel: self.kernel,
            stride: self.stride,
            dilation: self.dilation,
            padding,
            output,
        }
    }
}

/// A batch norm's prefix, the ReLU and the residual that follow a convolution.
#[derive(Clone, Copy, Default)]
pub(super) struct After<'a> {
    pub(super) norm: Option<&'a str>,
    pub(super) relu: bool,
    pub(super) residual: Option<Residual>,
}

impl<'a> After<'a> {
    pub(super) fn norm_relu(norm: &'a str) -> Self {
        Self { norm: Some(norm), relu: true, residual: None }
    }

    pub(super) fn norm(norm: &'a str) -> Self {
        Self { norm: Some(norm), relu: false, residual: None }
    }

    pub(super) fn add(self, tensor: TensorId) -> Self {
        Self { residual: Some(Residual { tensor, after: false }), ..self }
    }
}

impl Builder {
    pub(super) fn new(network: &Network) -> Self {
        let graph = Graph { network: network.clone(), tensors: vec![], operations: vec![], camera_operations: 0 };
        Self { graph, lifetime: Lifetime::Pass, section: Section::Stem }
    }

    /// A tensor of f32 that lies between operations.
    pub(super) fn tensor(&mut self, name: &str, space: Space, extent: [usize; 3], channels: usize) -> TensorId {
        let (element, section, scope, lifetime) = (Element::F32, self.section, Scope::Inner, self.lifetime);
        self.add(Tensor {
            name: name.to_owned(),
            element,
            scale: None,
            space,
            section,
            scope,
            lifetime,
            extent,
            channels,
        })
    }

    pub(super) fn add(&mut self, tensor: Tensor) -> TensorId {
        self.graph.tensors.push(tensor);
        TensorId(self.graph.tensors.len() - 1)
    }

    /// Adds an operation that writes a whole new tensor.
    pub(super) fn push(
        &mut self,
        name: &str,
        op: impl Into<Op>,
        inputs: &[TensorId],
        (space, extent): (Space, [usize; 3]),
        channels: usize,
    ) -> TensorId {
        let output = self.tensor(name, space, extent, channels);
        self.push_into(name, op, inputs, &[output], 0, channels);
        output
    }

    /// Adds an operation that writes a whole new tensor of the shape of `x`.
    pub(super) fn push_like(&mut self, name: &str, op: impl Into<Op>, inputs: &[TensorId], x: TensorId) -> TensorId {
        let Tensor { space, extent, channels, .. } = *self.graph.tensor(x);
        self.push(name, op, inputs, (space, extent), channels)
    }

    /// Adds an operation that writes `channels` channels of the first of some existing tensors, and all of the others.
    pub(super) fn push_into(
        &mut self,
        name: &str,
        op: impl Into<Op>,
        inputs: &[TensorId],
        outputs: &[TensorId],
        first_channel: usize,
        channels: usize,
    ) {
        self.graph.operations.push(Operation {
            name: name.to_owned(),
            op: op.into(),
            inputs: inputs.to_vec(),
            outputs: outputs.to_vec(),
            first_channel,
            channels,
            relu: false,
            residual: None,
            recipe: Recipe::None,
            stage: None,
        });
    }

    /// The operation added last.
    pub(super) fn last(&mut self) -> &mut Operation {
        self.graph.operations.last_mut().expect("an operation was added")
    }

    /// Names the result of the operation added last.
    pub(super) fn stage(&mut self, stage: impl Into<String>) {
        self.last().stage = Some(stage.into());
    }

    /// A convolution and what follows it. The batch norm is an operation of its own.
    pub(super) fn conv(
        &mut self,
        prefix: &str,
        bias: bool,
        x: TensorId,
        shape: ConvShape,
        after: After<'_>,
    ) -> TensorId {
        let geometry = shape.geometry(self.graph.tensor(x));
        let y = self.push(prefix, Conv { geometry }, &[x], (shape.space, geometry.output), shape.channels);
        self.last().recipe = Recipe::Conv(ConvNames { prefix: prefix.to_owned(), bias, norm: None });
        self.after(y, after)
    }

    /// Adds what follows the operation added last, which wrote `y`.
    pub(super) fn after(&mut self, y: TensorId, after: After<'_>) -> TensorId {
        let Some(norm) = after.norm else {
            let last = self.last();
            last.relu = after.relu;
            last.residual = after.residual;
            return y;
        };
        let z = self.push_like(norm, BatchNorm, &[y], y);
        let last = self.last();
        last.recipe = Recipe::Module(norm.to_owned());
        last.relu = after.relu;
        last.residual = after.residual;
        z
    }
}

//! The network as a small typed graph of operations, in the order in which they run.
//!
//! [`Graph::build`] writes down SPEC's network literally, batch norms and all. [`Graph::fold_batch_norm`] and
//! [`Graph::fold_projection`] rewrite it into one that gives the same result with less work. A graph holds shapes and the
//! checkpoint names that weights come from, never weights: [`crate::model::import`] evaluates the [`Recipe`]s once, and at run
//! time the same graph is rebuilt from the network's parameters, so that nothing in a model file can change what runs.

mod backbone;
mod head;
mod neck;
mod rewrite;
#[cfg(test)]
mod tests;
mod view;

use crate::network::Network;
use voxcast_kernels::conv::Geometry;
use voxcast_kernels::window_attention;

/// A tensor of a [`Graph`], by position in [`Graph::tensors`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TensorId(pub usize);

/// How long a tensor is needed, and how many of it there are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scope {
    /// Within the pass of one camera; all cameras use the same memory, one after the other.
    Camera,
    /// Written in the pass of each camera, one place per camera, and kept from frame to frame.
    Features,
    /// After all cameras.
    Frame,
}

/// A channels-last tensor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tensor {
    /// The operation that writes it (the first, where several fill channels side by side).
    pub name: String,
    /// x, y, z of a volume; 1, height, width of an image; 1, x, y of a bird's-eye view.
    pub extent: [usize; 3],
    /// Numbers per position.
    pub channels: usize,
    /// How long it lives.
    pub scope: Scope,
}

impl Tensor {
    /// Positions.
    pub fn rows(&self) -> usize {
        self.extent.iter().product()
    }

    /// Numbers, of one camera where there are several.
    pub fn len(&self) -> usize {
        self.rows() * self.channels
    }

    /// Whether it holds nothing.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Which of a level's two matrices a gather uses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Matrix {
    /// One row per voxel.
    Volume,
    /// One row per bird's-eye-view cell.
    Bev,
}

/// What an operation computes. Inputs are listed in [`Operation::inputs`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Op {
    /// Camera bytes to normalised, padded image. No tensor input.
    Normalise,
    /// [`voxcast_kernels::conv`]: x.
    Conv {
        /// How x is walked.
        geometry: Geometry,
    },
    /// [`voxcast_kernels::deform_conv2d`]: x, offsets.
    DeformConv {
        /// How x is walked, undeformed.
        geometry: Geometry,
    },
    /// [`voxcast_kernels::depthwise`]: x.
    Depthwise {
        /// Taps along height and width.
        side: usize,
    },
    /// [`voxcast_kernels::scale_shift`]: x, in place. A batch norm that was not folded.
    BatchNorm,
    /// [`voxcast_kernels::max_pool`]: x.
    MaxPool {
        /// Taps along height and width.
        side: usize,
        /// Input steps per output step.
        stride: usize,
        /// Border on each side that never wins.
        padding: usize,
    },
    /// [`voxcast_kernels::upsample_add`]: x (in place), the coarser map.
    UpsampleAdd,
    /// [`voxcast_kernels::gather`]: features.
    Gather {
        /// Level index 0..3 (levels 1 to 3).
        level: usize,
        /// Which matrix.
        matrix: Matrix,
        /// First feature channel.
        first_channel: usize,
        /// Whether the branch's bias follows the mean (the projection fold).
        bias: bool,
    },
    /// [`voxcast_kernels::deconv3d`]: x.
    Deconv,
    /// [`voxcast_kernels::window_attention`]: x, which is also added to the result.
    WindowAttention {
        /// Plane, heads and windows.
        shape: window_attention::Shape,
    },
    /// [`voxcast_kernels::gate`]: volume (in place), bird's-eye view.
    Gate,
    /// [`voxcast_kernels::pool`]: x, mean over all positions.
    GlobalMean,
    /// [`voxcast_kernels::pool`]: one row, written to every position.
    Broadcast,
    /// [`voxcast_kernels::head`]: x. Writes classes (and logits) instead of a tensor.
    Head {
        /// Level 0..=3 (0 is the output).
        level: usize,
    },
}

/// A convolution's weights by checkpoint name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConvNames {
    /// Prefix of `.weight`, and of `.bias` where there is one.
    pub prefix: String,
    /// Whether `.bias` exists.
    pub bias: bool,
    /// Prefix of the batch norm (`.weight .bias .running_mean .running_var`) that is folded in.
    pub norm: Option<String>,
}

/// Where an operation's stored weights come from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Recipe {
    /// The operation has none.
    None,
    /// One convolution of any kind, or the gate.
    Conv(ConvNames),
    /// A batch norm of its own, by prefix: scale and shift.
    BatchNorm(String),
    /// The pyramid's 3x3 convolution followed by both branches' 1x1 convolutions, which are linear and have only the mean
    /// between them: one 3x3 convolution whose outputs are the volume's channels, then the bird's-eye view's.
    Projection {
        /// The pyramid's convolution.
        pixel: ConvNames,
        /// The volume branch's 1x1x1 convolution.
        volume: ConvNames,
        /// The bird's-eye-view branch's 1x1 convolution.
        bev: ConvNames,
    },
    /// Only the bias of a convolution with its folded norm: what remains to be added after the mean.
    Bias(ConvNames),
    /// Cascaded group attention, by prefix.
    Attention(String),
    /// The three linear layers, by prefix.
    Head(String),
}

/// A tensor that is added to the result.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Residual {
    /// What is added; it has the shape of the output.
    pub tensor: TensorId,
    /// Whether it is added after the rectifier instead of before.
    pub after: bool,
}

/// One operation.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Operation {
    /// Unique; the checkpoint's name where there is one.
    pub name: String,
    /// What is computed.
    pub op: Op,
    /// Tensors read, in the order that the operation's kind says.
    pub inputs: Vec<TensorId>,
    /// Tensor written.
    pub output: TensorId,
    /// First channel written: branches that are concatenated share one tensor.
    pub first_channel: usize,
    /// Channels written.
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

    /// The input that the result overwrites, for operations that work in place.
    pub fn in_place(&self) -> Option<TensorId> {
        match self.op {
            Op::BatchNorm | Op::UpsampleAdd | Op::Gate => Some(self.inputs[0]),
            _ => None,
        }
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

/// Which rewrites a graph gets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rewrites {
    /// Batch norms become part of the convolution before them.
    pub batch_norm: bool,
    /// Pyramid convolution, mean and both 1x1 convolutions become one convolution and a mean. Needs `batch_norm`.
    pub projection: bool,
}

impl Rewrites {
    /// Everything on: the fastest graph.
    pub const ALL: Self = Self { batch_norm: true, projection: true };
    /// Everything off: SPEC's operations one by one.
    pub const NONE: Self = Self { batch_norm: false, projection: false };
}

impl Graph {
    /// The network's operations as SPEC lists them. `coarse_heads` adds the heads of levels 1 to 3, which training used
    /// and inference does not need.
    pub fn build(network: &Network, coarse_heads: bool) -> Self {
        let mut b = Builder {
            graph: Graph { network: network.clone(), tensors: vec![], operations: vec![], camera_operations: 0 },
            scope: Scope::Camera,
        };
        let stages = backbone::build(&mut b, network);
        let features = neck::build(&mut b, network, stages);
        b.graph.camera_operations = b.graph.operations.len();
        b.scope = Scope::Frame;
        let volumes = view::build(&mut b, network, features);
        head::build(&mut b, network, volumes, coarse_heads);
        b.graph
    }

    /// The graph with the rewrites that are asked for.
    #[must_use]
    pub fn rewritten(self, rewrites: Rewrites) -> Self {
        let graph = if rewrites.batch_norm { self.fold_batch_norm() } else { self };
        if rewrites.projection { graph.fold_projection() } else { graph }
    }

    /// The tensor `id`.
    pub fn tensor(&self, id: TensorId) -> &Tensor {
        &self.tensors[id.0]
    }

    /// Names under which results can be dumped, in running order.
    pub fn stages(&self) -> impl Iterator<Item = &str> {
        self.operations.iter().filter_map(|o| o.stage.as_deref())
    }

    /// Multiply-adds of `operation`, of one camera where it runs per camera. Operations that only move or add numbers
    /// count 0, and a gather counts none because its cost is memory. [`u64::MAX`] stands for more than that.
    pub fn multiply_adds(&self, operation: &Operation) -> u64 {
        let out = self.tensor(operation.output);
        let x = operation.inputs.first().map(|&id| self.tensor(id));
        let x_channels = x.map_or(0, |x| x.channels);
        // Up to 32 bits of rows, and several factors of up to 21.
        let wide = |v: usize| v as u128;
        let (rows, channels) = (wide(out.rows()), wide(operation.channels));
        let count = match operation.op {
            Op::Conv { geometry } | Op::DeformConv { geometry } => rows * wide(geometry.depth()) * channels,
            Op::Depthwise { side } => rows * wide(side * side) * channels,
            Op::Deconv => rows * wide(8 * x_channels) * channels,
            Op::BatchNorm | Op::Gate => rows * channels,
            Op::WindowAttention { shape } => {
                let window: [usize; 2] = shape.window();
                let plane: usize = (0..2).map(|a| shape.extent[a].next_multiple_of(window[a])).product();
                let tokens = window[0] * window[1];
                wide(plane * shape.heads * shape.key_dim) * wide(3 * shape.part() + 25 + 2 * tokens + x_channels)
            }
            Op::Head { .. } => rows * wide(x_channels) * wide(2 * x_channels + operation.channels),
            _ => 0,
        };
        u64::try_from(count).unwrap_or(u64::MAX)
    }
}

/// Writes a graph one operation at a time.
struct Builder {
    graph: Graph,
    scope: Scope,
}

/// What the `conv` family of builder calls needs beside the input and the output.
#[derive(Clone, Copy)]
struct ConvShape {
    kernel: [usize; 3],
    stride: [usize; 3],
    dilation: [usize; 3],
    channels: usize,
}

impl ConvShape {
    /// A square kernel over height and width.
    fn image(side: usize, stride: usize, channels: usize) -> Self {
        Self { kernel: [1, side, side], stride: [1, stride, stride], dilation: [1; 3], channels }
    }

    /// A square kernel over x and y.
    fn plane(side: usize, dilation: usize, channels: usize) -> Self {
        Self { kernel: [1, side, side], stride: [1; 3], dilation: [1, dilation, dilation], channels }
    }

    /// A cube.
    fn volume(side: usize, channels: usize) -> Self {
        Self { kernel: [side; 3], stride: [1; 3], dilation: [1; 3], channels }
    }

    /// Padding that keeps the size at stride 1.
    fn padding(&self) -> [usize; 3] {
        std::array::from_fn(|a| self.dilation[a] * (self.kernel[a] / 2))
    }

    fn geometry(&self, x: &Tensor) -> Geometry {
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

/// A batch norm's prefix, the rectifier and the residual that follow a convolution.
#[derive(Clone, Copy, Default)]
struct After<'a> {
    norm: Option<&'a str>,
    relu: bool,
    residual: Option<Residual>,
}

impl<'a> After<'a> {
    fn norm_relu(norm: &'a str) -> Self {
        Self { norm: Some(norm), relu: true, residual: None }
    }

    fn norm(norm: &'a str) -> Self {
        Self { norm: Some(norm), relu: false, residual: None }
    }

    fn add(self, tensor: TensorId) -> Self {
        Self { residual: Some(Residual { tensor, after: false }), ..self }
    }
}

impl Builder {
    fn tensor(&mut self, name: &str, extent: [usize; 3], channels: usize) -> TensorId {
        self.graph.tensors.push(Tensor { name: name.to_owned(), extent, channels, scope: self.scope });
        TensorId(self.graph.tensors.len() - 1)
    }

    /// Adds an operation that writes a whole new tensor.
    fn push(&mut self, name: &str, op: Op, inputs: &[TensorId], extent: [usize; 3], channels: usize) -> TensorId {
        let output = self.tensor(name, extent, channels);
        self.push_into(name, op, inputs, output, 0, channels);
        output
    }

    /// Adds an operation that writes `channels` channels of an existing tensor.
    fn push_into(
        &mut self,
        name: &str,
        op: Op,
        inputs: &[TensorId],
        output: TensorId,
        first_channel: usize,
        channels: usize,
    ) {
        self.graph.operations.push(Operation {
            name: name.to_owned(),
            op,
            inputs: inputs.to_vec(),
            output,
            first_channel,
            channels,
            relu: false,
            residual: None,
            recipe: Recipe::None,
            stage: None,
        });
    }

    /// The operation added last.
    fn last(&mut self) -> &mut Operation {
        self.graph.operations.last_mut().expect("an operation was added")
    }

    /// Names the result of the operation added last.
    fn stage(&mut self, stage: impl Into<String>) {
        self.last().stage = Some(stage.into());
    }

    /// A convolution and what follows it. The batch norm is an operation of its own.
    fn conv(&mut self, prefix: &str, bias: bool, x: TensorId, shape: ConvShape, after: After<'_>) -> TensorId {
        let geometry = shape.geometry(self.graph.tensor(x));
        let y = self.push(prefix, Op::Conv { geometry }, &[x], geometry.output, shape.channels);
        self.last().recipe = Recipe::Conv(ConvNames { prefix: prefix.to_owned(), bias, norm: None });
        self.after(y, after)
    }

    /// Adds what follows the operation added last, which wrote `y`.
    fn after(&mut self, y: TensorId, after: After<'_>) -> TensorId {
        let Some(norm) = after.norm else {
            let last = self.last();
            last.relu = after.relu;
            last.residual = after.residual;
            return y;
        };
        let (extent, channels) = (self.graph.tensor(y).extent, self.graph.tensor(y).channels);
        let z = self.push(norm, Op::BatchNorm, &[y], extent, channels);
        let last = self.last();
        last.recipe = Recipe::BatchNorm(norm.to_owned());
        last.relu = after.relu;
        last.residual = after.residual;
        z
    }
}

//! What each operation stores in a model: the names, sizes and precisions of its parts.
//!
//! Writer ([`crate::import`]) and reader ([`crate::model`]) both follow this list, so they cannot disagree.

use crate::graph::{Graph, Op, Operation, Recipe};
use voxcast_kernels::LANES;
use voxcast_kernels::panels::packed_len;
use voxcast_kernels::window_attention::Shape;

/// How large weights are stored. Arithmetic is f32 either way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// Single precision.
    F32,
    /// Half precision: half the file, half the memory, exact widening.
    F16,
}

impl Precision {
    /// `f32` or `f16`.
    pub fn name(self) -> &'static str {
        match self {
            Precision::F32 => "f32",
            Precision::F16 => "f16",
        }
    }

    /// The precision of that name.
    pub fn parse(name: &str) -> Option<Self> {
        [Precision::F32, Precision::F16].into_iter().find(|p| p.name() == name)
    }
}

/// One stored tensor of an operation.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Part {
    /// What follows the operation's name and a dot.
    pub suffix: &'static str,
    /// Numbers, before padding to whole cache lines.
    pub len: usize,
    /// Whether the model's precision applies: packed panels of the large products. Everything else is f32.
    pub panels: bool,
}

impl Part {
    fn panels(suffix: &'static str, len: usize) -> Self {
        Self { suffix, len, panels: true }
    }

    fn plain(suffix: &'static str, len: usize) -> Self {
        Self { suffix, len, panels: false }
    }

    /// Bytes of one number.
    pub fn width(&self, precision: Precision) -> usize {
        if self.panels && precision == Precision::F16 { 2 } else { 4 }
    }

    /// Numbers stored: `len` and zeros up to a multiple of 64 bytes.
    pub fn stored_len(&self, precision: Precision) -> usize {
        self.len.next_multiple_of(64 / self.width(precision))
    }
}

/// No operation has more parts.
pub const MAX_PARTS: usize = 7;

/// The parts of `operation`, in the order in which [`crate::import`] computes them.
pub fn parts(graph: &Graph, operation: &Operation) -> Vec<Part> {
    let channels = operation.channels;
    let padded = channels.next_multiple_of(LANES);
    let x_channels = operation.inputs.first().map_or(0, |&x| graph.tensor(x).channels);
    match operation.op {
        Op::Conv { geometry } | Op::DeformConv { geometry } => {
            vec![Part::panels("weight", packed_len(geometry.depth(), channels)), Part::plain("bias", padded)]
        }
        Op::Deconv => {
            vec![Part::panels("weight", 8 * packed_len(8 * x_channels, channels)), Part::plain("bias", padded)]
        }
        Op::Depthwise { side } => vec![Part::plain("weight", side * side * padded), Part::plain("bias", padded)],
        Op::BatchNorm => vec![Part::plain("scale", padded), Part::plain("shift", padded)],
        Op::Gather { .. } if operation.recipe != Recipe::None => vec![Part::plain("bias", padded)],
        Op::Gate => vec![Part::plain("weight", padded), Part::plain("bias", LANES)],
        Op::WindowAttention { shape: shape @ Shape { heads, key_dim, .. } } => vec![
            Part::plain("qkv.weight", heads * packed_len(channels / heads, 3 * key_dim)),
            Part::plain("qkv.bias", heads * (3 * key_dim).next_multiple_of(LANES)),
            Part::plain("query.weight", heads * 25 * key_dim.next_multiple_of(LANES)),
            Part::plain("query.bias", heads * key_dim.next_multiple_of(LANES)),
            Part::plain("offsets", heads * shape.side() * shape.side()),
            Part::plain("proj.weight", packed_len(heads * key_dim, channels)),
            Part::plain("proj.bias", padded),
        ],
        Op::Head { .. } => {
            let hidden = x_channels.next_multiple_of(LANES);
            vec![
                Part::panels("0.weight", packed_len(x_channels, x_channels)),
                Part::plain("0.bias", hidden),
                Part::panels("1.weight", packed_len(x_channels, x_channels)),
                Part::plain("1.bias", hidden),
                Part::panels("2.weight", packed_len(x_channels, channels)),
                Part::plain("2.bias", padded),
            ]
        }
        Op::Normalise | Op::MaxPool { .. } | Op::UpsampleAdd | Op::Gather { .. } | Op::GlobalMean | Op::Broadcast => {
            vec![]
        }
    }
}

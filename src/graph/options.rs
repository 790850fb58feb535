//! What can be asked of a graph.

use super::temperature::Temperature;

/// Which results a graph has beside the classes of level 0.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Results {
    /// The logits of level 0.
    pub logits: bool,
    /// The heads of levels 1 to 3, which training used and inference does not need, for observers. Then all heads give
    /// logits.
    pub coarse_heads: bool,
    /// How sure level 0 is, by a softmax of this temperature.
    pub confidence: Option<Temperature>,
}

impl Results {
    /// The results of every head: all that weights are stored for.
    pub const ALL: Self = Self { logits: true, coarse_heads: true, confidence: None };
}

/// Which rewrites a graph gets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rewrites {
    /// Batch norms become part of the convolution before them.
    pub batch_norm: bool,
    /// Pyramid convolution, mean and both 1x1 convolutions become one convolution and a mean. Needs `batch_norm`.
    pub projection: bool,
    /// Convolutions are computed by Winograd's minimal filtering where their shapes make it worth while. Other bits than
    /// direct sums.
    pub winograd: bool,
}

impl Rewrites {
    /// Everything on: the fastest graph.
    pub const ALL: Self = Self { batch_norm: true, projection: true, winograd: true };
    /// Everything off: the published operations one by one.
    pub const NONE: Self = Self { batch_norm: false, projection: false, winograd: false };
}

//! Where an operation's stored weights come from, by the names of published checkpoints.

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
    /// The module of this prefix, whose tensors the operation's description knows: a batch norm of its own, attention,
    /// the head.
    Module(String),
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
    /// Only the bias of a 1x1 convolution with its folded norm: what remains to be added after the mean.
    Bias {
        /// The convolution.
        names: ConvNames,
        /// Its input channels.
        inputs: usize,
    },
}

impl ConvNames {
    fn heap_bytes(&self) -> usize {
        self.prefix.capacity() + self.norm.as_ref().map_or(0, String::capacity)
    }
}

impl Recipe {
    /// Bytes that it takes from the allocator.
    pub(crate) fn heap_bytes(&self) -> usize {
        match self {
            Recipe::None => 0,
            Recipe::Conv(names) | Recipe::Bias { names, .. } => names.heap_bytes(),
            Recipe::Module(prefix) => prefix.capacity(),
            Recipe::Projection { pixel, volume, bev } => pixel.heap_bytes() + volume.heap_bytes() + bev.heap_bytes(),
        }
    }
}

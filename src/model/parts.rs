//! What each operation stores in a model: the names, sizes and precisions of its parts.
//!
//! Writer ([`crate::model::import`]) and reader ([`crate::model`]) both follow this list, so they cannot disagree.

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

/// The parts of `operation`, in the order in which [`crate::model::import`] computes them.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::graph::Rewrites;
    use crate::network::{BUILT_IN, Network};

    #[test]
    fn precisions_have_names() {
        for precision in [Precision::F32, Precision::F16] {
            assert_eq!(Precision::parse(precision.name()), Some(precision));
        }
        assert_eq!(Precision::parse("F32"), None);
    }

    #[test]
    fn parts_fill_whole_cache_lines() {
        let plain = Part::plain("bias", 17);
        assert_eq!([Precision::F32, Precision::F16].map(|p| (plain.width(p), plain.stored_len(p))), [(4, 32), (4, 32)]);
        let panels = Part::panels("weight", 17);
        assert_eq!(
            [Precision::F32, Precision::F16].map(|p| (panels.width(p), panels.stored_len(p))),
            [(4, 32), (2, 32)]
        );
        assert_eq!(Part::panels("weight", 64).stored_len(Precision::F16), 64);
    }

    #[test]
    fn no_operation_has_more_parts_than_a_session_has_room_for() {
        for name in BUILT_IN {
            let network = Network::built_in(name).expect("built in");
            for rewrites in [Rewrites::ALL, Rewrites::NONE] {
                let graph = Graph::build(&network, true).rewritten(rewrites);
                let counts: Vec<usize> = graph.operations.iter().map(|o| parts(&graph, o).len()).collect();
                assert_eq!(counts.iter().max(), Some(&MAX_PARTS));
                for operation in &graph.operations {
                    let parts = parts(&graph, operation);
                    assert_eq!(parts.is_empty(), operation.recipe == Recipe::None, "{}", operation.name);
                    assert!(parts.iter().all(|p| p.len > 0), "{}", operation.name);
                }
            }
        }
    }

    #[test]
    fn stored_sizes_of_known_operations() {
        let graph = Graph::build(&Network::built_in("nuscenes-200").expect("built in"), false).rewritten(Rewrites::ALL);
        let lens = |name: &str| {
            let operation = graph.operations.iter().find(|o| o.name == name).expect(name);
            parts(&graph, operation).iter().map(|p| p.len).collect::<Vec<_>>()
        };
        assert_eq!(lens("img_backbone.conv1"), [7 * 7 * 3 * 64, 64]);
        // 27 offsets and mask logits fill two panels of 16.
        assert_eq!(lens("img_backbone.layer3.0.conv2.conv_offset"), [9 * 256 * 32, 32]);
        // 64 channels for the volume and 64 for the plane.
        assert_eq!(lens("img_neck.fpn_convs.0.conv.projected"), [9 * 512 * 128, 128]);
        assert_eq!(lens("view_transformer.up_sample1.0"), [8 * 8 * 64 * 32, 32]);
        assert_eq!(lens("view_transformer.imvts.0.combine_coeff"), [64, 16]);
        // 17 classes fill two panels.
        assert_eq!(lens("occ_head.mlp_occ_lvl0"), [32 * 32, 32, 32 * 32, 32, 32 * 32, 32]);
    }
}

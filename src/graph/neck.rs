//! The feature pyramid: laterals, top-down sums, one 3x3 convolution per level. No norm, no activation.

use super::{After, Builder, ConvShape, Op, Scope, TensorId};
use crate::network::Network;

/// C3, C4, C5 to P3, P4, P5. The results are kept per camera.
pub(super) fn build(b: &mut Builder, network: &Network, stages: [TensorId; 3]) -> [TensorId; 3] {
    let mut sums = [0, 1, 2].map(|i| {
        let prefix = format!("img_neck.lateral_convs.{i}.conv");
        b.conv(&prefix, true, stages[i], ConvShape::image(1, 1, network.fpn), After::default())
    });
    for i in [1, 0] {
        let extent = b.graph.tensor(sums[i]).extent;
        sums[i] = b.push(&format!("img_neck.sum.{i}"), Op::UpsampleAdd, &[sums[i], sums[i + 1]], extent, network.fpn);
    }
    [0, 1, 2].map(|i| {
        let prefix = format!("img_neck.fpn_convs.{i}.conv");
        let features = b.conv(&prefix, true, sums[i], ConvShape::image(3, 1, network.fpn), After::default());
        b.graph.tensors[features.0].scope = Scope::Features;
        b.stage(format!("fpn.p{}", i + 3));
        features
    })
}

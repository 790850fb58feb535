//! The feature pyramid: laterals, top-down sums, one 3x3 convolution per level. No norm, no activation.

use super::builder::{After, Builder, ConvShape};
use super::ops::UpsampleAdd;
use super::tensor::{Lifetime, Section, TensorId};
use crate::network::Network;

/// C3, C4, C5 to P3, P4, P5. The results are kept per camera.
pub(super) fn build(b: &mut Builder, network: &Network, stages: [TensorId; 3]) -> [TensorId; 3] {
    b.section = Section::Pyramid;
    let mut sums = [0, 1, 2].map(|i| {
        let prefix = format!("img_neck.lateral_convs.{i}.conv");
        b.conv(&prefix, true, stages[i], ConvShape::image(1, 1, network.fpn), After::default())
    });
    for i in [1, 0] {
        sums[i] = b.push_like(&format!("img_neck.sum.{i}"), UpsampleAdd, &[sums[i], sums[i + 1]], sums[i]);
    }
    [0, 1, 2].map(|i| {
        let prefix = format!("img_neck.fpn_convs.{i}.conv");
        let features = b.conv(&prefix, true, sums[i], ConvShape::image(3, 1, network.fpn), After::default());
        b.graph.tensors[features.0].lifetime = Lifetime::Camera;
        b.stage(format!("fpn.p{}", i + 3));
        features
    })
}

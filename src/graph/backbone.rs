//! ResNet, caffe style, with modulated deformable convolution in the stages that the network says.

use super::builder::{After, Builder, ConvShape};
use super::element::Element;
use super::ops::{DeformConv, MaxPool, Normalise};
use super::recipe::{ConvNames, Recipe};
use super::tensor::{Lifetime, Scope, Section, Space, Tensor, TensorId};
use crate::network::{Block, Network};

/// Image to C3, C4, C5.
pub(super) fn build(b: &mut Builder, network: &Network) -> [TensorId; 3] {
    let [height, width] = network.image;
    let bgr = b.add(Tensor {
        name: "image.bgr".to_owned(),
        element: Element::U8,
        scale: None,
        space: Space::Image,
        section: Section::Stem,
        scope: Scope::Input,
        lifetime: Lifetime::Camera,
        extent: [1, height, width],
        channels: 3,
    });
    let image = b.push_like("image", Normalise, &[bgr], bgr);
    b.stage("image.input");
    let stem = b.conv(
        "img_backbone.conv1",
        false,
        image,
        ConvShape::image(7, 2, network.width),
        After::norm_relu("img_backbone.bn1"),
    );
    let pool = MaxPool { side: 3, stride: 2, padding: 1 };
    let quarter = (Space::Image, [1, height / 4, width / 4]);
    let mut x = b.push("img_backbone.maxpool", pool, &[stem], quarter, network.width);
    let mut stages = vec![];
    for stage in 0..4 {
        b.section = Section::Stage(stage + 1);
        for index in 0..network.depths[stage] {
            let prefix = format!("img_backbone.layer{}.{index}", stage + 1);
            let stride = if stage > 0 && index == 0 { 2 } else { 1 };
            x = match network.block {
                Block::Bottleneck => bottleneck(b, network, &prefix, x, stage, stride),
                Block::Basic => basic(b, network, &prefix, x, stage, stride),
            };
        }
        if stage > 0 {
            b.stage(format!("backbone.c{}", stage + 2));
            stages.push(x);
        }
    }
    [stages[0], stages[1], stages[2]]
}

/// What the block's result is added to: x, or its 1x1 projection where the shape changes.
fn shortcut(b: &mut Builder, prefix: &str, x: TensorId, channels: usize, stride: usize) -> TensorId {
    if stride == 1 && b.graph.tensor(x).channels == channels {
        return x;
    }
    let norm = format!("{prefix}.downsample.1");
    b.conv(&format!("{prefix}.downsample.0"), false, x, ConvShape::image(1, stride, channels), After::norm(&norm))
}

fn bottleneck(b: &mut Builder, network: &Network, prefix: &str, x: TensorId, stage: usize, stride: usize) -> TensorId {
    let width = network.width << stage;
    let out = width * Block::Bottleneck.expansion();
    let (bn1, bn2, bn3) = (format!("{prefix}.bn1"), format!("{prefix}.bn2"), format!("{prefix}.bn3"));
    let y = b.conv(&format!("{prefix}.conv1"), false, x, ConvShape::image(1, stride, width), After::norm_relu(&bn1));
    let conv2 = format!("{prefix}.conv2");
    let shape = ConvShape::image(3, 1, width);
    let y = if network.dcn[stage] {
        let geometry = shape.geometry(b.graph.tensor(y));
        let offsets = ConvShape::image(3, 1, DeformConv::offset_channels(geometry.kernel.iter().product()));
        let offsets = b.conv(&format!("{conv2}.conv_offset"), true, y, offsets, After::default());
        let z = b.push(&conv2, DeformConv { geometry }, &[y, offsets], (Space::Image, geometry.output), width);
        b.last().recipe = Recipe::Conv(ConvNames { prefix: conv2, bias: false, norm: None });
        b.after(z, After::norm_relu(&bn2))
    } else {
        b.conv(&conv2, false, y, shape, After::norm_relu(&bn2))
    };
    let shortcut = shortcut(b, prefix, x, out, stride);
    b.conv(&format!("{prefix}.conv3"), false, y, ConvShape::image(1, 1, out), After::norm_relu(&bn3).add(shortcut))
}

fn basic(b: &mut Builder, network: &Network, prefix: &str, x: TensorId, stage: usize, stride: usize) -> TensorId {
    let width = network.width << stage;
    let (bn1, bn2) = (format!("{prefix}.bn1"), format!("{prefix}.bn2"));
    let y = b.conv(&format!("{prefix}.conv1"), false, x, ConvShape::image(3, stride, width), After::norm_relu(&bn1));
    let shortcut = shortcut(b, prefix, x, width, stride);
    b.conv(&format!("{prefix}.conv2"), false, y, ConvShape::image(3, 1, width), After::norm_relu(&bn2).add(shortcut))
}

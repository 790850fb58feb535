//! From pixels to voxels: gather, both branches of each level, their fusion, and the coarse-to-fine refinement.

use super::builder::{After, Builder, ConvShape};
use super::matrices::Matrix;
use super::ops::{BatchNorm, Broadcast, Conv, Deconv, Depthwise, Gate, Gather, GlobalMean, WindowAttention};
use super::recipe::{ConvNames, Recipe};
use super::site::Residual;
use super::tensor::{Branch, Section, Space, TensorId};
use crate::network::{HEADS, Network};
use voxcast_kernels::window_attention::Shape;

/// Features of levels 1 to 3 to the volumes of levels 0 to 3.
pub(super) fn build(b: &mut Builder, network: &Network, features: [TensorId; 3]) -> [TensorId; 4] {
    let fused = [0, 1, 2].map(|level| single_scale(b, network, level, features[level]));
    let refined3 = refine(b, network, 3, fused[2]);
    let sum2 = up(b, network, 3, refined3, Some(fused[1]));
    let refined2 = refine(b, network, 2, sum2);
    let sum1 = up(b, network, 2, refined2, Some(fused[0]));
    let refined1 = refine(b, network, 1, sum1);
    let up1 = up(b, network, 1, refined1, None);
    let refined0 = refine(b, network, 0, up1);
    [refined0, refined1, refined2, refined3]
}

/// Level `level` (1 to 3) doubled, to which the finer level's fused volume is added.
fn up(b: &mut Builder, network: &Network, level: usize, x: TensorId, fused: Option<TensorId>) -> TensorId {
    let prefix = format!("view_transformer.up_sample{level}.0");
    b.section = Section::Upsample(level);
    let extent = b.graph.tensor(x).extent.map(|v| 2 * v);
    let y = b.push(&prefix, Deconv, &[x], (Space::Volume, extent), network.channels[level - 1]);
    b.last().recipe = Recipe::Conv(ConvNames { prefix, bias: true, norm: None });
    let norm = format!("view_transformer.up_sample{level}.1");
    let residual = fused.map(|tensor| Residual { tensor, after: true });
    b.after(y, After { residual, ..After::norm_relu(&norm) })
}

fn refine(b: &mut Builder, network: &Network, level: usize, x: TensorId) -> TensorId {
    let prefix = format!("view_transformer.refine_lvl{level}");
    b.section = Section::Refine(level);
    let y = b.conv(
        &format!("{prefix}.0"),
        true,
        x,
        ConvShape::volume(3, network.channels[level]),
        After::norm_relu(&format!("{prefix}.1")),
    );
    b.stage(format!("volume.lvl{level}"));
    y
}

/// One level (index 0..3): gather, volume branch, bird's-eye-view branch, fusion.
fn single_scale(b: &mut Builder, network: &Network, level: usize, features: TensorId) -> TensorId {
    let prefix = format!("view_transformer.imvts.{level}");
    let stage = format!("level{}", level + 1);
    let channels = network.channels[level + 1];
    let [x, y, z] = network.grids[level];

    let section = |branch| Section::Level(level + 1, branch);
    let gather = |b: &mut Builder, matrix, name: &str, extent| {
        b.section = section(Branch::Gather);
        let op = Gather { level, matrix, first_channel: 0 };
        let rows = b.push(&format!("{prefix}.gather.{name}"), op, &[features], extent, network.fpn);
        b.stage(format!("{stage}.gather.{name}"));
        rows
    };
    let mut volume = gather(b, Matrix::Volume, "volume", (Space::Volume, [x, y, z]));
    b.section = section(Branch::Volume);
    for (i, side) in [1, 3, 3].into_iter().enumerate() {
        let norm = format!("{prefix}.down_conv3d.{}", 3 * i + 1);
        let conv = format!("{prefix}.down_conv3d.{}", 3 * i);
        volume = b.conv(&conv, true, volume, ConvShape::volume(side, channels), After::norm_relu(&norm));
    }
    b.stage(format!("{stage}.volume"));

    let mut bev = gather(b, Matrix::Bev, "bev", (Space::Plane, [1, x, y]));
    b.section = section(Branch::Bev);
    for (i, side) in [1, 3, 3].into_iter().enumerate() {
        let norm = format!("{prefix}.xy_conv.{}", 3 * i + 1);
        let conv = format!("{prefix}.xy_conv.{}", 3 * i);
        bev = b.conv(&conv, true, bev, ConvShape::plane(side, 1, channels), After::norm_relu(&norm));
    }
    b.stage(format!("{stage}.bev"));
    bev = efficient_vit(b, network, level, &format!("{prefix}.bev_attn_layer"), bev);
    b.stage(format!("{stage}.attention"));
    bev = aspp(b, &format!("{prefix}.aspp_xy"), bev);
    b.stage(format!("{stage}.aspp"));

    b.section = section(Branch::Volume);
    let fused = b.push_like(&format!("{prefix}.combine_coeff"), Gate, &[volume, bev], volume);
    b.last().recipe = Recipe::Conv(ConvNames { prefix: format!("{prefix}.combine_coeff"), bias: true, norm: None });
    b.stage(format!("{stage}.fused"));
    fused
}

/// EfficientViT block (arXiv 2305.07027): depthwise, feed-forward, window attention, depthwise, feed-forward, each added
/// to what it gets.
fn efficient_vit(b: &mut Builder, network: &Network, level: usize, prefix: &str, x: TensorId) -> TensorId {
    let x = depthwise(b, &format!("{prefix}.dw0.m"), x);
    let x = feed_forward(b, &format!("{prefix}.ffn0.m"), x);
    let attention = format!("{prefix}.mixer.m.attn");
    let (extent, channels) = (b.graph.tensor(x).extent, b.graph.tensor(x).channels);
    let shape = Shape { extent: [extent[1], extent[2]], channels, heads: HEADS, key_dim: network.key_dims[level] };
    let y = b.push_like(&attention, WindowAttention { shape }, &[x], x);
    b.last().recipe = Recipe::Module(attention);
    let y = depthwise(b, &format!("{prefix}.dw1.m"), y);
    feed_forward(b, &format!("{prefix}.ffn1.m"), y)
}

fn depthwise(b: &mut Builder, prefix: &str, x: TensorId) -> TensorId {
    let conv = format!("{prefix}.c");
    let y = b.push_like(&conv, Depthwise { side: 3 }, &[x], x);
    b.last().recipe = Recipe::Conv(ConvNames { prefix: conv, bias: false, norm: None });
    b.after(y, After::norm(&format!("{prefix}.bn")).add(x))
}

fn feed_forward(b: &mut Builder, prefix: &str, x: TensorId) -> TensorId {
    let channels = b.graph.tensor(x).channels;
    let norm = format!("{prefix}.pw1.bn");
    let hidden =
        b.conv(&format!("{prefix}.pw1.c"), false, x, ConvShape::plane(1, 1, 2 * channels), After::norm_relu(&norm));
    let norm = format!("{prefix}.pw2.bn");
    b.conv(&format!("{prefix}.pw2.c"), false, hidden, ConvShape::plane(1, 1, channels), After::norm(&norm).add(x))
}

/// Bottleneck atrous spatial pyramid pooling (arXiv 1706.05587): five convolutions and a global mean side by side.
fn aspp(b: &mut Builder, prefix: &str, x: TensorId) -> TensorId {
    let (extent, channels) = (b.graph.tensor(x).extent, b.graph.tensor(x).channels);
    let half = channels / 2;
    let one = ConvShape::plane(1, 1, half);
    let inner =
        b.conv(&format!("{prefix}.input_conv.0"), false, x, one, After::norm_relu(&format!("{prefix}.input_conv.1")));

    let wide = b.tensor(&format!("{prefix}.aspp.convs"), Space::Plane, extent, 6 * half);
    for (i, (side, rate)) in [(1, 1), (3, 1), (3, 6), (3, 12), (3, 18)].into_iter().enumerate() {
        let name = format!("{prefix}.aspp.convs.{i}.0");
        let geometry = ConvShape::plane(side, rate, half).geometry(b.graph.tensor(inner));
        b.push_into(&name, Conv { geometry }, &[inner], &[wide], i * half, half);
        b.last().recipe = Recipe::Conv(ConvNames { prefix: name, bias: false, norm: None });
        let norm = format!("{prefix}.aspp.convs.{i}.1");
        b.push_into(&norm, BatchNorm, &[wide], &[wide], i * half, half);
        b.last().recipe = Recipe::Module(norm);
        b.last().relu = true;
    }
    let mean = b.push(&format!("{prefix}.aspp.convs.5.0"), GlobalMean, &[inner], (Space::Plane, [1; 3]), half);
    let pooled =
        b.conv(&format!("{prefix}.aspp.convs.5.1"), false, mean, one, After { relu: true, ..After::default() });
    b.push_into(&format!("{prefix}.aspp.broadcast"), Broadcast, &[pooled], &[wide], 5 * half, half);

    let y = b.conv(
        &format!("{prefix}.aspp.project.0"),
        false,
        wide,
        one,
        After::norm_relu(&format!("{prefix}.aspp.project.1")),
    );
    let norm = format!("{prefix}.out_conv.1");
    // The ReLU of `out` comes before the sum with x.
    let after = After { residual: Some(Residual { tensor: x, after: true }), ..After::norm_relu(&norm) };
    b.conv(&format!("{prefix}.out_conv.0"), false, y, ConvShape::plane(1, 1, channels), after)
}

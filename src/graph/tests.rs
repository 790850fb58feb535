//! The graph against the figures that are known of the published network.

use super::ops::{BatchNorm, Conv, Deconv, DeformConv, Winograd, WinogradDeconv};
use super::*;
use crate::network::Network;
use std::collections::BTreeSet;
use voxcast_kernels::conv::Geometry;

fn full() -> Graph {
    Graph::build(&Network::built_in("nuscenes-200").expect("built in"), Results::ALL)
}

/// Billions of multiply-adds of a frame of six cameras, of the operations that `wanted` picks.
fn work(graph: &Graph, wanted: impl Fn(&Operation) -> bool) -> f64 {
    let operations = graph.operations.iter().enumerate().filter(|(_, o)| wanted(o));
    let count = |(i, o)| graph.multiply_adds(o) * if i < graph.camera_operations { 6 } else { 1 };
    operations.map(count).sum::<u64>() as f64 / 1e9
}

fn assert_near(found: f64, expected: f64, what: &str) {
    // The figures are rounded.
    assert!((found - expected).abs() <= 1.0, "{what}: {found:.2}, expected {expected}");
}

fn geometry(operation: &Operation) -> Option<Geometry> {
    match operation.op {
        Op::Conv(Conv { geometry })
        | Op::DeformConv(DeformConv { geometry })
        | Op::Winograd(Winograd { geometry, .. }) => Some(geometry),
        _ => None,
    }
}

fn side(operation: &Operation) -> Option<usize> {
    geometry(operation).map(|g| g.kernel[2])
}

#[test]
fn multiply_adds_are_the_published_ones() {
    let graph = Graph::build(&full().network, Results::default()).fold_batch_norm();
    let backbone = |o: &Operation| o.name.starts_with("img_backbone.");
    let deformed = |o: &Operation| matches!(o.op, Op::DeformConv(_));
    let offsets = |o: &Operation| o.name.ends_with("conv_offset");
    let pyramid = |o: &Operation| o.name.starts_with("img_neck.");
    assert_near(work(&graph, |o| backbone(o) && side(o) == Some(1)), 645.0, "1x1 of the backbone");
    assert_near(work(&graph, deformed), 534.0, "deformable 3x3");
    assert_near(work(&graph, offsets), 53.0, "offsets");
    assert_near(
        work(&graph, |o| backbone(o) && side(o) == Some(3) && !deformed(o) && !offsets(o)),
        144.0,
        "plain 3x3 of the backbone",
    );
    assert_near(work(&graph, |o| side(o) == Some(7)), 21.0, "stem");
    assert_near(work(&graph, |o| pyramid(o) && side(o) == Some(1)), 64.0, "laterals");
    assert_near(work(&graph, |o| pyramid(o) && side(o) == Some(3)), 431.0, "pyramid");
    assert_near(work(&graph, |o| !backbone(o) && !pyramid(o)), 93.0, "after the gather");
    let one = |name: &str| work(&graph, |o| o.name == name);
    assert!((one("view_transformer.refine_lvl0.0") - 17.7).abs() < 0.05);
    assert!((one("view_transformer.imvts.0.down_conv3d.3") - 8.85).abs() < 0.05);
    assert!((one("view_transformer.up_sample1.0") - 10.5).abs() < 0.05);
    assert_near(work(&graph, |_| true), 1984.0, "all");
    let folded = graph.clone().fold_projection();
    assert_near(work(&graph, |_| true) - work(&folded, |_| true), 291.0, "saved by the projection fold");
}

#[test]
fn stages_are_those_of_the_golden_cases() {
    let mut expected = vec!["image.input".to_owned()];
    expected.extend((3..6).map(|i| format!("backbone.c{i}")));
    expected.extend((3..6).map(|i| format!("fpn.p{i}")));
    for level in 1..=3 {
        for stage in ["gather.volume", "gather.bev", "volume", "bev", "attention", "aspp", "fused"] {
            expected.push(format!("level{level}.{stage}"));
        }
    }
    expected.extend((0..4).flat_map(|l| [format!("volume.lvl{l}"), format!("logits.lvl{l}")]));
    expected.sort();
    let stages = |graph: &Graph| {
        let mut stages: Vec<String> = graph.stages().map(str::to_owned).collect();
        stages.sort();
        stages
    };
    assert_eq!(stages(&full()), expected);
    assert_eq!(stages(&full().fold_batch_norm()), expected);
    let gone = |s: &String| s.starts_with("fpn.") || s.contains(".gather.");
    let left: Vec<String> = expected.iter().filter(|s| !gone(s)).cloned().collect();
    assert_eq!(stages(&full().rewritten(Rewrites::ALL)), left);
    let inference = Graph::build(&full().network, Results::default());
    assert_eq!(inference.stages().filter(|s| s.starts_with("logits.")).collect::<Vec<_>>(), ["logits.lvl0"]);
}

/// What every graph must be, before and after each rewrite.
fn assert_sound(graph: &Graph) {
    let mut names = BTreeSet::new();
    let mut written: BTreeSet<TensorId> = BTreeSet::new();
    for (index, operation) in graph.operations.iter().enumerate() {
        let name = &operation.name;
        assert!(names.insert(name), "{name} is there twice");
        for read in operation.reads() {
            let tensor = graph.tensor(read);
            let there = written.contains(&read) || tensor.scope == Scope::Input;
            assert!(there, "{name} reads {} before it is written", tensor.name);
        }
        let output = graph.tensor(operation.output());
        assert!(operation.first_channel + operation.channels <= output.channels, "{name} writes past its tensor");
        assert_eq!(output.lifetime == Lifetime::Frame, index >= graph.camera_operations, "{name}");
        if let Some(id) = operation.in_place().or(operation.residual.map(|r| r.tensor)) {
            let other = graph.tensor(id);
            assert_eq!((other.extent, other.channels), (output.extent, output.channels), "{name}");
        }
        if let Some(geometry) = geometry(operation) {
            let x = graph.tensor(operation.inputs[0]);
            assert_eq!((geometry.input, geometry.channels), (x.extent, x.channels), "{name}");
            assert_eq!(geometry.output, output.extent, "{name}");
        }
        written.extend(&operation.outputs);
    }
}

#[test]
fn every_rewrite_leaves_a_sound_graph() {
    for name in crate::network::BUILT_IN {
        let network = Network::built_in(name).expect("built in");
        for coarse in [false, true] {
            let graph = Graph::build(&network, Results { coarse_heads: coarse, ..Results::default() });
            let norms = |g: &Graph| g.operations.iter().filter(|o| o.op == Op::BatchNorm(BatchNorm)).count();
            assert_sound(&graph);
            assert!(norms(&graph) > 60, "{name}");
            let folded = graph.clone().fold_batch_norm();
            assert_sound(&folded);
            assert_eq!(norms(&folded), 0, "each norm follows a convolution");
            assert_eq!(graph.operations.len() - folded.operations.len(), norms(&graph));
            let all = folded.clone().fold_projection();
            assert_sound(&all);
            assert_eq!(folded.operations.len() - all.operations.len(), 6, "two convolutions of each level");
            assert_eq!(all.clone().fold_projection().fold_batch_norm(), all, "nothing is left to fold");
            let filtered = all.clone().use_winograd();
            assert_sound(&filtered);
            assert_eq!(filtered.clone().use_winograd(), filtered, "nothing is left to choose");
        }
    }
}

/// Only what computes a convolution changes, and only where it is worth it: never more multiply-adds, and never weights
/// that are much larger than the maps.
#[test]
fn winograd_saves_work_and_leaves_all_else() {
    let mut executed = vec![];
    for (name, image) in [("nuscenes-200", [928, 1600]), ("nuscenes-200", [256, 704]), ("edge", [128, 352])] {
        let network = Network { image, ..Network::built_in(name).expect("built in") };
        let direct = Graph::build(&network, Results::ALL).fold_batch_norm().fold_projection();
        let graph = direct.clone().use_winograd();
        assert_eq!((&graph.tensors, graph.camera_operations), (&direct.tensors, direct.camera_operations));
        assert_eq!(graph.operations.len(), direct.operations.len());
        for (index, (new, old)) in graph.operations.iter().zip(&direct.operations).enumerate() {
            assert_eq!(graph.multiply_adds(new), direct.multiply_adds(old), "{}", old.name);
            let filtered = match new.op {
                Op::Winograd(Winograd { shape, geometry }) => Some((shape, Op::from(Conv { geometry }))),
                Op::WinogradDeconv(WinogradDeconv { shape }) => Some((shape, Op::from(Deconv))),
                _ => None,
            };
            match filtered {
                Some((shape, direct)) => {
                    assert_eq!(direct, old.op, "{}", old.name);
                    assert!(2 * graph.executed_multiply_adds(new) < graph.multiply_adds(new), "{}", old.name);
                    let maps = graph.tensor(new.inputs[0]).len() + shape.rows() * new.channels;
                    let direct = shape.parts() * shape.direct_depth() * new.channels.next_multiple_of(16);
                    let most = if index < graph.camera_operations { (3 * maps).max(2 * direct) } else { maps / 2 };
                    assert!(shape.weights_len() <= most, "{}", old.name);
                }
                None => assert_eq!(new, old),
            }
            let restored = Operation { op: old.op.clone(), ..new.clone() };
            assert_eq!(&restored, old);
        }
        let doubled = graph.operations.iter().filter(|o| matches!(o.op, Op::WinogradDeconv(_))).count();
        assert_eq!(doubled, if name == "edge" { 1 } else { 2 }, "{name}: volumes with more voxels than weights");
        let count = |o: &Operation| matches!(o.op, Op::Winograd(_) | Op::WinogradDeconv(_));
        let all: u64 = graph.operations.iter().filter(|o| count(o)).map(|o| graph.multiply_adds(o)).sum();
        let left: u64 = graph.operations.iter().filter(|o| count(o)).map(|o| graph.executed_multiply_adds(o)).sum();
        executed.push((graph.operations.iter().filter(|o| count(o)).count(), all as f64 / left as f64));
    }
    for (count, saved) in executed {
        assert!(count >= 14 && saved > 2.3, "{count} operations, {saved:.2} times fewer multiply-adds");
    }
}

#[test]
fn work_beyond_64_bits_is_told_as_the_largest() {
    let network = Network {
        channels: [65536, 65536, 65536, 65536],
        key_dims: [8192; 3],
        classes: 256,
        grids: [[1024, 1024, 512], [512, 512, 256], [256, 256, 128]],
        ..full().network
    };
    network.check().expect("within the rules");
    let graph = Graph::build(&network, Results::ALL);
    let most = graph.operations.iter().map(|o| graph.multiply_adds(o)).max();
    assert_eq!(most, Some(u64::MAX));
}

#[test]
fn tensors_know_what_they_are() {
    let graph = full().rewritten(Rewrites::ALL);
    let known = |name: &str| {
        let operation = graph.operations.iter().find(|o| o.name == name).expect(name);
        let tensor = graph.tensor(operation.result());
        (tensor.element, tensor.space, tensor.section.to_string(), tensor.scope, tensor.lifetime)
    };
    let f32 = |space, section: &str, scope, lifetime| (Element::F32, space, section.to_owned(), scope, lifetime);
    let inner = |space, section, lifetime| f32(space, section, Scope::Inner, lifetime);
    let (pass, camera, frame) = (Lifetime::Pass, Lifetime::Camera, Lifetime::Frame);
    assert_eq!(known("image"), inner(Space::Image, "backbone stem", pass));
    assert_eq!(known("img_backbone.layer3.0.conv2"), inner(Space::Image, "backbone layer3", pass));
    assert_eq!(known("img_neck.fpn_convs.1.conv.projected"), inner(Space::Image, "pyramid", camera));
    let level = "view_transformer.imvts.1";
    assert_eq!(known(&format!("{level}.gather.volume")), inner(Space::Volume, "level 2 gather", frame));
    assert_eq!(known(&format!("{level}.down_conv3d.3")), inner(Space::Volume, "level 2 volume", frame));
    assert_eq!(known(&format!("{level}.bev_attn_layer.mixer.m.attn")), inner(Space::Plane, "level 2 bev", frame));
    assert_eq!(known("view_transformer.up_sample3.0"), inner(Space::Volume, "up_sample3", frame));
    assert_eq!(known("view_transformer.refine_lvl0.0"), inner(Space::Volume, "refine_lvl0", frame));
    assert_eq!(known("occ_head.mlp_occ_lvl1"), inner(Space::Volume, "head", frame));
    assert_eq!(known("occ_head.mlp_occ_lvl0"), f32(Space::Volume, "head", Scope::Output, frame));
    let inputs: Vec<&Tensor> = graph.tensors.iter().filter(|t| t.scope == Scope::Input).collect();
    assert_eq!((inputs.len(), inputs[0].element, inputs[0].bytes()), (1, Element::U8, 928 * 1600 * 3));
    let outputs = graph.tensors.iter().filter(|t| t.scope == Scope::Output);
    assert_eq!(outputs.map(|t| t.bytes()).collect::<Vec<_>>(), [640_000, 640_000 * 17 * 4]);
}

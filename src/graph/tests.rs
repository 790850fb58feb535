//! The graph against the figures that are known of the published network.

use super::*;
use std::collections::BTreeSet;

fn full() -> Graph {
    Graph::build(&Network::built_in("nuscenes-200").expect("built in"), true)
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

fn side(operation: &Operation) -> Option<usize> {
    match operation.op {
        Op::Conv { geometry } | Op::DeformConv { geometry } => Some(geometry.kernel[2]),
        _ => None,
    }
}

#[test]
fn multiply_adds_are_the_published_ones() {
    let graph = Graph::build(&full().network, false).fold_batch_norm();
    let backbone = |o: &Operation| o.name.starts_with("img_backbone.");
    let deformed = |o: &Operation| matches!(o.op, Op::DeformConv { .. });
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
    let inference = Graph::build(&full().network, false);
    assert_eq!(inference.stages().filter(|s| s.starts_with("logits.")).collect::<Vec<_>>(), ["logits.lvl0"]);
}

/// What every graph must be, before and after each rewrite.
fn assert_sound(graph: &Graph) {
    let mut names = BTreeSet::new();
    let mut written = BTreeSet::new();
    for (index, operation) in graph.operations.iter().enumerate() {
        let name = &operation.name;
        assert!(names.insert(name), "{name} is there twice");
        for read in operation.reads() {
            assert!(written.contains(&read), "{name} reads {} before it is written", graph.tensor(read).name);
        }
        let output = graph.tensor(operation.output);
        assert!(operation.first_channel + operation.channels <= output.channels, "{name} writes past its tensor");
        assert_eq!(output.scope == Scope::Frame, index >= graph.camera_operations, "{name}");
        if let Some(id) = operation.in_place().or(operation.residual.map(|r| r.tensor)) {
            let other = graph.tensor(id);
            assert_eq!((other.extent, other.channels), (output.extent, output.channels), "{name}");
        }
        if let Op::Conv { geometry } | Op::DeformConv { geometry } = operation.op {
            let x = graph.tensor(operation.inputs[0]);
            assert_eq!((geometry.input, geometry.channels), (x.extent, x.channels), "{name}");
            assert_eq!(geometry.output, output.extent, "{name}");
        }
        written.insert(operation.output);
    }
}

#[test]
fn every_rewrite_leaves_a_sound_graph() {
    for name in crate::network::BUILT_IN {
        let network = Network::built_in(name).expect("built in");
        for coarse in [false, true] {
            let graph = Graph::build(&network, coarse);
            let norms = |g: &Graph| g.operations.iter().filter(|o| o.op == Op::BatchNorm).count();
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
        }
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
    let graph = Graph::build(&network, true);
    let most = graph.operations.iter().map(|o| graph.multiply_adds(o)).max();
    assert_eq!(most, Some(u64::MAX));
}

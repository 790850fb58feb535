use super::*;
use crate::graph::{Results, Rewrites, Scope};
use crate::network::Network;

fn folded(name: &str) -> Graph {
    let network = Network::built_in(name).expect("built in");
    Graph::build(&network, Results::ALL).rewritten(Rewrites { winograd: false, ..Rewrites::ALL })
}

fn quantised(graph: Graph, keep_f32: &[&str]) -> Graph {
    let keep_f32: Vec<String> = keep_f32.iter().map(|&name| name.to_owned()).collect();
    graph.quantise(&keep_f32, &mut |_| Scale::of_range(127.0)).expect("scales for all")
}

/// Operations that compute in floating point, and conversions.
fn floating(graph: &Graph) -> Vec<&str> {
    let element = |id: TensorId| graph.tensor(id).element;
    let floating = |o: &&Operation| element(o.inputs[0]) == Element::F32 || element(o.output()) == Element::F32;
    graph.operations.iter().filter(floating).map(|o| o.name.as_str()).collect()
}

/// What every graph must be: tensors written before they are read, the camera's pass first, types that go together.
fn assert_sound(graph: &Graph) {
    let mut written = vec![false; graph.tensors.len()];
    for (index, operation) in graph.operations.iter().enumerate() {
        let name = &operation.name;
        for read in operation.reads() {
            let tensor = graph.tensor(read);
            assert!(written[read.0] || tensor.scope == Scope::Input, "{name} reads {} too early", tensor.name);
        }
        let output = graph.tensor(operation.output());
        assert_eq!(output.lifetime == Lifetime::Frame, index >= graph.camera_operations, "{name}");
        assert_eq!(output.element == Element::I8, output.scale.is_some(), "{name}");
        if let Some(residual) = operation.residual {
            assert_eq!(graph.tensor(residual.tensor).element, output.element, "{name}");
        }
        operation.outputs.iter().for_each(|id| written[id.0] = true);
    }
}

#[test]
fn all_but_attention_is_in_integers() {
    for name in crate::network::BUILT_IN {
        let graph = quantised(folded(name), &[]);
        assert_sound(&graph);
        let expected: Vec<String> = (0..3)
            .flat_map(|level| {
                let block = format!("view_transformer.imvts.{level}.bev_attn_layer");
                let attention = format!("{block}.mixer.m.attn");
                [format!("{block}.ffn0.m.pw2.c.f32"), attention.clone(), format!("{attention}.i8")]
            })
            .collect();
        assert_eq!(floating(&graph), expected, "{name}");
        let offsets = graph.tensors.iter().filter(|t| t.element == Element::I32).count();
        let deformed = graph.operations.iter().filter(|o| matches!(o.op, Op::DeformConvI8(_))).count();
        assert_eq!(offsets, deformed);
        let Op::ConvI8(stem) = &graph.operations[1].op else { panic!("{:?}", graph.operations[1]) };
        assert_eq!((stem.geometry.channels, stem.signed), (3, true));
        assert_eq!(graph.tensor(graph.operations[0].output()).channels, 3);
    }
}

#[test]
fn what_is_kept_takes_along_what_belongs_to_it() {
    let keep = |names: &[&str]| {
        let graph = quantised(folded("nuscenes-200"), names);
        assert_sound(&graph);
        floating(&graph)
            .into_iter()
            .filter(|name| !name.contains("bev_attn_layer"))
            .map(str::to_owned)
            .collect::<Vec<_>>()
    };
    assert_eq!(keep(&[]), [""; 0]);
    // The image goes with the stem, and what pools the result follows.
    let expected = ["image", "img_backbone.conv1", "img_backbone.maxpool", "img_backbone.maxpool.i8"];
    assert_eq!(keep(&["img_backbone.conv1"]), expected);
    // The offsets of a deformable convolution, and the other way around.
    let conv = "img_backbone.layer3.4.conv2";
    let expected = ["img_backbone.layer3.4.conv1.f32", &format!("{conv}.conv_offset"), conv, &format!("{conv}.i8")];
    assert_eq!(keep(&[conv]), expected);
    assert_eq!(keep(&[&format!("{conv}.conv_offset")]), expected);
    // One of several branches side by side.
    let aspp = keep(&["view_transformer.imvts.1.aspp_xy.aspp.convs.2.0"]);
    let branches = aspp.iter().filter(|name| name.contains("aspp.convs.") && name.ends_with(".0")).count();
    assert_eq!(branches, 5, "{aspp:?}");
    // Features are kept per camera as they are gathered.
    let gathers = ["volume", "bev"].map(|branch| format!("view_transformer.imvts.0.gather.{branch}"));
    let graph = quantised(folded("nuscenes-200"), &gathers.each_ref().map(|name| &name[..]));
    let features = graph.operations.iter().find(|o| o.name == "img_neck.fpn_convs.0.conv.projected").expect("it");
    let features = graph.tensor(features.output());
    assert_eq!((features.element, features.lifetime), (Element::I8, Lifetime::Pass));
    let name = format!("{}.f32", features.name);
    let converted = graph.tensors.iter().find(|t| t.name == name).expect("converted");
    assert_eq!((converted.element, converted.lifetime), (Element::F32, Lifetime::Camera));
    // A gather of features of which none is left in integers.
    let all = keep(&["img_backbone", "img_neck"]);
    assert!(all.iter().any(|name| name.ends_with("imvts.0.gather.volume")), "{all:?}");
}

#[test]
fn scales_are_as_coarse_as_kernels_need() {
    let graph = folded("edge");
    let fine = |name: &str| {
        Scale::of_range(if name.contains("gather") || name.contains("down_conv3d.0") { 1.0 } else { 127.0 })
    };
    let graph = graph.quantise(&[], &mut |name| fine(name)).expect("scales for all");
    for operation in graph.operations.iter().filter(|o| matches!(o.op, Op::GatherI8(_))) {
        let [features, rows] = [operation.inputs[0], operation.output()].map(|id| graph.tensor(id).scale.expect("one"));
        assert!(features.wide() / rows.wide() <= GatherI8::MOST_RATIO, "{}", operation.name);
    }
    let pool = graph.operations.iter().find(|o| matches!(o.op, Op::MaxPoolI8(_))).expect("one");
    assert_eq!(graph.tensor(pool.output()).scale, graph.tensor(pool.inputs[0]).scale);
    for broadcast in graph.operations.iter().filter(|o| matches!(o.op, Op::BroadcastI8(_))) {
        assert_eq!(graph.tensor(broadcast.output()).scale, graph.tensor(broadcast.inputs[0]).scale);
    }
}

#[test]
fn what_cannot_be_is_refused() {
    let error = folded("edge").quantise(&["img_backbone.layer9".to_owned()], &mut |_| Scale::of_range(1.0));
    let error = error.expect_err("no such operation");
    assert!(error.message().contains("no operation \"img_backbone.layer9\""), "{error}");
    let network = Network::built_in("edge").expect("built in");
    let error = Graph::build(&network, Results::ALL).quantise(&[], &mut |_| Scale::of_range(1.0));
    assert!(error.expect_err("batch norms").message().contains("folded batch norms"));
    let error = folded("edge").quantise(&[], &mut |name| Quantisation::default().scale(name)).expect_err("no scales");
    assert!(error.message().contains("\"image\": its scale is missing"), "{error}");
}

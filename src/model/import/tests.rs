//! Folding in f64 against the layers evaluated one after the other, and what is refused.

use super::*;
use crate::base::random::Random;
use crate::graph::ops::{Winograd, WinogradDeconv, transformed};
use crate::graph::parts::Storage;
use crate::graph::{Op, Results, Rewrites};
use crate::small;
use std::collections::{BTreeMap, BTreeSet};
use voxcast_kernels::deconv3d::kernel_tap;
use voxcast_kernels::panels::{packed_index, packed_len};

/// Drawn weights, kept so that a test can evaluate the layers themselves. Some can be spoilt.
#[derive(Default)]
struct Drawn {
    known: RefCell<BTreeMap<String, Vec<f64>>>,
    spoilt: BTreeMap<&'static str, f64>,
}

impl Source for Drawn {
    fn tensor(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>> {
        let mut random = Random::new(name.bytes().fold(7, |h, b| h * 31 % 1_000_003 + u64::from(b)));
        let positive = name.ends_with("running_var");
        let draw = |_| f64::from(if positive { random.range(0.3, 2.0) } else { random.normal() });
        let mut values: Vec<f64> = (0..shape.iter().product()).map(draw).collect();
        if let Some(&value) = self.spoilt.get(name) {
            values[0] = value;
        }
        self.known.borrow_mut().insert(name.to_owned(), values.clone());
        Ok(values)
    }
}

impl Drawn {
    fn get(&self, name: &str) -> Vec<f64> {
        self.known.borrow()[name].clone()
    }

    /// A batch norm as its definition says.
    fn norm(&self, prefix: &str, channel: usize, x: f64) -> f64 {
        let part = |name: &str| self.get(&format!("{prefix}.{name}"))[channel];
        (x - part("running_mean")) / (part("running_var") + 1e-5).sqrt() * part("weight") + part("bias")
    }
}

fn graph(rewrites: Rewrites) -> Graph {
    Graph::build(&small::tiny(), Results::ALL).rewritten(rewrites)
}

/// The f32 parts that the operation `name` stores.
fn evaluate(source: &Drawn, graph: &Graph, name: &str) -> Vec<Vec<f32>> {
    let operation = graph.operations.iter().find(|o| o.name == name).expect(name);
    let values = operation.op.description().evaluate(&graph.site(operation), &Weights(source)).expect("sound weights");
    values.into_iter().map(|values| values.into_iter().map(|v| v as f32).collect()).collect()
}

fn assert_near(found: f32, expected: f64, what: &str) {
    assert!(
        (f64::from(found) - expected).abs() <= 1e-5 * (1.0 + expected.abs()),
        "{what}: {found}, expected {expected}"
    );
}

#[test]
fn a_folded_convolution_is_convolution_then_norm() {
    let (source, graph) = (Drawn::default(), graph(Rewrites::ALL));
    // A 1x1 without bias, and a 3x3x3 with one.
    for (name, norm, inputs, outputs, taps) in [
        ("img_backbone.layer1.0.conv3", "img_backbone.layer1.0.bn3", 2, 8, 1),
        ("view_transformer.refine_lvl2.0", "view_transformer.refine_lvl2.1", 16, 16, 27),
    ] {
        let parts = evaluate(&source, &graph, name);
        let weight = source.get(&format!("{name}.weight"));
        let bias = source.known.borrow().get(&format!("{name}.bias")).cloned().unwrap_or(vec![0.0; outputs]);
        for n in 0..outputs {
            // The layers of one unit input and of none give one column and the bias.
            let none = source.norm(norm, n, bias[n]);
            assert_near(parts[1][n], none, &format!("{name}: bias {n}"));
            for (tap, input) in [(0, 0), (taps - 1, inputs - 1), (taps / 2, 1)] {
                let one = source.norm(norm, n, weight[(n * inputs + input) * taps + tap] + bias[n]);
                let found = parts[0][packed_index(taps * inputs, tap * inputs + input, n)];
                assert_near(found, one - none, &format!("{name}: weight {n}, {input}, {tap}"));
            }
        }
        assert!(parts[1][outputs..].iter().all(|&v| v == 0.0), "padding");
    }
}

#[test]
fn the_folded_projection_is_pyramid_then_branches() {
    let (source, graph) = (Drawn::default(), graph(Rewrites::ALL));
    let parts = evaluate(&source, &graph, "img_neck.fpn_convs.1.conv.projected");
    let biases = ["volume", "bev"].map(|b| evaluate(&source, &graph, &format!("view_transformer.imvts.1.gather.{b}")));
    let (fpn, branch) = (5, 16);
    let mut random = Random::new(4);
    let patch: Vec<f64> = (0..fpn * 9).map(|_| f64::from(random.normal())).collect();
    let pixel_weight = source.get("img_neck.fpn_convs.1.conv.weight");
    let pixel_bias = source.get("img_neck.fpn_convs.1.conv.bias");
    let feature: Vec<f64> = (0..fpn)
        .map(|f| pixel_bias[f] + (0..fpn * 9).map(|k| pixel_weight[f * fpn * 9 + k] * patch[k]).sum::<f64>())
        .collect();
    for (b, (conv, norm)) in [
        ("view_transformer.imvts.1.down_conv3d.0", "view_transformer.imvts.1.down_conv3d.1"),
        ("view_transformer.imvts.1.xy_conv.0", "view_transformer.imvts.1.xy_conv.1"),
    ]
    .into_iter()
    .enumerate()
    {
        let (weight, bias) = (source.get(&format!("{conv}.weight")), source.get(&format!("{conv}.bias")));
        for c in 0..branch {
            let n = b * branch + c;
            let mut projected = f64::from(parts[1][n]);
            for (tap, input) in (0..9).flat_map(|tap| (0..fpn).map(move |input| (tap, input))) {
                let w = parts[0][packed_index(9 * fpn, tap * fpn + input, n)];
                projected += f64::from(w) * patch[input * 9 + tap];
            }
            // A row of one pixel, and a row of none: the pixel's bias belongs to the pixel.
            let one: f64 = bias[c] + (0..fpn).map(|f| weight[c * fpn + f] * feature[f]).sum::<f64>();
            let after = f64::from(biases[b][0][c]);
            assert_near((projected + after) as f32, source.norm(norm, c, one), &format!("{conv}, channel {c}"));
            assert_near(after as f32, source.norm(norm, c, bias[c]), &format!("{conv}, channel {c}, empty row"));
        }
    }
}

#[test]
fn transposed_weights_reach_the_voxels_that_they_should() {
    let (source, graph) = (Drawn::default(), graph(Rewrites::NONE));
    let name = "view_transformer.up_sample2.0";
    let parts = evaluate(&source, &graph, name);
    let raw = source.get(&format!("{name}.weight"));
    let (inputs, outputs) = (16, 8);
    let size = packed_len(8 * inputs, outputs);
    // Along one axis, output 2 i + p takes kernel taps 1 and 3 of inputs i and i - 1 (p = 0), 2 and 0 of i and i + 1
    // (p = 1); `kernel_tap` says which of the two is listed first.
    let mut seen = std::collections::BTreeSet::new();
    for parity in 0..8usize {
        for tap in 0..8usize {
            let kernel: [usize; 3] =
                std::array::from_fn(|axis| kernel_tap(parity >> (2 - axis) & 1, tap >> (2 - axis) & 1));
            for axis in 0..3 {
                let expected = if parity >> (2 - axis) & 1 == 0 { [1, 3] } else { [0, 2] };
                assert!(expected.contains(&kernel[axis]), "parity {parity}, tap {tap}: {kernel:?}");
            }
            seen.insert(kernel);
            for (input, output) in [(0, 0), (3, 5), (15, 7)] {
                let at = kernel.iter().fold(input * outputs + output, |at, k| at * 4 + k);
                let found = parts[0][parity * size + packed_index(8 * inputs, tap * inputs + input, output)];
                assert_eq!(found, raw[at] as f32, "parity {parity}, tap {tap}, {input} to {output}");
            }
        }
    }
    assert_eq!(seen.len(), 64, "each of the kernel's taps is used once");
}

/// Of every operation of networks that have all tiles, in planes and in volumes.
#[test]
fn transformed_weights_are_those_of_the_direct_convolution() {
    let small_volumes = Network {
        image: [96, 160],
        block: crate::network::Block::Basic,
        dcn: [false; 4],
        width: 32,
        channels: [16, 32, 16, 8],
        key_dims: [4, 2, 1],
        grids: [[24, 24, 4], [12, 12, 2], [6, 6, 1]],
        ..small::tiny()
    };
    let wide_volumes = Network { grids: [[64, 64, 4], [32, 32, 2], [16, 16, 1]], ..small_volumes.clone() };
    let mut kinds = BTreeSet::new();
    for network in [small_volumes, wide_volumes] {
        let graph = |winograd| Graph::build(&network, Results::ALL).rewritten(Rewrites { winograd, ..Rewrites::ALL });
        let (source, direct, filtered) = (Drawn::default(), graph(false), graph(true));
        for operation in &filtered.operations {
            let (Op::Winograd(Winograd { shape, .. }) | Op::WinogradDeconv(WinogradDeconv { shape })) = &operation.op
            else {
                continue;
            };
            kinds.insert(operation.op.description().kind());
            let [old, new] = [&direct, &filtered].map(|graph| evaluate(&source, graph, &operation.name));
            let depth = shape.direct_depth();
            let size = packed_len(depth, shape.columns);
            let weight = |part, k, n| f64::from(old[0][part * size + packed_index(depth, k, n)]);
            assert_eq!(new[1], old[1], "{}: the bias", operation.name);
            for (found, expected) in new[0].iter().zip(transformed(shape, weight)) {
                assert_near(*found, expected, &operation.name);
            }
        }
    }
    assert_eq!(
        kinds.into_iter().collect::<Vec<_>>(),
        ["conv2d F(2,3)", "conv2d F(4,3)", "conv3d F(2,3)", "conv3d F(4,3)", "deconv3d F(3,2)"]
    );
}

#[test]
fn a_norm_of_its_own_is_scale_and_shift() {
    let (source, graph) = (Drawn::default(), graph(Rewrites::NONE));
    let parts = evaluate(&source, &graph, "img_backbone.bn1");
    for c in 0..2 {
        assert_near(parts[1][c], source.norm("img_backbone.bn1", c, 0.0), "shift");
        assert_near(parts[0][c] + parts[1][c], source.norm("img_backbone.bn1", c, 1.0), "scale");
    }
}

#[test]
fn every_part_has_the_size_that_readers_expect() {
    for rewrites in [Rewrites::ALL, Rewrites::NONE, Rewrites { projection: false, ..Rewrites::ALL }] {
        let (source, graph) = (Drawn::default(), graph(rewrites));
        for operation in &graph.operations {
            let expected: Vec<usize> = parts(&graph, operation).iter().map(|p| p.len).collect();
            if expected.is_empty() {
                continue;
            }
            let found: Vec<usize> = evaluate(&source, &graph, &operation.name).iter().map(Vec::len).collect();
            assert_eq!(found, expected, "{}", operation.name);
        }
    }
}

#[test]
fn numbers_that_cannot_be_stored_are_named() {
    let directory = tempfile::tempdir().expect("a place");
    let path = directory.path().join("model");
    let import_with = |name: &'static str, value: f64, precision| {
        let source = Drawn { spoilt: [(name, value)].into(), ..Drawn::default() };
        let options = Options { precision, rewrites: Rewrites::ALL };
        import(&source, &small::tiny(), options, &path, &mut |_, _| ())
    };
    let conv = "img_backbone.layer1.0.conv1.weight";
    for (name, value, precision, kind, expected) in [
        (
            "img_backbone.bn1.running_var",
            -0.5,
            Precision::F32,
            ErrorKind::Format,
            "bn1.running_var\": element [0] is -0.5",
        ),
        (conv, 1e39, Precision::F32, ErrorKind::Format, "layer1.0.conv1.weight\": folding gives inf"),
        (conv, 1e6, Precision::F16, ErrorKind::Unsupported, "expected at most 65504; use f32"),
        (conv, f64::NAN, Precision::F32, ErrorKind::Format, "folding gives NaN"),
    ] {
        let error = import_with(name, value, precision).expect_err(name);
        assert_eq!(error.kind(), kind, "{error}");
        assert!(error.message().contains(expected), "{error}");
        assert!(!path.exists());
    }
    import_with(conv, 1e6, Precision::F32).expect("single precision holds it");
    assert!(path.exists());
}

#[test]
fn contradictory_options_are_refused_and_progress_is_told() {
    let directory = tempfile::tempdir().expect("a place");
    let path = directory.path().join("model");
    let rewrites = Rewrites { batch_norm: false, ..Rewrites::ALL };
    let options = Options { rewrites, ..Options::default() };
    let error = import(&Drawn::default(), &small::tiny(), options, &path, &mut |_, _| ()).expect_err("a contradiction");
    assert_eq!(error.kind(), ErrorKind::Unsupported);
    let mut told = vec![];
    import(&Drawn::default(), &small::tiny(), Options::default(), &path, &mut |done, total| told.push((done, total)))
        .expect("sound weights");
    let total = told.len();
    assert!(total > 50 && told.into_iter().eq((1..=total).map(|done| (done, total))));
}

#[test]
fn integers_are_stored_exactly_or_refused() {
    let part = |element| Part { suffix: "x", len: 2, storage: Storage::Always(element) };
    let encoded = |element, values: &[f64]| encode("x", &part(element), values, Precision::F16);
    assert_eq!(encoded(Element::I8, &[-128.0, 127.0]).expect("integers")[..3], [128, 127, 0]);
    let found = encoded(Element::I32, &[-1.0, f64::from(i32::MIN)]).expect("integers");
    assert_eq!((found.len(), &found[..8]), (64, &[255, 255, 255, 255, 0, 0, 0, 128][..]));
    for (element, value) in [
        (Element::I8, 128.0),
        (Element::U8, -1.0),
        (Element::I32, 0.5),
        (Element::I32, 2147483648.0),
        (Element::I8, f64::NAN),
    ] {
        let error = encoded(element, &[value]).expect_err("no such integer");
        assert!(error.message().contains("expected an integer"), "{error}");
    }
}

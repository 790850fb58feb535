//! Convolutions by Winograd's minimal filtering in whole networks: how far they are from exact sums, that a model says whether it
//! has them, and that one without them computes what it always did.

#[path = "support/small.rs"]
#[allow(dead_code, reason = "other tests use the rest")]
mod small;

use small::Images;
use std::collections::BTreeMap;
use std::sync::Arc;
use voxcast::container::Container;
use voxcast::graph::{Op, Results, Rewrites, TensorId};
use voxcast::import::import_to_bytes;
use voxcast::model::{Options, use_winograd};
use voxcast::network::Block;
use voxcast::weights::Precision;
use voxcast::{ErrorKind, Model, Network, Session, SessionOptions, digest};
use voxcast_kernels::conv::Geometry;
use voxcast_kernels::panels::packed_index;

const EXACT: Rewrites = Rewrites { winograd: false, ..Rewrites::ALL };

/// Both sizes of tiles, in planes and in volumes, with residuals before the ReLU.
fn network() -> Network {
    Network {
        block: Block::Basic,
        dcn: [false; 4],
        width: 32,
        channels: [16, 32, 16, 32],
        key_dims: [4, 2, 4],
        image: [96, 192],
        grids: [[24, 24, 4], [12, 12, 2], [6, 6, 1]],
        depths: [2, 2, 1, 1],
        ..small::network()
    }
}

/// A model whose rounding stays as small as it is.
fn model(network: &Network, precision: Precision, rewrites: Rewrites) -> Arc<Model> {
    let options = Options { precision, rewrites };
    let bytes = import_to_bytes(&small::Tempered(1), network, options, &mut |_, _| ()).unwrap();
    Arc::new(Model::from_bytes(bytes).unwrap())
}

/// The model of direct sums, and what [`use_winograd`] makes of it.
fn models(network: &Network, precision: Precision) -> [Arc<Model>; 2] {
    let exact = model(network, precision, EXACT);
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("model");
    use_winograd(&exact, &path, &mut |_, _| ()).unwrap();
    [exact, Arc::new(Model::read(&path).unwrap())]
}

/// The convolution that an operation computes, either way.
fn geometry(op: &Op) -> Option<Geometry> {
    match op {
        Op::Conv(conv) => Some(conv.geometry),
        Op::Winograd(winograd) => Some(winograd.geometry),
        _ => None,
    }
}

/// Root mean square errors over that of the result, by operation of `names`: of what a frame of `model` computes of each
/// operation's own inputs, against sums in f64 with the weights of `exact`.
fn errors(model: &Arc<Model>, exact: &Model, names: &[String]) -> BTreeMap<String, f64> {
    let network = model.network();
    let container = Container::from_bytes(exact.bytes().to_vec()).unwrap();
    let part = |name: String| -> Vec<f32> {
        let (_, _, bytes) = container.tensor(&name).unwrap();
        bytes.as_chunks().0.iter().map(|&b| f32::from_le_bytes(b)).collect()
    };
    let mut session = Session::new(model.clone(), small::rig(network, 0.3), &SessionOptions::default()).unwrap();
    let graph = session.graph().clone();
    let mut written: BTreeMap<TensorId, Vec<f32>> = BTreeMap::new();
    let mut sums: BTreeMap<String, [f64; 2]> = BTreeMap::new();
    let images = Images::new(network, 5);
    session
        .run_observed(&images.views(), &mut |event| {
            let operation = event.operation;
            let Some(output) = event.output.get::<f32>() else { return };
            if names.contains(&operation.name) {
                let geometry = geometry(&operation.op).unwrap();
                let (weights, bias) =
                    (part(format!("{}.weight", operation.name)), part(format!("{}.bias", operation.name)));
                let residual = operation.residual.map(|r| (&written[&r.tensor], r.after));
                let stride = graph.tensor(operation.output()).channels;
                let sums = sums.entry(operation.name.clone()).or_default();
                for row in 0..geometry.rows() {
                    for n in 0..operation.channels {
                        let mut exact = dot(&geometry, &written[&operation.inputs[0]], &weights, row, n);
                        exact += f64::from(bias[n]);
                        let at = row * stride + operation.first_channel + n;
                        let added = residual.map_or((0.0, false), |(rows, after)| (f64::from(rows[at]), after));
                        exact += if added.1 { 0.0 } else { added.0 };
                        exact = if operation.relu { exact.max(0.0) } else { exact };
                        exact += if added.1 { added.0 } else { 0.0 };
                        sums[0] += (f64::from(output[at]) - exact).powi(2);
                        sums[1] += exact.powi(2);
                    }
                }
            }
            written.insert(operation.result(), output.to_vec());
        })
        .unwrap();
    sums.into_iter().map(|(name, [off, of])| (name, (off / of).sqrt())).collect()
}

/// One output of a convolution whose packed weights are `weights`.
fn dot(geometry: &Geometry, input: &[f32], weights: &[f32], row: usize, n: usize) -> f64 {
    let Geometry { input: extent, channels, kernel, output, padding, .. } = *geometry;
    let at = [row / output[2] / output[1], row / output[2] % output[1], row % output[2]];
    let mut sum = 0.0;
    for tap in 0..kernel.iter().product() {
        let tap_at = [tap / kernel[2] / kernel[1], tap / kernel[2] % kernel[1], tap % kernel[2]];
        let x: [usize; 3] = std::array::from_fn(|a| (at[a] + tap_at[a]).wrapping_sub(padding[a]));
        if (0..3).any(|a| x[a] >= extent[a]) {
            continue;
        }
        let from = ((x[0] * extent[1] + x[1]) * extent[2] + x[2]) * channels;
        for c in 0..channels {
            let weight = weights[packed_index(geometry.depth(), tap * channels + c, n)];
            sum += f64::from(input[from + c]) * f64::from(weight);
        }
    }
    sum
}

#[test]
fn errors_of_every_operation_are_at_most_twice_those_of_direct_sums() {
    let network = network();
    let [exact, filtered] = models(&network, Precision::F32);
    let graph = filtered.graph(false, Results::default());
    let chosen = graph.operations.iter().filter(|o| matches!(o.op, Op::Winograd(_)));
    let kinds: BTreeMap<String, &str> = chosen.map(|o| (o.name.clone(), o.op.description().kind())).collect();
    for kind in ["conv2d F(2,3)", "conv2d F(4,3)", "conv3d F(2,3)", "conv3d F(4,3)"] {
        assert!(kinds.values().any(|k| *k == kind), "{kind} is not among {kinds:?}");
    }
    let names: Vec<String> = kinds.keys().cloned().collect();
    let [direct, here] = [&exact, &filtered].map(|model| errors(model, &exact, &names));
    let table: Vec<String> = names
        .iter()
        .map(|name| format!("{name} {}: {:.2e}, direct {:.2e}", kinds[name], here[name], direct[name]))
        .collect();
    assert!(names.iter().all(|name| here[name] <= 2.0 * direct[name]), "{}", table.join("\n"));
}

fn run(model: &Arc<Model>) -> (Vec<u8>, Vec<f32>) {
    let options = SessionOptions { logits: true, ..SessionOptions::default() };
    let network = model.network();
    let mut session = Session::new(model.clone(), small::rig(network, 0.0), &options).unwrap();
    let images = Images::new(network, 5);
    let result = session.run(&images.views()).unwrap();
    (result.classes.to_vec(), result.logits.unwrap().to_vec())
}

#[test]
fn direct_sums_have_the_bits_that_they_always_had() {
    // One camera that looks along an axis: no sine or cosine that another machine might round in another way.
    let exact = small::model(&Network { cameras: 1, ..network() }, Precision::F32, EXACT, 1);
    let graph = exact.graph(false, Results::default());
    assert!(!graph.operations.iter().any(|o| matches!(o.op, Op::Winograd(_))));
    let file = Container::from_bytes(exact.bytes().to_vec()).unwrap();
    assert!(!file.metadata().contains_key("winograd"), "a file of the form that earlier versions wrote");
    let (_, logits) = run(&exact);
    assert_eq!(format!("{:016x}", digest::floats(&logits)), "9486f5332a5eee28");
}

#[test]
fn a_model_of_direct_sums_becomes_one_that_uses_winograd() {
    let network = network();
    for precision in [Precision::F32, Precision::F16] {
        let [exact, transformed] = models(&network, precision);
        let imported = model(&network, precision, Rewrites::ALL);
        assert_eq!(transformed.options(), imported.options());
        assert!(transformed.tensors().eq(imported.tensors()), "names, types and sizes");
        let [old, new] = [&exact, &transformed].map(|model| Container::from_bytes(model.bytes().to_vec()).unwrap());
        let mut kept = 0;
        for name in new.names().iter().filter(|name| !name.ends_with(".transformed")) {
            assert_eq!(new.tensor(name).unwrap(), old.tensor(name).unwrap(), "{name}");
            kept += 1;
        }
        assert!(kept > 100 && kept < new.names().len());
        let ((exact_classes, exact_logits), (classes, logits)) = (run(&exact), run(&transformed));
        assert_ne!(logits, exact_logits, "other roundings");
        let equal = classes.iter().zip(&exact_classes).filter(|(a, b)| a == b).count();
        assert!(equal as f64 >= 0.999 * classes.len() as f64, "{equal} of {} classes", classes.len());
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("again");
        let error = use_winograd(&transformed, &path, &mut |_, _| ()).unwrap_err();
        assert!(error.kind() == ErrorKind::Unsupported && !path.exists(), "{error}");
    }
}

//! Convolutions by Winograd's minimal filtering in whole networks: how far they are from exact sums, that a model says whether it
//! has them, and that one without them computes what it always did.

#[path = "support/small.rs"]
#[allow(dead_code, reason = "other tests use the rest")]
mod small;

use small::Images;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use voxcast::container::Container;
use voxcast::graph::{Op, Results, Rewrites, Tensor, TensorId};
use voxcast::import::import_to_bytes;
use voxcast::model::{Options, use_winograd};
use voxcast::network::Block;
use voxcast::weights::Precision;
use voxcast::{Budget, ErrorKind, Isa, Model, Network, Session, SessionOptions, Step, Threads, digest};
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

/// The same with volumes so large that doubling them is worth it too.
fn wide() -> Network {
    Network { grids: [[60, 60, 4], [30, 30, 2], [15, 15, 1]], ..network() }
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

/// The convolution that an operation computes, either way, or of a transposed one that of each parity.
fn geometries(op: &Op, input: &Tensor) -> Vec<Geometry> {
    match op {
        Op::Conv(conv) => vec![conv.geometry],
        Op::Winograd(winograd) => vec![winograd.geometry],
        Op::Deconv(_) | Op::WinogradDeconv(_) => {
            let of = |parity: usize| Geometry {
                input: input.extent,
                channels: input.channels,
                kernel: [2; 3],
                stride: [1; 3],
                dilation: [1; 3],
                padding: [1 - parity / 4, 1 - parity / 2 % 2, 1 - parity % 2],
                output: input.extent,
            };
            (0..8).map(of).collect()
        }
        other => panic!("no convolution: {other:?}"),
    }
}

/// Where row `row` of part `part` of an operation's parts lies in the output.
fn position(geometry: &Geometry, parts: usize, part: usize, row: usize) -> usize {
    let [_, y, z] = geometry.output;
    match parts {
        1 => row,
        _ => {
            let at = [row / (y * z) * 2 + part / 4, row / z % y * 2 + part / 2 % 2, row % z * 2 + part % 2];
            (at[0] * 2 * y + at[1]) * 2 * z + at[2]
        }
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
                let geometries = geometries(&operation.op, graph.tensor(operation.inputs[0]));
                let (weights, bias) =
                    (part(format!("{}.weight", operation.name)), part(format!("{}.bias", operation.name)));
                let residual = operation.residual.map(|r| (&written[&r.tensor], r.after));
                let stride = graph.tensor(operation.output()).channels;
                let sums = sums.entry(operation.name.clone()).or_default();
                let parts = geometries.len();
                let outputs = geometries
                    .iter()
                    .zip(weights.chunks_exact(weights.len() / parts))
                    .enumerate()
                    .flat_map(|(part, of)| (0..of.0.rows()).map(move |row| (part, of, row)));
                for (part, (geometry, weights), row) in outputs {
                    for n in 0..operation.channels {
                        let mut exact = dot(geometry, &written[&operation.inputs[0]], weights, row, n);
                        exact += f64::from(bias[n]);
                        let at = position(geometry, parts, part, row) * stride + operation.first_channel + n;
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
    for tap in 0..kernel.iter().product::<usize>() {
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
    let mut met = BTreeSet::new();
    for network in [network(), wide()] {
        let [exact, filtered] = models(&network, Precision::F32);
        let graph = filtered.graph(false, Results::default());
        let chosen = graph.operations.iter().filter(|o| matches!(o.op, Op::Winograd(_) | Op::WinogradDeconv(_)));
        // One network's operations of a kind are enough: exact sums take a while.
        let kinds = chosen.map(|o| (o.name.clone(), o.op.description().kind())).filter(|(_, kind)| !met.contains(kind));
        let kinds: BTreeMap<String, &str> = kinds.collect();
        let names: Vec<String> = kinds.keys().cloned().collect();
        let [direct, here] = [&exact, &filtered].map(|model| errors(model, &exact, &names));
        let table: Vec<String> = names
            .iter()
            .map(|name| format!("{name} {}: {:.2e}, direct {:.2e}", kinds[name], here[name], direct[name]))
            .collect();
        assert!(names.iter().all(|name| here[name] <= 2.0 * direct[name]), "{}", table.join("\n"));
        met.extend(kinds.into_values());
    }
    let every = ["conv2d F(2,3)", "conv2d F(4,3)", "conv3d F(2,3)", "conv3d F(4,3)", "deconv3d F(3,2)"];
    assert_eq!(met.into_iter().collect::<Vec<_>>(), every);
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
fn isa_threads_and_steps_do_not_show() {
    let network = wide();
    let model = model(&network, Precision::F32, Rewrites::ALL);
    let rig = small::rig(&network, 0.0);
    let images = Images::new(&network, 5);
    let mut first: Option<Vec<f32>> = None;
    let sets = Isa::available().flat_map(|isa| [1, 2, 3].map(|threads| (isa, threads)));
    // The scalar code takes seconds for a frame.
    for (isa, threads) in sets.filter(|&(isa, threads)| isa != Isa::Scalar || threads == 2) {
        let threads_of = Threads::new(threads).unwrap();
        let options = SessionOptions { isa, threads: threads_of, logits: true, ..SessionOptions::default() };
        let mut session = Session::new(model.clone(), rig.clone(), &options).unwrap();
        for whole in [true, false] {
            let what = format!("{} {threads} threads, whole: {whole}", isa.name());
            let found = if whole {
                session.run(&images.views()).unwrap().logits.unwrap().to_vec()
            } else if isa == Isa::Scalar {
                continue;
            } else {
                for (camera, view) in images.views().iter().enumerate() {
                    session.set_camera(camera, *view).unwrap();
                }
                while session.step(Budget::Slices(7)) != Step::Complete {}
                session.occupancy().unwrap().logits.unwrap().to_vec()
            };
            let want = first.get_or_insert_with(|| found.clone());
            assert!(found.iter().zip(&*want).all(|(a, b)| a.to_bits() == b.to_bits()), "{what}");
        }
    }
}

#[test]
fn direct_sums_have_the_bits_that_they_always_had() {
    // One camera that looks along an axis: no sine or cosine that another machine might round in another way.
    let exact = small::model(&Network { cameras: 1, ..network() }, Precision::F32, EXACT, 1);
    let graph = exact.graph(false, Results::default());
    assert!(!graph.operations.iter().any(|o| matches!(o.op, Op::Winograd(_) | Op::WinogradDeconv(_))));
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

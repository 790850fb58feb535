//! The bit contract: nothing but model, rig and images can change a bit of the result.

#[path = "support/small.rs"]
#[allow(dead_code, reason = "other tests use the rest")]
mod small;

use safetensors::Dtype;
use small::Images;
use std::collections::BTreeMap;
use std::sync::Arc;
use voxcast::container::{self, Container, Data, Layout, Tensor};
use voxcast::graph::{Graph, Op, Results, Rewrites, Temperature};
use voxcast::weights::Precision;
use voxcast::{Confidence, ImageView, Isa, Model, Network, Rig, Session, SessionOptions, Threads};

/// Everything that a frame gives, in bits.
#[derive(Debug, PartialEq)]
struct Bits {
    classes: Vec<u8>,
    logits: Vec<u32>,
    /// Of "occupied" and of the class.
    confidence: [Vec<u8>; 2],
}

fn session(model: &Arc<Model>, rig: &Arc<Rig>, isa: Isa, threads: Threads) -> Session {
    let options = SessionOptions { isa, threads, logits: true, confidence: true, ..SessionOptions::default() };
    Session::new(model.clone(), rig.clone(), &options).unwrap()
}

fn run(session: &mut Session, images: &[ImageView<'_>]) -> Bits {
    let result = session.run(images).unwrap();
    let logits = result.logits.expect("asked for").iter().map(|v| v.to_bits()).collect();
    let Confidence { occupied, class } = result.confidence.expect("asked for");
    Bits { classes: result.classes.to_vec(), logits, confidence: [occupied.to_vec(), class.to_vec()] }
}

/// Names where two results part; whole vectors in a message would fill screens.
fn assert_same(found: &Bits, expected: &Bits, what: &str) {
    let first = found.logits.iter().zip(&expected.logits).position(|(a, b)| a != b);
    assert_eq!(first, None, "{what}: the first logit that differs");
    let first = found.classes.iter().zip(&expected.classes).position(|(a, b)| a != b);
    assert_eq!(first, None, "{what}: the first class that differs");
    assert!(found.confidence == expected.confidence, "{what}: how sure it is differs");
    assert_eq!((found.logits.len(), found.classes.len()), (expected.logits.len(), expected.classes.len()), "{what}");
}

/// Results that could not reveal a difference would prove nothing: one logit in `alike` is like no other.
fn assert_varied(bits: &Bits, alike: usize) {
    let mut values = bits.logits.clone();
    values.sort_unstable();
    values.dedup();
    assert!(values.len() > bits.logits.len() / alike, "{} different logits", values.len());
    assert!(bits.logits.iter().all(|&b| f32::from_bits(b).is_finite()));
    let mut classes = bits.classes.clone();
    classes.sort_unstable();
    classes.dedup();
    assert!(classes.len() > 3, "classes {classes:?}");
}

/// Smaller still: the scalar kernels compute each multiply-add in software unless the build may use the instruction. Its finest
/// volume is wide enough for Winograd's minimal filtering.
fn tiny() -> Network {
    Network {
        image: [32, 64],
        channels: [16, 16, 24, 32],
        grids: [[8, 12, 4], [4, 6, 2], [2, 3, 1]],
        depths: [1; 4],
        ..small::network()
    }
}

#[test]
fn isa_threads_repetition_company_and_rig_swaps_do_not_show() {
    let graph = Graph::build(&tiny(), Results::ALL).rewritten(Rewrites::ALL);
    assert!(graph.operations.iter().any(|o| matches!(o.op, Op::Winograd(_))));
    let stored = [
        (Precision::F32, Rewrites::ALL),
        (Precision::F32, Rewrites::NONE),
        (Precision::F16, Rewrites::ALL),
        (Precision::I8, Rewrites::ALL),
        (Precision::I8, Rewrites { projection: false, ..Rewrites::ALL }),
    ];
    for (precision, rewrites) in stored {
        let network = small::suited(tiny(), precision);
        let (rig, other_rig) = (small::rig(&network, 0.3), small::rig(&network, 1.0));
        let images = Images::new(&network, 5);
        let model = small::model(&network, precision, rewrites, 1);
        let images = images.views();
        let expected = run(&mut session(&model, &rig, Isa::Scalar, Threads::calling()), &images);
        // Integers are often the same.
        assert_varied(&expected, if precision == Precision::I8 { 8 } else { 2 });
        for isa in Isa::available() {
            for count in [1, 2, 3, 8] {
                let what = format!("{} {rewrites:?} {} on {count} threads", precision.name(), isa.name());
                let threads = Threads::new(count).unwrap();
                let mut one = session(&model, &rig, isa, threads.clone());
                assert_same(&run(&mut one, &images), &expected, &what);
                assert_same(&run(&mut one, &images), &expected, &format!("{what}, again"));
                // What another session does on the same threads, or on its own, at the same time.
                let mut two = session(&model, &rig, isa, threads);
                let mut three = session(&model, &rig, isa, Threads::calling());
                std::thread::scope(|scope| {
                    for session in [&mut one, &mut two, &mut three] {
                        let (images, expected, what) = (&images, &expected, &what);
                        scope.spawn(move || assert_same(&run(session, images), expected, &format!("{what}, at once")));
                    }
                });
                one.set_rig(other_rig.clone()).unwrap();
                let swapped = run(&mut one, &images);
                assert_ne!(swapped.logits, expected.logits, "{what}: another rig gives another result");
                one.set_rig(rig.clone()).unwrap();
                assert_same(&run(&mut one, &images), &expected, &format!("{what}, its rig back"));
            }
        }
    }
}

#[test]
fn a_frame_leaves_nothing_behind() {
    for precision in Precision::ALL {
        let network = small::suited(small::network(), precision);
        let model = small::model(&network, precision, Rewrites::ALL, 1);
        let rig = small::rig(&network, 0.3);
        let (images, others) = (Images::new(&network, 5), Images::new(&network, 6));
        let mut session = session(&model, &rig, Isa::best(), Threads::new(2).unwrap());
        let expected = run(&mut session, &images.views());
        assert_ne!(run(&mut session, &others.views()), expected, "other images give another result");
        assert_same(&run(&mut session, &images.views()), &expected, "after another frame");
        // A failed frame neither.
        assert!(session.run(&images.views()[1..]).is_err());
        assert_same(&run(&mut session, &images.views()), &expected, "after a refused frame");
    }
}

#[test]
fn weights_images_and_camera_order_do_show() {
    let network = small::network();
    let rig = small::rig(&network, 0.3);
    let images = Images::new(&network, 5);
    let result = |seed, images: &[ImageView<'_>]| {
        let model = small::model(&network, Precision::F32, Rewrites::ALL, seed);
        run(&mut session(&model, &rig, Isa::best(), Threads::calling()), images)
    };
    let expected = result(1, &images.views());
    assert_ne!(result(2, &images.views()), expected);
    let mut turned = images.views();
    turned.reverse();
    assert_ne!(result(1, &turned), expected);
}

#[test]
fn coarse_heads_and_observers_do_not_show() {
    let network = small::network();
    let model = small::model(&network, Precision::F32, Rewrites::ALL, 1);
    let rig = small::rig(&network, 0.3);
    let images = Images::new(&network, 5);
    let expected = run(&mut session(&model, &rig, Isa::best(), Threads::calling()), &images.views());
    let options = SessionOptions { coarse_heads: true, ..SessionOptions::default() };
    let mut other = Session::new(model, rig, &options).unwrap();
    let mut seen = 0;
    let result = other.run_observed(&images.views(), &mut |_| seen += 1).unwrap();
    assert_eq!(result.classes, expected.classes);
    assert_eq!((result.logits, result.confidence), (None, None), "nobody asked for them");
    assert!(seen > 100, "{seen} events");
}

/// The confidence is the softmax of the logits over the model's temperature, whatever the precision, and asking for it changes
/// nothing else.
#[test]
fn confidence_is_a_softmax_of_the_logits() {
    for (precision, temperature) in [(Precision::F32, 1.0), (Precision::F16, 0.4), (Precision::I8, 40.0)] {
        let network = small::suited(small::network(), precision);
        let (rig, images) = (small::rig(&network, 0.3), Images::new(&network, 5));
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("model");
        let model = small::model(&network, precision, Rewrites::ALL, 1);
        model.save_with_temperature(Temperature::try_from(temperature).unwrap(), &path).unwrap();
        let sharp = Arc::new(Model::open(&path).unwrap());
        assert_eq!((model.temperature().value(), sharp.temperature().value()), (1.0, temperature));
        let plain = run(&mut session(&model, &rig, Isa::best(), Threads::calling()), &images.views());
        let found = run(&mut session(&sharp, &rig, Isa::best(), Threads::new(3).unwrap()), &images.views());
        assert!(found.classes == plain.classes && found.logits == plain.logits, "a temperature changes neither");
        assert_eq!(temperature == 1.0, found.confidence == plain.confidence);
        // Nothing else is asked for: the same codes.
        let options = SessionOptions { confidence: true, ..SessionOptions::default() };
        let mut alone = Session::new(sharp, rig, &options).unwrap();
        let result = alone.run(&images.views()).unwrap();
        let Confidence { occupied, class } = result.confidence.unwrap();
        assert!(result.logits.is_none() && result.classes == plain.classes);
        assert!([occupied, class] == found.confidence.each_ref().map(|codes| &codes[..]));
        let mut seen = std::collections::BTreeSet::new();
        for (voxel, logits) in found.logits.chunks_exact(network.classes).enumerate() {
            let scaled: Vec<f64> = logits.iter().map(|&bits| f64::from(f32::from_bits(bits) / temperature)).collect();
            let most = scaled.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let total: f64 = scaled.iter().map(|logit| (logit - most).exp()).sum();
            let exact = [1.0 - (scaled[0] - most).exp() / total, 1.0 / total].map(|p| 255.0 * p);
            let codes = [occupied[voxel], class[voxel]];
            let off = codes.iter().zip(exact).map(|(&code, exact)| (f64::from(code) - exact).abs());
            assert!(off.fold(0.0, f64::max) < 0.51, "{precision:?} voxel {voxel}: {codes:?}, not {exact:?}");
            seen.extend(codes);
        }
        assert!(seen.len() > 10, "{precision:?}: {} codes", seen.len());
    }
}

/// Half precision is storage: a model of the same numbers in single precision gives the same bits.
#[test]
fn half_precision_only_stores() {
    let network = small::network();
    let rig = small::rig(&network, 0.3);
    let images = Images::new(&network, 5);
    let half_bytes = small::model_bytes(&network, Precision::F16, Rewrites::ALL, 1);
    let wide_bytes = widened(&network, half_bytes.clone());
    let [half, wide] = [half_bytes, wide_bytes].map(|bytes| Arc::new(Model::from_bytes(bytes).unwrap()));
    assert!(wide.file_size() > half.file_size() * 3 / 2);
    let full = small::model(&network, Precision::F32, Rewrites::ALL, 1);
    let [half, wide, full] = [half, wide, full]
        .map(|model| run(&mut session(&model, &rig, Isa::best(), Threads::calling()), &images.views()));
    assert_same(&half, &wide, "f16 against the same weights in f32");
    assert_ne!(full.logits, half.logits, "rounded weights are not those of the checkpoint");
}

/// The same model with every number of half precision stored in single precision.
fn widened(network: &Network, bytes: Vec<u8>) -> Vec<u8> {
    let half = Container::from_bytes(bytes).unwrap();
    // Names and lengths of the wanted tensors are those of any model in single precision.
    let pattern = Container::from_bytes(small::model_bytes(network, Precision::F32, Rewrites::ALL, 2)).unwrap();
    let tensors = pattern.names().into_iter().map(|name| {
        let (_, shape, _) = pattern.tensor(&name).unwrap();
        let (dtype, _, bytes) = half.tensor(&name).unwrap();
        let mut words: Vec<f32> = match dtype {
            Dtype::F16 => bytes.as_chunks().0.iter().map(|&b| half::f16::from_le_bytes(b).to_f32()).collect(),
            _ => bytes.as_chunks().0.iter().map(|&b| f32::from_le_bytes(b)).collect(),
        };
        words.resize(shape[0], 0.0);
        let bytes: Vec<u8> = words.iter().flat_map(|v| v.to_le_bytes()).collect();
        Tensor { name, dtype: Dtype::F32, shape: shape.to_vec(), data: Data::Make(Box::new(move || Ok(bytes))) }
    });
    let metadata: BTreeMap<String, String> = pattern.metadata().clone();
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("wide");
    container::write(&path, tensors.collect(), &metadata, Layout::Aligned).unwrap();
    std::fs::read(&path).unwrap()
}

use super::*;
use crate::ErrorKind;
use crate::graph::Rewrites;
use crate::small;

fn calibrator(precision: Precision, rewrites: Rewrites) -> Result<Calibrator> {
    Calibrator::new(small::model(&small::network(), precision, rewrites, 1), Isa::best(), &Threads::calling())
}

#[test]
fn every_tensor_of_the_folded_graph_has_a_range() {
    let mut calibrator = calibrator(Precision::F32, Rewrites::ALL).expect("f32");
    assert_eq!(calibrator.ranges().expect_err("nothing was seen").kind(), ErrorKind::Unsupported);
    for seed in 0..2 {
        assert_eq!(calibrator.see(&small::scene(&small::network(), seed)).expect("a scene"), []);
    }
    let ranges = calibrator.ranges().expect("two frames");
    assert_eq!(ranges.frames, 2);
    let graph = &calibrator.graph;
    let inner =
        graph.operations.iter().filter(|o| !matches!(o.op, Op::Head(_))).map(|o| &graph.tensor(o.output()).name);
    for name in inner {
        let range = ranges.tensors.get(name).unwrap_or_else(|| panic!("{name}"));
        assert!(range.threshold > 0.0 && range.threshold <= range.max, "{name}: {range:?}");
    }
    assert!(ranges.tensors.contains_key("occ_head.mlp_occ_lvl0.0") && ranges.tensors.contains_key("image"));
}

#[test]
fn hidden_layers_are_those_of_the_head() {
    // The first layer's largest value, computed from the head's own weights.
    let mut calibrator = calibrator(Precision::F32, Rewrites::ALL).expect("f32");
    let scene = small::scene(&small::network(), 3);
    calibrator.see(&scene).expect("a scene");
    let (model, network) = (&calibrator.model, small::network());
    let graph = model.graph(false, Results::ALL);
    let head = graph.operations.last().expect("a head");
    assert_eq!(head.name, "occ_head.mlp_occ_lvl0");
    let parts = model.part_refs(&graph, head).expect("its parts");
    let (weights, bias) = (model.resolve(&parts[0]).of::<f32>(), model.resolve(&parts[1]).of::<f32>());
    let rig = small::rig(&network, 0.0);
    let options = SessionOptions { logits: true, coarse_heads: true, ..SessionOptions::default() };
    let mut session = Session::new(model.clone(), rig, &options).expect("a session");
    let (mut most, channels) = (0.0f64, network.channels[0]);
    session
        .run_observed(&views(&scene), &mut |event| {
            if event.operation.stage.as_deref() == Some("volume.lvl0") {
                for x in event.output.of::<f32>().chunks_exact(channels) {
                    for n in 0..channels {
                        let weight = |k| f64::from(weights[voxcast_kernels::panels::packed_index(channels, k, n)]);
                        let sum: f64 = (0..channels).map(|k| weight(k) * f64::from(x[k])).sum();
                        most = most.max(sum + f64::from(bias[n]));
                    }
                }
            }
        })
        .expect("a frame");
    let found = calibrator.ranges().expect("a frame").tensors["occ_head.mlp_occ_lvl0.0"].max;
    assert!((found - most).abs() < 1e-5 * most, "{found} {most}");
}

#[test]
fn a_dead_camera_is_said_and_left_out() {
    let network = small::network();
    let mut scene = small::scene(&network, 1);
    let whole = |scene: &Scene| {
        let mut calibrator = calibrator(Precision::F32, Rewrites::ALL).expect("f32");
        let notes = calibrator.see(scene)?;
        calibrator.ranges().map(|ranges| (notes, ranges))
    };
    let (_, sound) = whole(&scene).expect("a scene");
    scene.images[1].bgr.fill(7);
    let (notes, ranges) = whole(&scene).expect("one camera is left");
    assert_eq!(notes.len(), 1);
    assert!(notes[0].message().starts_with("camera 1 \"CAM_1\": its image is of one colour"), "{}", notes[0]);
    assert!(ranges.tensors["image"].max <= sound.tensors["image"].max, "the dead camera's image does not count");
    scene.images[0].bgr.fill(0);
    assert_eq!(whole(&scene).expect_err("no camera is left").kind(), ErrorKind::Mismatch);
}

#[test]
fn models_that_cannot_be_calibrated_are_refused() {
    let error = calibrator(Precision::F32, Rewrites::NONE).expect_err("batch norms");
    assert!(error.message().contains("keeps its batch norms"), "{error}");
    assert!(calibrator(Precision::F16, Rewrites::ALL).is_ok());
}

#[test]
fn numbers_that_are_not_finite_are_named() {
    let network = small::network();
    struct Huge;
    impl crate::import::Source for Huge {
        fn tensor(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>> {
            let values = small::Weights(1).tensor(name, shape)?;
            let factor = if name == "img_backbone.conv1.weight" { 1e38 } else { 1.0 };
            Ok(values.into_iter().map(|v| v * factor).collect())
        }
    }
    let bytes = crate::import::import_to_bytes(&Huge, &network, Default::default(), &mut |_, _| ()).expect("finite");
    let model = Arc::new(Model::from_bytes(bytes).expect("a model"));
    let mut calibrator = Calibrator::new(model, Isa::best(), &Threads::calling()).expect("f32");
    let error = calibrator.see(&small::scene(&network, 1)).expect_err("infinite");
    assert!(error.message().contains("\"img_backbone.conv1\": a number that is not finite"), "{error}");
}

#[test]
fn frames_are_spread() {
    let of = |len, count| spread(len, count).collect::<Vec<_>>();
    assert_eq!(of(10, 4), [0, 2, 5, 7]);
    assert_eq!(of(3, 32), [0, 1, 2]);
    assert_eq!(of(0, 4), [0usize; 0]);
}

//! Sound containers that are no sound models.

use super::*;
use crate::base::error::ErrorKind;
use crate::file::container;
use crate::graph::parts::MAX_PARTS;
use crate::graph::{Recipe, Scale};
use crate::model::import::import;
use crate::model::ranges::Ranges;
use crate::model::seeded::SeededWeights;
use crate::small;
use std::sync::OnceLock;

fn network() -> Network {
    Network { image: [32, 32], ..small::tiny() }
}

fn sound(options: Options) -> Vec<u8> {
    let directory = tempfile::tempdir().expect("a place");
    let path = directory.path().join("model");
    import(&SeededWeights { seed: 1 }, &network(), options, &path, &mut |_, _| ()).expect("a model");
    std::fs::read(&path).expect("what was just written")
}

/// A tensor on its way into a file: name, type, length, bytes.
type Loose = (String, Dtype, usize, Vec<u8>);

/// The model's bytes after its tensors and metadata were edited, with a right checksum.
fn edited(edit: impl FnOnce(&mut Vec<Loose>, &mut BTreeMap<String, String>)) -> Vec<u8> {
    edited_of(sound(Options::default()), edit)
}

fn edited_of(model: Vec<u8>, edit: impl FnOnce(&mut Vec<Loose>, &mut BTreeMap<String, String>)) -> Vec<u8> {
    let model = Container::from_bytes(model).expect("sound");
    let loose = |name: String| {
        let (dtype, shape, bytes) = model.tensor(&name).expect("a listed name");
        (name, dtype, shape[0], bytes.to_vec())
    };
    let mut tensors: Vec<Loose> = model.names().into_iter().map(loose).collect();
    let mut metadata = model.metadata().clone();
    edit(&mut tensors, &mut metadata);
    let directory = tempfile::tempdir().expect("a place");
    let path = directory.path().join("model");
    let tensors = tensors.iter().map(|(name, dtype, len, bytes)| Tensor {
        name: name.clone(),
        dtype: *dtype,
        shape: vec![*len],
        data: Data::Bytes(bytes),
    });
    container::write(&path, tensors.collect(), &metadata, Layout::Packed).expect("room");
    std::fs::read(&path).expect("what was just written")
}

fn refused(edit: impl FnOnce(&mut Vec<Loose>, &mut BTreeMap<String, String>), expected: &str) {
    let error = Model::from_bytes(edited(edit)).expect_err(expected);
    assert_eq!(error.kind(), ErrorKind::Format, "{error}");
    assert!(error.message().contains(expected), "{error} (expected {expected})");
}

#[test]
fn bytes_may_start_anywhere() {
    // In a static, as bytes that are built in.
    static SHIFTED: OnceLock<[Vec<u8>; 4]> = OnceLock::new();
    let file = sound(Options::default());
    let shifted = SHIFTED.get_or_init(|| [0, 1, 2, 3].map(|start| [&vec![0; start][..], &file].concat()));
    for (start, bytes) in shifted.iter().enumerate() {
        let model = Model::from_bytes(&bytes[start..]).unwrap_or_else(|e| panic!("from byte {start}: {e}"));
        assert_eq!(model.container.bytes(), file);
    }
}

#[test]
fn a_model_that_was_read_needs_no_file() {
    let directory = tempfile::tempdir().expect("a place");
    let path = directory.path().join("model");
    let file = sound(Options::default());
    std::fs::write(&path, &file).expect("room");
    let model = Model::read(&path).expect("sound");
    let cut = std::fs::OpenOptions::new().write(true).open(&path).and_then(|f| f.set_len(100));
    cut.expect("a file of our own");
    assert_eq!((model.container.bytes(), model.path()), (&file[..], Some(&*path)));
    for error in [Model::read(&path), Model::open(&path)].map(|again| again.expect_err("a cut file")) {
        assert_eq!((error.kind(), error.path()), (ErrorKind::Format, Some(&*path)));
    }
}

#[test]
fn models_say_what_they_are() {
    for precision in [Precision::F32, Precision::F16] {
        for rewrites in [
            Rewrites::ALL,
            Rewrites::NONE,
            Rewrites { projection: false, ..Rewrites::ALL },
            Rewrites { winograd: false, ..Rewrites::ALL },
        ] {
            let options = Options { precision, rewrites };
            let bytes = sound(options);
            let size = bytes.len();
            let model = Model::from_bytes(bytes).expect("sound");
            assert_eq!((model.options(), model.file_size(), model.path()), (options, size, None));
            assert_eq!(*model.network(), network());
            assert!(model.checksum().is_some());
            let found: Vec<String> = model.tensors().map(|(name, ..)| name).collect();
            let graphs = model.form.graphs().expect("sound");
            let expected = super::stored(&graphs).into_iter().flat_map(|(g, o)| {
                let operation = &graphs[g].operations[o];
                parts(&graphs[g], operation).into_iter().map(|part| format!("{}.{}", operation.name, part.suffix))
            });
            assert!(found.into_iter().eq(expected), "in this order");
            for unfolded in [false, true] {
                let graph = model.graph(unfolded, Results::ALL);
                for operation in &graph.operations {
                    let refs = model.part_refs(&graph, operation).expect("all are there");
                    let parts = parts(&graph, operation);
                    assert_eq!(refs.len(), parts.len());
                    for (found, part) in refs.iter().zip(&parts) {
                        let elements = model.resolve(found);
                        assert_eq!(elements.len(), part.len, "{}", operation.name);
                        assert_eq!(elements.element(), part.element(precision), "{}", operation.name);
                    }
                }
            }
        }
    }
    assert!(Model::from_bytes(edited(|_, _| ())).is_ok(), "the tests below spoil a sound model");
}

#[test]
fn metadata_that_is_wrong_is_named() {
    for key in ["format", "network", "precision", "batch_norm", "projection"] {
        refused(|_, m| drop(m.remove(key)), key);
    }
    let set = |key: &'static str, value: &'static str| {
        move |_: &mut Vec<Loose>, m: &mut BTreeMap<String, String>| drop(m.insert(key.to_owned(), value.to_owned()))
    };
    refused(set("format", "voxcast-model-2"), "found \"voxcast-model-2\", expected \"voxcast-model-1\"");
    refused(set("format", "pt"), "found \"pt\"");
    refused(set("precision", "f64"), "found \"f64\", expected f32, f16 or int8");
    refused(set("projection", "yes"), "found \"yes\", expected folded or kept");
    refused(set("winograd", "kept"), "found \"kept\", expected \"conv, deconv\" or no such key; import it anew");
    refused(set("batch_norm", "kept"), "the batch norms are not");
    refused(set("network", "{}"), "network JSON: missing field");
    let deeper = Network { depths: [2, 1, 1, 1], ..network() }.to_json();
    refused(
        |_, m| drop(m.insert("network".into(), deeper)),
        "tensor \"img_backbone.layer1.1.conv1.weight\" is missing",
    );
    let wider = Network { fpn: 6, ..network() }.to_json();
    refused(|_, m| drop(m.insert("network".into(), wider)), "img_neck.");
    refused(set("precision", "f16"), "expected F16 of shape");
}

#[test]
fn tensors_that_are_wrong_are_named() {
    refused(|t, _| drop(t.remove(3)), "is missing");
    refused(|t, _| t[3].0 = "x".into(), "is missing");
    refused(
        |t, _| {
            let (_, _, len, bytes) = &mut t[0];
            *len -= 16;
            bytes.truncate(*len * 4);
        },
        "tensor \"img_backbone.conv1.weight\": found F32 of shape",
    );
    refused(|t, _| t[1].1 = Dtype::U32, "found U32");
    // A tensor of the right size that starts between two numbers.
    refused(|t, _| t.insert(0, ("pad".into(), Dtype::U8, 2, vec![0; 2])), "not aligned");
    assert!(Model::from_bytes(edited(|t, _| t.push(("more".into(), Dtype::U8, 1, vec![0])))).is_ok());
}

#[test]
fn no_operation_has_more_parts_than_a_session_has_room_for() {
    for name in crate::network::BUILT_IN {
        let network = Network::built_in(name).expect("built in");
        let most = |graph: &Graph| {
            assert!(graph.operations.iter().flat_map(|o| parts(graph, o)).all(|part| part.len > 0));
            graph.operations.iter().map(|o| parts(graph, o).len()).max().expect("operations")
        };
        for rewrites in [Rewrites::ALL, Rewrites::NONE] {
            let graph = Graph::build(&network, Results::ALL).rewritten(rewrites);
            assert_eq!(most(&graph), 7);
            for operation in &graph.operations {
                let stores = !parts(&graph, operation).is_empty();
                assert_eq!(stores, operation.recipe != Recipe::None, "{}", operation.name);
            }
        }
        let graph = Graph::build(&network, Results::ALL).rewritten(Rewrites { winograd: false, ..Rewrites::ALL });
        let graph = graph.quantise(&[], &mut |_| Scale::of_range(1.0)).expect("scales for all");
        assert_eq!(most(&graph), MAX_PARTS);
    }
}

/// A network and an int8 model of it.
fn int8() -> (Network, Vec<u8>) {
    let network = small::suited(network(), Precision::I8);
    let bytes = small::model_bytes(&network, Precision::I8, Rewrites::ALL, 1);
    (network, bytes)
}

#[test]
fn int8_models_say_what_they_are() {
    let (network, bytes) = int8();
    assert_eq!(bytes, int8().1, "the same each time");
    let model = Model::from_bytes(bytes).expect("sound");
    assert_eq!((model.options().precision, model.network()), (Precision::I8, &network));
    let quantisation = model.quantisation().expect("int8");
    assert_eq!(quantisation.keep_f32, [""; 0]);
    let graph = model.graph(false, Results::ALL);
    assert_eq!(graph, model.graph(true, Results::ALL), "there is no other");
    let scaled = graph.tensors.iter().filter(|tensor| tensor.scale.is_some()).count();
    assert!(scaled > 60 && quantisation.scales.len() > 60, "{scaled}");
    assert!(small::model(&network, Precision::F32, Rewrites::ALL, 1).quantisation().is_none());
}

#[test]
fn what_kernels_take_for_granted_of_int8_is_checked() {
    let (_, bytes) = int8();
    let refused = |part: &str, change: &dyn Fn(&mut [u8]), expected: &str| {
        let edited = edited_of(bytes.clone(), |tensors, _| {
            let (.., data) = tensors.iter_mut().find(|(name, ..)| name == part).expect(part);
            change(data);
        });
        let error = Model::from_bytes(edited).expect_err(expected);
        assert_eq!(error.kind(), ErrorKind::Format, "{error}");
        assert!(error.message().contains(expected) && !error.message().contains('\n'), "{error} (expected {expected})");
    };
    let put = |value: i32| move |data: &mut [u8]| data[..4].copy_from_slice(&value.to_le_bytes());
    let conv = "img_backbone.layer1.0.conv1";
    let of = |part: &str| format!("{conv}.{part}");
    refused(&of("weight"), &|data| data[5] = 0x80, "conv1\": weight [5] is -128, expected -127 to 127");
    refused(&of("weight"), &|data| data[0] = data[0].wrapping_add(1) & 0x7f, "sums [0]: found");
    refused(&of("sums"), &|data| data[0] ^= 1, "sums [0]: found");
    refused(&of("pairs"), &|data| data[0] ^= 1, "pairs [0]: found");
    refused(&of("bias"), &put(i32::MAX), "column 0: its sum may reach");
    refused(&of("multiplier"), &put(-1), "multiplier: found -1, expected 0 to 2147483647");
    refused("img_backbone.layer1.0.conv3.residual", &put(1 << 30), "column 0: its sum may reach");
    refused("image.factors", &put(-1), "\"image\": factor: found -1");
    refused("image.offsets", &put(i32::MIN), "offset: found");
    refused("img_neck.sum.0.factors", &put(1 << 15), "factor: found 32768, expected 0 to 32767");
    let level = "view_transformer.imvts.0";
    refused(&format!("{level}.gather.volume.factor"), &put(i32::MAX), "factor: found");
    refused(&format!("{level}.gather.volume.bias"), &put(i32::MIN), "bias: found");
    refused(&format!("{level}.combine_coeff.weight"), &|data| data[1] = 0x80, "weight [1] is -128");
    refused(&format!("{level}.combine_coeff.logit"), &put(i32::MAX), "the logit's sum may reach");
    refused(&format!("{level}.combine_coeff.factors"), &put(-5), "factor: found -5");
    refused(&format!("{level}.bev_attn_layer.dw0.m.c.weight"), &|data| data[0] = 0x80, "weight [0] is -128");
    refused(&format!("{level}.bev_attn_layer.dw0.m.c.bias"), &put(i32::MIN), "channel 0: its sum may reach");
    refused(&format!("{level}.aspp_xy.aspp.convs.5.0.factor"), &put(-1), "factor: found -1");
    refused("view_transformer.up_sample1.0.sums", &|data| data[0] ^= 1, "sums [0]: found");
    refused("occ_head.mlp_occ_lvl0.1.weight", &|data| data[0] = 0x80, "layer 1: weight [0] is -128");
    refused("occ_head.mlp_occ_lvl0.2.scale", &put(0), "2.scale is 0e0, expected");
    let metadata = |key: &'static str, value: &'static str, expected: &str| {
        let edited = edited_of(bytes.clone(), |_, m| drop(m.insert(key.to_owned(), value.to_owned())));
        let error = Model::from_bytes(edited).expect_err(expected);
        assert_eq!(error.kind(), ErrorKind::Format);
        assert!(error.message().contains(expected), "{error} (expected {expected})");
    };
    metadata("scales", "{}", "tensor \"image\": its scale is missing");
    metadata("scales", "{\"image\":0}", "metadata key \"scales\"");
    metadata("scales", "[]", "metadata key \"scales\"");
    metadata("keep_f32", "[\"nothing\"]", "no operation \"nothing\"");
    metadata("keep_f32", "[\"img_backbone.layer1.0.conv1\"]", "expected F32");
    metadata("precision", "f32", "expected F32");
}

#[test]
fn int8_is_refused_where_it_cannot_be() {
    let (network, _) = int8();
    let options = Options { precision: Precision::I8, rewrites: Rewrites::ALL };
    let source = SeededWeights { seed: 1 };
    let error = import::import_to_bytes(&source, &network, options, &mut |_, _| ()).expect_err("no ranges");
    assert!(error.message().contains("int8 needs the ranges"), "{error}");
    let refused = |change: &dyn Fn(&mut Ranges), expected: &str| {
        let mut ranges = small::ranges(&network, Rewrites::ALL, 1);
        change(&mut ranges);
        let integers = import::Integers { rewrites: Rewrites::ALL, ranges: &ranges, keep_f32: &[] };
        let error = import::import_int8_to_bytes(&small::Near(small::Weights(1)), &network, &integers, &mut |_, _| ());
        let error = error.expect_err(expected);
        assert!(error.message().contains(expected) && !error.message().contains('\n'), "{error} (expected {expected})");
    };
    let conv = "img_backbone.layer1.0.conv1";
    refused(
        &|ranges| assert!(ranges.tensors.remove(conv).is_some()),
        "\"img_backbone.layer1.0.conv1\": the ranges lack it",
    );
    let set =
        |threshold: f64| move |ranges: &mut Ranges| ranges.tensors.get_mut(conv).expect("it").threshold = threshold;
    refused(&set(0.0), "its range is 0");
    refused(&set(f64::NAN), "range NaN");
    refused(&set(1e-43), "the scale underflows");
    let integers = import::Integers {
        rewrites: Rewrites::NONE,
        ranges: &small::ranges(&network, Rewrites::ALL, 1),
        keep_f32: &[],
    };
    let error = import::import_int8_to_bytes(&source, &network, &integers, &mut |_, _| ()).expect_err("batch norms");
    assert!(error.message().contains("folded batch norms"), "{error}");
}

#[test]
fn a_range_that_is_finer_than_its_sums_is_made_coarser() {
    let (network, _) = int8();
    let conv = "img_backbone.layer1.0.conv1";
    let scale = |threshold: Option<f64>| {
        let mut ranges = small::ranges(&network, Rewrites::ALL, 1);
        if let Some(threshold) = threshold {
            ranges.tensors.get_mut(conv).expect("it").threshold = threshold;
        }
        let integers = import::Integers { rewrites: Rewrites::ALL, ranges: &ranges, keep_f32: &[] };
        let source = small::Near(small::Weights(1));
        let bytes = import::import_int8_to_bytes(&source, &network, &integers, &mut |_, _| ()).expect("a model");
        let model = Model::from_bytes(bytes).expect("what was just written");
        model.quantisation().expect("int8").scales[conv].wide()
    };
    let [fine, finer] = [1e-9, 1e-12].map(|threshold| scale(Some(threshold)));
    assert_eq!(fine, finer, "what the weights give");
    assert!(fine > 1e-9 && fine < scale(None), "{fine:e}");
}

#[test]
fn a_model_gives_its_weights_back() {
    let network = network();
    for (precision, rewrites) in
        [(Precision::F32, Rewrites::ALL), (Precision::F16, Rewrites { projection: false, ..Rewrites::ALL })]
            .map(|(precision, rewrites)| (precision, Rewrites { winograd: false, ..rewrites }))
    {
        let model = small::model(&network, precision, rewrites, 1);
        let source = unpacked::Unpacked::new(&model).expect("floating point");
        let again = import::import_to_bytes(&source, &network, model.options(), &mut |_, _| ()).expect("all weights");
        let again = Model::from_bytes(again).expect("a model");
        for ((name, _, _, found), (expected_name, _, _, expected)) in again.contents().zip(model.contents()) {
            assert_eq!(name, expected_name);
            // Folded products of folded weights are rounded twice.
            if !name.contains(".projected.") {
                assert!(found == expected, "{name}");
            }
        }
    }
    let kept = small::model(&network, Precision::F32, Rewrites::NONE, 1);
    assert!(unpacked::Unpacked::new(&kept).is_err());
    assert!(unpacked::Unpacked::new(&Model::from_bytes(int8().1).expect("a model")).is_err());
}

#[test]
fn stored_sizes_of_known_operations() {
    let network = Network::built_in("nuscenes-200").expect("built in");
    let graph = |winograd| Graph::build(&network, Results::default()).rewritten(Rewrites { winograd, ..Rewrites::ALL });
    let (direct, filtered) = (graph(false), graph(true));
    let lens_in = |graph: &Graph, name: &str| {
        let operation = graph.operations.iter().find(|o| o.name == name).expect(name);
        parts(graph, operation).iter().map(|p| p.len).collect::<Vec<_>>()
    };
    let lens = |name: &str| lens_in(&direct, name);
    assert_eq!(lens("img_backbone.conv1"), [7 * 7 * 3 * 64, 64]);
    // 27 offsets and mask logits fill two panels of 16.
    assert_eq!(lens("img_backbone.layer3.0.conv2.conv_offset"), [9 * 256 * 32, 32]);
    // 64 channels for the volume and 64 for the plane.
    assert_eq!(lens("img_neck.fpn_convs.0.conv.projected"), [9 * 512 * 128, 128]);
    // Six by six points in place of nine taps; in a volume with three taps along z.
    assert_eq!(lens_in(&filtered, "img_neck.fpn_convs.0.conv.projected"), [36 * 512 * 128, 128]);
    assert_eq!(lens_in(&filtered, "view_transformer.refine_lvl0.0"), [36 * 3 * 32 * 32, 32]);
    assert_eq!(lens_in(&filtered, "img_backbone.conv1"), lens("img_backbone.conv1"));
    assert_eq!(lens("view_transformer.up_sample1.0"), [8 * 8 * 64 * 32, 32]);
    assert_eq!(lens("view_transformer.imvts.0.combine_coeff"), [64, 16]);
    // 17 classes fill two panels.
    assert_eq!(lens("occ_head.mlp_occ_lvl0"), [32 * 32, 32, 32 * 32, 32, 32 * 32, 32]);
}

#[test]
fn a_temperature_is_kept_and_a_wrong_one_refused() {
    use crate::graph::Temperature;
    let directory = tempfile::tempdir().expect("a place");
    let path = directory.path().join("model");
    let rewrites = Rewrites { winograd: false, ..Rewrites::ALL };
    let model = Model::from_bytes(sound(Options { rewrites, ..Options::default() })).expect("sound");
    assert_eq!(model.temperature(), Temperature::ONE);
    let warm: Temperature = "1.375".parse().expect("a temperature");
    model.save_with_temperature(warm, &path).expect("written");
    let found = Model::open(&path).expect("sound");
    assert_eq!(found.temperature(), warm);
    assert_ne!(found.checksum(), model.checksum(), "evaluations tell them apart");
    // A model that is made of it has it too.
    let source = unpacked::Unpacked::new(&found).expect("floating point");
    let half = Options { precision: Precision::F16, ..Options::default() };
    let bytes = import::import_to_bytes(&source, found.network(), half, &mut |_, _| ()).expect("a model");
    assert_eq!(Model::from_bytes(bytes).expect("sound").temperature(), warm);
    // One is no key at all: the same bytes as before.
    found.save_with_temperature(Temperature::ONE, &path).expect("written");
    assert_eq!(std::fs::read(&path).expect("a file"), model.bytes());
    for (text, expected) in [("warm", "expected a number"), ("0", "temperature 0e0"), ("-1", "expected a positive")] {
        let wrong = |_: &mut Vec<Loose>, metadata: &mut BTreeMap<String, String>| {
            metadata.insert("temperature".to_owned(), text.to_owned());
        };
        refused(wrong, "metadata key \"temperature\"");
        refused(wrong, expected);
    }
}

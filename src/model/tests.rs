//! Sound containers that are no sound models.

use super::*;
use crate::file::container;
use crate::graph::Recipe;
use crate::graph::parts::MAX_PARTS;
use crate::model::import::import;
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
    let model = Container::from_bytes(sound(Options::default())).expect("sound");
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
        for rewrites in [Rewrites::ALL, Rewrites::NONE, Rewrites { projection: false, ..Rewrites::ALL }] {
            let options = Options { precision, rewrites };
            let bytes = sound(options);
            let size = bytes.len();
            let model = Model::from_bytes(bytes).expect("sound");
            assert_eq!((model.options(), model.file_size(), model.path()), (options, size, None));
            assert_eq!(*model.network(), network());
            assert!(model.checksum().is_some());
            let stored: Vec<String> = model.tensors().map(|(name, ..)| name).collect();
            let graphs = model.form.graphs().expect("sound");
            let expected = stored(&graphs).into_iter().flat_map(|(g, o)| {
                let operation = &graphs[g].operations[o];
                parts(&graphs[g], operation).into_iter().map(|part| format!("{}.{}", operation.name, part.suffix))
            });
            assert!(stored.into_iter().eq(expected), "in this order");
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
        for rewrites in [Rewrites::ALL, Rewrites::NONE] {
            let graph = Graph::build(&network, Results::ALL).rewritten(rewrites);
            let counts: Vec<usize> = graph.operations.iter().map(|o| parts(&graph, o).len()).collect();
            assert_eq!(counts.iter().max(), Some(&MAX_PARTS));
            for operation in &graph.operations {
                let parts = parts(&graph, operation);
                assert_eq!(parts.is_empty(), operation.recipe == Recipe::None, "{}", operation.name);
                assert!(parts.iter().all(|p| p.len > 0), "{}", operation.name);
            }
        }
    }
}

#[test]
fn stored_sizes_of_known_operations() {
    let network = Network::built_in("nuscenes-200").expect("built in");
    let graph = Graph::build(&network, Results::default()).rewritten(Rewrites::ALL);
    let lens = |name: &str| {
        let operation = graph.operations.iter().find(|o| o.name == name).expect(name);
        parts(&graph, operation).iter().map(|p| p.len).collect::<Vec<_>>()
    };
    assert_eq!(lens("img_backbone.conv1"), [7 * 7 * 3 * 64, 64]);
    // 27 offsets and mask logits fill two panels of 16.
    assert_eq!(lens("img_backbone.layer3.0.conv2.conv_offset"), [9 * 256 * 32, 32]);
    // 64 channels for the volume and 64 for the plane.
    assert_eq!(lens("img_neck.fpn_convs.0.conv.projected"), [9 * 512 * 128, 128]);
    assert_eq!(lens("view_transformer.up_sample1.0"), [8 * 8 * 64 * 32, 32]);
    assert_eq!(lens("view_transformer.imvts.0.combine_coeff"), [64, 16]);
    // 17 classes fill two panels.
    assert_eq!(lens("occ_head.mlp_occ_lvl0"), [32 * 32, 32, 32 * 32, 32, 32 * 32, 32]);
}

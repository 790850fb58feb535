//! Sound containers that are no sound models.

use super::*;
use crate::file::container;
use crate::model::import::import;
use crate::model::seeded::SeededWeights;
use std::sync::OnceLock;

fn network() -> Network {
    Network {
        depths: [1; 4],
        width: 2,
        fpn: 4,
        channels: [3, 8, 8, 8],
        key_dims: [1; 3],
        image: [32, 32],
        grids: [[8, 4, 4], [4, 2, 2], [2, 1, 1]],
        ..Network::built_in("nuscenes-200").expect("built in")
    }
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
            let expected = stored_parts(&network(), rewrites).into_iter().map(|(name, _)| name);
            assert!(stored.into_iter().eq(expected), "in this order");
            for unfolded in [false, true] {
                let graph = model.graph(unfolded, true);
                for operation in &graph.operations {
                    let refs = model.part_refs(&graph, operation).expect("all are there");
                    let parts = parts(&graph, operation);
                    assert_eq!(refs.len(), parts.len());
                    for (found, part) in refs.iter().zip(&parts) {
                        assert_eq!(model.resolve(found).len(), part.len, "{}", operation.name);
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
    refused(set("precision", "f64"), "found \"f64\", expected f32 or f16");
    refused(set("projection", "yes"), "found \"yes\", expected folded or kept");
    refused(set("batch_norm", "kept"), "the batch norms are not");
    refused(set("network", "{}"), "network JSON: missing field");
    let deeper = Network { depths: [2, 1, 1, 1], ..network() }.to_json();
    refused(
        |_, m| drop(m.insert("network".into(), deeper)),
        "tensor \"img_backbone.layer1.1.conv1.weight\" is missing",
    );
    let wider = Network { fpn: 5, ..network() }.to_json();
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

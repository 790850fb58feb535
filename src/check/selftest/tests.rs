use super::*;
use crate::file::container::{self, Data, Tensor};
use crate::graph::Rewrites;
use crate::graph::parts::Precision;
use crate::model;
use crate::small;

fn recorded(precision: Precision) -> (tempfile::TempDir, std::path::PathBuf) {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("model");
    let network = small::suited(small::tiny(), precision);
    std::fs::write(&path, small::model_bytes(&network, precision, Rewrites::ALL, 1)).expect("a model");
    record(&path, Isa::best(), &Threads::calling()).expect("a self-test");
    (directory, path)
}

fn open(path: &Path) -> Arc<Model> {
    Arc::new(Model::open(path).expect("a model"))
}

/// Writes the model again with other metadata and other bytes of one tensor.
fn rewrite(path: &Path, edit: impl Fn(&mut SelfTest), tensor: &str, change: impl Fn(&mut [u8])) {
    let model = open(path);
    let mut metadata = model.metadata().clone();
    let mut test = model.self_test().expect("sound").expect("one");
    edit(&mut test);
    metadata.insert(KEY.to_owned(), serde_json::to_string(&test).expect("JSON"));
    let mut tensors = Vec::new();
    for (name, dtype, shape, bytes) in model.contents() {
        let mut bytes = bytes.to_vec();
        if name == tensor {
            change(&mut bytes);
        }
        let data = Data::Make(Box::new(move || Ok(bytes)));
        tensors.push(Tensor { name, dtype, shape: shape.to_vec(), data });
    }
    container::write(path, tensors, &metadata, model::LAYOUT).expect("written");
}

#[test]
fn a_sound_machine_passes_on_every_instruction_set_and_number_of_threads() {
    for precision in Precision::ALL {
        let (_directory, path) = recorded(precision);
        let model = open(&path);
        for isa in Isa::available() {
            for threads in [1, 3] {
                let report = run(&model, isa, &Threads::new(threads).expect("threads")).expect("a self-test");
                assert_eq!(report.fault, None, "{isa:?}");
                assert!(report.operations > 100, "{report:?}");
            }
        }
    }
}

#[test]
fn recording_twice_gives_the_same_bytes() {
    let (_directory, path) = recorded(Precision::F32);
    let first = std::fs::read(&path).expect("a file");
    record(&path, Isa::best(), &Threads::new(2).expect("threads")).expect("a self-test");
    assert!(std::fs::read(&path).expect("a file") == first);
    assert!(record_to_bytes(&open(&path), Isa::best(), &Threads::calling()).expect("a self-test") == first);
}

#[test]
fn wrong_weights_are_found_where_they_are() {
    let (_directory, path) = recorded(Precision::F32);
    let tensor = "view_transformer.imvts.1.down_conv3d.3.weight";
    // A single weight may meet nothing but zeros in so small a network.
    rewrite(&path, |_| (), tensor, |bytes| bytes.iter_mut().skip(2).step_by(4).for_each(|b| *b ^= 0x40));
    let report = run(&open(&path), Isa::best(), &Threads::calling()).expect("a self-test");
    let fault = report.fault.expect("a fault");
    assert_eq!(fault.operation, "view_transformer.imvts.1.down_conv3d.3");
    assert_eq!(fault.camera, None);
    assert_ne!(fault.expected, fault.found);
    assert!(fault.to_string().contains("down_conv3d.3"), "{fault}");
    let (_directory, path) = recorded(Precision::F32);
    rewrite(&path, |_| (), "img_backbone.conv1.weight", |bytes| bytes[2] ^= 0x40);
    let fault = run(&open(&path), Isa::best(), &Threads::calling()).expect("a self-test").fault.expect("a fault");
    assert_eq!((fault.operation.as_str(), fault.camera), ("img_backbone.conv1", Some(0)));
}

#[test]
fn a_wrong_integer_is_found_where_it_is() {
    let (_directory, path) = recorded(Precision::I8);
    rewrite(&path, |_| (), "img_backbone.conv1.multiplier", |bytes| bytes[2] ^= 0x40);
    let fault = run(&open(&path), Isa::best(), &Threads::calling()).expect("a self-test").fault.expect("a fault");
    assert_eq!((fault.operation.as_str(), fault.camera), ("img_backbone.conv1", Some(0)));
}

#[test]
fn wrong_digests_and_other_operations_are_found() {
    let (_directory, path) = recorded(Precision::F32);
    rewrite(&path, |test| test.classes = "0123456789abcdef".to_owned(), "", |_| ());
    let fault = run(&open(&path), Isa::best(), &Threads::calling()).expect("a self-test").fault.expect("a fault");
    assert_eq!((fault.operation.as_str(), fault.expected.as_str()), ("classes", "0123456789abcdef"));
    rewrite(&path, |test| test.operations.truncate(3), "", |_| ());
    let error = run(&open(&path), Isa::best(), &Threads::calling()).expect_err("three operations");
    assert_eq!(error.kind(), ErrorKind::Format);
}

#[test]
fn a_model_without_or_with_a_malformed_one_says_so() {
    let (directory, path) = recorded(Precision::F32);
    let plain = directory.path().join("plain");
    std::fs::write(&plain, small::model_bytes(&small::tiny(), Precision::F32, Rewrites::ALL, 1)).expect("a model");
    let error = run(&open(&plain), Isa::best(), &Threads::calling()).expect_err("none");
    assert_eq!(error.kind(), ErrorKind::Unsupported);
    let model = open(&path);
    let mut metadata = model.metadata().clone();
    metadata.insert(KEY.to_owned(), "{\"seed\": -1}".to_owned());
    model.save_with(&plain, &metadata).expect("written");
    let error = run(&open(&plain), Isa::best(), &Threads::calling()).expect_err("malformed");
    assert!(error.kind() == ErrorKind::Format && error.to_string().contains("self_test"), "{error}");
}

use super::*;
use crate::file::container::{Data, Layout, Tensor, write};
use crate::synth::set_file;
use std::collections::BTreeMap;

/// The smallest set: two cameras of 32 x 32, a grid of 8 x 8 x 8.
fn network() -> Network {
    let edge = Network::built_in("edge").expect("built in");
    Network { image: [32, 32], cameras: 2, grids: [[4, 4, 4], [2, 2, 2], [1, 1, 1]], ..edge }
}

/// Writes a frame without the program that usually does.
fn save(directory: &Path, seed: u64, labels: Vec<u8>, visible: &[u8]) {
    let images: Vec<u8> = (0..2 * 32 * 32 * 3).map(|i| (i * 7 + seed as usize) as u8).collect();
    // Unit matrices with shifts that tell them apart.
    let entry = |i: u16| match i % 16 {
        0 | 5 | 10 | 15 => 1,
        3 | 7 | 11 => i,
        _ => 0,
    };
    let matrices: Vec<u8> = (0..32u16).flat_map(|i| f32::from(entry(i)).to_le_bytes()).collect();
    let tensor = |name: &str, dtype, shape: &[usize], bytes: Vec<u8>| Tensor {
        name: name.to_owned(),
        dtype,
        shape: shape.to_vec(),
        data: Data::Make(Box::new(move || Ok(bytes))),
    };
    let tensors = vec![
        tensor("images", Dtype::U8, &[2, 32, 32, 3], images),
        tensor("lidar2img", Dtype::F32, &[2, 4, 4], matrices),
        tensor("labels", Dtype::U8, &[8, 8, labels.len() / 64], labels),
        tensor("visible", Dtype::U8, &[8, 8, 8], visible.to_vec()),
    ];
    write(&directory.join(set_file(seed)), tensors, &BTreeMap::new(), Layout::Packed).expect("written");
}

fn set_json(directory: &Path, format: &str) {
    let network: serde_json::Value = serde_json::from_str(&network().to_json()).expect("JSON");
    let set = serde_json::json!({ "format": format, "classes": CLASSES, "network": network });
    std::fs::write(directory.join("set.json"), set.to_string()).expect("written");
}

#[test]
fn frames_come_in_order_with_labels_and_images() {
    let directory = tempfile::tempdir().expect("a directory");
    set_json(directory.path(), "voxcast-synth-1");
    let labels = |seed: usize| (0..512).map(|i| ((i + seed) % 17) as u8).collect::<Vec<u8>>();
    let visible: Vec<u8> = (0..512).map(|i| (i % 2) as u8).collect();
    for seed in [12, 7] {
        save(directory.path(), seed, labels(seed as usize), &visible);
    }
    std::fs::write(directory.path().join(".000000003.safetensors.1-0.tmp"), "half").expect("written");
    let set = Synthetic::open(directory.path()).expect("a set");
    assert_eq!((set.len(), set.id(0), set.id(1)), (2, "000000007", "000000012"));
    assert_eq!((set.grid().size, set.masks()), ([8, 8, 8], &["visible"][..]));
    let frame = set.frame(1).expect("a frame");
    assert_eq!((frame.truth.labels, &frame.truth.masks[0]), (labels(12), &visible));
    assert_eq!(frame.scene.cameras(), 2);
    assert_eq!((frame.scene.images[1].bgr[0], frame.scene.lidar2img[1][3]), ((3072 * 7 + 12) as u8, 19.0));
    assert_eq!(set.truth(0).expect("labels").labels, labels(7));
}

#[test]
fn what_is_no_set_is_refused_with_its_file() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path();
    let refused = |expected: &str| {
        let error = Synthetic::open(path).expect_err(expected);
        assert!(error.to_string().contains(expected), "{error}");
    };
    refused("set.json: there is none, expected the directory of a set that synth --set wrote");
    set_json(path, "voxcast-synth-9");
    refused("found \"voxcast-synth-9\", expected \"voxcast-synth-1\"");
    set_json(path, "voxcast-synth-1");
    refused("no frames");
    save(path, 1, vec![17; 512], &[0; 512]);
    save(path, 2, vec![0; 256], &[0; 512]);
    let set = Synthetic::open(path).expect("a set");
    for (index, expected) in [(0, "voxel 0 has label 17, expected 0 to 16 or 255"), (1, "shape [8, 8, 4]")] {
        let error = set.truth(index).expect_err(expected);
        let file = path.join(set_file(index as u64 + 1));
        assert!(error.path() == Some(&file) && error.message().contains(expected), "{error}");
    }
}

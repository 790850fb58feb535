//! Any bytes as UniOcc's list of scenes, and as the cameras of a frame: an error, or frames that lie below the set.

#![no_main]

use libfuzzer_sys::fuzz_target;
use std::fs;
use std::io::{Cursor, Write};
use std::path::{Component, Path};
use voxcast::dataset::{DataSet, UniOcc};
use voxcast_fuzz::scratch_file;
use zip::ZipWriter;
use zip::write::SimpleFileOptions;

/// `[{"occ_in_scene_paths": ["a.npz"]}]`.
const LIST: &[u8] = b"\x80\x04](}(\x8c\x12occ_in_scene_paths](\x8c\x05a.npzeue.";

/// A frame whose cameras are the pickle `bytes`.
fn frame(bytes: &[u8]) -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(vec![]));
    zip.start_file("cameras.npy", SimpleFileOptions::default()).expect("an entry");
    let literal = "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }\n";
    let header = [b"\x93NUMPY\x01\x00", &(literal.len() as u16).to_le_bytes()[..], literal.as_bytes()].concat();
    zip.write_all(&header).and_then(|()| zip.write_all(bytes)).expect("memory to write to");
    zip.finish().expect("memory to write to").into_inner()
}

fuzz_target!(|bytes: &[u8]| {
    let root = scratch_file("uniocc");
    fs::create_dir_all(&root).expect("room for a directory");
    let list = root.join("scene_infos.pkl");
    fs::write(&list, bytes).expect("room for a small file");
    if let Ok(set) = UniOcc::open(&root, &root) {
        for index in 0..set.len() {
            let below = |part| matches!(part, Component::Normal(_));
            assert!(Path::new(set.id(index)).components().all(below), "{:?}", set.id(index));
        }
    }
    fs::write(&list, LIST).expect("room for a small file");
    fs::write(root.join("a.npz"), frame(bytes)).expect("room for a small file");
    let set = UniOcc::open(&root, &root).expect("a sound list");
    // There are no images, so that the last thing that can be right is the calibration.
    assert!(set.scene(0).is_err());
});

//! Any bytes as a scene of tensors: an error, or images and matrices that fit each other.
//!
//! Bytes that begin a header are also tried with as much data behind it as it asks for.

#![no_main]

use libfuzzer_sys::fuzz_target;
use voxcast::Scene;
use voxcast::scene::{MAX_CAMERAS, MAX_SIDE};
use voxcast_fuzz::data_len;

/// Bytes of images to make up for one input.
const MAX_DATA: usize = 1 << 20;

fn read(bytes: &[u8]) {
    let Ok(scene) = Scene::from_safetensors(bytes) else { return };
    assert!((1..=MAX_CAMERAS).contains(&scene.cameras()));
    assert_eq!([scene.names.len(), scene.lidar2img.len()], [scene.cameras(); 2]);
    for image in &scene.images {
        assert!((1..=MAX_SIDE).contains(&image.height) && (1..=MAX_SIDE).contains(&image.width));
        assert_eq!(image.bgr.len(), image.height * image.width * 3);
    }
    assert!(scene.lidar2img.iter().flatten().all(|v| v.is_finite()));
    // Either answer will do.
    drop(scene.check(&voxcast_fuzz::network()));
}

fuzz_target!(|bytes: &[u8]| {
    read(bytes);
    let len = data_len(bytes);
    if bytes.starts_with(b"{") && len <= MAX_DATA {
        read(&[&(bytes.len() as u64).to_le_bytes()[..], bytes, &vec![0x3f; len]].concat());
    }
});

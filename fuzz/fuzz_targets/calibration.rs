//! Any text as a calibration: an error, or cameras within bounds.

#![no_main]

use libfuzzer_sys::fuzz_target;
use std::path::{Component, Path};
use voxcast::camera::read_calibration;

fuzz_target!(|bytes: &[u8]| {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let Ok(cameras) = read_calibration(text) else { return };
    assert!(!cameras.is_empty());
    for camera in cameras {
        assert!((1..=65_536).contains(&camera.width) && (1..=65_536).contains(&camera.height));
        assert!(camera.lidar2img.iter().all(|v| v.is_finite()));
        assert!(!Path::new(&camera.file).components().any(|c| matches!(c, Component::ParentDir | Component::RootDir)));
    }
});

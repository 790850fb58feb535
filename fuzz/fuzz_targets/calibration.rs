//! Any text as a calibration: an error, or cameras within bounds whose matrices are what they are called.

#![no_main]

use libfuzzer_sys::fuzz_target;
use std::path::{Component, Path};
use voxcast::camera::read_calibration_with_notes;

fuzz_target!(|bytes: &[u8]| {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let Ok((cameras, notes)) = read_calibration_with_notes(text) else { return };
    assert!(notes.iter().all(|note| !note.message().contains('\n')), "{notes:?}");
    assert!(!cameras.is_empty());
    for camera in cameras {
        assert!((1..=65_536).contains(&camera.width) && (1..=65_536).contains(&camera.height));
        let m = camera.lidar2img;
        assert!(m.iter().all(|v| v.is_finite()));
        let last = [m[12], m[13], m[14], m[15] - 1.0];
        assert!(last.iter().all(|v| v.abs() <= 2e-6), "{last:?}");
        assert!(!Path::new(&camera.file).components().any(|c| matches!(c, Component::ParentDir | Component::RootDir)));
    }
});

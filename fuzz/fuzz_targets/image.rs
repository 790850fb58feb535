//! Any bytes as an image file of a scene: an error, or pixels of the size that the calibration states.
//!
//! The first two bytes are that size.

#![no_main]

use libfuzzer_sys::fuzz_target;
use std::path::PathBuf;
use std::sync::OnceLock;
use voxcast::Scene;

/// A directory of this process, in memory where there is one.
fn directory() -> &'static PathBuf {
    static DIRECTORY: OnceLock<PathBuf> = OnceLock::new();
    DIRECTORY.get_or_init(|| {
        let memory = PathBuf::from("/dev/shm");
        let base = if memory.is_dir() { memory } else { std::env::temp_dir() };
        let directory = base.join(format!("voxcast-fuzz-image-{}", std::process::id()));
        std::fs::create_dir_all(&directory).expect("room for a directory");
        directory
    })
}

fuzz_target!(|bytes: &[u8]| {
    let Some((&[width, height], file)) = bytes.split_first_chunk() else { return };
    let calibration = format!(
        r#"{{"cameras":[{{"name":"a","file":"a","width":{width},"height":{height},
            "lidar2img":[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}}]}}"#
    );
    std::fs::write(directory().join("calibration.json"), calibration).expect("room for a small file");
    std::fs::write(directory().join("a"), file).expect("room for a small file");
    if let Ok(scene) = Scene::open(directory()) {
        let image = &scene.images[0];
        assert_eq!([image.width, image.height], [width, height].map(usize::from));
        assert_eq!(image.bgr.len(), image.width * image.height * 3);
    }
});

use super::*;
use safetensors::tensor::TensorView;

fn tensors(images: (Dtype, &[usize]), matrices: (Dtype, &[usize]), first: f32) -> Vec<u8> {
    let size = |(dtype, shape): (Dtype, &[usize])| shape.iter().product::<usize>() * dtype.bitsize() / 8;
    let pixels: Vec<u8> = (0..size(images)).map(|i| i as u8).collect();
    let mut entries: Vec<u8> = first.to_le_bytes().to_vec();
    entries.resize(size(matrices), 0);
    let views = [
        ("images", TensorView::new(images.0, images.1.to_vec(), &pixels).unwrap()),
        ("lidar2img", TensorView::new(matrices.0, matrices.1.to_vec(), &entries).unwrap()),
    ];
    safetensors::serialize(views, None).unwrap()
}

fn sample() -> Vec<u8> {
    tensors((Dtype::U8, &[2, 3, 5, 3]), (Dtype::F32, &[2, 4, 4]), 1.5)
}

#[test]
fn safetensors_scene_keeps_order_and_bits() {
    let scene = Scene::from_safetensors(&sample()).unwrap();
    assert_eq!((scene.cameras(), scene.images[1].height, scene.images[1].width), (2, 3, 5));
    assert_eq!(scene.images[1].bgr, (45..90).collect::<Vec<u8>>());
    assert_eq!((scene.lidar2img[0][0], scene.lidar2img[0][1]), (1.5, 0.0));
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scene.safetensors");
    std::fs::write(&path, sample()).unwrap();
    assert_eq!(Scene::open(&path).unwrap(), scene);
}

#[test]
fn malformed_safetensors_say_what_is_wrong() {
    for (bytes, expected) in [
        (
            tensors((Dtype::U8, &[2, 3, 5, 4]), (Dtype::F32, &[2, 4, 4]), 0.0),
            "shape [2, 3, 5, 4], expected [N, H, W, 3]",
        ),
        (tensors((Dtype::U8, &[2, 3, 5, 3]), (Dtype::F32, &[3, 4, 4]), 0.0), "expected [2, 4, 4]"),
        (tensors((Dtype::F32, &[2, 3, 5, 3]), (Dtype::F32, &[2, 4, 4]), 0.0), "is F32, expected u8"),
        (tensors((Dtype::U8, &[2, 3, 5, 3]), (Dtype::F16, &[2, 4, 4]), 0.0), "is F16, expected f32"),
        (tensors((Dtype::U8, &[0, 3, 5, 3]), (Dtype::F32, &[0, 4, 4]), 0.0), "0 cameras, expected 1 to 64"),
        (tensors((Dtype::U8, &[65, 1, 1, 3]), (Dtype::F32, &[65, 4, 4]), 0.0), "65 cameras"),
        (tensors((Dtype::U8, &[1, 0, 5, 3]), (Dtype::F32, &[1, 4, 4]), 0.0), "at least one pixel"),
        (tensors((Dtype::U8, &[1, 1, 16385, 3]), (Dtype::F32, &[1, 4, 4]), 0.0), "sides up to 16384"),
        (tensors((Dtype::U8, &[1, 1, 1, 3]), (Dtype::F32, &[1, 4, 4]), f32::NAN), "lidar2img[0][0] is NaN"),
        (tensors((Dtype::U8, &[1, 1, 1, 3]), (Dtype::F32, &[1, 4, 4]), f32::INFINITY), "is inf"),
    ] {
        let error = Scene::from_safetensors(&bytes).unwrap_err();
        assert!(error.message().contains(expected), "{error} does not say {expected:?}");
    }
    let bytes = sample();
    for length in 0..bytes.len() {
        assert!(Scene::from_safetensors(&bytes[..length]).is_err(), "{length} bytes were accepted");
    }
}

#[test]
fn forward_follows_the_data_set() {
    assert_eq!(forward_of(&[[-50.0, 50.0], [-50.0, 50.0], [-5.0, 3.0]]), [0.0, 1.0]);
    assert_eq!(forward_of(&[[0.0, 51.2], [-25.6, 25.6], [-2.0, 4.4]]), [1.0, 0.0]);
}

#[test]
fn missing_file_is_named() {
    let error = Scene::open(Path::new("/no/such/scene.safetensors")).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::Io);
    assert!(error.to_string().starts_with("/no/such/scene.safetensors: cannot open"), "{error}");
}

#[cfg(feature = "images")]
mod directory {
    use super::*;
    use std::fs;

    fn scene() -> Scene {
        let mut scene = Scene::from_safetensors(&sample()).unwrap();
        scene.names = vec!["CAM_FRONT".into(), "rück/seite".into()];
        scene.lidar2img[1] = std::array::from_fn(|i| 0.1 * i as f32 - 1.0 / 3.0);
        scene
    }

    fn saved() -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        scene().save(&dir.path().join("deep/scene")).unwrap();
        dir
    }

    /// What opening says after `from` became `to` in the calibration.
    fn edited(from: &str, to: &str) -> Error {
        let dir = saved();
        let path = dir.path().join("deep/scene/calibration.json");
        let text = fs::read_to_string(&path).unwrap();
        assert!(text.contains(from), "{text} has no {from}");
        fs::write(&path, text.replacen(from, to, 1)).unwrap();
        Scene::open(&dir.path().join("deep/scene")).unwrap_err()
    }

    #[test]
    fn saved_scene_opens_to_the_same_bits() {
        let dir = saved();
        assert_eq!(Scene::open(&dir.path().join("deep/scene")).unwrap(), scene());
        let mut files: Vec<_> =
            fs::read_dir(dir.path().join("deep/scene")).unwrap().map(|f| f.unwrap().file_name()).collect();
        files.sort();
        assert_eq!(files, ["CAM_FRONT.png", "calibration.json", "r_ck_seite.png"]);
    }

    #[test]
    fn names_that_collide_get_files_of_their_own() {
        let mut scene = scene();
        scene.names = vec!["01_a".into(), "A".into()];
        scene.images.push(scene.images[0].clone());
        scene.names.push("a".into());
        scene.lidar2img.push([0.5; 16]);
        let dir = tempfile::tempdir().unwrap();
        scene.save(dir.path()).unwrap();
        assert_eq!(Scene::open(dir.path()).unwrap(), scene);
    }

    #[test]
    fn calibration_that_does_not_fit_is_refused() {
        let error = edited("\"width\":5", "\"width\":6");
        assert_eq!(error.kind(), ErrorKind::Mismatch);
        assert!(error.path().unwrap().ends_with("CAM_FRONT.png"));
        assert!(error.message().contains("image of 3x5, the calibration expects 3x6"), "{error}");
        for name in ["../CAM_FRONT.png", "/etc/passwd", "."] {
            let error = edited("\"CAM_FRONT.png\"", &format!("{name:?}"));
            assert!(error.message().contains("expected a path inside the"), "{error}");
        }
        let error = edited("\"CAM_FRONT.png\"", "\"\"");
        assert!(error.message().contains("\"file\" is an empty string"), "{error}");
        let error = edited("\"CAM_FRONT.png\"", "\"none.png\"");
        assert_eq!(error.kind(), ErrorKind::Io);
        assert!(error.path().unwrap().ends_with("none.png") && error.message().contains("CAM_FRONT"), "{error}");
        assert_eq!(edited("\"CAM_FRONT.png\"", "\"calibration.json\"").kind(), ErrorKind::Format);
    }

    #[test]
    fn broken_images_are_refused() {
        let dir = saved();
        let scene = dir.path().join("deep/scene");
        let path = scene.join("CAM_FRONT.png");
        let bytes = fs::read(&path).unwrap();
        for length in 0..bytes.len() - 12 {
            // The last twelve bytes are the end marker, which decoders do not need.
            fs::write(&path, &bytes[..length]).unwrap();
            let error = Scene::open(&scene).unwrap_err();
            assert!(error.path() == Some(&path) && error.message().contains("CAM_FRONT"), "{length}: {error}");
        }
    }

    #[test]
    fn header_that_claims_more_than_the_file_can_hold_is_refused_early() {
        let dir = saved();
        let scene = dir.path().join("deep/scene");
        let path = scene.join("CAM_FRONT.png");
        let text = fs::read_to_string(scene.join("calibration.json")).unwrap();
        fs::write(
            scene.join("calibration.json"),
            text.replace("\"width\":5", "\"width\":16000").replace("\"height\":3", "\"height\":16000"),
        )
        .unwrap();
        for (side, expected) in [(16_000u32, "expected more bytes"), (1 << 24, "")] {
            let mut bytes = fs::read(&path).unwrap();
            bytes[16..20].copy_from_slice(&side.to_be_bytes());
            bytes[20..24].copy_from_slice(&side.to_be_bytes());
            let checksum = crc32(&bytes[12..29]);
            bytes[29..33].copy_from_slice(&checksum.to_be_bytes());
            fs::write(&path, bytes).unwrap();
            let error = Scene::open(&scene).unwrap_err();
            assert!(error.message().contains(expected), "{error}");
        }
    }

    /// A JPEG that is cut into blocks in a way that its decoder did not expect: progressive, with a third component
    /// four times as wide as the second.
    #[test]
    fn decoder_that_panics_is_an_error_of_the_image() {
        let dir = saved();
        let scene = dir.path().join("deep/scene");
        let path = scene.join("CAM_FRONT.png");
        let mut bytes = Vec::new();
        let pixels: Vec<u8> = (0..9 * 7 * 3).map(|i| (i * 37 % 251) as u8).collect();
        let encoder = image::codecs::jpeg::JpegEncoder::new(&mut bytes);
        image::ImageEncoder::write_image(encoder, &pixels, 9, 7, image::ExtendedColorType::Rgb8).unwrap();
        let frame = bytes.windows(2).position(|marker| marker == [0xff, 0xc0]).unwrap();
        bytes[frame + 1] = 0xc2;
        for (component, sampling) in [0x21, 0x11, 0x42].into_iter().enumerate() {
            bytes[frame + 11 + 3 * component] = sampling;
        }
        fs::write(&path, bytes).unwrap();
        let text = fs::read_to_string(scene.join("calibration.json")).unwrap();
        let text = text.replacen("\"width\":5", "\"width\":9", 1).replacen("\"height\":3", "\"height\":7", 1);
        fs::write(scene.join("calibration.json"), text).unwrap();
        let error = Scene::open(&scene).unwrap_err();
        assert!(error.path() == Some(&path) && error.message().contains("CAM_FRONT"), "{error}");
    }

    fn crc32(bytes: &[u8]) -> u32 {
        !bytes.iter().fold(!0u32, |crc, &b| {
            (0..8).fold(crc ^ u32::from(b), |c, _| if c & 1 == 1 { (c >> 1) ^ 0xedb8_8320 } else { c >> 1 })
        })
    }
}

use super::*;
use crate::ErrorKind;
use safetensors::tensor::TensorView;

fn tensors(images: (Dtype, &[usize]), matrices: (Dtype, &[usize]), first: f32) -> Vec<u8> {
    let size = |(dtype, shape): (Dtype, &[usize])| shape.iter().product::<usize>() * dtype.bitsize() / 8;
    let pixels: Vec<u8> = (0..size(images)).map(|i| i as u8).collect();
    // Unit matrices, but for the first element.
    let unit = |i: usize| if i == 0 { first } else { f32::from(u8::from((i % 16).is_multiple_of(5))) };
    let mut entries: Vec<u8> = (0..size(matrices) / 4).flat_map(|i| unit(i).to_le_bytes()).collect();
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
        (tensors((Dtype::U8, &[1, 1, 1, 3]), (Dtype::F32, &[1, 4, 4]), 0.0), "camera 0: lidar2img is singular"),
    ] {
        let error = Scene::from_safetensors(&bytes).unwrap_err();
        assert!(error.message().contains(expected), "{error} does not say {expected:?}");
    }
    let bytes = sample();
    for length in 0..bytes.len() {
        assert!(Scene::from_safetensors(&bytes[..length]).is_err(), "{length} bytes were accepted");
    }
}

/// A scene file of one pixel with more tensors beside its two, and the last column of its matrix.
fn with(more: &[&str], column: [f32; 4]) -> Vec<u8> {
    let matrix = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0; 3]];
    let matrix: Vec<u8> = matrix
        .iter()
        .zip(column)
        .flat_map(|(row, last)| row.iter().copied().chain([last]))
        .flat_map(f32::to_le_bytes)
        .collect();
    let view = |dtype, shape: &[usize], data| TensorView::new(dtype, shape.to_vec(), data).unwrap();
    let mut views = vec![
        ("images", view(Dtype::U8, &[1, 1, 1, 3], &[1, 2, 3][..])),
        ("lidar2img", view(Dtype::F32, &[1, 4, 4], &matrix)),
    ];
    views.extend(more.iter().map(|name| (*name, view(Dtype::U8, &[1], &[7][..]))));
    safetensors::serialize(views, None).unwrap()
}

#[test]
fn tensors_that_are_not_used_are_noted() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scene.safetensors");
    for (more, expected) in [
        (&[][..], None),
        (&["labels", "visible", "pixel.depth"], None),
        (&["img_aug_matrix", "cam_intrinsic"], Some("not used: \"cam_intrinsic\", \"img_aug_matrix\"")),
        (&["Images"], Some("not used: \"Images\"")),
    ] {
        std::fs::write(&path, with(more, [0.0, 0.0, 0.0, 1.0])).unwrap();
        let (_, notes) = Scene::open_with_notes(&path).unwrap();
        assert_eq!(notes.len(), usize::from(expected.is_some()), "{notes:?}");
        let said = notes.first().map(ToString::to_string).unwrap_or_default();
        assert!(said.contains(expected.unwrap_or_default()), "{said}");
        assert!(notes.iter().all(|note| note.path() == Some(&path)));
    }
    for (column, expected) in [
        ([1.0, 2.0, 3.0, 0.0], "in row 3, expected [0, 0, 0, 1]"),
        ([0.0, 0.0, 0.0, 1.5], "in row 3"),
        ([0.0, 0.0, 0.0, f32::NAN], "lidar2img[3][3] is NaN"),
    ] {
        let error = Scene::from_safetensors(&with(&[], column)).expect_err(expected);
        assert!(error.message().contains(expected), "{error}");
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
        scene.lidar2img[1][..12].copy_from_slice(&[
            0.1,
            -1.0 / 3.0,
            0.7,
            5.0,
            0.3,
            2.0,
            0.25,
            -1.0,
            0.5,
            0.125,
            1.0,
            9.0,
        ]);
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
        scene.lidar2img.push(scene.lidar2img[1]);
        let dir = tempfile::tempdir().unwrap();
        scene.save(dir.path()).unwrap();
        assert_eq!(Scene::open(dir.path()).unwrap(), scene);
    }

    #[test]
    fn calibration_that_does_not_fit_is_refused() {
        let error = edited("\"width\":5", "\"width\":6");
        assert_eq!(error.kind(), ErrorKind::Mismatch);
        assert!(error.path().unwrap().ends_with("CAM_FRONT.png"));
        assert!(error.message().contains("CAM_FRONT: 3x5, the calibration expects 3x6"), "{error}");
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
        for length in 0..bytes.len() {
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

    fn crc32(bytes: &[u8]) -> u32 {
        !bytes.iter().fold(!0u32, |crc, &b| {
            (0..8).fold(crc ^ u32::from(b), |c, _| if c & 1 == 1 { (c >> 1) ^ 0xedb8_8320 } else { c >> 1 })
        })
    }
}

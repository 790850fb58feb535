//! Logs in Foxglove's messages by other programs.

use super::super::schema;
use super::*;

#[test]
fn foxglove_messages_of_others() {
    let mut recorder = Recorder::new(Some(Compression::Zstd));
    let transform = |child: &str| schema::FrameTransform {
        parent_frame_id: "base".into(),
        child_frame_id: child.into(),
        ..schema::FrameTransform::default()
    };
    let transforms = ["a", "b", "LIDAR_TOP"].map(transform).to_vec();
    recorder.foxglove("/tf", &schema::FrameTransforms { transforms });
    for name in ["a", "b"] {
        recorder.foxglove(
            &format!("/{name}/camera_info"),
            &schema::CameraCalibration {
                k: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
                frame_id: name.into(),
                ..Default::default()
            },
        );
        let (encoding, bytes) = if name == "a" { ("mono8", 1) } else { ("rgba8", 4) };
        recorder.foxglove(
            &format!("/{name}/image_raw"),
            &schema::RawImage {
                width: 64,
                height: 32,
                encoding: encoding.into(),
                step: 64 * bytes,
                data: (0..64 * 32 * bytes).map(|i| i as u8).collect(),
                ..Default::default()
            },
        );
    }
    let bytes = recorder.finish();
    let mut replay = replay(&bytes).expect("a log");
    assert_eq!((replay.summary().frame.as_str(), replay.len()), ("LIDAR_TOP", 1));
    let frame = replay.frame(0).expect("a frame");
    assert_eq!(frame.scene.images[0].bgr[3..6], [1, 1, 1]);
    assert_eq!(frame.scene.images[1].bgr[..6], [2, 1, 0, 6, 5, 4]);
    assert_eq!(frame.scene.lidar2img[0][..4], [1.0, 0.0, 0.0, 0.0]);
}

/// A log of two cameras with the camera matrix `k` and the image file `file`, at one moment.
fn plain(k: [f64; 9], file: &[u8]) -> Vec<u8> {
    let mut recorder = Recorder::new(None);
    let transform = |child: &str| schema::FrameTransform {
        parent_frame_id: "base".into(),
        child_frame_id: child.into(),
        ..schema::FrameTransform::default()
    };
    let transforms = ["a", "b", "lidar"].map(transform).to_vec();
    recorder.foxglove("/tf", &schema::FrameTransforms { transforms });
    for name in ["a", "b"] {
        let calibration =
            schema::CameraCalibration { k: k.to_vec(), frame_id: name.into(), ..schema::CameraCalibration::default() };
        recorder.foxglove(&format!("/{name}/camera_info"), &calibration);
        let image = schema::CompressedImage { data: file.to_vec(), ..schema::CompressedImage::default() };
        recorder.foxglove(&format!("/{name}/image"), &image);
    }
    recorder.finish()
}

#[test]
fn images_and_matrices_are_checked_as_those_of_scenes() {
    const K: [f64; 9] = [50.0, 0.0, 31.5, 0.0, 50.0, 15.5, 0.0, 0.0, 1.0];
    let file = Encoded::png(&scene(1).images[0]).expect("a PNG").bytes;
    let whole = |k| replay(&plain(k, &file)).and_then(|mut replay| replay.frame(0));
    let frame = whole(K).expect("a frame");
    assert!(frame.notes.is_empty() && frame.scene.images[0] == scene(1).images[0]);
    assert_eq!(whole(K.map(|v| 2.0 * v)).expect("a frame").scene.images, frame.scene.images);
    for (at, value, expected) in [
        (
            0,
            -50.0,
            "topic /a/camera_info: camera matrix with -50 in row 0, column 0, expected focal lengths greater than 0",
        ),
        (3, 1.0, "topic /a/camera_info: camera matrix with 1 in row 1, column 0"),
        (8, 0.0, "topic /a/camera_info: camera matrix with 0 in row 2, column 2"),
    ] {
        let mut k = K;
        k[at] = value;
        let error = whole(k).expect_err(expected);
        assert!(error.message().contains(expected), "{error}");
    }
    // Behind the header, which is 33 bytes long, a gamma that is not sRGB's.
    let chunk = [&b"gAMA"[..], &100_000u32.to_be_bytes()].concat();
    let chunk = [&4u32.to_be_bytes()[..], &chunk, &crc32fast::hash(&chunk).to_be_bytes()].concat();
    let frame = replay(&plain(K, &[&file[..33], &chunk, &file[33..]].concat())).and_then(|mut r| r.frame(0));
    let notes: Vec<String> = frame.expect("a frame").notes.iter().map(ToString::to_string).collect();
    assert!(
        notes.len() == 2 && notes[0].starts_with("image of camera a: its colour profile is not applied"),
        "{notes:?}"
    );
    // Without its end.
    let error = replay(&plain(K, &file[..file.len() - 12])).and_then(|mut r| r.frame(0)).unwrap_err();
    assert!(error.message().contains("s: image of camera a: PNG: "), "{error}");
}

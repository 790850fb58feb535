//! ROS 2 bags.

use super::super::schema;
use super::*;
use crate::scene::Image;

/// What ROS 2 writes.
struct Cdr(Vec<u8>);

impl Cdr {
    fn new() -> Self {
        Self(vec![0, 1, 0, 0])
    }

    fn align(mut self, to: usize) -> Self {
        while !(self.0.len() - 4).is_multiple_of(to) {
            self.0.push(0);
        }
        self
    }

    fn u32(self, value: u32) -> Self {
        let mut out = self.align(4);
        out.0.extend(value.to_le_bytes());
        out
    }

    fn u8(mut self, value: u8) -> Self {
        self.0.push(value);
        self
    }

    fn text(self, text: &str) -> Self {
        let mut out = self.u32(text.len() as u32 + 1);
        out.0.extend(text.as_bytes());
        out.u8(0)
    }

    fn numbers(self, values: &[f64]) -> Self {
        let mut out = self.align(8);
        values.iter().for_each(|v| out.0.extend(v.to_le_bytes()));
        out
    }

    fn bytes(self, bytes: &[u8]) -> Self {
        let mut out = self.u32(bytes.len() as u32);
        out.0.extend(bytes);
        out
    }

    fn header(self, stamp: u64, frame: &str) -> Self {
        self.u32((stamp / SECOND) as u32).u32((stamp % SECOND) as u32).text(frame)
    }
}

impl Recorder {
    fn ros(&mut self, topic: &str, schema: &str, message: Cdr) {
        self.bytes(topic, [schema, "ros2msg", "cdr"], &message.0);
    }
}

/// A ROS 2 bag of two cameras, the second of which is distorted if `d` says so. `skip` leaves an image of the second out.
fn bag(compression: Option<Compression>, d: &[f64], skip: Option<u64>) -> Vec<u8> {
    let mut recorder = Recorder::new(compression);
    let transform = |cdr: Cdr, stamp, parent, child, place: [f64; 3], turn: [f64; 4]| {
        cdr.header(stamp, parent).text(child).numbers(&place).numbers(&turn)
    };
    // x right, y down, z ahead of a camera that looks along x.
    let optical = [-0.5, 0.5, -0.5, 0.5];
    let fixed = transform(Cdr::new().u32(3), 0, "base_link", "/left", [1.0, 0.5, 1.0], optical);
    let fixed = transform(fixed, 0, "base_link", "right", [1.0, -0.5, 1.0], optical);
    let fixed = transform(fixed, 0, "base_link", "lidar", [0.0, 0.0, 2.0], [0.0, 0.0, 0.0, 1.0]);
    recorder.ros("/tf_static", "tf2_msgs/msg/TFMessage", fixed);
    for step in 0..4u64 {
        let begin = step * 100_000_000;
        // The vehicle drives ten metres a second.
        let tf =
            transform(Cdr::new().u32(1), begin, "odom", "base_link", [step as f64, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]);
        recorder.ros("/tf", "tf2_msgs/msg/TFMessage", tf);
        for (camera, late) in [("left", 0), ("right", 20_000_000u64)] {
            let stamp = begin + late;
            let d = if camera == "right" { d } else { &[] };
            let info =
                Cdr::new().header(stamp, camera).u32(32).u32(64).text("plumb_bob").u32(d.len() as u32).numbers(d);
            let info = info
                .numbers(&[50.0, 0.0, 31.5, 0.0, 50.0, 15.5, 0.0, 0.0, 1.0])
                .numbers(&[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
                .numbers(&[0.0; 12])
                .u32(0);
            recorder.ros(&format!("/{camera}/camera_info"), "sensor_msgs/msg/CameraInfo", info);
            if camera == "right" && skip == Some(step) {
                continue;
            }
            let image = &scene(step).images[usize::from(camera == "right")];
            let message = Cdr::new().header(stamp, camera);
            if camera == "left" {
                let file = Encoded::png(image).expect("a PNG").bytes;
                let message = message.text("bgr8; png compressed bgr8").bytes(&file);
                recorder.ros("/left/image_raw/compressed", "sensor_msgs/msg/CompressedImage", message);
            } else {
                // Rows with two bytes of rest, red first.
                let rows = image.bgr.chunks_exact(3 * 64);
                let data: Vec<u8> =
                    rows.flat_map(|row| row.chunks_exact(3).flat_map(|p| [p[2], p[1], p[0]]).chain([9, 9])).collect();
                let message = message.u32(32).u32(64).text("rgb8").u8(0).u32(3 * 64 + 2).bytes(&data);
                recorder.ros("/right/image_raw", "sensor_msgs/msg/Image", message);
            }
        }
    }
    recorder.bytes("/imu", ["sensor_msgs/msg/Imu", "ros2msg", "cdr"], &[0, 1, 0, 0, 1]);
    recorder.finish()
}

#[test]
fn a_ros_bag_by_hand() {
    for compression in [None, Some(Compression::Zstd)] {
        let bytes = bag(compression, &[], None);
        let mut replay = replay(&bytes).expect("a bag");
        let summary = replay.summary();
        assert_eq!(summary.cameras[1], ("right".to_owned(), "/right/image_raw".to_owned()));
        // The last image of the right camera comes 20 ms after the last transform, within the tolerance.
        assert_eq!((replay.len(), summary.without_transform, summary.incomplete), (4, 0, 0));
        for step in 0..4 {
            let frame = replay.frame(step).expect("a frame");
            assert_eq!(frame.stamps, [Some(step as u64 * 100_000_000), Some(step as u64 * 100_000_000 + 20_000_000)]);
            assert_eq!(frame.scene.images, scene(step as u64).images, "step {step}");
            assert_eq!((frame.files[0].is_some(), frame.files[1].is_some()), (true, false));
            // A point ahead of the lidar: the lidar is at the frame's time, 10 ms after the left camera and 10 ms before the
            // right one, and the vehicle drives 0.1 m in that. After the last transform it stands.
            let (left, right) = if step < 3 { (0.1, -0.1) } else { (0.0, 0.0) };
            for (camera, moved) in [(0, left), (1, right)] {
                let m = &frame.scene.lidar2img[camera];
                let image =
                    |row: usize| f64::from(m[4 * row] * 10.0 + m[4 * row + 1] * 2.0 + m[4 * row + 2] + m[4 * row + 3]);
                let depth = 10.0 + moved - 1.0;
                let across = if camera == 0 { -(2.0 - 0.5) } else { -(2.0 + 0.5) };
                let down = -(1.0 + 2.0 - 1.0);
                for (found, expected) in [
                    (image(2), depth),
                    (image(0), 50.0 * across + 31.5 * depth),
                    (image(1), 50.0 * down + 15.5 * depth),
                ] {
                    assert!(
                        (found - expected).abs() < 1e-3,
                        "step {step}, camera {camera}: {found}, expected {expected}"
                    );
                }
            }
        }
    }
}

#[test]
fn missing_images_and_lenses() {
    let mut replay = replay(&bag(None, &[], Some(2))).expect("a bag");
    assert_eq!((replay.len(), replay.summary().incomplete), (4, 1));
    let frame = replay.frame(2).expect("a frame");
    assert_eq!(frame.stamps, [Some(200_000_000), None]);
    assert!(frame.scene.images[1] == Image { height: 32, width: 64, bgr: vec![0; 32 * 64 * 3] });
    let again =
        Replay::from_bytes(bag(None, &[-0.2, 0.01, 0.0, 0.0, 0.0], None), &network(), &ReplayOptions::default());
    let mut replay = again.expect("a bag");
    let frame = replay.frame(1).expect("a frame");
    let straight = scene(1).images;
    assert!(frame.scene.images[0] == straight[0] && frame.scene.images[1] != straight[1]);
    assert!(frame == replay.frame(1).expect("a frame"), "again the same");
    let mut replay =
        Replay::from_bytes(bag(None, &[0.1; 12], None), &network(), &ReplayOptions::default()).expect("a bag");
    let error = replay.frame(0).unwrap_err();
    assert!(
        error.message().contains("topic /right/image_raw at 0.020000000 s: distortion \"plumb_bob\" of 12"),
        "{error}"
    );
}

#[test]
fn what_does_not_fit_is_said() {
    let bytes = bag(None, &[], None);
    let open = |network: &Network, options: &ReplayOptions| {
        Replay::from_bytes(bytes.clone(), network, options).err().expect("refused").message().to_owned()
    };
    let six = Network { cameras: 6, ..network() };
    let said = open(&six, &ReplayOptions::default());
    assert!(said.contains("2 cameras, the model expects 6; found left (/left/image_raw/compressed), right"), "{said}");
    let named = ReplayOptions { frame: Some("velodyne".into()), ..ReplayOptions::default() };
    let said = open(&network(), &named);
    assert!(said.contains("no frame \"velodyne\", expected one of: base_link, left, lidar, odom, right"), "{said}");
    let tight = ReplayOptions { tolerance: 0, ..ReplayOptions::default() };
    // Each image is a frame of its own, with half of the cameras; the last has no transform.
    let replay = Replay::from_bytes(bytes.clone(), &network(), &tight).expect("a bag");
    assert_eq!((replay.len(), replay.summary().incomplete, replay.summary().without_transform), (7, 7, 1));
    let mut empty = Recorder::new(None);
    empty.bytes("/imu", ["sensor_msgs/msg/Imu", "ros2msg", "cdr"], &[0, 1, 0, 0, 1]);
    refused(&empty.finish(), "no images, expected topics of foxglove.CompressedImage");
    refused(b"PK\x03\x04 and so on", "expected an MCAP file");
    let mut broken = Recorder::new(None);
    broken.ros("/left/image_raw", "sensor_msgs/msg/Image", Cdr::new().u32(5));
    refused(&broken.finish(), "topic /left/image_raw: CDR byte");
    let mut broken = Recorder::new(None);
    broken.foxglove("/tf", &schema::FrameTransform { child_frame_id: "a".into(), ..Default::default() });
    broken.foxglove(
        "/left/image",
        &schema::RawImage { timestamp: Some(schema::Timestamp { seconds: -1, nanos: 0 }), ..Default::default() },
    );
    refused(&broken.finish(), "topic /left/image: stamp of -1 s");
}

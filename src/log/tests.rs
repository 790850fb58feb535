//! Logs written by the tests, whole and damaged, and what is made of them.

use super::schema::{self, Schema, descriptors};
use super::*;
use crate::base::error::{ErrorKind, Result};
use crate::network::{Grid, Network};
use crate::runtime::session::{CameraStatus, Confidence, Occupancy};
use crate::scene::{Image, Scene};
use crate::synth::Synthesiser;
use mcap::records::MessageHeader;
use mcap::{Compression, WriteOptions, Writer};
use std::collections::BTreeMap;
use std::io::Cursor;
use std::sync::OnceLock;
use std::time::Duration;

const SECOND: u64 = 1_000_000_000;

fn network() -> Network {
    Network { image: [32, 64], cameras: 2, ..Network::built_in("edge").expect("built in") }
}

/// Two small images of noise, and where the cameras of a drawn scene stand.
fn scene(seed: u64) -> Scene {
    static DRAWN: OnceLock<Scene> = OnceLock::new();
    let drawn = || Synthesiser::new(&network()).expect("17 classes").frame(1).scene;
    let mut scene = DRAWN.get_or_init(drawn).clone();
    let mut random = crate::random::Random::new(seed);
    for image in &mut scene.images {
        image.bgr.iter_mut().for_each(|v| *v = random.next_u64() as u8);
    }
    scene
}

/// A log as a recorder would write it, message by message.
struct Recorder {
    writer: Writer<Cursor<Vec<u8>>>,
    sequence: u32,
}

impl Recorder {
    fn new(compression: Option<Compression>) -> Self {
        let options = WriteOptions::new().compression(compression).compression_threads(0).chunk_size(Some(4096));
        Self { writer: options.create(Cursor::new(Vec::new())).expect("memory"), sequence: 0 }
    }

    fn bytes(&mut self, topic: &str, [schema, encoding, messages]: [&str; 3], data: &[u8]) {
        let described = if encoding == "protobuf" { descriptors(schema) } else { b"# text".to_vec() };
        let schema = self.writer.add_schema(schema, encoding, &described).expect("a schema");
        let channel_id = self.writer.add_channel(schema, topic, messages, &BTreeMap::new()).expect("a channel");
        self.sequence += 1;
        let time = u64::from(self.sequence);
        let header = MessageHeader { channel_id, sequence: self.sequence, log_time: time, publish_time: time };
        self.writer.write_to_known_channel(&header, data).expect("memory");
    }

    fn foxglove<M: Schema>(&mut self, topic: &str, message: &M) {
        self.bytes(topic, [M::NAME, "protobuf", "protobuf"], &message.encode_to_vec());
    }

    fn ros(&mut self, topic: &str, schema: &str, message: Cdr) {
        self.bytes(topic, [schema, "ros2msg", "cdr"], &message.0);
    }

    fn finish(mut self) -> Vec<u8> {
        self.writer.finish().expect("memory");
        self.writer.into_inner().into_inner()
    }
}

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

fn replay(bytes: &[u8]) -> Result<Replay> {
    Replay::from_bytes(bytes.to_vec(), &network(), &ReplayOptions::default())
}

fn refused(bytes: &[u8], expected: &str) -> ErrorKind {
    let error = replay(bytes).err().unwrap_or_else(|| panic!("accepted, expected {expected}"));
    assert!(error.message().contains(expected), "{error} does not say {expected:?}");
    error.kind()
}

/// What [`LogWriter`] makes of some frames.
fn written(scenes: &[(u64, [u64; 2], Scene)]) -> Vec<u8> {
    let dir = tempfile::tempdir().expect("a directory");
    let path = dir.path().join("out.mcap");
    let network = network();
    let grid = Grid::of(&network);
    let voxels = grid.voxels();
    let mut writer = LogWriter::create(&path, &network).expect("a log");
    for (stamp, stamps, scene) in scenes {
        let classes: Vec<u8> = (0..voxels).map(|at| (at % 17) as u8).collect();
        let support = vec![3; voxels];
        let cameras = [CameraStatus::default(); 2];
        let occupancy =
            Occupancy { grid, classes: &classes, logits: None, confidence: None, support: &support, cameras: &cameras };
        let files: Vec<Encoded> = scene.images.iter().map(|image| Encoded::png(image).expect("a PNG")).collect();
        let shots: Vec<Shot<'_>> = (0..2)
            .map(|camera| Shot {
                name: &scene.names[camera],
                stamp: stamps[camera],
                file: Some(&files[camera]),
                size: [32, 64],
                lidar2img: &scene.lidar2img[camera],
            })
            .collect();
        let latency = Duration::from_millis(5);
        writer.push(&LogFrame { stamp: *stamp, shots: &shots, occupancy, latency }).expect("written");
    }
    assert!(!path.exists(), "not before it is finished");
    writer.finish().expect("written");
    std::fs::read(&path).expect("a log")
}

#[test]
fn what_is_written_comes_back_bit_for_bit() {
    let scenes: Vec<(u64, [u64; 2], Scene)> = (0..3)
        .map(|i| {
            let begin = 1_700_000_000 * SECOND + i * SECOND / 2;
            (begin + 10, [begin, begin + 20], scene(i))
        })
        .collect();
    let bytes = written(&scenes);
    assert!(bytes == written(&scenes), "the same frames give the same bytes");
    let mut replay = replay(&bytes).expect("a log");
    let summary = replay.summary().clone();
    assert_eq!((replay.len(), summary.incomplete, summary.left_out, summary.without_transform), (3, 0, 0, 0));
    assert_eq!((summary.frame.as_str(), summary.extent.ending), ("lidar", Ending::Whole));
    for (index, (stamp, stamps, scene)) in scenes.iter().enumerate() {
        let frame = replay.frame(index).expect("a frame");
        assert_eq!((frame.stamp, frame.stamps), (*stamp, stamps.map(Some).to_vec()));
        assert_eq!(frame.scene.lidar2img, scene.lidar2img);
        assert!(frame.scene == *scene);
        assert!(frame.files[0].as_ref().is_some_and(|file| file.format == "png"));
    }
}

#[test]
fn confidence_is_two_fields_more() {
    use super::schema::VoxelGrid;
    use prost::Message as _;
    let network = network();
    let grid = Grid::of(&network);
    let voxels = grid.voxels();
    let dir = tempfile::tempdir().expect("a directory");
    let classes: Vec<u8> = (0..voxels).map(|at| (at % 17) as u8).collect();
    let (occupied, class): (Vec<u8>, Vec<u8>) = (0..voxels).map(|at| (at as u8, (at * 7) as u8)).unzip();
    let written = |confidence| {
        let path = dir.path().join("out.mcap");
        let occupancy =
            Occupancy { grid, classes: &classes, logits: None, confidence, support: &vec![3; voxels], cameras: &[] };
        let mut writer = LogWriter::create(&path, &network).expect("a log");
        let latency = Duration::from_millis(5);
        writer.push(&LogFrame { stamp: 7, shots: &[], occupancy, latency }).expect("written");
        writer.finish().expect("written");
        let bytes = std::fs::read(&path).expect("a log");
        let messages = mcap::MessageStream::new(&bytes).expect("a log");
        let message = messages.map(|m| m.expect("whole")).find(|m| m.channel.topic == "/voxcast/occupancy");
        VoxelGrid::decode(&message.expect("voxels").data[..]).expect("a grid")
    };
    let (plain, sure) = (written(None), written(Some(Confidence { occupied: &occupied, class: &class })));
    let fields = |grid: &VoxelGrid| grid.fields.iter().map(|f| (f.name.clone(), f.offset)).collect::<Vec<_>>();
    let mut expected = fields(&plain);
    expected.extend([("confidence_occupied".to_owned(), 8), ("confidence_class".to_owned(), 9)]);
    assert_eq!((fields(&sure), plain.cell_stride, sure.cell_stride), (expected, 8, 10));
    let [nx, ny, nz] = grid.size;
    assert_eq!((sure.row_stride as usize, sure.slice_stride as usize), (10 * nx, 10 * nx * ny));
    let cells = sure.data.chunks_exact(10).zip(plain.data.chunks_exact(8));
    assert_eq!(cells.len(), voxels);
    for (index, (sure, plain)) in cells.enumerate() {
        let (x, y, z) = (index % nx, index / nx % ny, index / nx / ny);
        let at = (x * ny + y) * nz + z;
        assert!(sure[..8] == *plain && sure[8..] == [occupied[at], class[at]], "cell {index}");
    }
}

#[test]
fn a_log_that_is_cut_off_is_read_as_far_as_it_is_whole() {
    let scenes: Vec<_> = (0..3).map(|i| (i * SECOND, [i * SECOND; 2], scene(i))).collect();
    let bytes = written(&scenes);
    let (mut most, mut frames_before) = (0, 0);
    for length in (0..bytes.len()).step_by(997).chain([bytes.len() - 1, bytes.len() - 8]) {
        match replay(&bytes[..length]) {
            Ok(replay) => {
                let Extent { read, length: found, ending } = replay.summary().extent;
                assert!(ending != Ending::Whole && read <= found && found == length as u64, "{length}");
                let frames = replay.len();
                assert!(frames >= frames_before, "{length} bytes give {frames} frames, fewer than before");
                (most, frames_before) = (most.max(frames), frames);
            }
            Err(error) => {
                let expected = [
                    "begins with bytes",
                    "the log is cut off",
                    "the log is whole records",
                    "is not known at",
                    "no lidar among",
                ];
                assert!(expected.iter().any(|part| error.message().contains(part)), "{length}: {error}");
            }
        }
    }
    assert_eq!(most, 3);
    // Where a recorder's file is longer than what it has written.
    let mut padded = bytes[..bytes.len() - 5000].to_vec();
    padded.resize(bytes.len(), 0);
    assert_eq!(replay(&padded).expect("a log").summary().extent.ending, Ending::Cut);
}

#[test]
fn damage_is_named_and_never_a_panic() {
    let bytes = written(&[(0, [0; 2], scene(1))]);
    let mut random = crate::random::Random::new(3);
    for _ in 0..400 {
        let mut damaged = bytes.clone();
        for _ in 0..1 + random.below(3) {
            let at = random.below(damaged.len());
            damaged[at] = random.next_u64() as u8;
        }
        if let Ok(mut replay) = replay(&damaged) {
            for index in 0..replay.len() {
                let _ = replay.frame(index);
            }
        }
    }
    // A byte of a packed chunk.
    let chunk = bytes.windows(4).position(|w| w == [0x28, 0xb5, 0x2f, 0xfd]).expect("zstd");
    let mut damaged = bytes.clone();
    damaged[chunk + 40] ^= 0xff;
    assert_eq!(refused(&damaged, "chunk at byte"), ErrorKind::Format);
    // A chunk that claims more than it may, and one that claims other than it has.
    let size = chunk - 8 - 4 - 4 - 4 - 8;
    damaged = bytes.clone();
    damaged[size..size + 8].copy_from_slice(&u64::MAX.to_le_bytes());
    assert_eq!(refused(&damaged, "bytes unpacked, expected at most"), ErrorKind::TooLarge);
    damaged[size..size + 8].copy_from_slice(&1000u64.to_le_bytes());
    refused(&damaged, "other than 1000 bytes unpacked");
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

//! What is written: it comes back.

use super::super::schema::VoxelGrid;
use super::*;
use crate::network::Grid;
use crate::runtime::session::{CameraStatus, Confidence, Occupancy};
use prost::Message as _;
use std::time::Duration;

/// What [`LogWriter`] makes of some frames.
pub(super) fn written(scenes: &[(u64, [u64; 2], Scene)]) -> Vec<u8> {
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

use super::super::Frame;
use super::*;
use crate::file::npz::{Array, Elements, write_npz};
use crate::image::png::write_rgb_png;
use std::fs;

const VOXELS: usize = 640_000;

struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        let place = Self(tempfile::tempdir().expect("a directory"));
        for segment in ["voxels/validation/001", "voxels/validation/000", "kitti/training/calib"] {
            fs::create_dir_all(place.path(segment)).expect("made");
        }
        // The voxels of 0.1 m lie beside those of 0.4 m, and are not read.
        fs::write(place.path("voxels/validation/000/007.npz"), "").expect("written");
        place.labels("000/007", &[], [&[], &[], &[]], "infov");
        place.labels("001/000", &[], [&[], &[], &[]], "infov");
        for camera in 0..5u8 {
            let directory = place.path(&format!("kitti/training/image_{camera}"));
            fs::create_dir_all(&directory).expect("made");
            write_rgb_png(&directory.join("1000007.png"), 3, 2, &[camera; 18]).expect("written");
        }
        let mut text = String::new();
        for camera in 0..5 {
            // Each camera stands a metre further to the front than the one before.
            text += &format!("P{camera}: 100 0 50 0 0 200 60 0 0 0 1 0\n");
            text += &format!("Tr_velo_to_cam_{camera}: 0 -1 0 0 0 0 -1 1.5 1 0 0 -{camera}\n");
        }
        fs::write(place.path("kitti/training/calib/1000007.txt"), text).expect("written");
        place
    }

    fn path(&self, file: &str) -> PathBuf {
        self.0.path().join(file)
    }

    fn labels(&self, frame: &str, some: &[(usize, u8)], masks: [&[usize]; 3], last: &str) {
        let mut labels = vec![15u8; VOXELS];
        some.iter().for_each(|&(at, label)| labels[at] = label);
        let masks = masks.map(|inside| {
            let mut mask = vec![0u8; VOXELS];
            inside.iter().for_each(|&at| mask[at] = 1);
            mask
        });
        let shape = &[200, 200, 16];
        let array = |name, bytes| Array { name, shape, elements: Elements::U8(bytes) };
        let arrays = [
            array("voxel_label", &labels[..]),
            array("origin_voxel_state", &masks[0][..]),
            array("final_voxel_state", &masks[1][..]),
            array(last, &masks[2][..]),
        ];
        write_npz(&self.path(&format!("voxels/validation/{frame}_04.npz")), &arrays).expect("written");
    }

    fn open(&self) -> Result<Occ3dWaymo> {
        Occ3dWaymo::open(&self.path("kitti"), &self.path("voxels"), Split::Validation)
    }
}

#[test]
fn frames_labels_and_cameras() {
    let place = Place::new();
    place.labels("000/007", &[(3, 0), (4, 14), (5, 23), (VOXELS - 1, 2)], [&[3], &[4, 5], &[5, 6]], "infov");
    let set = place.open().expect("a set");
    assert_eq!((set.len(), set.id(0), set.id(1)), (2, "000/007", "001/000"));
    let Frame { scene, truth, .. } = set.frame(0).expect("a frame");
    let mut expected = vec![0u8; VOXELS];
    (expected[3], expected[4], expected[VOXELS - 1]) = (1, 15, 3);
    assert!(truth.labels == expected);
    let inside = truth.masks.iter().map(|mask| (0..10).filter(|&at| mask[at] == 1).collect::<Vec<_>>());
    assert_eq!(inside.collect::<Vec<_>>(), [vec![3], vec![4, 5], vec![5, 6], vec![5]]);
    assert_eq!(scene.names, CAMERAS);
    for camera in 0..5 {
        assert_eq!(scene.images[camera].bgr[0], camera as u8);
        // (x, y, z) of the vehicle is at (-y, 1.5 - z, x - camera) of the camera.
        let c = camera as f32;
        let expected =
            [50.0, -100.0, 0.0, -50.0 * c, 60.0, 0.0, -200.0, 300.0 - 60.0 * c, 1.0, 0.0, 0.0, -c, 0.0, 0.0, 0.0, 1.0];
        assert_eq!(scene.lidar2img[camera], expected, "camera {camera}");
    }
}

#[test]
fn what_is_missing_or_malformed_is_named() {
    let place = Place::new();
    let file = place.path("voxels/validation/000/007_04.npz");
    let said = |expected: &str| {
        let error = place.open().expect("a set").truth(0).expect_err(expected);
        assert!(error.path() == Some(&file) && error.message().contains(expected), "{error}");
    };
    place.labels("000/007", &[(70, 16)], [&[], &[], &[]], "infov");
    said("array \"voxel_label\": voxel 70 is 16, expected 0 to 15, or 23");
    place.labels("000/007", &[], [&[], &[], &[]], "outfov");
    said("no array \"infov\", expected u8 [200, 200, 16]");
    place.labels("000/007", &[], [&[], &[], &[]], "infov");
    let calibration = place.path("kitti/training/calib/1000007.txt");
    fs::write(&calibration, "P0: 1 0 0 0 0 1 0 0 0 0 1 0\n").expect("written");
    let error = place.open().expect("a set").frame(0).expect_err("no transform");
    assert!(error.path() == Some(&calibration) && error.message().contains("no line \"Tr_velo_to_cam_0:\""), "{error}");
    let empty = Occ3dWaymo::open(&place.path("kitti"), &place.path("kitti"), Split::Training).expect_err("no labels");
    assert!(empty.message().contains("no labels, expected files such as 000/000_04.npz"), "{empty}");
    assert!("val".parse::<Split>().is_err() && "training".parse() == Ok(Split::Training));
}

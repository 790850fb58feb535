use super::super::IGNORED;
use super::*;
use crate::image::png::write_rgb_png;
use std::fs;

const DRIVE: &str = "2013_05_28_drive_0006_sync";

/// A quarter turn: the camera's axes in the lidar's, and where it stands, as KITTI-360 gives them.
const CAMERA_TO_LIDAR: &str = "0 0 1 0.25 -1 0 0 0.5 0 -1 0 0.75\n";
const PERSPECTIVE: &str = "calib_time: 2013\nR_rect_00: 1 0 0 0 1 0 0 0 1\nP_rect_00: 100 0 50 0 0 200 60 0 0 0 1 0\n";

struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        let place = Self(tempfile::tempdir().expect("a directory"));
        place.write("calibration/perspective.txt", PERSPECTIVE.as_bytes());
        place.write("calibration/calib_cam_to_velo.txt", CAMERA_TO_LIDAR.as_bytes());
        for (number, digits) in [("000005", 6), ("000000", 10)] {
            place.labels(number, &[]);
            let image = place.path(&format!("data_2d_raw/{DRIVE}/image_00/data_rect/{number:0>digits$}.png"));
            fs::create_dir_all(image.parent().expect("a directory")).expect("made");
            write_rgb_png(&image, 4, 3, &[digits as u8; 36]).expect("written");
        }
        place
    }

    fn path(&self, file: &str) -> PathBuf {
        self.0.path().join(file)
    }

    fn write(&self, file: &str, bytes: &[u8]) {
        let path = self.path(file);
        fs::create_dir_all(path.parent().expect("a directory")).expect("made");
        fs::write(path, bytes).expect("written");
    }

    /// Labels that are empty but for some voxels.
    fn labels(&self, number: &str, some: &[([usize; 3], u8)]) {
        let mut labels = vec![0u8; 256 * 256 * 32];
        for &([x, y, z], label) in some {
            labels[(x * 256 + y) * 32 + z] = label;
        }
        self.write(&format!("preprocess/labels/{DRIVE}/{number}_1_1.npy"), &npy("(256, 256, 32)", &labels));
    }

    fn open(&self) -> Result<SscBench> {
        SscBench::open(self.0.path(), Split::Val)
    }
}

fn npy(shape: &str, bytes: &[u8]) -> Vec<u8> {
    let mut header = format!("{{'descr': '|u1', 'fortran_order': False, 'shape': {shape}, }}");
    header.push_str(&" ".repeat(118 - header.len() - 1));
    header.push('\n');
    [b"\x93NUMPY\x01\x00", &(header.len() as u16).to_le_bytes()[..], header.as_bytes(), bytes].concat()
}

#[test]
fn frames_and_labels() {
    let place = Place::new();
    place.labels("000005", &[([1, 2, 3], 18), ([255, 255, 31], 255), ([0, 0, 1], 7)]);
    let set = place.open().expect("a set");
    assert_eq!((set.len(), set.id(0), set.id(1)), (2, &*format!("{DRIVE}/000000"), &*format!("{DRIVE}/000005")));
    assert_eq!((set.classes().len(), set.grid().bounds[0], set.masks().len()), (19, [0.0, 51.2], 0));
    let truth = set.truth(1).expect("labels");
    let mut expected = vec![0u8; 256 * 256 * 32];
    (expected[(256 + 2) * 32 + 3], expected[256 * 256 * 32 - 1], expected[1]) = (18, IGNORED, 7);
    assert!(truth.labels == expected);
    let frames = [0, 1].map(|index| set.frame(index).expect("a frame").scene);
    assert_eq!(frames.each_ref().map(|scene| scene.images[0].bgr[0]), [10, 6], "images by six digits or ten");
    // A point (x, y, z) of the lidar is at (0.5 - y, 0.75 - z, x - 0.25) of the camera.
    let [right, down, ahead] = [[0.0, -1.0, 0.0, 0.5], [0.0, 0.0, -1.0, 0.75], [1.0, 0.0, 0.0, -0.25f32]];
    let expected: Vec<f32> = (0..4)
        .map(|i| 100.0 * right[i] + 50.0 * ahead[i])
        .chain((0..4).map(|i| 200.0 * down[i] + 60.0 * ahead[i]))
        .chain(ahead)
        .chain([0.0, 0.0, 0.0, 1.0])
        .collect();
    assert_eq!(frames[0].lidar2img[0][..], expected[..]);
}

#[test]
fn what_is_missing_or_malformed_is_named() {
    let place = Place::new();
    let opening = |file: &str, bytes: &[u8], expected: &str| {
        let before = fs::read(place.path(file)).expect("there");
        place.write(file, bytes);
        let error = place.open().expect_err(expected);
        assert!(error.path() == Some(&place.path(file)) && error.message().contains(expected), "{error}");
        place.write(file, &before);
    };
    let perspective = "calibration/perspective.txt";
    opening(perspective, b"P_rect_00: 1 2\n", "P_rect_00: 2 numbers, expected 12");
    opening(perspective, b"R_rect_00: 1\n", "no line \"P_rect_00:\"");
    opening(
        perspective,
        PERSPECTIVE.replace("R_rect_00: 1", "R_rect_00: nan").as_bytes(),
        "\"nan\", expected a finite",
    );
    opening("calibration/calib_cam_to_velo.txt", b"1 0 0 0 0 2 0 0 0 0 1 0", "scaled: row 1");
    opening("calibration/calib_cam_to_velo.txt", b"1 0 0 0 0 -1 0 0 0 0 1 0", "mirrored");
    let labels = format!("preprocess/labels/{DRIVE}/000000_1_1.npy");
    for (bytes, expected) in [
        (npy("(256, 32, 256)", &[0; 256 * 256 * 32]), "shape [256, 32, 256], expected [256, 256, 32]"),
        (npy("(256, 256, 32)", &[19; 256 * 256 * 32]), "voxel 0 has label 19, expected 0 to 18 or 255"),
    ] {
        place.write(&labels, &bytes);
        let error = place.open().expect("a set").truth(0).expect_err(expected);
        assert!(error.path() == Some(&place.path(&labels)) && error.message().contains(expected), "{error}");
    }
    fs::remove_dir_all(place.path("preprocess")).expect("removed");
    assert!(place.open().is_err());
    assert!("05".parse::<Split>().is_err() && "train".parse() == Ok(Split::Train));
}

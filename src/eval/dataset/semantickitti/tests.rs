use super::*;
use crate::base::error::ErrorKind;
use crate::base::pose::Pose;
use crate::image::png::write_rgb_png;
use std::fs;

const VOXELS: usize = 256 * 256 * 32;

/// A published set in small: 08 and 09 with a frame or two, of tiny images.
struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        let place = Place(tempfile::tempdir().expect("a directory"));
        for (sequence, frames) in [("08", &["000005", "000000"][..]), ("09", &["000010"])] {
            for folder in ["image_2", "image_3", "voxels"] {
                fs::create_dir_all(place.path(sequence).join(folder)).expect("made");
            }
            // The lidar looks along +x, cameras along +z with x to the right and y down; the lidar is 0.5 m above.
            let calibration = "P0: 7 0 0 0 0 7 0 0 0 0 1 0\nP1: 7 0 0 0 0 7 0 0 0 0 1 0\n\
                P2: 100 0 50 10 0 200 20 -4 0 0 1 0.5\nP3: 100 0 50 -30 0 200 20 0 0 0 1 0\n\
                Tr: 0 -1 0 0 0 0 -1 -0.5 1 0 0 0.25\n";
            fs::write(place.path(sequence).join("calib.txt"), calibration).expect("written");
            for frame in frames {
                place.images(sequence, frame);
                place.labels(sequence, frame, &[], &[]);
            }
        }
        // Frames between have images and no labels, and sweeps without any.
        place.images("08", "000003");
        fs::write(place.path("08").join("voxels/000003.bin"), vec![0; VOXELS / 8]).expect("written");
        place
    }

    fn root(&self) -> &Path {
        self.0.path()
    }

    fn path(&self, sequence: &str) -> PathBuf {
        self.root().join("sequences").join(sequence)
    }

    fn images(&self, sequence: &str, frame: &str) {
        for (folder, shift) in [("image_2", 0), ("image_3", 100)] {
            let rgb: Vec<u8> = (0..4 * 3 * 3).map(|i| i + shift).collect();
            let path = self.path(sequence).join(folder).join(format!("{frame}.png"));
            write_rgb_png(&path, 4, 3, &rgb).expect("written");
        }
    }

    /// Writes labels of the voxels at (x, y, z), and the invalid ones.
    fn labels(&self, sequence: &str, frame: &str, set: &[([usize; 3], u16)], invalid: &[[usize; 3]]) {
        let mut labels = vec![0u8; 2 * VOXELS];
        for &([x, y, z], label) in set {
            let at = x * 256 * 32 + y * 32 + z;
            labels[2 * at..][..2].copy_from_slice(&label.to_le_bytes());
        }
        let mut bits = vec![0u8; VOXELS / 8];
        for &[x, y, z] in invalid {
            bits[(x * 256 * 32 + y * 32 + z) / 8] |= 0x80 >> (z % 8);
        }
        fs::write(self.path(sequence).join(format!("voxels/{frame}.label")), labels).expect("written");
        fs::write(self.path(sequence).join(format!("voxels/{frame}.invalid")), bits).expect("written");
    }

    fn open(&self) -> Result<SemanticKitti> {
        SemanticKitti::open(self.root(), Split::Val, false, Scans::Benchmark)
    }
}

fn label(truth: &Truth, [x, y, z]: [usize; 3]) -> u8 {
    truth.labels[(x * 256 + y) * 32 + z]
}

#[test]
fn labels_at_their_voxels() {
    let place = Place::new();
    let set = [
        ([0, 0, 0], 10),
        ([1, 2, 3], 252),
        ([255, 255, 31], 81),
        ([7, 0, 8], 60),
        ([7, 0, 9], 99),
        ([7, 0, 10], 40),
        ([7, 0, 11], 259),
    ];
    place.labels("08", "000005", &set, &[[7, 0, 10], [7, 0, 14]]);
    let kitti = place.open().expect("a set");
    assert_eq!((kitti.len(), kitti.id(0), kitti.id(1)), (2, "08/000000", "08/000005"));
    assert_eq!((kitti.classes().len(), kitti.masks().len(), kitti.grid().voxels()), (20, 0, VOXELS));
    let truth = kitti.truth(1).expect("labels");
    for (voxel, expected) in [
        ([0, 0, 0], 1),
        ([1, 2, 3], 1),
        ([255, 255, 31], 19),
        ([7, 0, 8], 9),
        ([7, 0, 9], IGNORED),
        ([7, 0, 10], IGNORED),
        ([7, 0, 11], 5),
        ([7, 0, 13], 0),
        ([7, 0, 14], IGNORED),
        ([7, 0, 15], 0),
    ] {
        assert_eq!(label(&truth, voxel), expected, "{voxel:?}");
    }
    assert_eq!(truth.labels.iter().filter(|&&l| l != 0).count(), 8);
    assert_eq!((truth.origins, truth.grid_to_lidar), (vec![[0.0; 3]], Pose::IDENTITY));
    assert!(kitti.truth(0).expect("labels").labels.iter().all(|&l| l == 0));
}

#[test]
fn every_stored_label_has_its_class() {
    // Per class, the labels that the official map sends there.
    let official: [&[u16]; 20] = [
        &[0],
        &[10, 252],
        &[11],
        &[15],
        &[18, 258],
        &[13, 16, 20, 256, 257, 259],
        &[30, 254],
        &[31, 253],
        &[32, 255],
        &[40, 60],
        &[44],
        &[48],
        &[49],
        &[50],
        &[51],
        &[70],
        &[71],
        &[72],
        &[80],
        &[81],
    ];
    let mut known = 0;
    for (class, labels) in official.iter().enumerate() {
        labels.iter().for_each(|&label| assert_eq!(class_of(label), Some(class as u8), "{label}"));
        known += labels.len();
    }
    let ignored: Vec<u16> = (0..=u16::MAX).filter(|&label| class_of(label) == Some(IGNORED)).collect();
    assert_eq!(ignored, [1, 52, 99]);
    assert_eq!((0..=u16::MAX).filter(|&label| class_of(label).is_some()).count(), known + 3);
}

#[test]
fn cameras_by_hand() {
    let place = Place::new();
    let frame = place.open().expect("a set").frame(0).expect("a frame");
    assert_eq!(frame.scene.names, ["image_2"]);
    assert_eq!((frame.scene.images[0].height, frame.scene.images[0].width), (3, 4));
    assert_eq!(frame.scene.images[0].bgr[..6], [2, 1, 0, 5, 4, 3], "red is stored first");
    // A point (x, y, z) is at (-y, -z - 0.5, x + 0.25) of the camera.
    let left = [50.0, -100.0, 0.0, 22.5, 20.0, 0.0, -200.0, -99.0, 1.0, 0.0, 0.0, 0.75, 0.0, 0.0, 0.0, 1.0];
    assert_eq!(frame.scene.lidar2img, [left]);
    let stereo = SemanticKitti::open(place.root(), Split::Sequence(9), true, Scans::Benchmark).expect("a set");
    let scene = stereo.frame(0).expect("a frame").scene;
    assert_eq!((stereo.id(0), &scene.names[..]), ("09/000010", &["image_2".to_owned(), "image_3".to_owned()][..]));
    assert_eq!(scene.images[1].bgr[0], 102);
    assert_eq!(scene.lidar2img[0], left);
    assert_eq!(scene.lidar2img[1][3], -30.0 + 50.0 * 0.25);
}

#[test]
fn splits_are_the_published_ones() {
    for (text, expected) in [
        ("train", &[0, 1, 2, 3, 4, 5, 6, 7, 9, 10][..]),
        ("val", &[8]),
        ("test", &[11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21]),
        ("05", &[5]),
    ] {
        assert_eq!(text.parse::<Split>().expect("a split").sequences(), expected);
    }
    for text in ["", "8", "22", "0x", "+8", "valid"] {
        assert!(text.parse::<Split>().is_err(), "{text}");
    }
}

#[test]
fn what_is_missing_or_malformed_is_named() {
    let place = Place::new();
    let refused = |split, expected: &str, file: &Path| {
        let error = SemanticKitti::open(place.root(), split, false, Scans::Benchmark).expect_err(expected);
        assert!(error.path() == Some(file) && error.message().contains(expected), "{error}");
    };
    refused(Split::Train, "cannot read", &place.path("00").join("calib.txt"));
    let calibration = place.path("09").join("calib.txt");
    for (text, expected) in [
        ("P2: 1 0 0 0 0 1 0 0 0 0 1 0\n", "no line \"Tr:\""),
        ("P2: 1 0 0 0 0 1 0 0 0 0 1\nTr: 1 0 0 0 0 1 0 0 0 0 1 0\n", "P2: 11 numbers, expected 12"),
        ("P2: 1 0 0 0 0 1 0 0 0 0 1 0 5\nTr: 1 0 0 0 0 1 0 0 0 0 1 0\n", "P2: 13 numbers, expected 12"),
        ("P2: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: 1 0 0 0 0 1 0 0 nan 0 1 0\n", "Tr: \"nan\", expected a finite number"),
        ("P2: 1e39 0 0 0 0 1 0 0 0 0 1 0\nTr: 1 0 0 0 0 1 0 0 0 0 1 0\n", "lidar2img[0][0] is inf"),
        ("P2: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: 2 0 0 0 0 2 0 0 0 0 2 0\n", "Tr: scaled: row 0"),
        ("P2: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: 1 0 0 0 0 1 0 0 0 0 -1 0\n", "Tr: mirrored"),
        ("P2: 1 0 0 0 0 1 0 0 5 5 1 0\nTr: 1 0 0 0 0 1 0 0 0 0 1 0\n", "P2: 5 in row 2, column 0"),
        ("P2: 2 0 0 0 0 2 0 0 0 0 2 0\nTr: 1 0 0 0 0 1 0 0 0 0 1 0\n", "P2: 2 in row 2, column 2"),
        ("P2: 1 0 0 0 0 1 0 0 0 0 1 0\nP2: 1 0 0 0 0 1 0 0 0 0 1 0\n", "two lines \"P2:\""),
    ] {
        fs::write(&calibration, text).expect("written");
        refused(Split::Sequence(9), expected, &calibration);
    }
    let voxels = place.path("08").join("voxels");
    let said = |file: &str, expected: &str| {
        let set = place.open().expect("a set");
        let error = set.truth(0).expect_err(expected);
        assert_eq!(error.path(), Some(&*voxels.join(file)), "{error}");
        assert!(error.message().contains(expected), "{error}");
    };
    place.labels("08", "000000", &[([0, 0, 5], 2)], &[]);
    said("000000.label", "voxel 5 has label 2, which SemanticKITTI does not have");
    fs::write(voxels.join("000000.label"), vec![0; 2 * VOXELS - 1]).expect("written");
    said("000000.label", "4194303 bytes, expected 4194304");
    place.labels("08", "000000", &[], &[]);
    fs::write(voxels.join("000000.invalid"), vec![0; VOXELS / 8 + 1]).expect("written");
    said("000000.invalid", "262145 bytes, expected 262144");
    fs::remove_file(voxels.join("000000.invalid")).expect("removed");
    said("000000.invalid", "cannot open");
    let image = place.path("08").join("image_2/000005.png");
    fs::write(&image, "no image").expect("written");
    let error = place.open().expect("a set").frame(1).expect_err("no image");
    assert_eq!((error.kind(), error.path()), (ErrorKind::Format, Some(&*image)), "{error}");
    fs::remove_file(voxels.join("000000.label")).expect("removed");
    fs::remove_file(voxels.join("000005.label")).expect("removed");
    refused(Split::Val, "no labels, expected files such as", &voxels);
}

#[test]
fn the_benchmark_is_every_fifth_scan() {
    let place = Place::new();
    let voxels = place.path("08").join("voxels");
    for number in 0..12 {
        place.labels("08", &format!("{number:06}"), &[], &[]);
    }
    let ids = |scans| {
        let set = SemanticKitti::open(place.root(), Split::Val, false, scans).expect("a set");
        (0..set.len()).map(|i| set.id(i).to_owned()).collect::<Vec<_>>()
    };
    assert_eq!(ids(Scans::Benchmark), ["08/000000", "08/000005", "08/000010"]);
    assert_eq!(ids(Scans::Labelled).len(), 12);
    // What the benchmark does not score may be as it likes.
    fs::remove_file(voxels.join("000003.invalid")).expect("removed");
    fs::write(voxels.join("000004.label"), "no label").expect("written");
    let set = place.open().expect("a set");
    (0..set.len()).for_each(|i| drop(set.truth(i).expect("labels")));
    // An image that it scores, and no label for it.
    place.images("08", "000015");
    let error = place.open().expect_err("a label is missing");
    assert!(
        error.path() == Some(&*voxels) && error.message().contains("no 000015.label for image_2/000015.png"),
        "{error}"
    );
    assert_eq!(ids(Scans::Labelled).len(), 12);
}

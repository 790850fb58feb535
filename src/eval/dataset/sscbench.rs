//! SSCBench's KITTI-360 as it is published (arXiv 2306.09001): drives of KITTI-360, and labelled voxels of every fifth frame.
//!
//! Below ROOT, `preprocess/labels/DRIVE/NNNNNN_1_1.npy` (u8 [256, 256, 32], classes as they are trained, 255 unknown),
//! `data_2d_raw/DRIVE/image_00/data_rect/NNNNNN.png` and KITTI-360's `calibration/perspective.txt` and
//! `calibration/calib_cam_to_velo.txt` are read. The labels at full resolution already have the unified classes, and what is
//! invalid in them; `voxels/*.{bin,label,invalid}`, from which they were made, are not read.

use super::kitti::{GRID, check_pose, matrix, numbers, parse, product, rows, values};
use super::{DataSet, Grid, Truth, check_labels};
use crate::base::error::{Error, Result};
use crate::base::note::Note;
use crate::file::npz::read_npy_integers;
use crate::image::file::read_image;
use crate::scene::{Scene, check_finite};
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// Names of the classes, in order; 0 is empty.
pub const CLASSES: [&str; 19] = [
    "empty",
    "car",
    "bicycle",
    "motorcycle",
    "truck",
    "other vehicle",
    "person",
    "road",
    "parking",
    "sidewalk",
    "other ground",
    "building",
    "fence",
    "vegetation",
    "terrain",
    "pole",
    "traffic sign",
    "other structure",
    "other object",
];

/// The camera: the left one of the rectified pair.
const CAMERA: &str = "image_00";

/// Which drives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Split {
    /// 0000, 0002 to 0005, 0007 and 0010.
    Train,
    /// 0006.
    Val,
    /// 0009.
    Test,
}

impl Split {
    fn drives(self) -> &'static [u8] {
        match self {
            Split::Train => &[0, 2, 3, 4, 5, 7, 10],
            Split::Val => &[6],
            Split::Test => &[9],
        }
    }
}

impl FromStr for Split {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        match text {
            "train" => Ok(Split::Train),
            "val" => Ok(Split::Val),
            "test" => Ok(Split::Test),
            _ => Err(format!("{text:?}, expected train, val or test")),
        }
    }
}

/// SSCBench's KITTI-360: the frames with labels, in the order of drive and number, without masks.
#[derive(Clone, Debug)]
pub struct SscBench {
    root: PathBuf,
    lidar2img: [f32; 16],
    /// `DRIVE/NNNNNN`.
    frames: Vec<String>,
}

impl SscBench {
    /// Opens the drives of `split` below `root`. Frames are listed, not read.
    ///
    /// # Errors
    /// [`ErrorKind::Io`](crate::ErrorKind::Io) if the calibration or a drive cannot be read;
    /// [`ErrorKind::Format`](crate::ErrorKind::Format) if the calibration is malformed or a drive has no labels.
    pub fn open(root: &Path, split: Split) -> Result<Self> {
        let lidar2img = calibration(&root.join("calibration"))?;
        let mut frames = Vec::new();
        for drive in split.drives() {
            let name = format!("2013_05_28_drive_{drive:04}_sync");
            let directory = root.join("preprocess/labels").join(&name);
            let labelled = numbers(&directory, "_1_1.npy")?;
            if labelled.is_empty() {
                return Err(Error::format("no labels, expected files such as 000005_1_1.npy").in_file(&directory));
            }
            frames.extend(labelled.into_iter().map(|number| format!("{name}/{number}")));
        }
        Ok(Self { root: root.to_owned(), lidar2img, frames })
    }
}

/// P_rect_00 * R_rect_00 * inverse(camera to lidar), in f64 and rounded once.
fn calibration(directory: &Path) -> Result<[f32; 16]> {
    let read = |path: &Path| std::fs::read_to_string(path).map_err(|e| Error::io(path, "read", &e));
    let path = directory.join("perspective.txt");
    let text = read(&path)?;
    let camera2img = rows(&text, "P_rect_00").map_err(|e| e.in_file(&path))?;
    let turn: [f64; 9] = values(&text, "R_rect_00").map_err(|e| e.in_file(&path))?;
    let path = directory.join("calib_cam_to_velo.txt");
    let camera_to_lidar = pose(&read(&path)?).map_err(|e| e.in_file(&path))?;
    let lidar2camera = inverse(&camera_to_lidar);
    let turned = [0, 1, 2]
        .map(|row| [0, 1, 2, 3].map(|column| (0..3).map(|i| turn[3 * row + i] * lidar2camera[i][column]).sum::<f64>()));
    let matrix = product(&camera2img, &turned);
    check_finite(CAMERA, &matrix).map_err(|e| e.in_file(&path))?;
    Ok(matrix)
}

/// The pose that stands alone in a file.
fn pose(text: &str) -> Result<[[f64; 4]; 3]> {
    const NAME: &str = "camera to lidar";
    let line = text.lines().next().unwrap_or_default();
    let pose = matrix(&parse(line, NAME)?);
    check_pose(NAME, &pose)?;
    Ok(pose)
}

/// The inverse of a rigid 3x4.
fn inverse(pose: &[[f64; 4]; 3]) -> [[f64; 4]; 3] {
    [0, 1, 2].map(|r| {
        let column = pose.map(|row| row[r]);
        let shift: f64 = (0..3).map(|i| column[i] * pose[i][3]).sum();
        [column[0], column[1], column[2], -shift]
    })
}

impl DataSet for SscBench {
    fn classes(&self) -> &[&'static str] {
        &CLASSES
    }

    fn grid(&self) -> Grid {
        GRID
    }

    fn len(&self) -> usize {
        self.frames.len()
    }

    fn id(&self, index: usize) -> &str {
        &self.frames[index]
    }

    fn scene(&self, index: usize) -> Result<(Scene, Vec<Note>)> {
        let (drive, number) = self.frames[index].split_once('/').unwrap_or_default();
        let directory = self.root.join("data_2d_raw").join(drive).join(CAMERA).join("data_rect");
        // Images of KITTI-360 itself have ten digits.
        let short = directory.join(format!("{number}.png"));
        let path = if short.exists() { short } else { directory.join(format!("{number:0>10}.png")) };
        let mut notes = Vec::new();
        let scene = Scene {
            names: vec![CAMERA.to_owned()],
            images: vec![read_image(&path, CAMERA, None, &mut notes)?],
            lidar2img: vec![self.lidar2img],
        };
        Ok((scene, notes))
    }

    fn truth(&self, index: usize) -> Result<Truth> {
        let path = self.root.join("preprocess/labels").join(format!("{}_1_1.npy", self.frames[index]));
        let (shape, values) = read_npy_integers(&path)?;
        if shape != GRID.size {
            return Err(Error::format(format!("shape {shape:?}, expected {:?}", GRID.size)).in_file(&path));
        }
        let labels: Option<Vec<u8>> = values.iter().map(|&value| u8::try_from(value).ok()).collect();
        let labels = labels.ok_or_else(|| Error::format("a label beyond 255, expected a class").in_file(&path))?;
        check_labels(&labels, CLASSES.len()).map_err(|e| e.in_file(&path))?;
        Ok(Truth::of_lidar(labels))
    }
}

#[cfg(test)]
mod tests;

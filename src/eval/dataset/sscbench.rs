//! SSCBench's KITTI-360 as it is published (arXiv 2306.09001): drives of KITTI-360, and labelled voxels of every fifth frame.
//!
//! Below ROOT, `preprocess/labels/DRIVE/NNNNNN_1_1.npy` (u8 [256, 256, 32], classes as they are trained, 255 unknown),
//! `data_2d_raw/DRIVE/image_00/data_rect/NNNNNN.png` and KITTI-360's `calibration/perspective.txt` and
//! `calibration/calib_cam_to_velo.txt` are read. The labels at full resolution already have the unified classes, and what is
//! invalid in them; `voxels/*.{bin,label,invalid}`, from which they were made, are not read.

use super::semantickitti::GRID;
use super::{DataSet, Grid, Pose, Truth, check_labels};
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
            frames.extend(labelled(&directory)?.into_iter().map(|number| format!("{name}/{number}")));
        }
        Ok(Self { root: root.to_owned(), lidar2img, frames })
    }
}

/// Numbers of the frames with labels at full resolution in `directory`, ascending.
fn labelled(directory: &Path) -> Result<Vec<String>> {
    let failed = |e: &std::io::Error| Error::io(directory, "read", e);
    let mut numbers = Vec::new();
    for entry in std::fs::read_dir(directory).map_err(|e| failed(&e))? {
        let name = entry.map_err(|e| failed(&e))?.file_name();
        let number = name.to_str().and_then(|name| name.strip_suffix("_1_1.npy"));
        numbers.extend(number.filter(|n| !n.is_empty() && n.bytes().all(|b| b.is_ascii_digit())).map(str::to_owned));
    }
    if numbers.is_empty() {
        return Err(Error::format("no labels, expected files such as 000005_1_1.npy").in_file(directory));
    }
    numbers.sort_unstable();
    Ok(numbers)
}

/// P_rect_00 * R_rect_00 * inverse(camera to lidar), in f64 and rounded once.
fn calibration(directory: &Path) -> Result<[f32; 16]> {
    let read = |path: &Path| std::fs::read_to_string(path).map_err(|e| Error::io(path, "read", &e));
    let path = directory.join("perspective.txt");
    let text = read(&path)?;
    let projection: [f64; 12] = numbers(&text, Some("P_rect_00:")).map_err(|e| e.in_file(&path))?;
    let turn: [f64; 9] = numbers(&text, Some("R_rect_00:")).map_err(|e| e.in_file(&path))?;
    let path = directory.join("calib_cam_to_velo.txt");
    let camera: [f64; 12] = numbers(&read(&path)?, None).map_err(|e| e.in_file(&path))?;
    let lidar_to_camera = inverse(&camera).map_err(|e| e.in_file(&path))?;
    let mut matrix = [0.0; 16];
    matrix[15] = 1.0;
    for column in 0..4 {
        let point = [0, 1, 2].map(|row| lidar_to_camera[4 * row + column]);
        let turned = [0, 1, 2].map(|row| (0..3).map(|i| turn[3 * row + i] * point[i]).sum::<f64>());
        for row in 0..3 {
            let sum: f64 = (0..3).map(|i| projection[4 * row + i] * turned[i]).sum();
            matrix[4 * row + column] = (sum + if column == 3 { projection[4 * row + 3] } else { 0.0 }) as f32;
        }
    }
    check_finite(CAMERA, &matrix).map_err(|e| e.in_file(&path))?;
    Ok(matrix)
}

/// The numbers behind `key`, or of the first line.
fn numbers<const N: usize>(text: &str, key: Option<&str>) -> Result<[f64; N]> {
    let name = key.unwrap_or("first line");
    let line = match key {
        Some(key) => text.lines().find_map(|line| line.strip_prefix(key)),
        None => text.lines().next(),
    };
    let line = line.ok_or_else(|| Error::format(format!("no line \"{name}\", expected one of {N} numbers")))?;
    let parsed = line.split_whitespace().map(|word| {
        let number = word.parse::<f64>().ok().filter(|n| n.is_finite());
        number.ok_or_else(|| Error::format(format!("{name} {word:?}, expected a finite number")))
    });
    let numbers: Vec<f64> = parsed.collect::<Result<_>>()?;
    let found = numbers.len();
    numbers.try_into().map_err(|_| Error::format(format!("{name} {found} numbers, expected {N}")))
}

/// The inverse of a rigid 3x4.
fn inverse(matrix: &[f64; 12]) -> Result<[f64; 12]> {
    let row = |r: usize| [matrix[4 * r], matrix[4 * r + 1], matrix[4 * r + 2]];
    let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let rigid = (0..3).all(|i| (0..3).all(|j| (dot(row(i), row(j)) - f64::from(u8::from(i == j))).abs() < 1e-3));
    let [[a, b, c], [d, e, f], third] = [row(0), row(1), row(2)];
    let cross = [b * f - c * e, c * d - a * f, a * e - b * d];
    // Right angles alone would let a mirror pass.
    if !rigid || dot(cross, third) < 0.0 {
        return Err(Error::format("camera to lidar is no rotation, expected rows of length 1 at right angles"));
    }
    let shift = [3, 7, 11].map(|i| matrix[i]);
    let column = |c: usize| [matrix[c], matrix[4 + c], matrix[8 + c]];
    let mut inverse = [0.0; 12];
    for r in 0..3 {
        inverse[4 * r..4 * r + 3].copy_from_slice(&column(r));
        inverse[4 * r + 3] = -dot(column(r), shift);
    }
    Ok(inverse)
}

impl DataSet for SscBench {
    fn classes(&self) -> &[&'static str] {
        &CLASSES
    }

    fn grid(&self) -> Grid {
        GRID
    }

    fn masks(&self) -> &[&'static str] {
        &[]
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
        Ok(Truth { labels, masks: vec![], origins: vec![[0.0; 3]], grid_to_lidar: Pose::IDENTITY })
    }
}

#[cfg(test)]
mod tests;

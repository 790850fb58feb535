//! Occ3D's labels of the Waymo Open Dataset (arXiv 2304.14365): `LABELS/NNN/FFF_04.npz`, with the images and calibrations as
//! mmdetection3d's converter writes them ("KITTI format").
//!
//! Below ROOT, `training/image_0` to `image_4` (`.jpg` or `.png`) and `training/calib/*.txt` are read. A file is called
//! after its split, segment and frame: 0 for training or 1 for validation, three digits, three digits. Voxels lie in the frame
//! of the vehicle, which is the one in which Waymo gives its points and in which networks of it see.
//!
//! Of the two programs that Occ3D has published for its scores, one counts the voxels of its mask *camera*, the other those
//! that are in *camera* and in *fov*; the latter are a mask of their own here.

use super::arrays::Arrays;
use super::kitti::{product, rows};
use super::{Axes, DataSet, Grid, Pose, Truth};
use crate::base::error::{Error, Result};
use crate::base::note::Note;
use crate::image::file::read_image;
use crate::scene::{Scene, check_finite};
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// Names of the classes, in order; 0 is empty, the others are one above the labels as they are published.
pub const CLASSES: [&str; 16] = [
    "empty",
    "general object",
    "vehicle",
    "pedestrian",
    "sign",
    "cyclist",
    "traffic light",
    "pole",
    "construction cone",
    "bicycle",
    "motorcycle",
    "building",
    "vegetation",
    "tree trunk",
    "road",
    "walkable",
];

/// The cameras by Waymo's names, in the order of their folders: `image_0` is the first.
pub const CAMERAS: [&str; 5] = ["FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT"];

const GRID: Grid =
    Grid { size: [200, 200, 16], bounds: [[-40.0, 40.0], [-40.0, 40.0], [-1.0, 5.4]], axes: Axes::Lidar };

/// The stored labels of a voxel in which nothing is: of 0.4 m voxels, and as some copies keep it from the 0.1 m ones.
const FREE: [u8; 2] = [15, 23];

/// Where the uppermost lidar is mounted, in metres of the vehicle.
const LIDAR: [f64; 3] = [1.43, 0.0, 2.184];

/// Which split.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Split {
    /// Segments of training.
    Training,
    /// Segments of validation.
    Validation,
}

impl FromStr for Split {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        match text {
            "training" => Ok(Split::Training),
            "validation" => Ok(Split::Validation),
            _ => Err(format!("{text:?}, expected training or validation")),
        }
    }
}

/// Occ3D-Waymo: the frames with labels in the order of segment and number, with the masks `lidar`, `camera`, `fov` and `camera+fov`.
#[derive(Clone, Debug)]
pub struct Occ3dWaymo {
    root: PathBuf,
    labels: PathBuf,
    prefix: char,
    /// `NNN/FFF`.
    frames: Vec<String>,
}

impl Occ3dWaymo {
    /// Opens the labels in `labels`, or in its `training` or `validation`. Frames are listed, not read.
    ///
    /// # Errors
    /// [`ErrorKind::Io`](crate::ErrorKind::Io) if a directory cannot be read; [`ErrorKind::Format`](crate::ErrorKind::Format)
    /// if there are no labels.
    pub fn open(root: &Path, labels: &Path, split: Split) -> Result<Self> {
        let (name, prefix) = match split {
            Split::Training => ("training", '0'),
            Split::Validation => ("validation", '1'),
        };
        let below = labels.join(name);
        let labels = if below.is_dir() { below } else { labels.to_owned() };
        let is_number = |text: &str| text.len() == 3 && text.bytes().all(|b| b.is_ascii_digit());
        let mut frames = Vec::new();
        for segment in listed(&labels, |name| Some(name).filter(|name| is_number(name)).map(str::to_owned))? {
            let file = |name: &str| name.strip_suffix("_04.npz").filter(|n| is_number(n)).map(str::to_owned);
            frames.extend(listed(&labels.join(&segment), file)?.into_iter().map(|frame| format!("{segment}/{frame}")));
        }
        if frames.is_empty() {
            return Err(Error::format("no labels, expected files such as 000/000_04.npz").in_file(&labels));
        }
        Ok(Self { root: root.to_owned(), labels, prefix, frames })
    }

    /// What the converter calls the files of a frame.
    fn file(&self, index: usize) -> String {
        format!("{}{}", self.prefix, self.frames[index].replace('/', ""))
    }
}

/// What `name` makes of the entries of a directory, ascending.
fn listed(directory: &Path, name: impl Fn(&str) -> Option<String>) -> Result<Vec<String>> {
    let failed = |e: &std::io::Error| Error::io(directory, "read", e);
    let mut found = Vec::new();
    for entry in std::fs::read_dir(directory).map_err(|e| failed(&e))? {
        found.extend(entry.map_err(|e| failed(&e))?.file_name().to_str().and_then(&name));
    }
    found.sort_unstable();
    Ok(found)
}

impl DataSet for Occ3dWaymo {
    fn classes(&self) -> &[&'static str] {
        &CLASSES
    }

    fn grid(&self) -> Grid {
        GRID
    }

    fn masks(&self) -> &[&'static str] {
        &["lidar", "camera", "fov", "camera+fov"]
    }

    fn len(&self) -> usize {
        self.frames.len()
    }

    fn id(&self, index: usize) -> &str {
        &self.frames[index]
    }

    fn scene(&self, index: usize) -> Result<(Scene, Vec<Note>)> {
        let file = self.file(index);
        let path = self.root.join("training/calib").join(format!("{file}.txt"));
        let text = std::fs::read_to_string(&path).map_err(|e| Error::io(&path, "read", &e))?;
        let mut notes = Vec::new();
        let mut scene = Scene { names: Vec::new(), images: Vec::new(), lidar2img: Vec::new() };
        for (camera, name) in CAMERAS.into_iter().enumerate() {
            let matrix = rows(&text, &format!("P{camera}"))
                .and_then(|projection| {
                    let pose = rows(&text, &format!("Tr_velo_to_cam_{camera}"))?;
                    let matrix = product(&projection, &pose);
                    check_finite(name, &matrix)?;
                    Ok(matrix)
                })
                .map_err(|e| e.in_file(&path))?;
            let images = self.root.join(format!("training/image_{camera}"));
            let jpeg = images.join(format!("{file}.jpg"));
            let image = if jpeg.exists() { jpeg } else { images.join(format!("{file}.png")) };
            scene.images.push(read_image(&image, name, None, &mut notes)?);
            scene.names.push(name.to_owned());
            scene.lidar2img.push(matrix);
        }
        Ok((scene, notes))
    }

    fn truth(&self, index: usize) -> Result<Truth> {
        let path = self.labels.join(format!("{}_04.npz", self.frames[index]));
        let mut arrays = Arrays::read(&path)?;
        let mut labels = arrays.take("voxel_label", GRID.size, FREE[1])?;
        if let Some(at) = labels.iter().position(|&label| label > FREE[0] && label != FREE[1]) {
            let message = format!("array \"voxel_label\": voxel {at} is {}, expected 0 to 15, or 23", labels[at]);
            return Err(Error::format(message).in_file(&path));
        }
        for label in &mut labels {
            *label = if FREE.contains(label) { 0 } else { *label + 1 };
        }
        let masks = ["origin_voxel_state", "final_voxel_state", "infov"].map(|name| {
            let mask = arrays.take(name, GRID.size, u8::MAX)?;
            Ok(mask.into_iter().map(|state| u8::from(state != 0)).collect())
        });
        let mut masks = masks.into_iter().collect::<Result<Vec<Vec<u8>>>>()?;
        masks.push(masks[1].iter().zip(&masks[2]).map(|(camera, fov)| camera & fov).collect());
        Ok(Truth { labels, masks, origins: vec![LIDAR], grid_to_lidar: Pose::IDENTITY })
    }
}

#[cfg(test)]
mod tests;

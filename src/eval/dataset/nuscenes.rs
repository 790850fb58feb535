//! nuScenes v1.0 as it is published (arXiv 1903.11027), with the labels of SurroundOcc (arXiv 2303.09551), of Occ3D
//! (arXiv 2304.14365) or of OpenOcc v2 (arXiv 2306.02851).
//!
//! Of the tables, `scene`, `sample`, `sample_data`, `calibrated_sensor`, `ego_pose` and `sensor` are read; of the samples,
//! the images of the six cameras at key frames. The lidar's sweeps are not read, but frames are in its frame of reference.

mod labels;
mod splits;
mod tables;

use super::{DataSet, Grid, Pose, Published, Truth};
use crate::base::error::{Error, Result};
use crate::base::note::Note;
use crate::image::file::read_image;
use crate::scene::Scene;
pub use crate::scene::camera::NUSCENES_RING as CAMERAS;
use crate::synth::CLASSES;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// The sensor in whose frame of reference networks see.
const LIDAR: &str = "LIDAR_TOP";

/// Whose labels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Labels {
    /// `samples/<file of LIDAR_TOP>.npy`, or the same without `samples`: 200 x 200 x 16 voxels of 0.5 m in the lidar frame.
    SurroundOcc,
    /// `<scene>/<sample>/labels.npz`: 200 x 200 x 16 voxels of 0.4 m in the ego frame, with the masks `lidar` and `camera`.
    Occ3d,
    /// `<scene>/<sample>/labels.npz` as Occ3D's, with classes in another order, without "others" and masks.
    OpenOcc,
}

/// Which scenes of the tables.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Scenes {
    /// All.
    All,
    /// Those of the official validation split.
    Val,
    /// All but those.
    Train,
    /// Those that a text file names, one a line.
    Listed(PathBuf),
}

impl Scenes {
    /// The names that are listed, and the file that does; none if no file does.
    fn listed(&self) -> Result<(BTreeSet<String>, Option<&Path>)> {
        let Scenes::Listed(path) = self else { return Ok((BTreeSet::new(), None)) };
        let text = std::fs::read_to_string(path).map_err(|e| Error::io(path, "read", &e))?;
        let names: BTreeSet<String> = text.split_whitespace().map(str::to_owned).collect();
        if names.is_empty() {
            return Err(Error::format("no names of scenes, expected one a line").in_file(path));
        }
        Ok((names, Some(path)))
    }

    fn has(&self, name: &str, listed: &BTreeSet<String>) -> bool {
        match self {
            Scenes::All => true,
            Scenes::Val => splits::is_val(name),
            Scenes::Train => !splits::is_val(name),
            Scenes::Listed(_) => listed.contains(name),
        }
    }
}

/// nuScenes with labels: key frames in the order of their scenes' names and of time.
#[derive(Clone, Debug)]
pub struct NuScenes {
    /// Where `samples` is.
    root: PathBuf,
    labels: Labels,
    /// Where the labels are.
    directory: PathBuf,
    entries: Vec<Entry>,
}

/// What the tables say of a key frame.
#[derive(Clone, Debug)]
struct Entry {
    /// `<scene>/<sample>`.
    id: String,
    /// File of the lidar's sweep.
    lidar: String,
    /// In the order of [`CAMERAS`].
    cameras: Vec<CameraImage>,
    lidar_to_ego: Pose,
    lidar_to_global: Pose,
}

#[derive(Clone, Debug)]
struct CameraImage {
    /// Its image, below the root.
    filename: String,
    /// Height and width.
    size: [usize; 2],
    lidar2img: [f32; 16],
}

impl NuScenes {
    /// Reads the tables below `root`, or in it: `root/v1.0-*`, of which there must be one alone, or a directory of tables
    /// that has the samples beside it. `directory` holds the labels. Images and labels are read frame by frame.
    ///
    /// # Errors
    /// [`ErrorKind::Io`](crate::ErrorKind::Io) for a table that cannot be read; [`ErrorKind::Format`](crate::ErrorKind::Format)
    /// for one that is malformed, refers to a row that is not there, or lacks a sensor of a key frame;
    /// [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) for a listed scene that the tables do not have.
    pub fn open(root: &Path, labels: Labels, directory: &Path, scenes: &Scenes) -> Result<Self> {
        let (root, tables) = find_tables(root)?;
        let entries = tables::read(&tables, scenes)?;
        let samples = directory.join("samples");
        let directory = if labels == Labels::SurroundOcc && samples.is_dir() { samples } else { directory.to_owned() };
        Ok(Self { root, labels, directory, entries })
    }
}

/// What the challenge of OpenOcc needs to know.
impl NuScenes {
    /// Whose labels it has.
    pub fn labels(&self) -> Labels {
        self.labels
    }

    /// The token of the sample that frame `index` is.
    ///
    /// # Panics
    /// If there is no such frame.
    pub fn sample(&self, index: usize) -> &str {
        self.entries[index].id.rsplit('/').next().unwrap_or_default()
    }

    /// The frame of Occ3D's and OpenOcc's voxels in that of the lidar, at frame `index`.
    ///
    /// # Panics
    /// If there is no such frame.
    pub fn grid_to_lidar(&self, index: usize) -> Pose {
        self.entries[index].lidar_to_ego.inverse()
    }

    /// The places of the lidar in all frames of the scene of frame `index`, in metres of its vehicle, as the published program of
    /// the challenge takes them: in the order of time, less than 39 m away along x and y, and of more than eight, eight that are spread evenly.
    ///
    /// # Panics
    /// If there is no such frame.
    pub fn ray_origins(&self, index: usize) -> Vec<[f64; 3]> {
        let frame = &self.entries[index];
        let scene = |entry: &Entry| entry.id.split('/').next().map(str::to_owned);
        let from_global = frame.lidar_to_global.inverse();
        let mut places = Vec::new();
        for other in self.entries.iter().filter(|other| scene(other) == scene(frame)) {
            // The program keeps them in f32, and the frame's own as exactly 0.
            let place = if other.id == frame.id { [0.0; 3] } else { (from_global * other.lidar_to_global).origin() };
            let place = frame.lidar_to_ego.apply(place.map(|v| f64::from(v as f32)));
            if place[0].abs() < 39.0 && place[1].abs() < 39.0 {
                places.push(place);
            }
        }
        match places.len() {
            0..=8 => places,
            count => (0..8).map(|i| places[(i as f64 * (count - 1) as f64 / 7.0).round() as usize]).collect(),
        }
    }

    /// The number that OpenOcc gives a class.
    ///
    /// # Panics
    /// If `class` is none.
    pub fn published_class(&self, class: u8) -> u8 {
        labels::openocc_label(class)
    }
}

/// Where samples are, and where tables are.
fn find_tables(root: &Path) -> Result<(PathBuf, PathBuf)> {
    if root.join("sample.json").is_file() {
        let beside = match root.parent().filter(|_| root.file_name().is_some()) {
            Some(parent) => parent.to_owned(),
            None => root.join(".."),
        };
        return Ok((beside, root.to_owned()));
    }
    let failed = |e: &std::io::Error| Error::io(root, "read", e);
    let mut found = Vec::new();
    for entry in std::fs::read_dir(root).map_err(|e| failed(&e))? {
        let entry = entry.map_err(|e| failed(&e))?;
        let named = entry.file_name().to_str().is_some_and(|name| name.starts_with("v1.0-"));
        found.extend((named && entry.path().is_dir()).then(|| entry.path()));
    }
    found.sort_unstable();
    match &found[..] {
        [tables] => Ok((root.to_owned(), tables.clone())),
        [] => Err(Error::format("no tables, expected a directory such as v1.0-trainval").in_file(root)),
        [first, ..] => {
            let message =
                format!("{} versions, expected one; name its directory, such as {}", found.len(), first.display());
            Err(Error::format(message).in_file(root))
        }
    }
}

impl DataSet for NuScenes {
    fn classes(&self) -> &[&'static str] {
        &CLASSES
    }

    fn grid(&self) -> Grid {
        match self.labels {
            Labels::SurroundOcc => labels::SURROUNDOCC,
            Labels::Occ3d | Labels::OpenOcc => labels::OCC3D,
        }
    }

    fn masks(&self) -> &[&'static str] {
        match self.labels {
            Labels::SurroundOcc | Labels::OpenOcc => &[],
            Labels::Occ3d => &["lidar", "camera"],
        }
    }

    fn published(&self) -> Option<Published> {
        match self.labels {
            Labels::SurroundOcc => Some(Published::LabelsBrought),
            Labels::Occ3d => Some(Published::WithOthers { mask: 1 }),
            Labels::OpenOcc => None,
        }
    }

    fn len(&self) -> usize {
        self.entries.len()
    }

    fn id(&self, index: usize) -> &str {
        &self.entries[index].id
    }

    fn scene(&self, index: usize) -> Result<(Scene, Vec<Note>)> {
        let mut notes = Vec::new();
        let mut scene = Scene { names: Vec::new(), images: Vec::new(), lidar2img: Vec::new() };
        for (camera, name) in self.entries[index].cameras.iter().zip(CAMERAS) {
            scene.images.push(read_image(&self.root.join(&camera.filename), name, Some(camera.size), &mut notes)?);
            scene.names.push(name.to_owned());
            scene.lidar2img.push(camera.lidar2img);
        }
        Ok((scene, notes))
    }

    fn truth(&self, index: usize) -> Result<Truth> {
        let entry = &self.entries[index];
        match self.labels {
            Labels::SurroundOcc => {
                let name = entry.lidar.rsplit('/').next().unwrap_or_default();
                let labels = labels::read_surroundocc(&self.directory.join(format!("{name}.npy")))?;
                Ok(Truth { labels, masks: vec![], origins: vec![[0.0; 3]], grid_to_lidar: Pose::IDENTITY })
            }
            Labels::Occ3d => {
                let (labels, masks) = labels::read_occ3d(&self.directory.join(&entry.id).join("labels.npz"))?;
                let origins = vec![entry.lidar_to_ego.origin()];
                Ok(Truth { labels, masks, origins, grid_to_lidar: entry.lidar_to_ego.inverse() })
            }
            Labels::OpenOcc => {
                let labels = labels::read_openocc(&self.directory.join(&entry.id).join("labels.npz"))?;
                let origins = vec![entry.lidar_to_ego.origin()];
                Ok(Truth { labels, masks: vec![], origins, grid_to_lidar: entry.lidar_to_ego.inverse() })
            }
        }
    }
}

#[cfg(test)]
mod tests;

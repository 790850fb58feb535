//! UniOcc as it is published (arXiv 2503.24381): frames of several data sets in one format, with the calibration beside the labels.
//!
//! `ROOT/scene_infos.pkl` lists the scenes and their frames, and each frame is an `.npz` below ROOT: `occ_label` and
//! `occ_mask_camera` of integers [200, 200, 16], and `cameras`, a list of dicts with `name` (or `cam_name`), `filename`,
//! `intrinsics` [3, 3] and `extrinsics` [4, 4], camera to vehicle. Images lie in the data set that the frames come from. Flows,
//! annotations and the vehicle's pose are not read.
//!
//! The list of scenes and the cameras are pickles. They are not executed: plain values and NumPy's arrays are built by a
//! machine that can do nothing else, and whatever else they name is refused.

use super::{Axes, DataSet, Frame, Grid, Pose, Truth, is_inside};
use crate::base::error::{Error, ErrorKind, Result};
use crate::base::note::Note;
use crate::file::bounded::read_bounded;
use crate::file::npz::{RawArray, read_npz_raw};
use crate::file::pickle::numpy::NumPy;
use crate::file::pickle::{Id, Pickle, Value};
use crate::image::file::read_image;
use crate::scene::camera::NUSCENES_RING;
use crate::scene::matrix::{check_intrinsic, check_rigid};
use crate::scene::{Scene, check_finite};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Names of the classes, in order; 0 is empty. 1 to 9 are the labels as they are published, of which 0 is "others" here last.
pub const CLASSES: [&str; 11] = [
    "empty",
    "car",
    "bicycle",
    "motorcycle",
    "pedestrian",
    "traffic cone",
    "vegetation",
    "road",
    "terrain",
    "building",
    "others",
];

const GRID: Grid =
    Grid { size: [200, 200, 16], bounds: [[-40.0, 40.0], [-40.0, 40.0], [-1.0, 5.4]], axes: Axes::Lidar };

/// The stored label of a voxel in which nothing is.
const FREE: i64 = 10;

/// The stored label of a voxel of no other class.
const OTHERS: i64 = 0;

/// The arrays of a frame that are read.
const CAMERAS: &str = "cameras";
const LABELS: &str = "occ_label";
const MASK: &str = "occ_mask_camera";
const ALL: [&str; 3] = [CAMERAS, LABELS, MASK];

/// Most bytes of a list of scenes: those of 28,130 frames have two million.
const MAX_LIST: u64 = 1 << 28;

/// Most that the axis along which a camera looks may rise or fall, as a sine: those of vehicles look around.
const STEEPEST: f64 = 0.8;

/// UniOcc: the frames in the order of its list, with the mask `camera`.
#[derive(Clone, Debug)]
pub struct UniOcc {
    root: PathBuf,
    images: PathBuf,
    /// Files of the frames below the root, without `.npz`.
    frames: Vec<String>,
}

impl UniOcc {
    /// Opens the set in `root`, whose images lie below `images`. Frames are listed, not read.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if the list cannot be read; [`ErrorKind::Format`] if it is malformed, names anything but plain
    /// values and arrays, or lists no frame, one twice, or one outside of the set.
    pub fn open(root: &Path, images: &Path) -> Result<Self> {
        let path = root.join("scene_infos.pkl");
        let frames = read_bounded(&path, MAX_LIST).and_then(|bytes| listed(&bytes)).map_err(|e| e.in_file(&path))?;
        Ok(Self { root: root.to_owned(), images: images.to_owned(), frames })
    }

    fn arrays(&self, index: usize, names: &[&str]) -> Result<Arrays> {
        Arrays::read(self.root.join(format!("{}.npz", self.frames[index])), names)
    }
}

/// The frames of a list of scenes. Of sets with several vehicles a scene, each has a list of its own.
fn listed(bytes: &[u8]) -> Result<Vec<String>> {
    let pickle = Pickle::<NumPy>::parse(bytes, "the list of scenes")?;
    let wrong = |what: &Value<NumPy>, expected: &str| {
        Error::format(format!("the list of scenes has {}, expected {expected}", what.kind()))
    };
    let scenes = pickle.elements(pickle.root_id()).ok_or_else(|| wrong(pickle.root(), "a list of dicts"))?;
    let mut frames = Vec::new();
    for &scene in scenes {
        let Value::Dict(keys) = pickle.get(scene) else {
            return Err(wrong(pickle.get(scene), "a dict for each scene"));
        };
        let vehicles = pickle.under(keys, "egos").and_then(|id| pickle.elements(id));
        for &vehicle in vehicles.unwrap_or(&[scene]) {
            let Value::Dict(keys) = pickle.get(vehicle) else {
                return Err(wrong(pickle.get(vehicle), "a dict for each vehicle"));
            };
            let paths = pickle.under(keys, "occ_in_scene_paths").and_then(|id| pickle.elements(id));
            let paths = paths.ok_or_else(|| {
                Error::format("a scene without a list \"occ_in_scene_paths\", expected the files of its frames")
            })?;
            for &path in paths {
                frames.push(frame_of(&pickle, path)?);
            }
        }
    }
    // As paths, for `a//b` is the file `a/b`.
    let mut seen = BTreeSet::new();
    match frames.iter().find(|frame| !seen.insert(Path::new(*frame))) {
        Some(twice) => Err(Error::format(format!("frame {twice:?} is there twice"))),
        None if frames.is_empty() => Err(Error::format("no frames, expected some")),
        None => Ok(frames),
    }
}

/// The name of a frame, whose file is named. It is a path below the set as well, for results may be named after it: `..npz`
/// and `a/.npz` are files, but `.` and `a/` are no frames.
fn frame_of(pickle: &Pickle<'_, NumPy>, id: Id) -> Result<String> {
    let path = string(pickle, id).map_err(|found| Error::format(format!("the file of a frame is {found}")))?;
    let named = |frame: &&str| is_inside(path) && is_inside(frame) && !frame.ends_with('/');
    match path.strip_suffix(".npz").filter(named) {
        Some(frame) => Ok(frame.to_owned()),
        None => Err(Error::format(format!("file {path:?}, expected a named .npz below the set"))),
    }
}

/// A string, or what is there instead.
fn string<'a>(pickle: &Pickle<'a, NumPy>, id: Id) -> std::result::Result<&'a str, String> {
    match pickle.get(id) {
        &Value::Str(text) => std::str::from_utf8(pickle.text(text)).map_err(|_| "not UTF-8".to_owned()),
        other => Err(format!("{}, expected a string", other.kind())),
    }
}

impl UniOcc {
    /// Images and calibration of the frame in the file `path`.
    fn read_scene(&self, path: &Path, cameras: &[Camera]) -> Result<(Scene, Vec<Note>)> {
        let mut notes = Vec::new();
        let mut scene = Scene { names: Vec::new(), images: Vec::new(), lidar2img: Vec::new() };
        for camera in cameras {
            let matrix = camera.to_vehicle.inverse().then_project(&camera.intrinsic);
            check_finite(&camera.name, &matrix).map_err(|e| e.in_file(path))?;
            scene.images.push(read_image(&self.images.join(&camera.file), &camera.name, None, &mut notes)?);
            scene.names.push(camera.name.clone());
            scene.lidar2img.push(matrix);
        }
        let height = cameras.iter().map(|camera| camera.to_vehicle.origin()[2]).sum::<f64>() / cameras.len() as f64;
        if height < 0.0 {
            let message = "its cameras lie below the ground of the voxels: do the extrinsics lead to another frame?";
            notes.push(Note::new(message).in_file(path));
        }
        Ok((scene, notes))
    }
}

/// What a frame says of a camera.
struct Camera {
    name: String,
    /// Its image below the root of the images.
    file: String,
    intrinsic: [[f64; 3]; 3],
    to_vehicle: Pose,
}

/// The cameras of a frame: in the order of [`NUSCENES_RING`] where they have its names, else in that of the file.
fn cameras(array: &RawArray) -> Result<Vec<Camera>> {
    if array.descr != "|O" {
        let message = format!("array \"cameras\" is of type {:?}, expected objects", array.descr);
        return Err(Error::format(message));
    }
    let pickle = Pickle::<NumPy>::parse(&array.bytes, "array \"cameras\"")?;
    let root = pickle.root();
    let elements = pickle.elements(pickle.root_id());
    let elements = elements
        .filter(|cameras| !cameras.is_empty())
        .ok_or_else(|| Error::format(format!("array \"cameras\" is {}, expected a list of cameras", root.kind())))?;
    let mut cameras = elements.iter().map(|&camera| read_camera(&pickle, camera)).collect::<Result<Vec<_>>>()?;
    let place = |camera: &Camera| NUSCENES_RING.iter().position(|name| *name == camera.name);
    if cameras.iter().all(|camera| place(camera).is_some()) {
        cameras.sort_by_key(place);
    }
    Ok(cameras)
}

fn read_camera(pickle: &Pickle<'_, NumPy>, id: Id) -> Result<Camera> {
    let Value::Dict(keys) = pickle.get(id) else {
        return Err(Error::format(format!("a camera is {}, expected a dict", pickle.get(id).kind())));
    };
    let name = pickle.under(keys, "name").or_else(|| pickle.under(keys, "cam_name"));
    let name = name.ok_or_else(|| Error::format("a camera without \"name\""))?;
    let name = string(pickle, name).map_err(|found| Error::format(format!("the name of a camera is {found}")))?;
    let wrong = |what: String| Error::format(format!("camera {name:?}: {what}"));
    let get = |key: &str| pickle.under(keys, key).ok_or_else(|| wrong(format!("no \"{key}\"")));
    let file = string(pickle, get("filename")?).map_err(|found| wrong(format!("\"filename\" is {found}")))?;
    if !is_inside(file) {
        return Err(wrong(format!("\"filename\" is {file:?}, expected a path below the data set of the images")));
    }
    let intrinsic = pickle
        .matrix(get("intrinsics")?)
        .map_err(|found| wrong(format!("\"intrinsics\" is {found}, expected [3, 3] numbers")))?;
    check_intrinsic(&intrinsic)
        .map_err(|(found, expected)| wrong(format!("\"intrinsics\": {found}, expected {expected}")))?;
    let to_vehicle = pickle
        .matrix(get("extrinsics")?)
        .map_err(|found| wrong(format!("\"extrinsics\" is {found}, expected [4, 4] numbers")))?;
    check_rigid(&to_vehicle)
        .map_err(|(found, expected)| wrong(format!("\"extrinsics\": {found}, expected {expected}")))?;
    // CARLA's cameras have their x ahead and their z up.
    if to_vehicle[2][2].abs() > STEEPEST {
        let message = format!(
            "camera {name:?}: \"extrinsics\" have its third axis upright, expected the one along which it looks: x to the \
             right, y down, z ahead"
        );
        return Err(Error::new(ErrorKind::Unsupported, message));
    }
    let to_vehicle = Pose::from_rigid(&to_vehicle);
    Ok(Camera { name: name.to_owned(), file: file.to_owned(), intrinsic, to_vehicle })
}

/// The arrays of a frame that are called one of `names`.
struct Arrays {
    path: PathBuf,
    found: Vec<RawArray>,
}

impl Arrays {
    fn read(path: PathBuf, names: &[&str]) -> Result<Self> {
        Ok(Self { found: read_npz_raw(&path, names)?, path })
    }

    fn get(&self, name: &str) -> Result<&RawArray> {
        let array = self.found.iter().find(|array| array.name == name);
        array.ok_or_else(|| Error::format(format!("no array \"{name}\"")).in_file(&self.path))
    }

    fn cameras(&self) -> Result<Vec<Camera>> {
        cameras(self.get(CAMERAS)?).map_err(|e| e.in_file(&self.path))
    }

    fn truth(&self, cameras: &[Camera]) -> Result<Truth> {
        let labels = self.voxels(LABELS, "0 to 10", |label| match label {
            FREE => Some(0),
            OTHERS => Some(CLASSES.len() as u8 - 1),
            1..FREE => Some(label as u8),
            _ => None,
        })?;
        let mask = self.voxels(MASK, "0 or 1", |inside| u8::try_from(inside).ok().filter(|&inside| inside < 2))?;
        // Nothing says where a lidar is; the middle of the cameras has the same view.
        let place = |axis: usize| {
            let places = cameras.iter().map(|camera| camera.to_vehicle.origin()[axis]);
            places.sum::<f64>() / cameras.len() as f64
        };
        let origins = vec![[0, 1, 2].map(place)];
        Ok(Truth { labels, masks: vec![mask], origins, grid_to_lidar: Pose::IDENTITY })
    }

    /// What `read` makes of every voxel's integer.
    fn voxels(&self, name: &str, expected: &str, read: impl Fn(i64) -> Option<u8>) -> Result<Vec<u8>> {
        let array = self.get(name)?;
        let failed = |message: String| Error::format(format!("array \"{name}\": {message}")).in_file(&self.path);
        if array.shape != GRID.size {
            return Err(failed(format!("shape {:?}, expected {:?}", array.shape, GRID.size)));
        }
        let stored = array
            .integers()
            .map_err(|e| Error::new(e.kind(), format!("array \"{name}\": {}", e.message())).in_file(&self.path))?;
        let voxel = |(at, &value): (usize, &i64)| {
            read(value).ok_or_else(|| failed(format!("voxel {at} is {value}, expected {expected}")))
        };
        stored.iter().enumerate().map(voxel).collect()
    }
}

impl DataSet for UniOcc {
    fn classes(&self) -> &[&'static str] {
        &CLASSES
    }

    fn grid(&self) -> Grid {
        GRID
    }

    fn masks(&self) -> &[&'static str] {
        &["camera"]
    }

    fn len(&self) -> usize {
        self.frames.len()
    }

    fn id(&self, index: usize) -> &str {
        &self.frames[index]
    }

    fn frame(&self, index: usize) -> Result<Frame> {
        let arrays = self.arrays(index, &ALL)?;
        let cameras = arrays.cameras()?;
        let (scene, notes) = self.read_scene(&arrays.path, &cameras)?;
        Ok(Frame { scene, truth: arrays.truth(&cameras)?, notes })
    }

    fn scene(&self, index: usize) -> Result<(Scene, Vec<Note>)> {
        let arrays = self.arrays(index, &[CAMERAS])?;
        self.read_scene(&arrays.path, &arrays.cameras()?)
    }

    fn truth(&self, index: usize) -> Result<Truth> {
        let arrays = self.arrays(index, &ALL)?;
        arrays.truth(&arrays.cameras()?)
    }
}

#[cfg(test)]
mod tests;

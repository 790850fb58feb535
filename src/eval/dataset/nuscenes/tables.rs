//! The tables of nuScenes: JSON lists of rows that refer to one another by token. The largest have gigabytes, of which key
//! frames need a tenth; so rows are read one by one, and what is not needed is dropped at once.

use super::super::{Pose, is_inside};
use super::{CAMERAS, CameraImage, Entry, LIDAR, Scenes};
use crate::base::error::{Error, Result};
use crate::scene::check_finite;
use crate::scene::matrix::check_intrinsic;
use serde::de::{DeserializeOwned, DeserializeSeed, Deserializer, SeqAccess, Visitor};
use std::collections::HashMap;
use std::fs::File;
use std::io::BufReader;
use std::marker::PhantomData;
use std::path::{Path, PathBuf};

/// Sensors that a frame needs: the cameras in their order, then the lidar.
const SENSORS: usize = CAMERAS.len() + 1;

#[derive(serde::Deserialize)]
struct SensorRow {
    token: String,
    channel: String,
}

#[derive(serde::Deserialize)]
struct CalibratedRow {
    token: String,
    sensor_token: String,
    translation: Vec<f64>,
    rotation: Vec<f64>,
    camera_intrinsic: Vec<Vec<f64>>,
}

#[derive(serde::Deserialize)]
struct SceneRow {
    token: String,
    name: String,
}

#[derive(serde::Deserialize)]
struct SampleRow {
    token: String,
    timestamp: u64,
    scene_token: String,
}

#[derive(serde::Deserialize)]
struct DataRow {
    token: String,
    sample_token: String,
    ego_pose_token: String,
    calibrated_sensor_token: String,
    filename: String,
    is_key_frame: bool,
    height: usize,
    width: usize,
}

#[derive(serde::Deserialize)]
struct EgoRow {
    token: String,
    translation: Vec<f64>,
    rotation: Vec<f64>,
}

/// How a sensor is mounted.
struct Calibrated {
    /// Which of the [`SENSORS`], if any.
    sensor: Option<usize>,
    to_ego: Pose,
    /// Empty for a lidar.
    intrinsic: Vec<Vec<f64>>,
}

/// A key frame in the making.
struct Sample {
    scene: String,
    token: String,
    timestamp: u64,
    records: [Option<Record>; SENSORS],
}

/// What one sensor saw.
struct Record {
    token: String,
    filename: String,
    size: [usize; 2],
    calibrated: String,
    ego: String,
}

/// The key frames of `scenes` in the tables of `directory`, in the order of scene and time.
///
/// # Errors
/// [`ErrorKind::Io`](crate::ErrorKind::Io) for a table that cannot be read; [`ErrorKind::Format`](crate::ErrorKind::Format)
/// for one that is malformed, for a token that is not there, and for a key frame without one of its sensors.
pub(super) fn read(directory: &Path, scenes: &Scenes) -> Result<Vec<Entry>> {
    let tables = Tables { directory };
    let calibrated = tables.calibrated()?;
    let mut samples = tables.samples(&tables.scenes(scenes)?)?;
    let mut egos = tables.records(&mut samples, &calibrated)?;
    tables.egos(&mut egos)?;
    let mut samples: Vec<Sample> = samples.into_values().flatten().collect();
    samples.sort_by(|a, b| (&a.scene, a.timestamp, &a.token).cmp(&(&b.scene, b.timestamp, &b.token)));
    if samples.is_empty() {
        return Err(Error::format("no key frames of the scenes that are asked for").in_file(&tables.path("sample")));
    }
    let entry = |sample| entry(sample, &calibrated, &egos).map_err(|e| e.in_file(&tables.path("sample_data")));
    samples.into_iter().map(entry).collect()
}

struct Tables<'a> {
    directory: &'a Path,
}

impl Tables<'_> {
    fn path(&self, table: &str) -> PathBuf {
        self.directory.join(format!("{table}.json"))
    }

    /// Calls `row` with each row of a table.
    fn each<T: DeserializeOwned>(&self, table: &str, row: impl FnMut(T) -> Result<()>) -> Result<()> {
        let path = self.path(table);
        let file = File::open(&path).map_err(|e| Error::io(&path, "open", &e))?;
        let mut json = serde_json::Deserializer::from_reader(BufReader::with_capacity(1 << 18, file));
        let mut rows = EachRow { row, failed: None, kind: PhantomData };
        let parsed = (&mut rows).deserialize(&mut json).and_then(|()| json.end());
        match (rows.failed, parsed) {
            (Some(error), _) => Err(error.in_file(&path)),
            (None, Err(e)) if e.is_io() => Err(Error::io(&path, "read", &e.into())),
            (None, Err(e)) => Err(Error::format(format!("table does not parse: {e}")).in_file(&path)),
            (None, Ok(())) => Ok(()),
        }
    }

    /// Every calibrated sensor by its token.
    fn calibrated(&self) -> Result<HashMap<String, Calibrated>> {
        let mut channels = HashMap::new();
        self.each("sensor", |row: SensorRow| insert(&mut channels, row.token, row.channel))?;
        let mut calibrated = HashMap::new();
        self.each("calibrated_sensor", |row: CalibratedRow| {
            let channel = find(&channels, &row.sensor_token, "sensor").map_err(|e| of_row(&row.token, &e))?;
            let to_ego = pose(&row.rotation, &row.translation).map_err(|e| of_row(&row.token, &e))?;
            let sensor = CAMERAS.iter().chain([&LIDAR]).position(|name| name == channel);
            insert(&mut calibrated, row.token, Calibrated { sensor, to_ego, intrinsic: row.camera_intrinsic })
        })?;
        Ok(calibrated)
    }

    /// The name of every scene by its token; none for those that are not asked for.
    fn scenes(&self, scenes: &Scenes) -> Result<HashMap<String, Option<String>>> {
        let (listed, list) = scenes.listed()?;
        let mut unseen = listed.clone();
        let mut names = HashMap::new();
        self.each("scene", |row: SceneRow| {
            // Labels lie in folders of these names.
            if !is_inside(&row.name) {
                return Err(of_row(&row.token, &Error::format(format!("name {:?}, expected a file name", row.name))));
            }
            unseen.remove(&row.name);
            let wanted = scenes.has(&row.name, &listed);
            insert(&mut names, row.token, wanted.then_some(row.name))
        })?;
        match (unseen.first(), list) {
            (Some(name), Some(list)) => {
                let message = format!("scene {name:?} is not in {}", self.path("scene").display());
                Err(Error::mismatch(message).in_file(list))
            }
            _ => Ok(names),
        }
    }

    /// Every sample by its token; none for those of other scenes.
    fn samples(&self, scenes: &HashMap<String, Option<String>>) -> Result<HashMap<String, Option<Sample>>> {
        let mut samples = HashMap::new();
        self.each("sample", |row: SampleRow| {
            let scene = find(scenes, &row.scene_token, "scene").map_err(|e| of_row(&row.token, &e))?;
            if !is_inside(&row.token) {
                return Err(Error::format(format!("token {:?}, expected a file name", row.token)));
            }
            let sample = scene.clone().map(|scene| Sample {
                scene,
                token: row.token.clone(),
                timestamp: row.timestamp,
                records: std::array::from_fn(|_| None),
            });
            insert(&mut samples, row.token, sample)
        })?;
        Ok(samples)
    }

    /// Gives the samples what their sensors saw. The result has the tokens of the poses that this needs.
    fn records(
        &self,
        samples: &mut HashMap<String, Option<Sample>>,
        calibrated: &HashMap<String, Calibrated>,
    ) -> Result<HashMap<String, Option<Pose>>> {
        let mut egos = HashMap::new();
        self.each("sample_data", |row: DataRow| {
            if !row.is_key_frame {
                return Ok(());
            }
            let failed = |e: Error| of_row(&row.token, &e);
            let sensor = find(calibrated, &row.calibrated_sensor_token, "calibrated_sensor").map_err(failed)?.sensor;
            let sample = samples.get_mut(&row.sample_token);
            let sample = sample.ok_or_else(|| failed(missing(&row.sample_token, "sample")))?;
            let (Some(sensor), Some(sample)) = (sensor, sample) else { return Ok(()) };
            if !is_inside(&row.filename) {
                let message = format!("filename {:?}, expected a path below the data set", row.filename);
                return Err(failed(Error::format(message)));
            }
            if let Some(other) = &sample.records[sensor] {
                let message = format!("is of the same sensor and sample as {:?}", other.token);
                return Err(failed(Error::format(message)));
            }
            egos.insert(row.ego_pose_token.clone(), None);
            sample.records[sensor] = Some(Record {
                token: row.token,
                filename: row.filename,
                size: [row.height, row.width],
                calibrated: row.calibrated_sensor_token,
                ego: row.ego_pose_token,
            });
            Ok(())
        })?;
        Ok(egos)
    }

    /// Fills in the poses of the vehicle that are asked for.
    fn egos(&self, egos: &mut HashMap<String, Option<Pose>>) -> Result<()> {
        self.each("ego_pose", |row: EgoRow| {
            if let Some(place) = egos.get_mut(&row.token) {
                *place = Some(pose(&row.rotation, &row.translation).map_err(|e| of_row(&row.token, &e))?);
            }
            Ok(())
        })
    }
}

/// The frame of a sample: its cameras projected as BEVDet, SurroundOcc and mmdetection3d do, with the vehicle's motion
/// between the lidar's time and the camera's.
fn entry(
    sample: Sample,
    calibrated: &HashMap<String, Calibrated>,
    egos: &HashMap<String, Option<Pose>>,
) -> Result<Entry> {
    let [cameras @ .., lidar] = sample.records;
    let record = |record: Option<Record>, channel: &str| {
        let none = || Error::format(format!("sample {:?} has no key frame of {channel}", sample.token));
        let record = record.ok_or_else(none)?;
        let failed = |e: Error| of_row(&record.token, &e);
        let mount = find(calibrated, &record.calibrated, "calibrated_sensor").map_err(failed)?;
        let ego = egos.get(&record.ego).copied().flatten();
        let ego = ego.ok_or_else(|| failed(missing(&record.ego, "ego_pose")))?;
        Ok((record, mount, ego))
    };
    let (lidar, lidar_mount, lidar_ego) = record(lidar, LIDAR)?;
    let lidar_to_global = lidar_ego * lidar_mount.to_ego;
    let mut seen = Vec::with_capacity(CAMERAS.len());
    for (camera, name) in cameras.into_iter().zip(CAMERAS) {
        let (camera, mount, ego) = record(camera, name)?;
        let rows = intrinsic(&mount.intrinsic).map_err(|e| of_row(&camera.calibrated, &e))?;
        let lidar_to_camera = (ego * mount.to_ego).inverse() * lidar_to_global;
        let lidar2img = lidar_to_camera.then_project(&rows);
        check_finite(name, &lidar2img).map_err(|e| of_row(&camera.token, &e))?;
        seen.push(CameraImage { filename: camera.filename, size: camera.size, lidar2img });
    }
    let id = format!("{}/{}", sample.scene, sample.token);
    Ok(Entry { id, lidar: lidar.filename, cameras: seen, lidar_to_ego: lidar_mount.to_ego, lidar_to_global })
}

fn intrinsic(rows: &[Vec<f64>]) -> Result<[[f64; 3]; 3]> {
    let row = |row: &Vec<f64>| <[f64; 3]>::try_from(row.as_slice()).ok();
    let rows: Option<Vec<[f64; 3]>> = rows.iter().map(row).collect();
    let rows = rows.and_then(|rows| <[[f64; 3]; 3]>::try_from(rows).ok());
    let rows = rows.ok_or_else(|| Error::format("camera_intrinsic of another shape, expected 3 rows of 3 numbers"))?;
    match check_intrinsic(&rows) {
        Ok(()) => Ok(rows),
        Err((found, expected)) => Err(Error::format(format!("camera_intrinsic: {found}, expected {expected}"))),
    }
}

fn pose(rotation: &[f64], translation: &[f64]) -> Result<Pose> {
    let wrong = |field: &str, found: usize, expected: usize| {
        Error::format(format!("{field} of {found} numbers, expected {expected}"))
    };
    let rotation = rotation.try_into().map_err(|_| wrong("rotation", rotation.len(), 4))?;
    let translation = translation.try_into().map_err(|_| wrong("translation", translation.len(), 3))?;
    Pose::new(rotation, translation)
}

fn insert<T>(map: &mut HashMap<String, T>, token: String, value: T) -> Result<()> {
    if map.contains_key(&token) {
        return Err(Error::format(format!("token {token:?} is there twice")));
    }
    map.insert(token, value);
    Ok(())
}

fn find<'a, T>(map: &'a HashMap<String, T>, token: &str, table: &str) -> Result<&'a T> {
    map.get(token).ok_or_else(|| missing(token, table))
}

fn missing(token: &str, table: &str) -> Error {
    Error::format(format!("{table}_token {token:?} is not in {table}.json"))
}

fn of_row(token: &str, error: &Error) -> Error {
    Error::new(error.kind(), format!("row {token:?}: {}", error.message()))
}

/// Hands on the rows of a list as they are read.
struct EachRow<T, F> {
    row: F,
    /// Why the reading was broken off.
    failed: Option<Error>,
    kind: PhantomData<T>,
}

impl<'de, T: DeserializeOwned, F: FnMut(T) -> Result<()>> DeserializeSeed<'de> for &mut EachRow<T, F> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> std::result::Result<(), D::Error> {
        deserializer.deserialize_seq(self)
    }
}

impl<'de, T: DeserializeOwned, F: FnMut(T) -> Result<()>> Visitor<'de> for &mut EachRow<T, F> {
    type Value = ();

    fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("a list of rows")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut rows: A) -> std::result::Result<(), A::Error> {
        while let Some(row) = rows.next_element()? {
            if let Err(error) = (self.row)(row) {
                self.failed = Some(error);
                return Err(serde::de::Error::custom("broken off"));
            }
        }
        Ok(())
    }
}

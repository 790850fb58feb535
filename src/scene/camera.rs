//! Cameras as a `calibration.json` describes them.
//!
//! ```json
//! {"cameras": [
//!     {"name": "front", "file": "front.jpg", "width": 1600, "height": 900,
//!      "intrinsic": [[f, 0, cu], [0, f, cv], [0, 0, 1]],
//!      "lidar2camera": [4 rows of 4 numbers]},
//!     {"name": "rear", "file": "rear.jpg", "width": 1600, "height": 900,
//!      "lidar2img": [4 rows of 4 numbers]}
//! ]}
//! ```
//!
//! A `lidar2img` goes before the other two. Matrices must be what they are called, as far as the numbers tell: a
//! `lidar2camera` is a rotation and a translation, an `intrinsic` upper triangular, and points are columns. Keys that are
//! not named here are noted; those that say that the camera is no pinhole are refused.

use super::matrix::{self, Wrong};
use crate::base::error::{Error, ErrorKind, Result};
use crate::base::json;
use crate::base::note::Note;
use crate::network::Network;
use glam::{DMat4, DVec4};
use serde_json::{Map, Value};
use std::path::{Component, Path};

/// The cameras of nuScenes, in the order of the published networks' training.
pub const NUSCENES_RING: [&str; 6] =
    ["CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT"];

/// No image side may be longer.
const MAX_SIDE: u64 = 1 << 16;

/// A camera: which image is its own, and where lidar-frame points land in it.
#[derive(Clone, Debug, PartialEq)]
pub struct Camera {
    /// For people.
    pub name: String,
    /// Its image, relative to the calibration's directory and inside of it.
    pub file: String,
    /// Pixels of an image row, 1 to 65536.
    pub width: usize,
    /// Image rows, 1 to 65536.
    pub height: usize,
    /// Row-major 4x4: lidar-frame metres (x, y, z, 1) to (u * d, v * d, d, 1) with u, v in image pixels. Finite.
    pub lidar2img: [f32; 16],
}

impl Camera {
    /// Checks that the camera's image, padded to multiples of 32, has the size that `network` takes.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`] naming the camera, its size and the expected one.
    pub fn check(&self, network: &Network) -> Result<()> {
        super::check_padded(&self.name, [self.height, self.width], network)
    }
}

/// Keys that describe a calibration or a camera to people, and of which no note is made.
const DESCRIPTIONS: [&str; 9] =
    ["source", "token", "timestamp", "comment", "description", "license", "channel", "id", "version"];

/// The cameras of a `calibration.json`, in its order. [`read_calibration_with_notes`] also says what in it was not used.
///
/// # Errors
/// As [`read_calibration_with_notes`].
pub fn read_calibration(text: &str) -> Result<Vec<Camera>> {
    read_calibration_with_notes(text).map(|(cameras, _)| cameras)
}

/// The cameras of a `calibration.json`, in its order, and what in it was not used or is hardly ever meant.
///
/// Where a camera has `intrinsic` and `lidar2camera`, their product is computed in f64 and rounded once.
///
/// # Errors
/// [`ErrorKind::Format`], naming the camera and the key, if the text is not JSON, has a key twice or no cameras, or a
/// camera lacks a key, has one of another type or shape, a number that is not finite in f32, a file outside the
/// calibration's directory, the name of another camera, or a matrix that is not what it is called: `lidar2camera` rigid
/// within 0.005, `intrinsic` upper triangular with a last row of (0, 0, 1), `lidar2img` with a last row of (0, 0, 0, 1);
/// [`ErrorKind::Unsupported`] if a key says that the camera is no pinhole.
pub fn read_calibration_with_notes(text: &str) -> Result<(Vec<Camera>, Vec<Note>)> {
    let root = json::parse(text).map_err(|e| Error::format(format!("calibration JSON: {e}")))?;
    let list = root.get("cameras").and_then(Value::as_array).filter(|c| !c.is_empty());
    let list = list.ok_or_else(|| Error::format("calibration: no \"cameras\", expected a list of at least one"))?;
    let mut notes = Vec::new();
    let mut cameras: Vec<Camera> = Vec::with_capacity(list.len().min(super::MAX_CAMERAS));
    let mut unused = Vec::new();
    if let Some(keys) = root.as_object() {
        let entry = Entry { keys, who: "calibration".into() };
        unused.extend(entry.unused(&["cameras"])?);
    }
    for (index, camera) in list.iter().enumerate() {
        let camera = read_camera(index, camera, &mut unused, &mut notes)?;
        if let Some(twin) = cameras.iter().position(|other| other.name == camera.name) {
            let name = camera.name.escape_debug();
            return Err(Error::format(format!(
                "camera {index}: \"name\" is {name}, as of camera {twin}, expected another"
            )));
        }
        if let Some(twin) = cameras.iter().find(|other| other.file == camera.file) {
            let (a, b) = (twin.name.escape_debug(), camera.name.escape_debug());
            notes.push(Note::new(format!("cameras {a} and {b} have the same image, {:?}", camera.file)));
        }
        cameras.push(camera);
    }
    unused.sort_unstable();
    unused.dedup();
    if !unused.is_empty() {
        notes.insert(0, Note::new(format!("keys that are not used: {}", unused.join(", "))));
    }
    Ok((cameras, notes))
}

/// Whether a key is about what a pinhole's matrices cannot say: how the lens bends rays, or another kind of camera.
fn is_of_a_lens(key: &str) -> bool {
    let plain: String = key.chars().filter(char::is_ascii_alphanumeric).map(|c| c.to_ascii_lowercase()).collect();
    let exact = ["d", "dist", "xi", "model", "cameramodel", "cameratype", "projection", "projectionmodel", "lens"];
    let coefficient = matches!(plain.as_bytes(), [b'k' | b'p', b'0'..=b'9']);
    coefficient
        || exact.contains(&&*plain)
        || ["distort", "distcoef", "fisheye"].iter().any(|part| plain.contains(part))
}

/// Whether a value of such a key says that there is nothing of the kind.
fn says_pinhole(value: &Value) -> bool {
    match value {
        Value::Null | Value::Bool(false) => true,
        Value::Bool(true) => false,
        Value::Number(number) => number.as_f64() == Some(0.0),
        Value::String(text) => {
            let plain: String = text.chars().filter(char::is_ascii_alphabetic).collect();
            ["", "pinhole", "perspective", "none", "plumbbob"].contains(&&*plain.to_ascii_lowercase())
        }
        Value::Array(items) => items.iter().all(says_pinhole),
        Value::Object(keys) => keys.values().all(says_pinhole),
    }
}

/// One camera's keys, and what to call it when one of them is wrong.
struct Entry<'a> {
    keys: &'a Map<String, Value>,
    who: String,
}

impl Entry<'_> {
    fn bad<T>(&self, key: &str, found: &str, expected: &str) -> Result<T> {
        Err(Error::format(format!("{}: \"{key}\" is {found}, expected {expected}", self.who)))
    }

    fn text(&self, key: &str) -> Result<String> {
        match self.keys.get(key) {
            Some(Value::String(text)) if !text.is_empty() => Ok(text.clone()),
            other => self.bad(key, &describe(other), "a string that is not empty"),
        }
    }

    fn side(&self, key: &str) -> Result<usize> {
        match self.keys.get(key).and_then(Value::as_u64) {
            Some(side) if (1..=MAX_SIDE).contains(&side) => Ok(side as usize),
            _ => self.bad(key, &describe(self.keys.get(key)), "1 to 65536 pixels"),
        }
    }

    /// A square matrix, row by row.
    fn matrix<const N: usize>(&self, key: &str) -> Result<[[f64; N]; N]> {
        let expected = format!("{N} rows of {N} numbers");
        let Some(rows) = self.keys.get(key).and_then(Value::as_array) else {
            return self.bad(key, &describe(self.keys.get(key)), &expected);
        };
        if rows.len() != N {
            return self.bad(key, &format!("{} rows", rows.len()), &expected);
        }
        let mut matrix = [[0.0; N]; N];
        for (r, row) in rows.iter().enumerate() {
            let Some(row) = row.as_array().filter(|row| row.len() == N) else {
                return self.bad(key, &format!("{} in row {r}", describe(Some(row))), &expected);
            };
            for (c, value) in row.iter().enumerate() {
                let Some(number) = value.as_f64().filter(|v| v.is_finite()) else {
                    return self.bad(key, &format!("{} in row {r}, column {c}", describe(Some(value))), &expected);
                };
                matrix[r][c] = number;
            }
        }
        Ok(matrix)
    }

    /// A matrix that `check` finds nothing wrong with.
    fn checked<const N: usize>(
        &self,
        key: &str,
        check: fn(&[[f64; N]; N]) -> std::result::Result<(), Wrong>,
    ) -> Result<[[f64; N]; N]> {
        let matrix = self.matrix(key)?;
        match check(&matrix) {
            Ok(()) => Ok(matrix),
            Err((found, expected)) => self.bad(key, &found, expected),
        }
    }

    /// Keys that are not `known` and not for people. One that says that the camera is no pinhole is an error.
    fn unused(&self, known: &[&str]) -> Result<Vec<String>> {
        let mut unused = Vec::new();
        for (key, value) in self.keys.iter().filter(|(key, _)| !known.contains(&key.as_str())) {
            if is_of_a_lens(key) && !says_pinhole(value) {
                let shown = key.escape_debug();
                let message = format!(
                    "{}: \"{shown}\" is {}, expected a pinhole camera; undistort the images first, or leave the key out",
                    self.who,
                    describe(Some(value))
                );
                return Err(Error::new(ErrorKind::Unsupported, message));
            }
            if !is_of_a_lens(key) && !DESCRIPTIONS.contains(&key.as_str()) {
                unused.push(key.chars().take(40).collect::<String>().escape_debug().to_string());
            }
        }
        Ok(unused)
    }

    /// The product of `intrinsic` and `lidar2camera`, in f64.
    fn product(&self) -> Result<[[f64; 4]; 4]> {
        let k = self.checked("intrinsic", matrix::check_intrinsic)?;
        let row = |r: usize| DVec4::new(k[r][0], k[r][1], k[r][2], 0.0);
        let intrinsic = DMat4::from_cols(row(0), row(1), row(2), DVec4::W).transpose();
        let lidar2camera = self.checked("lidar2camera", matrix::check_rigid)?;
        let lidar2camera = DMat4::from_cols_array_2d(&lidar2camera).transpose();
        Ok((intrinsic * lidar2camera).transpose().to_cols_array_2d())
    }

    /// The product, or what is given in its place. `size` is the image's height and width.
    fn lidar2img(&self, size: [usize; 2], notes: &mut Vec<Note>) -> Result<[f32; 16]> {
        let has = |key| self.keys.contains_key(key);
        let (key, matrix) = if has("lidar2img") {
            let given = self.checked("lidar2img", matrix::check_projection)?;
            if matrix::handedness(&given) < 0.0 {
                notes.push(Note::new(format!(
                    "{}: \"lidar2img\" mirrors the image; is one of its axes turned?",
                    self.who
                )));
            }
            match ["intrinsic", "lidar2camera"].map(has) {
                [true, true] => {
                    if !matrix::alike(&given, &self.product()?) {
                        let message =
                            "\"lidar2img\" is used, and is not the product of \"intrinsic\" and \"lidar2camera\"";
                        notes.push(Note::new(format!("{}: {message}", self.who)));
                    }
                }
                [false, false] => {}
                [intrinsic, _] => {
                    let key = if intrinsic { "intrinsic" } else { "lidar2camera" };
                    notes.push(Note::new(format!("{}: \"{key}\" is not used, \"lidar2img\" is", self.who)));
                }
            }
            ("lidar2img", given)
        } else {
            if !has("intrinsic") {
                return self.bad("lidar2img", "missing", "it, or \"intrinsic\" and \"lidar2camera\"");
            }
            let product = self.product()?;
            let [height, width] = size.map(|side| side as f64);
            let [[_, _, u], [_, _, v], _] = self.matrix::<3>("intrinsic")?;
            if !((0.0..=width).contains(&u) && (0.0..=height).contains(&v)) {
                notes.push(Note::new(format!(
                    "{}: \"intrinsic\" has its centre at ({u}, {v}), outside the image of {width} x {height} pixels; is it that \
                     of the image in another size?",
                    self.who
                )));
            }
            ("intrinsic", product)
        };
        let rounded: [f32; 16] = std::array::from_fn(|i| matrix[i / 4][i % 4] as f32);
        match rounded.iter().position(|v| !v.is_finite()) {
            Some(i) => self.bad(
                key,
                &format!("{:e} in row {}, column {}", matrix[i / 4][i % 4], i / 4, i % 4),
                "finite f32 values",
            ),
            None => Ok(rounded),
        }
    }
}

/// Keys of a camera that are used.
const KEYS: [&str; 8] = ["name", "file", "width", "height", "stamp", "intrinsic", "lidar2camera", "lidar2img"];

fn read_camera(index: usize, value: &Value, unused: &mut Vec<String>, notes: &mut Vec<Note>) -> Result<Camera> {
    let Some(keys) = value.as_object() else {
        return Err(Error::format(format!("camera {index}: {}, expected an object", describe(Some(value)))));
    };
    let mut entry = Entry { keys, who: format!("camera {index}") };
    let name = entry.text("name")?;
    entry.who = format!("camera {index} ({})", name.escape_debug());
    let file = entry.text("file")?;
    // A calibration that came from elsewhere must not make the program read what lies elsewhere.
    let inside = Path::new(&file).components().all(|c| matches!(c, Component::Normal(_) | Component::CurDir));
    if !inside || file.contains(['\\', '\0']) {
        return entry.bad("file", &format!("{file:?}"), "a path inside the calibration's directory");
    }
    let (width, height) = (entry.side("width")?, entry.side("height")?);
    let lidar2img = entry.lidar2img([height, width], notes)?;
    unused.extend(entry.unused(&KEYS)?);
    Ok(Camera { name, file, width, height, lidar2img })
}

/// A JSON value in a few words.
fn describe(value: Option<&Value>) -> String {
    match value {
        None => "missing".into(),
        Some(Value::Null) => "null".into(),
        Some(Value::Bool(value)) => value.to_string(),
        Some(Value::Number(value)) => value.to_string(),
        Some(Value::String(value)) if value.is_empty() => "an empty string".into(),
        Some(Value::String(_)) => "a string".into(),
        Some(Value::Array(value)) => format!("a list of {}", value.len()),
        Some(Value::Object(_)) => "an object".into(),
    }
}

#[cfg(test)]
mod tests;

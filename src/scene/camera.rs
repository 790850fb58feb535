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
//! Keys that are not named here are ignored. A `lidar2img` is taken as it is, and goes before the other two.

use crate::base::error::{Error, Result};
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

/// The cameras of a `calibration.json`, in its order.
///
/// Where a camera has `intrinsic` and `lidar2camera`, their product is computed in f64 and rounded once.
///
/// # Errors
/// [`ErrorKind::Format`](crate::ErrorKind::Format), naming the camera and the key, if the text is not JSON, has no
/// cameras, or a camera lacks a key, has one of another type or shape, a number that is not finite in f32, or a file
/// outside the calibration's directory.
pub fn read_calibration(text: &str) -> Result<Vec<Camera>> {
    let root: Value = serde_json::from_str(text).map_err(|e| Error::format(format!("calibration JSON: {e}")))?;
    let cameras = root.get("cameras").and_then(Value::as_array).filter(|c| !c.is_empty());
    let cameras =
        cameras.ok_or_else(|| Error::format("calibration: no \"cameras\", expected a list of at least one"))?;
    cameras.iter().enumerate().map(|(i, camera)| read_camera(i, camera)).collect()
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

    /// The product, or what is given in its place.
    fn lidar2img(&self) -> Result<[f32; 16]> {
        let (key, matrix) = if self.keys.contains_key("lidar2img") {
            ("lidar2img", self.matrix::<4>("lidar2img")?)
        } else {
            if !self.keys.contains_key("intrinsic") {
                return self.bad("lidar2img", "missing", "it, or \"intrinsic\" and \"lidar2camera\"");
            }
            let k = self.matrix::<3>("intrinsic")?;
            let row = |r: usize| DVec4::new(k[r][0], k[r][1], k[r][2], 0.0);
            let intrinsic = DMat4::from_cols(row(0), row(1), row(2), DVec4::W).transpose();
            let lidar2camera = DMat4::from_cols_array_2d(&self.matrix::<4>("lidar2camera")?).transpose();
            ("intrinsic", (intrinsic * lidar2camera).transpose().to_cols_array_2d())
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

fn read_camera(index: usize, value: &Value) -> Result<Camera> {
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
    Ok(Camera { name, file, width, height, lidar2img: entry.lidar2img()? })
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
mod tests {
    use super::*;
    use serde_json::json;

    fn direct() -> Value {
        json!({"name": "a", "file": "img/a.png", "width": 20, "height": 10, "extra": [null],
            "lidar2img": [[1, 2, 3, 4], [5, 6, 7, 8], [9, 10, 11, 12], [0, 0, 0, 1.5]]})
    }

    fn product() -> Value {
        json!({"name": "b", "file": "b.png", "width": 20, "height": 10,
            "intrinsic": [[100.0, 0.0, 10.0], [0.0, 200.0, 5.0], [0.0, 0.0, 1.0]],
            "lidar2camera": [[0, -1, 0, 0.5], [0, 0, -1, 0.25], [1, 0, 0, -2], [0, 0, 0, 1]]})
    }

    fn read(cameras: &[Value]) -> Result<Vec<Camera>> {
        read_calibration(&json!({"source": "x", "cameras": cameras}).to_string())
    }

    #[test]
    fn both_forms_by_hand() {
        let cameras = read(&[direct(), product()]).unwrap();
        assert_eq!((cameras[0].name.as_str(), cameras[0].file.as_str()), ("a", "img/a.png"));
        assert_eq!((cameras[0].width, cameras[0].height), (20, 10));
        let expected = [1., 2., 3., 4., 5., 6., 7., 8., 9., 10., 11., 12., 0., 0., 0., 1.5];
        assert_eq!(cameras[0].lidar2img, expected);
        // Row 0: 100 * (0, -1, 0, 0.5) + 10 * (1, 0, 0, -2); row 1: 200 * (0, 0, -1, 0.25) + 5 * (1, 0, 0, -2).
        let expected = [10., -100., 0., 30., 5., 0., -200., 40., 1., 0., 0., -2., 0., 0., 0., 1.];
        assert_eq!(cameras[1].lidar2img, expected);
    }

    #[test]
    fn the_product_is_rounded_once() {
        let mut camera = product();
        // In f32, 2^24 + 1 loses its last bit before the subtraction; in f64 the difference is exactly 1.
        camera["intrinsic"][0] = json!([16_777_217.0, 0.0, -16_777_216.0]);
        camera["lidar2camera"] = json!([[1, 0, 0, 0], [0, 1, 0, 0], [1, 0, 1, 0], [0, 0, 0, 1]]);
        assert_eq!(read(&[camera]).unwrap()[0].lidar2img[0], 1.0);
    }

    #[test]
    fn a_matrix_that_is_given_goes_first() {
        let mut camera = product();
        camera["lidar2img"] = direct()["lidar2img"].clone();
        assert_eq!(read(&[camera]).unwrap()[0].lidar2img[3], 4.0);
    }

    #[test]
    fn wrong_keys_are_named() {
        let cases = [
            (direct(), "/name", json!(3), "camera 1: \"name\" is 3"),
            (direct(), "/name", json!(""), "camera 1: \"name\" is an empty string"),
            (direct(), "/file", json!("../b"), "\"file\" is \"../b\", expected a path inside"),
            (direct(), "/file", json!("a/../../b"), "inside the calibration's directory"),
            (direct(), "/file", json!("/etc/passwd"), "inside the calibration's directory"),
            (direct(), "/file", json!("..\\b"), "inside the calibration's directory"),
            (direct(), "/width", json!(0), "\"width\" is 0, expected 1 to 65536"),
            (direct(), "/height", json!(2.5), "\"height\" is 2.5"),
            (direct(), "/height", json!(65537), "\"height\" is 65537"),
            (direct(), "/height", json!(-3), "\"height\" is -3"),
            (direct(), "/lidar2img", json!([[1]]), "\"lidar2img\" is 1 rows, expected 4 rows of 4 numbers"),
            (direct(), "/lidar2img/2", json!([1, 2, 3]), "\"lidar2img\" is a list of 3 in row 2"),
            (direct(), "/lidar2img/2", json!("x"), "a string in row 2"),
            (direct(), "/lidar2img/1/3", json!("x"), "a string in row 1, column 3"),
            (direct(), "/lidar2img/1/3", json!(1e39), "\"lidar2img\" is 1e39 in row 1, column 3, expected finite"),
            (direct(), "/lidar2img", json!(null), "\"lidar2img\" is null"),
            (product(), "/intrinsic", json!([[1, 0, 0], [0, 1, 0]]), "\"intrinsic\" is 2 rows, expected 3 rows of 3"),
            (product(), "/intrinsic/0/0", json!(1e300), "\"intrinsic\" is"),
            (product(), "/lidar2camera/3", json!([0, 0, 1]), "\"lidar2camera\" is a list of 3 in row 3"),
            (product(), "/lidar2camera", json!({}), "\"lidar2camera\" is an object"),
            (product(), "", json!(7), "camera 1: 7, expected an object"),
        ];
        for (mut camera, pointer, value, expected) in cases {
            *camera.pointer_mut(pointer).unwrap() = value;
            let e = read(&[direct(), camera]).unwrap_err();
            assert!(e.message().contains(expected), "{e} (expected {expected})");
            assert!(e.message().starts_with("camera 1"), "{e}");
        }
    }

    #[test]
    fn missing_keys_are_named() {
        for (camera, keys) in [
            (direct(), &["name", "file", "width", "height", "lidar2img"][..]),
            (product(), &["intrinsic", "lidar2camera"]),
        ] {
            for key in keys {
                let mut camera = camera.clone();
                camera.as_object_mut().unwrap().remove(*key);
                let e = read(&[camera]).unwrap_err();
                assert!(e.message().contains("missing"), "{e}");
                assert!(e.message().contains(key), "{e}");
            }
        }
    }

    #[test]
    fn what_is_no_calibration_is_refused() {
        let good = json!({"cameras": [direct()]}).to_string();
        assert!(read_calibration(&good).is_ok());
        for n in 0..good.len() {
            assert!(read_calibration(&good[..n]).is_err(), "cut to {n} bytes");
        }
        for text in ["[]", "{}", "{\"cameras\":[]}", "{\"cameras\":{}}", "{\"cameras\":[null]}"] {
            assert!(read_calibration(text).is_err(), "{text}");
        }
        let nan = good.replace("1.5", "NaN");
        assert!(read_calibration(&nan).unwrap_err().message().starts_with("calibration JSON"));
        let infinite = good.replace("1.5", "1e999");
        assert!(read_calibration(&infinite).is_err());
    }
}

//! The calibration of a scene's cameras, read from `calibration.json`.

use crate::error::{Error, Result};
use serde::Deserialize;

/// One camera of a calibration.
#[derive(Clone, Debug, PartialEq)]
pub struct Camera {
    /// Name, for people.
    pub name: String,
    /// Image file, relative to the calibration's directory.
    pub file: String,
    /// Pixels of a row, or 0 where the calibration does not say.
    pub width: usize,
    /// Rows of pixels, or 0 where the calibration does not say.
    pub height: usize,
    /// Row-major 4x4: lidar-frame metres (x, y, z, 1) to (u*d, v*d, d, 1).
    pub lidar2img: [f32; 16],
}

#[derive(Deserialize)]
struct File {
    cameras: Vec<Entry>,
}

#[derive(Deserialize)]
struct Entry {
    name: String,
    #[serde(default)]
    file: String,
    #[serde(default)]
    width: usize,
    #[serde(default)]
    height: usize,
    lidar2img: Option<[[f64; 4]; 4]>,
    intrinsic: Option<[[f64; 3]; 3]>,
    lidar2camera: Option<[[f64; 4]; 4]>,
}

/// Reads the cameras of a calibration: `lidar2img`, or `intrinsic` (3x3) and `lidar2camera` (4x4).
///
/// # Errors
/// [`ErrorKind::Format`](crate::ErrorKind::Format) for JSON that does not say this.
pub fn read_calibration(text: &str) -> Result<Vec<Camera>> {
    let file: File = serde_json::from_str(text).map_err(|e| Error::format(format!("calibration JSON: {e}")))?;
    file.cameras.into_iter().map(camera).collect()
}

fn camera(entry: Entry) -> Result<Camera> {
    let matrix = match (entry.lidar2img, entry.intrinsic, entry.lidar2camera) {
        (Some(matrix), _, _) => matrix,
        (None, Some(k), Some(pose)) => std::array::from_fn(|r| {
            std::array::from_fn(|c| if r == 3 { pose[3][c] } else { (0..3).map(|i| k[r][i] * pose[i][c]).sum() })
        }),
        _ => {
            let message = format!("camera {}: found neither lidar2img nor intrinsic with lidar2camera", entry.name);
            return Err(Error::format(message));
        }
    };
    Ok(Camera {
        name: entry.name,
        file: entry.file,
        width: entry.width,
        height: entry.height,
        lidar2img: std::array::from_fn(|i| matrix[i / 4][i % 4] as f32),
    })
}

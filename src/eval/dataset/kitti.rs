//! What sets of KITTI's form share: the grid, files by number, and matrices as text.

use super::{Axes, Grid};
use crate::base::error::{Error, Result};
use crate::scene::matrix::check_rigid;
use std::path::Path;

/// The voxels that SemanticKITTI labels ahead of the vehicle, and after it SSCBench.
pub(super) const GRID: Grid =
    Grid { size: [256, 256, 32], bounds: [[0.0, 51.2], [-25.6, 25.6], [-2.0, 4.4]], axes: Axes::Lidar };

/// The numbers of the files in `directory` that end in `ending`, ascending.
pub(super) fn numbers(directory: &Path, ending: &str) -> Result<Vec<String>> {
    let failed = |e: &std::io::Error| Error::io(directory, "read", e);
    let mut stems = Vec::new();
    for entry in std::fs::read_dir(directory).map_err(|e| failed(&e))? {
        let name = entry.map_err(|e| failed(&e))?.file_name();
        let stem = name.to_str().and_then(|n| n.strip_suffix(ending));
        stems.extend(stem.filter(|s| !s.is_empty() && s.bytes().all(|b| b.is_ascii_digit())).map(str::to_owned));
    }
    stems.sort_unstable();
    Ok(stems)
}

/// The N numbers of the line `key: ...` of a calibration.
pub(super) fn values<const N: usize>(text: &str, key: &str) -> Result<[f64; N]> {
    let mut lines = text.lines().filter_map(|line| line.strip_prefix(key)?.strip_prefix(':'));
    let line = lines.next().ok_or_else(|| Error::format(format!("no line \"{key}:\", expected one of {N} numbers")))?;
    if lines.next().is_some() {
        return Err(Error::format(format!("two lines \"{key}:\", expected one")));
    }
    parse(line, key)
}

/// The N numbers of a line, which `name` calls it.
pub(super) fn parse<const N: usize>(line: &str, name: &str) -> Result<[f64; N]> {
    let mut values = [0.0; N];
    let mut found = 0;
    for word in line.split_whitespace() {
        let value = word.parse::<f64>().ok().filter(|v| v.is_finite());
        let value = value.ok_or_else(|| Error::format(format!("{name}: {word:?}, expected a finite number")))?;
        if let Some(place) = values.get_mut(found) {
            *place = value;
        }
        found += 1;
    }
    if found != N {
        return Err(Error::format(format!("{name}: {found} numbers, expected {N}")));
    }
    Ok(values)
}

/// The 3x4 matrix of the line `key: ...` of a calibration.
pub(super) fn rows(text: &str, key: &str) -> Result<[[f64; 4]; 3]> {
    values(text, key).map(|values| matrix(&values))
}

/// A row-major 3x4 matrix.
pub(super) fn matrix(values: &[f64; 12]) -> [[f64; 4]; 3] {
    std::array::from_fn(|row| std::array::from_fn(|column| values[4 * row + column]))
}

/// Refuses a 3x4 that is no rotation and translation; `name` is what the file calls it.
pub(super) fn check_pose(name: &str, &[a, b, c]: &[[f64; 4]; 3]) -> Result<()> {
    check_rigid(&[a, b, c, [0.0, 0.0, 0.0, 1.0]])
        .map_err(|(found, expected)| Error::format(format!("{name}: {found}, expected {expected}")))
}

/// Row-major 4x4 of first the rigid `lidar2camera`, then `camera2img`: computed in f64, rounded once.
pub(super) fn product(camera2img: &[[f64; 4]; 3], lidar2camera: &[[f64; 4]; 3]) -> [f32; 16] {
    let mut matrix = [0.0; 16];
    matrix[15] = 1.0;
    for (row, factors) in camera2img.iter().enumerate() {
        for column in 0..4 {
            let sum: f64 = (0..3).map(|i| factors[i] * lidar2camera[i][column]).sum();
            matrix[4 * row + column] = (sum + if column == 3 { factors[3] } else { 0.0 }) as f32;
        }
    }
    matrix
}

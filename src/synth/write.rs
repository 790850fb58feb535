//! Frames as files: scenes with their labels, and sets to train on.

use super::{CLASSES, Frame, Synthesiser};
use crate::base::error::{Error, ErrorKind, Result};
use crate::file::container::{self, Data, Layout, Tensor};
use crate::file::replace::replace_file;
use crate::network::Grid;
use half::f16;
use safetensors::Dtype;
use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::Path;

/// What `set.json` says the directory is.
pub const SET_FORMAT: &str = "voxcast-synth-1";

/// Name of the file of a seed in a set.
pub fn set_file(seed: u64) -> String {
    format!("{seed:09}.safetensors")
}

impl Frame {
    /// Writes a frame of a set, which is a scene as well: `images` u8 [N, H, W, 3] BGR, `lidar2img` f32 [N, 4, 4], `labels`
    /// and `visible` u8 [X, Y, Z]; with `pixels` also `pixel.class` u8 [N, H, W] and `pixel.depth` f16 [N, H, W].
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if the file cannot be written.
    pub fn save_tensors(&self, path: &Path, grid: Grid, pixels: bool) -> Result<()> {
        let count = self.scene.images.len();
        let [height, width] = self.scene.images.first().map_or([0, 0], |i| [i.height, i.width]);
        let tensor = |name: &str, dtype, shape: &[usize], bytes: Vec<u8>| Tensor {
            name: name.to_owned(),
            dtype,
            shape: shape.to_vec(),
            data: Data::Make(Box::new(move || Ok(bytes))),
        };
        let images = self.scene.images.iter().flat_map(|i| i.bgr.iter().copied()).collect();
        let matrices = self.scene.lidar2img.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
        let mut tensors = vec![
            tensor("images", Dtype::U8, &[count, height, width, 3], images),
            tensor("lidar2img", Dtype::F32, &[count, 4, 4], matrices),
            tensor("labels", Dtype::U8, &grid.size, self.labels.clone()),
            tensor("visible", Dtype::U8, &grid.size, self.visible.clone()),
        ];
        if pixels {
            let shape = [count, height, width];
            let depths = self.pixel_depths.iter().flatten().flat_map(|&v| f16::from_f32(v).to_le_bytes()).collect();
            tensors.push(tensor("pixel.class", Dtype::U8, &shape, self.pixel_classes.concat()));
            tensors.push(tensor("pixel.depth", Dtype::F16, &shape, depths));
        }
        container::write(path, tensors, &BTreeMap::new(), Layout::Packed)
    }

    /// Writes a scene directory: `calibration.json` and images as [`Scene::save_stamped`](crate::Scene::save_stamped) does, `labels.npz`
    /// (`classes` and `visible`, u8 [X, Y, Z]) and `labels.npy` (SurroundOcc's form: i64 rows x, y, z, class of the
    /// voxels that are not empty).
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if the directory or a file cannot be written.
    pub fn save_scene(&self, directory: &Path, grid: Grid) -> Result<()> {
        use crate::file::npz::{Array, Elements};
        self.scene.save_stamped(directory, Some(self.stamp))?;
        let array = |name, bytes| Array { name, shape: &grid.size, elements: Elements::U8(bytes) };
        crate::file::npz::write_npz(
            &directory.join("labels.npz"),
            &[array("classes", &self.labels[..]), array("visible", &self.visible[..])],
        )?;
        replace_file(&directory.join("labels.npy"), |out| write_rows(out, &self.labels, grid.size))
    }
}

/// SurroundOcc's labels: a version 1.0 `.npy` of i64 [n, 4], rows in voxel order. NumPy's own integers are 64 bits wide.
fn write_rows(out: &mut impl Write, labels: &[u8], [_, ny, nz]: [usize; 3]) -> io::Result<()> {
    let occupied = labels.iter().filter(|&&class| class != 0).count();
    let header = format!("{{'descr': '<i8', 'fortran_order': False, 'shape': ({occupied}, 4), }}");
    let length = (10 + header.len() + 1).next_multiple_of(64) - 10;
    out.write_all(b"\x93NUMPY\x01\x00")?;
    out.write_all(&(length as u16).to_le_bytes())?;
    writeln!(out, "{header:<width$}", width = length - 1)?;
    for (index, &class) in labels.iter().enumerate().filter(|&(_, &class)| class != 0) {
        for value in [index / (ny * nz), index / nz % ny, index % nz, usize::from(class)] {
            out.write_all(&(value as i64).to_le_bytes())?;
        }
    }
    Ok(())
}

impl Synthesiser {
    /// Begins a set, or goes on with one: makes the directory and writes its `set.json`.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`] if the directory holds a set of another network, so that frames would not fit together;
    /// [`ErrorKind::Io`] if it cannot be written.
    pub fn begin_set(&self, directory: &Path) -> Result<()> {
        std::fs::create_dir_all(directory).map_err(|e| Error::io(directory, "create", &e))?;
        let path = directory.join("set.json");
        let cameras: Vec<&str> = self.cameras.iter().map(|c| c.name.as_str()).collect();
        let matrices: Vec<&[f32]> = self.cameras.iter().map(|c| &c.lidar2img[..]).collect();
        let set = serde_json::json!({
            "format": SET_FORMAT,
            "network": serde_json::to_value(&self.network).unwrap_or_default(),
            "classes": CLASSES,
            "cameras": cameras,
            "lidar2img": matrices,
        });
        let text = format!("{set:#}\n");
        match std::fs::read_to_string(&path) {
            Ok(found) if found == text => Ok(()),
            Ok(_) => {
                let message = "a set of other frames, expected one of this network and these cameras or an empty place";
                Err(Error::new(ErrorKind::Mismatch, message).in_file(&path))
            }
            Err(e) if e.kind() == io::ErrorKind::NotFound => replace_file(&path, |out| out.write_all(text.as_bytes())),
            Err(e) => Err(Error::io(&path, "read", &e)),
        }
    }
}

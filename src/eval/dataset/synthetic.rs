//! Sets that `voxcast synth --set` wrote: `set.json`, and a `.safetensors` per seed.

use super::{DataSet, Grid, Pose, Truth, check_labels};
use crate::base::error::{Error, ErrorKind, Result};
use crate::base::note::Note;
use crate::file::container::Container;
use crate::network::Network;
use crate::scene::Scene;
use crate::synth::{CLASSES, SET_FORMAT};
use safetensors::Dtype;
use std::io;
use std::path::{Path, PathBuf};

/// A synthetic set: frames in the order of their seeds, with the mask `visible`.
#[derive(Clone, Debug)]
pub struct Synthetic {
    directory: PathBuf,
    grid: Grid,
    /// File names without `.safetensors`, ascending.
    seeds: Vec<String>,
}

impl Synthetic {
    /// Opens the set in `directory`. Frames are listed, not read.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if `set.json` or the directory cannot be read;
    /// [`ErrorKind::Format`] if `set.json` is not that of a set, or there is no frame.
    pub fn open(directory: &Path) -> Result<Self> {
        let path = directory.join("set.json");
        let text = std::fs::read_to_string(&path).map_err(|e| match e.kind() {
            io::ErrorKind::NotFound => {
                Error::new(ErrorKind::Io, "there is none, expected the directory of a set that synth --set wrote")
                    .in_file(&path)
            }
            _ => Error::io(&path, "read", &e),
        })?;
        let network = read_set(&text).map_err(|e| e.in_file(&path))?;
        let failed = |e: &std::io::Error| Error::io(directory, "read", e);
        let mut seeds = Vec::new();
        for entry in std::fs::read_dir(directory).map_err(|e| failed(&e))? {
            let name = entry.map_err(|e| failed(&e))?.file_name();
            let seed = name.to_str().and_then(|n| n.strip_suffix(".safetensors"));
            seeds.extend(seed.filter(|s| s.len() == 9 && s.bytes().all(|b| b.is_ascii_digit())).map(str::to_owned));
        }
        if seeds.is_empty() {
            return Err(Error::format("no frames, expected files such as 000000007.safetensors").in_file(directory));
        }
        seeds.sort_unstable();
        Ok(Self { directory: directory.to_owned(), grid: Grid::of(&network), seeds })
    }

    /// Runs `f` on the mapped file of frame `index`.
    fn with_file<T>(&self, index: usize, f: impl FnOnce(&Container) -> Result<T>) -> Result<T> {
        let path = self.directory.join(format!("{}.safetensors", self.seeds[index]));
        f(&Container::open(&path)?).map_err(|e| e.in_file(&path))
    }

    fn read_truth(&self, file: &Container) -> Result<Truth> {
        let voxels = |name: &str| {
            let expected = self.grid.size;
            match file.tensor(name) {
                Some((Dtype::U8, shape, bytes)) if shape == expected => Ok(bytes.to_vec()),
                Some((dtype, shape, _)) => {
                    let message =
                        format!("tensor \"{name}\" is {dtype:?} of shape {shape:?}, expected U8 {expected:?}");
                    Err(Error::format(message))
                }
                None => Err(Error::format(format!("no tensor \"{name}\", expected U8 {expected:?}"))),
            }
        };
        let labels = voxels("labels")?;
        check_labels(&labels, CLASSES.len())?;
        // The lidar is where the frame's metres begin.
        let masks = vec![voxels("visible")?];
        Ok(Truth { labels, masks, origins: vec![[0.0; 3]], grid_to_lidar: Pose::IDENTITY })
    }
}

/// The network whose images and grid the set has.
fn read_set(text: &str) -> Result<Network> {
    let set: serde_json::Value =
        serde_json::from_str(text).map_err(|e| Error::format(format!("set JSON does not parse: {e}")))?;
    if set["format"] != SET_FORMAT {
        return Err(Error::format(format!("key \"format\": found {}, expected \"{SET_FORMAT}\"", set["format"])));
    }
    if set["classes"] != serde_json::json!(CLASSES) {
        return Err(Error::format("key \"classes\": other classes, expected those of nuScenes, empty first"));
    }
    Network::from_json(&set["network"].to_string())
}

impl DataSet for Synthetic {
    fn classes(&self) -> &[&'static str] {
        &CLASSES
    }

    fn grid(&self) -> Grid {
        self.grid
    }

    fn masks(&self) -> &[&'static str] {
        &["visible"]
    }

    fn len(&self) -> usize {
        self.seeds.len()
    }

    fn id(&self, index: usize) -> &str {
        &self.seeds[index]
    }

    fn scene(&self, index: usize) -> Result<(Scene, Vec<Note>)> {
        // Of its own files there is nothing to be said.
        Ok((self.with_file(index, |file| Scene::from_safetensors(file.bytes()))?, Vec::new()))
    }

    fn truth(&self, index: usize) -> Result<Truth> {
        self.with_file(index, |file| self.read_truth(file))
    }
}

#[cfg(test)]
mod tests;

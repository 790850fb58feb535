//! Frames that `run` takes one after the other, from scenes or from a robot log, and where their results go.

use super::frame;
use super::run::{Run, write};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::time::Duration;
use voxcast::log::{Encoded, LogFrame, LogWriter, Replay, ReplayOptions, Shot, Summary};
use voxcast::scene::read_stamps;
use voxcast::synth::NANOSECONDS_PER_FRAME;
use voxcast::{Error, Network, Note, Occupancy, Result, Scene};

/// Whether `path` is, or is to be, a log.
pub fn is_log(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("mcap"))
}

/// What the results of scenes are called: a directory's name, or a file's without its ending.
fn names(scenes: &[PathBuf]) -> Result<Vec<String>> {
    let mut names = Vec::with_capacity(scenes.len());
    let mut taken = HashMap::new();
    for path in scenes {
        let name = if path.is_dir() { path.file_name() } else { path.file_stem() };
        let name = name.unwrap_or_default().to_string_lossy().into_owned();
        if let Some(other) = taken.insert(name.clone(), path) {
            let message = format!("its result would be called {name}.npz, as that of {}", other.display());
            return Err(Error::mismatch(message).in_file(path));
        }
        names.push(name);
    }
    Ok(names)
}

/// A frame to run.
pub struct Frame {
    /// What its result is called.
    pub name: String,
    /// Whose fault it is if it cannot be run.
    pub path: PathBuf,
    pub scene: Scene,
    /// The moment that it is about, in nanoseconds.
    pub stamp: u64,
    /// When each image was taken; none where there is none, and the camera is to be masked.
    pub stamps: Vec<Option<u64>>,
    /// What is to be said of it.
    pub notes: Vec<Note>,
    /// Image files as they came.
    files: Vec<Option<Encoded>>,
}

impl Frame {
    /// Numbers of the cameras without an image.
    pub fn missing(&self) -> impl Iterator<Item = usize> {
        self.stamps.iter().enumerate().filter(|(_, stamp)| stamp.is_none()).map(|(camera, _)| camera)
    }
}

/// Where frames come from.
pub enum Frames {
    /// Scene directories and files, with what their results are called.
    Scenes(Vec<(PathBuf, String)>),
    Log {
        path: PathBuf,
        replay: Box<Replay>,
    },
}

impl Frames {
    pub fn of_scenes(paths: &[PathBuf]) -> Result<Self> {
        let names = names(paths)?;
        Ok(Frames::Scenes(paths.iter().cloned().zip(names).collect()))
    }

    pub fn of_log(run: &Run, network: &Network) -> Result<Self> {
        let (cameras, frame) = (run.camera.clone(), run.frame.clone());
        let mut options = ReplayOptions { cameras, frame, ..ReplayOptions::default() };
        if let Some(milliseconds) = run.tolerance {
            options.tolerance = u64::from(milliseconds) * 1_000_000;
        }
        let replay = Box::new(Replay::open(&run.scene, network, &options)?);
        Ok(Frames::Log { path: run.scene.clone(), replay })
    }

    pub fn len(&self) -> usize {
        match self {
            Frames::Scenes(paths) => paths.len(),
            Frames::Log { replay, .. } => replay.len(),
        }
    }

    /// What became of the log, if they come from one.
    pub fn summary(&self) -> Option<&Summary> {
        match self {
            Frames::Scenes(_) => None,
            Frames::Log { replay, .. } => Some(replay.summary()),
        }
    }

    /// Reads a frame that `network` takes; with its image files if `with_files`.
    pub fn read(&mut self, index: usize, network: &Network, with_files: bool) -> Result<Frame> {
        match self {
            Frames::Scenes(paths) => {
                let (path, name) = &paths[index];
                let (scene, notes) = frame::read(path, network)?;
                let (stamps, files) = if with_files { beside(path, &scene)? } else { (None, Vec::new()) };
                let stamps = stamps.unwrap_or_else(|| vec![index as u64 * NANOSECONDS_PER_FRAME; scene.cameras()]);
                let (first, last) = stamps.iter().fold((u64::MAX, 0), |(a, b), &stamp| (a.min(stamp), b.max(stamp)));
                let stamp = first + (last - first) / 2;
                let stamps = stamps.into_iter().map(Some).collect();
                Ok(Frame { name: name.clone(), path: path.clone(), scene, stamp, stamps, notes, files })
            }
            Frames::Log { path, replay } => {
                let frame = replay.frame(index).map_err(|e| e.in_file(path))?;
                frame.scene.check(network).map_err(|e| e.in_file(path))?;
                let notes = frame.notes.into_iter().map(|note| note.in_file(path)).collect();
                let (stamp, stamps, files) = (frame.stamp, frame.stamps, frame.files);
                let name = format!("{index:06}");
                Ok(Frame { name, path: path.clone(), scene: frame.scene, stamp, stamps, notes, files })
            }
        }
    }
}

/// Stamps and image files of a scene, where it is a directory.
#[allow(clippy::type_complexity, reason = "two lists, one of which may be missing")]
fn beside(path: &Path, scene: &Scene) -> Result<(Option<Vec<u64>>, Vec<Option<Encoded>>)> {
    if !path.is_dir() {
        return Ok((None, vec![None; scene.cameras()]));
    }
    let file = path.join("calibration.json");
    let text = std::fs::read_to_string(&file).map_err(|e| Error::io(&file, "read", &e))?;
    let stamps = read_stamps(&text).map_err(|e| e.in_file(&file))?;
    let cameras = voxcast::camera::read_calibration(&text).map_err(|e| e.in_file(&file))?;
    let read = |camera: voxcast::camera::Camera| {
        let image = path.join(&camera.file);
        let bytes = std::fs::read(&image).map_err(|e| Error::io(&image, "read", &e))?;
        Ok(Encoded::format_of(&bytes).map(|format| Encoded { format, bytes }))
    };
    Ok((stamps, cameras.into_iter().map(read).collect::<Result<_>>()?))
}

/// Where results go.
pub enum Results {
    /// A `.npz` for each frame.
    Directory(PathBuf),
    Log(Box<LogWriter>),
}

impl Results {
    pub fn create(run: &Run, network: &Network) -> Result<Self> {
        let path = &run.output;
        if is_log(path) {
            return Ok(Results::Log(Box::new(LogWriter::create(path, network)?)));
        }
        if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("npz")) {
            let message = "one file for many frames, expected a directory for one .npz each, or a log (.mcap)";
            return Err(Error::mismatch(message).in_file(path));
        }
        frame::create_directory(path)?;
        Ok(Results::Directory(path.clone()))
    }

    /// Whether frames are to be read with their image files.
    pub fn takes_files(&self) -> bool {
        matches!(self, Results::Log(_))
    }

    pub fn push(
        &mut self,
        network: &Network,
        frame: Frame,
        occupancy: Occupancy<'_>,
        latency: Duration,
        logits: bool,
    ) -> Result<()> {
        let log = match self {
            Results::Directory(path) => {
                return write(&path.join(format!("{}.npz", frame.name)), network, &occupancy, logits);
            }
            Results::Log(log) => log,
        };
        let mut files = frame.files;
        for ((file, image), stamp) in files.iter_mut().zip(&frame.scene.images).zip(&frame.stamps) {
            if file.is_none() && stamp.is_some() {
                *file = Some(Encoded::png(image)?);
            }
        }
        let scene = &frame.scene;
        let shots: Vec<Shot<'_>> = (0..scene.cameras())
            .map(|camera| Shot {
                name: &scene.names[camera],
                stamp: frame.stamps[camera].unwrap_or(frame.stamp),
                file: files[camera].as_ref(),
                size: [scene.images[camera].height, scene.images[camera].width],
                lidar2img: &scene.lidar2img[camera],
            })
            .collect();
        log.push(&LogFrame { stamp: frame.stamp, shots: &shots, occupancy, latency })
            .map_err(|e| e.in_file(&frame.path))
    }

    pub fn finish(self) -> Result<()> {
        match self {
            Results::Directory(_) => Ok(()),
            Results::Log(log) => log.finish(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_told_apart() {
        let dir = tempfile::tempdir().unwrap();
        let paths = ["153.612", "153.664", "a.safetensors"].map(|name| dir.path().join(name));
        paths[..2].iter().for_each(|path| std::fs::create_dir(path).unwrap());
        assert_eq!(names(&paths).unwrap(), ["153.612", "153.664", "a"]);
        let twice = [dir.path().join("153.612"), dir.path().join("153.612.safetensors")];
        assert!(names(&twice).unwrap_err().message().contains("called 153.612.npz"));
    }
}

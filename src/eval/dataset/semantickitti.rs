//! SemanticKITTI's scene completion as it is published (arXiv 1904.01416): sequences of the KITTI odometry benchmark, and
//! labelled voxels of every fifth scan, which the benchmark scores, or of every scan.
//!
//! Below `ROOT/sequences/NN`, `calib.txt`, `image_2/*.png` (and `image_3`) and `voxels/*.{label,invalid}` are read. What one
//! sweep alone occupies (`.bin`) and what is `.occluded` from every place are no part of the score, and not read.

use super::kitti::{GRID, check_pose, numbers, product, rows};
use super::{DataSet, Grid, IGNORED, Truth};
use crate::base::error::{Error, Result};
use crate::base::note::Note;
use crate::file::regular::open_regular;
use crate::image::file::read_image;
use crate::scene::matrix::check_intrinsic;
use crate::scene::{Scene, check_finite};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// Names of the classes, in order; 0 is empty.
pub const CLASSES: [&str; 20] = [
    "empty",
    "car",
    "bicycle",
    "motorcycle",
    "truck",
    "other vehicle",
    "person",
    "bicyclist",
    "motorcyclist",
    "road",
    "parking",
    "sidewalk",
    "other ground",
    "building",
    "fence",
    "vegetation",
    "trunk",
    "terrain",
    "pole",
    "traffic sign",
];

/// The class of a label as it is stored, of the official map; [`IGNORED`] for those that it counts nowhere, none for what is
/// no label. Moving objects are of the class of those that stand.
fn class_of(label: u16) -> Option<u8> {
    Some(match label {
        0 => 0,
        10 | 252 => 1,
        11 => 2,
        15 => 3,
        18 | 258 => 4,
        13 | 16 | 20 | 256 | 257 | 259 => 5,
        30 | 254 => 6,
        31 | 253 => 7,
        32 | 255 => 8,
        40 | 60 => 9,
        44 => 10,
        48 => 11,
        49 => 12,
        50 => 13,
        51 => 14,
        70 => 15,
        71 => 16,
        72 => 17,
        80 => 18,
        81 => 19,
        // Outlier, other structure, other object.
        1 | 52 | 99 => IGNORED,
        _ => return None,
    })
}

/// Which sequences.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Split {
    /// 00 to 07, 09 and 10.
    Train,
    /// 08.
    Val,
    /// 11 to 21, whose labels are not published.
    Test,
    /// One sequence, 0 to 21.
    Sequence(u8),
}

impl Split {
    fn sequences(self) -> Vec<u8> {
        match self {
            Split::Train => vec![0, 1, 2, 3, 4, 5, 6, 7, 9, 10],
            Split::Val => vec![8],
            Split::Test => (11..=21).collect(),
            Split::Sequence(number) => vec![number],
        }
    }
}

impl FromStr for Split {
    type Err = String;

    /// `train`, `val`, `test`, or the two digits of a sequence.
    fn from_str(text: &str) -> std::result::Result<Self, String> {
        match text {
            "train" => Ok(Split::Train),
            "val" => Ok(Split::Val),
            "test" => Ok(Split::Test),
            _ => match text.parse() {
                Ok(number @ 0..=21) if text.len() == 2 && !text.starts_with('+') => Ok(Split::Sequence(number)),
                _ => Err(format!("{text:?}, expected train, val, test or a sequence 00 to 21")),
            },
        }
    }
}

/// Which scans of a sequence.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Scans {
    /// Every fifth, from 0 on: those that the benchmark scores. Labels of others are left out, and none may be missing.
    #[default]
    Benchmark,
    /// All that have labels: the archive of all scans, or a choice of one's own.
    Labelled,
}

/// Of so many scans, the benchmark scores the first.
const EVERY: u32 = 5;

impl Scans {
    fn has(self, stem: &str) -> bool {
        self == Scans::Labelled || stem.parse::<u32>().is_ok_and(|number| number % EVERY == 0)
    }
}

/// SemanticKITTI: the frames with labels, in the order of sequence and number, without masks.
#[derive(Clone, Debug)]
pub struct SemanticKitti {
    sequences: Vec<Sequence>,
    frames: Vec<Numbered>,
}

/// A drive, with one calibration.
#[derive(Clone, Debug)]
struct Sequence {
    directory: PathBuf,
    cameras: Vec<Projection>,
}

#[derive(Clone, Debug)]
struct Projection {
    /// Its folder of images.
    name: &'static str,
    lidar2img: [f32; 16],
}

#[derive(Clone, Debug)]
struct Numbered {
    /// Index in `sequences`.
    sequence: usize,
    /// `NN/NNNNNN`.
    id: String,
}

impl Numbered {
    /// File name without its ending.
    fn stem(&self) -> &str {
        &self.id[3..]
    }
}

impl SemanticKitti {
    /// Opens the sequences of `split` below `root/sequences`. The camera is the left colour one (`image_2`), with `stereo`
    /// followed by the right one (`image_3`). Frames are listed, not read.
    ///
    /// # Errors
    /// [`ErrorKind::Io`](crate::ErrorKind::Io) if a sequence of the split or its calibration cannot be read;
    /// [`ErrorKind::Format`](crate::ErrorKind::Format) if the calibration is malformed, its `Tr` is not rigid or a projection
    /// not upper triangular, a sequence has no labels, or an image of [`Scans::Benchmark`] none.
    pub fn open(root: &Path, split: Split, stereo: bool, scans: Scans) -> Result<Self> {
        let names: &[(&str, &str)] =
            if stereo { &[("image_2", "P2"), ("image_3", "P3")] } else { &[("image_2", "P2")] };
        let mut set = Self { sequences: Vec::new(), frames: Vec::new() };
        for number in split.sequences() {
            let directory = root.join("sequences").join(format!("{number:02}"));
            let path = directory.join("calib.txt");
            let text = std::fs::read_to_string(&path).map_err(|e| Error::io(&path, "read", &e))?;
            let cameras = names.iter().map(|&(name, key)| {
                let (camera2img, lidar2camera) = (rows(&text, key)?, rows(&text, "Tr")?);
                check_pose("Tr", &lidar2camera)?;
                check_intrinsic(&camera2img.map(|[x, y, z, _]| [x, y, z]))
                    .map_err(|(found, expected)| Error::format(format!("{key}: {found}, expected {expected}")))?;
                let lidar2img = product(&camera2img, &lidar2camera);
                check_finite(name, &lidar2img)?;
                Ok(Projection { name, lidar2img })
            });
            let cameras = cameras.collect::<Result<_>>().map_err(|e| e.in_file(&path))?;
            let sequence = set.sequences.len();
            let voxels = directory.join("voxels");
            let stems: Vec<String> = numbers(&voxels, ".label")?.into_iter().filter(|s| scans.has(s)).collect();
            if stems.is_empty() {
                return Err(Error::format("no labels, expected files such as 000005.label").in_file(&voxels));
            }
            let images = directory.join("image_2");
            if scans == Scans::Benchmark && images.is_dir() {
                let images = numbers(&images, ".png")?;
                let missing = images.iter().find(|s| scans.has(s) && stems.binary_search(s).is_err());
                if let Some(stem) = missing {
                    let message = format!("no {stem}.label for image_2/{stem}.png, expected one for every fifth image");
                    return Err(Error::format(message).in_file(&voxels));
                }
            }
            set.frames.extend(stems.into_iter().map(|s| Numbered { sequence, id: format!("{number:02}/{s}") }));
            set.sequences.push(Sequence { directory, cameras });
        }
        Ok(set)
    }
}

/// The bytes of a file that has `expected` of them.
fn read_exactly(path: &Path, expected: usize) -> Result<Vec<u8>> {
    let (file, length) = open_regular(path)?;
    if length != expected as u64 {
        return Err(Error::format(format!("{length} bytes, expected {expected}")).in_file(path));
    }
    let mut bytes = Vec::with_capacity(expected);
    file.take(length).read_to_end(&mut bytes).map_err(|e| Error::io(path, "read", &e))?;
    if bytes.len() != expected {
        return Err(Error::format(format!("{} bytes, expected {expected}", bytes.len())).in_file(path));
    }
    Ok(bytes)
}

impl DataSet for SemanticKitti {
    fn classes(&self) -> &[&'static str] {
        &CLASSES
    }

    fn grid(&self) -> Grid {
        GRID
    }

    fn len(&self) -> usize {
        self.frames.len()
    }

    fn id(&self, index: usize) -> &str {
        &self.frames[index].id
    }

    fn scene(&self, index: usize) -> Result<(Scene, Vec<Note>)> {
        let frame = &self.frames[index];
        let sequence = &self.sequences[frame.sequence];
        let mut notes = Vec::new();
        let mut scene = Scene { names: Vec::new(), images: Vec::new(), lidar2img: Vec::new() };
        for camera in &sequence.cameras {
            let path = sequence.directory.join(camera.name).join(format!("{}.png", frame.stem()));
            scene.images.push(read_image(&path, camera.name, None, &mut notes)?);
            scene.names.push(camera.name.to_owned());
            scene.lidar2img.push(camera.lidar2img);
        }
        Ok((scene, notes))
    }

    fn truth(&self, index: usize) -> Result<Truth> {
        let frame = &self.frames[index];
        let voxels = self.sequences[frame.sequence].directory.join("voxels");
        let path = voxels.join(format!("{}.label", frame.stem()));
        let stored = read_exactly(&path, 2 * GRID.voxels())?;
        // One bit per voxel, the first in the highest.
        let invalid = read_exactly(&voxels.join(format!("{}.invalid", frame.stem())), GRID.voxels() / 8)?;
        let mut labels = Vec::with_capacity(GRID.voxels());
        for (at, &bytes) in stored.as_chunks::<2>().0.iter().enumerate() {
            let label = u16::from_le_bytes(bytes);
            let class = class_of(label).ok_or_else(|| {
                Error::format(format!("voxel {at} has label {label}, which SemanticKITTI does not have")).in_file(&path)
            })?;
            let known = invalid[at / 8] >> (7 - at % 8) & 1 == 0;
            labels.push(if known { class } else { IGNORED });
        }
        Ok(Truth::of_lidar(labels))
    }
}

#[cfg(test)]
mod tests;

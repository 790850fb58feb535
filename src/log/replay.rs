//! A log as frames that a session can run.

use super::Stamp;
use super::file::{Channel, Ending, Extent, Log, Place};
use super::join::{Join, join};
use super::lens::{Lens, Undistortion};
use super::message::{self, Calibration, Encoded, Kind, Pixels};
use super::sources::{self, CameraTopics, Topic};
use super::transforms::{Tree, seconds};
use crate::base::error::{Error, ErrorKind, Result};
use crate::base::note::Note;
use crate::file::backing::Backing;
use crate::image::Image;
use crate::image::file::decode_image;
use crate::network::{MAX_SIDE, Network};
use crate::scene::matrix::check_intrinsic;
use crate::scene::{Scene, check_matrix};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

/// Images and calibrations that a log may have.
const MAX_MESSAGES: usize = 1 << 22;

/// Names by which lidars' frames go, in the order in which they are looked for.
const LIDAR_FRAMES: [&str; 6] = ["LIDAR_TOP", "lidar_top", "lidar", "lidar_link", "velodyne", "os_sensor"];

/// What a log does not say.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ReplayOptions {
    /// Cameras by name and topic of images, in the order of the network's training. If there are none, they are found.
    pub cameras: Vec<(String, String)>,
    /// The frame of reference in which the network sees. If there is none, a lidar's is found.
    pub frame: Option<String>,
    /// How much later than the first image of a frame the others may be, in nanoseconds. It must be less than the time from
    /// one image of a camera to its next. A transform may be as much older or younger than what it is used for.
    pub tolerance: Stamp,
}

impl Default for ReplayOptions {
    fn default() -> Self {
        Self { cameras: Vec::new(), frame: None, tolerance: 50_000_000 }
    }
}

/// What became of a log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Summary {
    /// How far it could be read.
    pub extent: Extent,
    /// Frames that can be run.
    pub frames: usize,
    /// Of those, the ones that lack the image of a camera.
    pub incomplete: usize,
    /// Images that did not come to a frame: too few others at their time.
    pub left_out: usize,
    /// Frames whose transforms are not known at their time.
    pub without_transform: usize,
    /// Cameras by name and topic, in the order of the frames' images.
    pub cameras: Vec<(String, String)>,
    /// The frame of reference in which the network sees.
    pub frame: String,
}

/// A frame of a log.
#[derive(Clone, Debug, PartialEq)]
pub struct ReplayFrame {
    /// Half way between the first and the last stamp of its images.
    pub stamp: Stamp,
    /// When each camera's image was taken; none where it is missing.
    pub stamps: Vec<Option<Stamp>>,
    /// Images and calibration. A missing image is black; its camera is to be masked.
    pub scene: Scene,
    /// For each camera, the file as it was sent, if it was used as it is: a JPEG or PNG without distortion.
    pub files: Vec<Option<Encoded>>,
    /// What the log says and is not obeyed, or is hardly ever meant, as of a scene ([`Scene::open_with_notes`]).
    pub notes: Vec<Note>,
}

/// A log as frames, in the order of time.
pub struct Replay {
    log: Log,
    cameras: Vec<CameraLog>,
    frames: Vec<Moment>,
    summary: Summary,
}

/// Images that belong together, and where their cameras stand.
struct Moment {
    join: Join,
    /// `lidar2img` of each camera.
    matrices: Vec<[f32; 16]>,
    /// What is to be said of those.
    notes: Vec<Note>,
}

/// Calibrations of a camera, each with the moment from which it holds.
type Calibrations = Vec<(Stamp, Arc<Calibration>)>;

/// A camera with what the log has of it.
struct CameraLog {
    camera: CameraTopics,
    /// In the order of their stamps.
    images: Vec<ImageAt>,
    calibrations: Calibrations,
    /// The latest one, with the calibration that it is for.
    undistortion: Option<(Arc<Calibration>, Undistortion)>,
}

#[derive(Clone, Copy)]
struct ImageAt {
    stamp: Stamp,
    kind: Kind,
    place: Place,
}

/// What is found while a log is read for the first time.
#[derive(Default)]
struct Index {
    images: BTreeMap<String, (Topic, Vec<ImageAt>)>,
    calibrations: BTreeMap<String, (Topic, Calibrations)>,
    tree: Tree,
    messages: usize,
}

impl Index {
    fn visit(&mut self, channel: &Channel, place: Place, data: &[u8]) -> Result<()> {
        let Some(kind) = channel.kind else { return Ok(()) };
        if kind.is_image() || kind.is_calibration() {
            self.messages += 1;
            if self.messages > MAX_MESSAGES {
                return Err(Error::new(
                    ErrorKind::TooLarge,
                    format!("more than {MAX_MESSAGES} images and calibrations"),
                ));
            }
        }
        if kind.is_image() {
            let message::Head { stamp, frame } = message::head(kind, data)?;
            let topic = || (Topic { name: channel.topic.clone(), frame }, Vec::new());
            let (_, images) = self.images.entry(channel.topic.clone()).or_insert_with(topic);
            images.push(ImageAt { stamp, kind, place });
        } else if kind.is_calibration() {
            let (stamp, calibration) = message::calibration(kind, data)?;
            let topic = || (Topic { name: channel.topic.clone(), frame: calibration.frame.clone() }, Vec::new());
            let (_, all) = self.calibrations.entry(channel.topic.clone()).or_insert_with(topic);
            // Most repeat the one before.
            let same =
                all.last().map(|(_, last): &(_, Arc<Calibration>)| last.clone()).filter(|last| **last == calibration);
            all.push((stamp, same.unwrap_or_else(|| Arc::new(calibration))));
        } else {
            for transform in message::transforms(kind, data)? {
                self.tree.add(transform)?;
            }
        }
        Ok(())
    }
}

impl Replay {
    /// Reads the log at `path`, which must not be changed while it is open, for `network`. Images are decoded frame by frame.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if it cannot be opened and mapped; [`ErrorKind::Format`] for malformed records and messages; \
    /// [`ErrorKind::Mismatch`] for cameras that are not those of the network, that have no calibration or no way to the
    /// lidar, and for a log in which no frame can be run; [`ErrorKind::Unsupported`] for other compressions and lenses;
    /// [`ErrorKind::TooLarge`] beyond four million messages or a chunk beyond 1 GiB. What is cut off at the end is no error.
    pub fn open(path: &Path, network: &Network, options: &ReplayOptions) -> Result<Self> {
        Backing::map(path, "an MCAP file")
            .and_then(|bytes| Self::read(bytes, network, options))
            .map_err(|e| e.in_file(path))
    }

    /// Reads the log that is in memory, as [`Replay::open`] does.
    ///
    /// # Errors
    /// Those of [`Replay::open`], without a file name.
    pub fn from_bytes(bytes: Vec<u8>, network: &Network, options: &ReplayOptions) -> Result<Self> {
        Self::read(Backing::Bytes(bytes.into()), network, options)
    }

    fn read(bytes: Backing, network: &Network, options: &ReplayOptions) -> Result<Self> {
        let mut index = Index::default();
        let log = Log::read(bytes, &mut |channel, place, data| index.visit(channel, place, data))?;
        index.tree.finish();
        let topics = |topic: &(Topic, Vec<ImageAt>)| topic.0.clone();
        let images: Vec<Topic> = index.images.values().map(topics).collect();
        let calibrations: Vec<Topic> = index.calibrations.values().map(|(topic, _)| topic.clone()).collect();
        let cameras = sources::find(&images, &calibrations, &options.cameras, network.cameras)
            .map_err(|e| with_hint(e, &log, images.is_empty()))?;
        let frame = lidar_frame(&index.tree, options.frame.as_deref())?;
        let mut sources = Vec::with_capacity(cameras.len());
        for camera in cameras {
            let mut images = index.images.get(&camera.images).map(|(_, images)| images.clone()).unwrap_or_default();
            let found = index.calibrations.get(&camera.calibration).map(|(_, all)| all.clone());
            let mut calibrations = found.unwrap_or_default();
            images.sort_by_key(|image| image.stamp);
            calibrations.sort_by_key(|(stamp, _)| *stamp);
            sources.push(CameraLog { camera, images, calibrations, undistortion: None });
        }
        let stamps: Vec<Vec<Stamp>> =
            sources.iter().map(|source| source.images.iter().map(|image| image.stamp).collect()).collect();
        let (joins, left_out) = join(&stamps, options.tolerance);
        if joins.is_empty() {
            return Err(Error::mismatch(
                "no moment has images of half of the cameras, expected stamps that belong together",
            ));
        }
        let place = Placement { tree: &index.tree, lidar: &frame, slack: options.tolerance };
        let (mut frames, mut without_transform, mut reason) = (Vec::with_capacity(joins.len()), 0, None);
        for join in joins {
            let mut notes = Vec::new();
            match place.matrices(&sources, &join, &mut notes) {
                Ok(matrices) => frames.push(Moment { join, matrices, notes }),
                Err(e) if e.kind() == ErrorKind::Mismatch => {
                    without_transform += 1;
                    reason.get_or_insert(e);
                }
                Err(e) => return Err(e),
            }
        }
        if let Some(reason) = reason.filter(|_| frames.is_empty()) {
            return Err(reason);
        }
        let summary = Summary {
            extent: log.extent,
            frames: frames.len(),
            incomplete: frames.iter().filter(|moment| moment.join.images.contains(&None)).count(),
            left_out,
            without_transform,
            cameras: sources.iter().map(|s| (s.camera.name.clone(), s.camera.images.clone())).collect(),
            frame,
        };
        Ok(Self { log, cameras: sources, frames, summary })
    }

    /// What became of the log.
    pub fn summary(&self) -> &Summary {
        &self.summary
    }

    /// Frames that can be run.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Whether there are none. A log without frames is refused when it is opened.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// Decodes frame `index`.
    ///
    /// # Errors
    /// Those of the images, naming topic and stamp.
    ///
    /// # Panics
    /// If there is no such frame.
    pub fn frame(&mut self, index: usize) -> Result<ReplayFrame> {
        let Moment { join, matrices, notes } = &self.frames[index];
        let mut frame = ReplayFrame {
            stamp: join.time,
            stamps: Vec::new(),
            scene: Scene { names: Vec::new(), images: Vec::new(), lidar2img: matrices.clone() },
            files: Vec::new(),
            notes: notes.clone(),
        };
        for (source, image) in self.cameras.iter_mut().zip(&join.images) {
            let name = source.camera.name.clone();
            let found = image.map(|image| source.images[image]);
            let calibration = source.calibration(found.map_or(join.time, |image| image.stamp)).clone();
            let (image, file) = match found {
                None => (blank(&calibration, &source.camera)?, None),
                Some(at) => {
                    let pixels = self.log.message(at.place, |data| message::pixels(at.kind, data));
                    pixels.and_then(|pixels| source.decode(pixels, calibration, &mut frame.notes)).map_err(|e| {
                        let topic = &source.camera.images;
                        Error::new(e.kind(), format!("topic {topic} at {} s: {}", seconds(at.stamp), e.message()))
                    })?
                }
            };
            frame.stamps.push(found.map(|image| image.stamp));
            frame.scene.names.push(name);
            frame.scene.images.push(image);
            frame.files.push(file);
        }
        Ok(frame)
    }
}

/// Says of a log in which no camera was found what it holds instead.
fn with_hint(error: Error, log: &Log, nothing: bool) -> Error {
    let mut others: Vec<&str> =
        log.channels.values().filter(|c| c.kind.is_none()).map(|c| c.described.as_str()).collect();
    others.sort_unstable();
    others.dedup();
    let ending =
        if log.extent.ending == Ending::Whole { String::new() } else { format!("; the log is {}", log.extent) };
    if !nothing {
        return Error::new(error.kind(), format!("{}{ending}", error.message()));
    }
    let others = if others.is_empty() { "nothing else".to_owned() } else { others.join(", ") };
    Error::mismatch(format!(
        "no images, expected topics of foxglove.CompressedImage, foxglove.RawImage, sensor_msgs/CompressedImage or \
         sensor_msgs/Image; it holds {others}{ending}"
    ))
}

/// The frame in which the network sees.
fn lidar_frame(tree: &Tree, named: Option<&str>) -> Result<String> {
    let known = || {
        let names = tree.names();
        if names.is_empty() { "none".to_owned() } else { names.join(", ") }
    };
    match named {
        Some(name) if tree.has(name) => Ok(name.to_owned()),
        Some(name) => Err(Error::mismatch(format!("no frame {name:?}, expected one of: {}", known()))),
        None => {
            let found = LIDAR_FRAMES.iter().find(|name| tree.has(name));
            let found = found.map(|name| (*name).to_owned());
            found.ok_or_else(|| {
                Error::mismatch(format!("no lidar among the frames {}; name the network's with --frame", known()))
            })
        }
    }
}

/// How cameras come to their matrices.
struct Placement<'a> {
    tree: &'a Tree,
    lidar: &'a str,
    slack: Stamp,
}

impl Placement<'_> {
    /// `lidar2img` of every camera: the camera at its image's time, the lidar at the frame's.
    fn matrices(&self, sources: &[CameraLog], join: &Join, notes: &mut Vec<Note>) -> Result<Vec<[f32; 16]>> {
        let (root, lidar) = self.tree.in_root(self.lidar, join.time, self.slack)?;
        let matrix = |(source, image): (&CameraLog, &Option<usize>)| {
            let stamp = image.map_or(join.time, |image| source.images[image].stamp);
            let frame = &source.camera.frame;
            let (other, camera) = self.tree.in_root(frame, stamp, self.slack)?;
            if other != root {
                return Err(Error::mismatch(format!(
                    "camera {}: no transforms lead from frame {frame:?} to {:?}; they end at {other:?} and {root:?}",
                    source.camera.name, self.lidar
                )));
            }
            let k = source.matrix(source.calibration(stamp));
            // A projection that is scaled as a whole, which scenes may have, comes out of a writer as a scaled camera.
            let scale = if k[2][2] == 0.0 { 1.0 } else { k[2][2] };
            check_intrinsic(&k.map(|row| row.map(|v| v / scale))).map_err(|(found, expected)| {
                let topic = &source.camera.calibration;
                Error::format(format!("topic {topic}: camera matrix with {found}, expected {expected}"))
            })?;
            let mut matrix = (camera.inverse() * lidar).then_project(&k);
            matrix.chunks_exact_mut(4).for_each(clear);
            check_matrix(&format!("camera {}", source.camera.name), &matrix, notes)?;
            Ok(matrix)
        };
        sources.iter().zip(&join.images).map(matrix).collect()
    }
}

/// Makes numbers 0 that are so far below the largest of their row that only the rounding of transforms can have left them.
fn clear(row: &mut [f32]) {
    let largest = row.iter().fold(0.0f32, |largest, v| largest.max(v.abs()));
    row.iter_mut().filter(|v| v.abs() < 1e-12 * largest).for_each(|v| *v = 0.0);
}

impl CameraLog {
    /// The calibration that holds at `stamp`: the last one before, or else the first.
    fn calibration(&self, stamp: Stamp) -> &Arc<Calibration> {
        let after = self.calibrations.partition_point(|(at, _)| *at <= stamp);
        &self.calibrations[after.saturating_sub(1)].1
    }

    /// The camera matrix of the images that [`CameraLog::decode`] gives.
    fn matrix(&self, calibration: &Calibration) -> [[f64; 3]; 3] {
        let Calibration { k, p, .. } = calibration;
        match self.camera.rectified && p[0] != 0.0 {
            true => std::array::from_fn(|row| std::array::from_fn(|column| p[4 * row + column])),
            false => std::array::from_fn(|row| std::array::from_fn(|column| k[3 * row + column])),
        }
    }

    /// The image without distortion, and its file if it is the same.
    fn decode(
        &mut self,
        pixels: Pixels,
        calibration: Arc<Calibration>,
        notes: &mut Vec<Note>,
    ) -> Result<(Image, Option<Encoded>)> {
        let size = size_of(&calibration)?;
        let lens = if self.camera.rectified { None } else { Lens::of(&calibration.model, &calibration.d)? };
        let [fx, _, _, _, fy, ..] = calibration.k;
        if !(self.camera.rectified || fx.is_normal() && fy.is_normal()) {
            return Err(Error::format(format!("focal lengths {fx} and {fy}, expected some that are not 0")));
        }
        let (image, file) = match pixels {
            Pixels::File(bytes) => {
                let image = decode_image(&bytes, &self.camera.name, size, notes)?;
                let file = Encoded::format_of(&bytes).map(|format| Encoded { format, bytes });
                (image, file)
            }
            Pixels::Raw { size: found, step, encoding, data } => {
                if let Some([height, width]) = size.filter(|&size| size != found) {
                    let [h, w] = found;
                    let message =
                        format!("image of {h}x{w}, the calibration expects {height}x{width} (height x width)");
                    return Err(Error::mismatch(message));
                }
                (raw_image(found, step, &encoding, &data)?, None)
            }
        };
        let Some(lens) = lens else { return Ok((image, file)) };
        let size = [image.height, image.width];
        if self.undistortion.as_ref().is_none_or(|(of, _)| *of != calibration) {
            let undistortion = Undistortion::new(&lens, &calibration.k, size);
            self.undistortion = Some((calibration, undistortion));
        }
        let undistorted = self.undistortion.as_ref().map(|(_, undistortion)| undistortion.apply(&image));
        Ok((undistorted.unwrap_or(image), None))
    }
}

/// Height and width that a calibration states; none if it leaves them out.
fn size_of(calibration: &Calibration) -> Result<Option<[usize; 2]>> {
    match calibration.size {
        [0, 0] => Ok(None),
        [height, width] if height > MAX_SIDE || width > MAX_SIDE || height == 0 || width == 0 => {
            let message = format!("calibration of images of {height}x{width}, expected sides from 1 to {MAX_SIDE}");
            Err(Error::format(message))
        }
        size => Ok(Some(size)),
    }
}

/// What stands for an image that is missing.
fn blank(calibration: &Calibration, camera: &CameraTopics) -> Result<Image> {
    let Some([height, width]) = size_of(calibration)? else {
        let message =
            format!("camera {}: an image is missing, and the calibration does not state its size", camera.name);
        return Err(Error::format(message));
    };
    Ok(Image { height, width, bgr: vec![0; 3 * height * width] })
}

/// Pixels as they lie in memory.
fn raw_image([height, width]: [usize; 2], step: usize, encoding: &str, data: &[u8]) -> Result<Image> {
    let (bytes, [blue, green, red]) = message::channels(encoding)?;
    let sound = (1..=MAX_SIDE).contains(&height) && (1..=MAX_SIDE).contains(&width) && step >= bytes * width;
    let needed = step.checked_mul(height.saturating_sub(1)).and_then(|rows| rows.checked_add(bytes * width));
    if !sound || needed.is_none_or(|needed| data.len() < needed) {
        let message = format!(
            "image of {height}x{width} {encoding} with rows {step} bytes apart in {} bytes, expected more",
            data.len()
        );
        return Err(Error::format(message));
    }
    let mut bgr = Vec::with_capacity(3 * height * width);
    for row in data.chunks(step).take(height) {
        bgr.extend(row[..bytes * width].chunks_exact(bytes).flat_map(|pixel| [pixel[blue], pixel[green], pixel[red]]));
    }
    Ok(Image { height, width, bgr })
}

//! Results as a log.

use super::Stamp;
use super::message::Encoded;
use super::pinhole::Pinhole;
use super::schema::{self, PackedElementField, Schema, Timestamp, Vector2, Vector3, descriptors, numeric};
use crate::base::error::{Error, ErrorKind, Result};
use crate::file::replace::Replacement;
use crate::network::{Grid, Network};
use crate::runtime::session::Occupancy;
use crate::show::picture::Palette;
use mcap::records::MessageHeader;
use mcap::{WriteOptions, Writer};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// The frame of reference of everything that is written.
const FRAME: &str = "lidar";

/// A camera's part in a frame.
#[derive(Clone, Copy, Debug)]
pub struct Shot<'a> {
    /// The camera, which names the topics `/NAME/image` and `/NAME/calibration` and its frame of reference.
    pub name: &'a str,
    /// When its image was taken.
    pub stamp: Stamp,
    /// The image; none if there was none, and then nothing is written of the camera.
    pub file: Option<&'a Encoded>,
    /// Height and width of the image in pixels.
    pub size: [usize; 2],
    /// Row-major 4x4: lidar-frame metres (x, y, z, 1) to (u*d, v*d, d, 1).
    pub lidar2img: &'a [f32; 16],
}

/// A frame to write.
#[derive(Clone, Copy, Debug)]
pub struct LogFrame<'a> {
    /// The moment that the result is about.
    pub stamp: Stamp,
    /// The cameras.
    pub shots: &'a [Shot<'a>],
    /// What the network said.
    pub occupancy: Occupancy<'a>,
    /// How long that took.
    pub latency: Duration,
}

/// Writes results as an MCAP file of Foxglove's messages. It appears under its name when it is finished, whole or not at all.
///
/// `docs/logs.md` lists topics and messages. Voxels are drawn in the colours of [`Palette::of`] the network's classes.
pub struct LogWriter {
    writer: Writer<BufWriter<File>>,
    replacement: Replacement,
    path: PathBuf,
    network: Network,
    colours: Vec<[u8; 3]>,
    channels: BTreeMap<String, (u16, u32)>,
}

impl LogWriter {
    /// Begins a log of results of `network` at `path`.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if no file can be made there.
    pub fn create(path: &Path, network: &Network) -> Result<Self> {
        let replacement = Replacement::create(path)?;
        let file = replacement.file.try_clone().map_err(|e| Error::io(path, "write", &e))?;
        // Compressing on the calling thread alone gives the same bytes on every machine.
        let options = WriteOptions::new()
            .library(concat!("voxcast ", env!("CARGO_PKG_VERSION")))
            .compression_threads(0)
            .create(BufWriter::with_capacity(1 << 18, file));
        let colours = Palette::of(network.classes).classes().iter().map(|class| class.rgb).collect();
        Ok(Self {
            writer: options.map_err(|e| failed(path, &e))?,
            replacement,
            path: path.to_owned(),
            network: network.clone(),
            colours,
            channels: BTreeMap::new(),
        })
    }

    /// Writes a frame.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if it cannot be written; [`ErrorKind::Format`] for a matrix that no camera has;
    /// [`ErrorKind::Mismatch`] for a result that is not the network's; [`ErrorKind::TooLarge`] for voxels beyond 4 GiB.
    pub fn push(&mut self, frame: &LogFrame<'_>) -> Result<()> {
        self.check(&frame.occupancy).map_err(|e| e.in_file(&self.path))?;
        for shot in frame.shots {
            let Some(file) = shot.file else { continue };
            let pinhole = Pinhole::of(shot.lidar2img)
                .map_err(|e| Error::new(e.kind(), format!("camera {}: {}", shot.name, e.message())))?;
            self.transform(shot, &pinhole)?;
            self.calibration(shot, &pinhole)?;
            let image = schema::CompressedImage {
                timestamp: Some(timestamp(shot.stamp)),
                data: file.bytes.clone(),
                format: file.format.to_owned(),
                frame_id: shot.name.to_owned(),
            };
            self.write(&format!("/{}/image", shot.name), shot.stamp, &image)?;
        }
        let stamp = frame.stamp;
        let voxels = self.voxels(stamp, &frame.occupancy)?;
        self.write("/voxcast/occupancy", stamp, &voxels)?;
        drop(voxels);
        let ground = self.ground(stamp, &frame.occupancy);
        self.write("/voxcast/ground", stamp, &ground)?;
        let cameras = frame.shots.iter().zip(frame.occupancy.cameras);
        let masked = cameras.filter(|(_, status)| status.masked).map(|(shot, _)| shot.name.to_owned());
        let status = schema::FrameStatus {
            timestamp: Some(timestamp(stamp)),
            latency: frame.latency.as_secs_f64(),
            digest: format!("{:016x}", frame.occupancy.digest()),
            occupied: frame.occupancy.classes.iter().filter(|&&class| class != 0).count() as u32,
            masked: masked.collect(),
        };
        self.write("/voxcast/status", stamp, &status)?;
        // A frame shares no chunk with the next, so that a copy that is cut off loses few.
        self.writer.flush().map_err(|e| failed(&self.path, &e))
    }

    /// Ends the log and gives the file its name.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if it cannot be written.
    pub fn finish(mut self) -> Result<()> {
        self.writer.finish().map_err(|e| failed(&self.path, &e))?;
        let out = self.writer.into_inner();
        out.into_inner().map_err(|e| Error::io(&self.path, "write", e.error()))?;
        self.replacement.commit(&self.path)
    }

    fn check(&self, occupancy: &Occupancy<'_>) -> Result<()> {
        let (found, expected) = (occupancy.grid, Grid::of(&self.network));
        if found != expected {
            let says = |grid: Grid| format!("{:?} voxels within {:?} m", grid.size, grid.bounds);
            let message = format!("a result of {}, the log is of {}", says(found), says(expected));
            return Err(Error::mismatch(message));
        }
        let beyond = |class: &&u8| usize::from(**class) >= self.colours.len();
        match occupancy.classes.iter().find(beyond) {
            Some(class) => Err(Error::mismatch(format!("class {class}, the network has {}", self.colours.len()))),
            None => Ok(()),
        }
    }

    fn write<M: Schema>(&mut self, topic: &str, stamp: Stamp, message: &M) -> Result<()> {
        let path = self.path.clone();
        let failed = |e: mcap::McapError| failed(&path, &e);
        let (channel_id, sequence) = match self.channels.get_mut(topic) {
            Some((id, sequence)) => {
                *sequence += 1;
                (*id, *sequence)
            }
            None => {
                let schema = self.writer.add_schema(M::NAME, "protobuf", &descriptors(M::NAME)).map_err(failed)?;
                let id = self.writer.add_channel(schema, topic, "protobuf", &BTreeMap::new()).map_err(failed)?;
                self.channels.insert(topic.to_owned(), (id, 0));
                (id, 0)
            }
        };
        let header = MessageHeader { channel_id, sequence, log_time: stamp, publish_time: stamp };
        self.writer.write_to_known_channel(&header, &message.encode_to_vec()).map_err(failed)
    }

    fn transform(&mut self, shot: &Shot<'_>, pinhole: &Pinhole) -> Result<()> {
        let [x, y, z] = pinhole.place;
        let [qw, qx, qy, qz] = pinhole.rotation;
        let transform = schema::FrameTransform {
            timestamp: Some(timestamp(shot.stamp)),
            parent_frame_id: FRAME.to_owned(),
            child_frame_id: shot.name.to_owned(),
            translation: Some(Vector3 { x, y, z }),
            rotation: Some(schema::Quaternion { x: qx, y: qy, z: qz, w: qw }),
        };
        self.write("/tf", shot.stamp, &transform)
    }

    fn calibration(&mut self, shot: &Shot<'_>, pinhole: &Pinhole) -> Result<()> {
        let k = pinhole.k;
        let side = |v: usize| u32::try_from(v).unwrap_or(u32::MAX);
        let calibration = schema::CameraCalibration {
            timestamp: Some(timestamp(shot.stamp)),
            width: side(shot.size[1]),
            height: side(shot.size[0]),
            distortion_model: String::new(),
            d: Vec::new(),
            k: k.to_vec(),
            r: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            p: vec![k[0], k[1], k[2], 0.0, k[3], k[4], k[5], 0.0, k[6], k[7], k[8], 0.0],
            frame_id: shot.name.to_owned(),
        };
        self.write(&format!("/{}/calibration", shot.name), shot.stamp, &calibration)
    }

    /// Where the grid begins, and the edges of its voxels.
    fn frame(&self) -> ([f64; 3], [f64; 3]) {
        let grid = self.network.output_grid();
        let low = self.network.bounds.map(|[low, _]| f64::from(low));
        let bounds = self.network.bounds.map(|bound| bound.map(f64::from));
        (low, std::array::from_fn(|axis| (bounds[axis][1] - bounds[axis][0]) / grid[axis] as f64))
    }

    /// Red, green, blue and alpha of a class; empty space has no alpha.
    fn colour(&self, class: u8) -> [u8; 4] {
        let [red, green, blue] = self.colours[usize::from(class)];
        [red, green, blue, if class == 0 { 0 } else { 255 }]
    }

    fn voxels(&self, stamp: Stamp, occupancy: &Occupancy<'_>) -> Result<schema::VoxelGrid> {
        let cell = if occupancy.confidence.is_some() { 10 } else { 8 };
        let [nx, ny, nz] = occupancy.grid.size;
        let bytes = occupancy.classes.len().checked_mul(cell).filter(|&bytes| u32::try_from(bytes).is_ok());
        let bytes = bytes.ok_or_else(|| Error::new(ErrorKind::TooLarge, "voxels of more than 4 GiB, expected less"))?;
        let mut data = Vec::with_capacity(bytes);
        for z in 0..nz {
            for y in 0..ny {
                for x in 0..nx {
                    let at = (x * ny + y) * nz + z;
                    let class = occupancy.classes[at];
                    data.extend(self.colour(class));
                    data.extend([class, 0]);
                    data.extend(occupancy.support[at].to_le_bytes());
                    data.extend(occupancy.confidence.iter().flat_map(|sure| [sure.occupied[at], sure.class[at]]));
                }
            }
        }
        let (low, [x, y, z]) = self.frame();
        Ok(schema::VoxelGrid {
            timestamp: Some(timestamp(stamp)),
            frame_id: FRAME.to_owned(),
            pose: Some(pose(low)),
            row_count: ny as u32,
            column_count: nx as u32,
            cell_size: Some(Vector3 { x, y, z }),
            slice_stride: (cell * nx * ny) as u32,
            row_stride: (cell * nx) as u32,
            cell_stride: cell as u32,
            fields: fields(if occupancy.confidence.is_some() { &CONFIDENCE } else { &[] }),
            data,
        })
    }

    /// Of each column the lowest voxel that is not empty.
    fn ground(&self, stamp: Stamp, occupancy: &Occupancy<'_>) -> schema::Grid {
        const CELL: usize = 12;
        let [nx, ny, nz] = occupancy.grid.size;
        let ([low_x, low_y, low_z], [x, y, z]) = self.frame();
        let mut data = Vec::with_capacity(CELL * nx * ny);
        for row in 0..ny {
            for column in 0..nx {
                let first = (column * ny + row) * nz;
                let classes = &occupancy.classes[first..first + nz];
                let found = classes.iter().position(|&class| class != 0);
                let class = found.map_or(0, |at| classes[at]);
                let support = occupancy.support[first + found.unwrap_or(0)];
                let height = found.map_or(f32::NAN, |at| (low_z + (at as f64 + 0.5) * z) as f32);
                data.extend(self.colour(class));
                data.extend([class, 0]);
                data.extend(support.to_le_bytes());
                data.extend(height.to_le_bytes());
            }
        }
        schema::Grid {
            timestamp: Some(timestamp(stamp)),
            frame_id: FRAME.to_owned(),
            pose: Some(pose([low_x, low_y, low_z])),
            column_count: nx as u32,
            cell_size: Some(Vector2 { x, y }),
            row_stride: (CELL * nx) as u32,
            cell_stride: CELL as u32,
            fields: fields(&[("height", 8, numeric::FLOAT32)]),
            data,
        }
    }
}

/// How sure the network is of a voxel.
const CONFIDENCE: [(&str, u32, i32); 2] =
    [("confidence_occupied", 8, numeric::UINT8), ("confidence_class", 9, numeric::UINT8)];

/// Colours, class and support of a cell, and what it has besides.
fn fields(more: &[(&str, u32, i32)]) -> Vec<PackedElementField> {
    let common = [
        ("red", 0, numeric::UINT8),
        ("green", 1, numeric::UINT8),
        ("blue", 2, numeric::UINT8),
        ("alpha", 3, numeric::UINT8),
        ("class", 4, numeric::UINT8),
        ("support", 6, numeric::UINT16),
    ];
    let field =
        |&(name, offset, r#type): &(&str, u32, i32)| PackedElementField { name: name.to_owned(), offset, r#type };
    common.iter().chain(more).map(field).collect()
}

fn pose([x, y, z]: [f64; 3]) -> schema::Pose {
    let orientation = schema::Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 };
    schema::Pose { position: Some(Vector3 { x, y, z }), orientation: Some(orientation) }
}

fn timestamp(stamp: Stamp) -> Timestamp {
    // The largest stamp has 18446744073 seconds.
    Timestamp { seconds: (stamp / 1_000_000_000) as i64, nanos: (stamp % 1_000_000_000) as i32 }
}

fn failed(path: &Path, error: &mcap::McapError) -> Error {
    match error {
        mcap::McapError::Io(e) => Error::io(path, "write", e),
        other => Error::new(ErrorKind::Io, format!("cannot write: {other}")).in_file(path),
    }
}

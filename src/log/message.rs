//! What is read of a message: stamps, images, calibrations, transforms, from either family.

use super::Stamp;
use super::cdr::Cdr;
use super::schema::{self, Schema};
use crate::base::error::{Error, ErrorKind, Result};
use crate::scene::Image;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use prost::Message;

/// A message that is of use here, and how it is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    FoxgloveCompressedImage,
    FoxgloveRawImage,
    FoxgloveCalibration,
    FoxgloveTransform,
    FoxgloveTransforms,
    RosCompressedImage,
    RosImage,
    RosCameraInfo,
    /// Transforms, of which those of `tf_static` hold for ever.
    RosTransforms {
        fixed: bool,
    },
}

impl Kind {
    /// By the name and encoding of the schema, the encoding of the messages, and the topic.
    pub(super) fn of(schema: &str, encoding: &str, messages: &str, topic: &str) -> Option<Self> {
        match (encoding, messages) {
            ("protobuf", "protobuf") => Some(match schema {
                schema::CompressedImage::NAME => Self::FoxgloveCompressedImage,
                schema::RawImage::NAME => Self::FoxgloveRawImage,
                schema::CameraCalibration::NAME => Self::FoxgloveCalibration,
                schema::FrameTransform::NAME => Self::FoxgloveTransform,
                schema::FrameTransforms::NAME => Self::FoxgloveTransforms,
                _ => return None,
            }),
            ("ros2msg" | "ros2idl", "cdr") => Some(match schema.replace("/msg/", "/").as_str() {
                "sensor_msgs/CompressedImage" => Self::RosCompressedImage,
                "sensor_msgs/Image" => Self::RosImage,
                "sensor_msgs/CameraInfo" => Self::RosCameraInfo,
                "tf2_msgs/TFMessage" => Self::RosTransforms { fixed: topic.ends_with("tf_static") },
                _ => return None,
            }),
            _ => None,
        }
    }

    pub(super) fn is_image(self) -> bool {
        use Kind::{FoxgloveCompressedImage, FoxgloveRawImage, RosCompressedImage, RosImage};
        matches!(self, FoxgloveCompressedImage | FoxgloveRawImage | RosCompressedImage | RosImage)
    }

    pub(super) fn is_calibration(self) -> bool {
        matches!(self, Self::FoxgloveCalibration | Self::RosCameraInfo)
    }
}

/// An image file as a camera sent it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Encoded {
    /// `jpeg` or `png`.
    pub format: &'static str,
    /// The file.
    pub bytes: Vec<u8>,
}

impl Encoded {
    /// The image as a PNG, from which it comes back bit for bit.
    ///
    /// # Errors
    /// [`ErrorKind::Format`] for an image that has not the bytes that its size says; [`ErrorKind::TooLarge`] for a side
    /// beyond 2^32.
    pub fn png(image: &Image) -> Result<Self> {
        let [width, height] = [image.width, image.height].map(|side| u32::try_from(side).ok());
        let (Some(width), Some(height)) = (width, height) else {
            return Err(Error::new(ErrorKind::TooLarge, "an image side beyond 2^32 pixels"));
        };
        let mut rgb = image.bgr.clone();
        rgb.chunks_exact_mut(3).for_each(|pixel| pixel.swap(0, 2));
        if rgb.len() != image.width * image.height * 3 {
            return Err(Error::format(format!("{} bytes of an image of {width} x {height} x 3", rgb.len())));
        }
        let mut bytes = Vec::new();
        PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Adaptive)
            .write_image(&rgb, width, height, ExtendedColorType::Rgb8)
            .map_err(|e| Error::format(format!("cannot be written as PNG: {e}")))?;
        Ok(Self { format: "png", bytes })
    }

    /// The format of a file, by its first bytes; none if it is neither JPEG nor PNG.
    pub fn format_of(bytes: &[u8]) -> Option<&'static str> {
        match bytes {
            [0xff, 0xd8, 0xff, ..] => Some("jpeg"),
            [0x89, b'P', b'N', b'G', ..] => Some("png"),
            _ => None,
        }
    }
}

/// An image that is not decoded.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Pixels {
    File(Vec<u8>),
    Raw { size: [usize; 2], step: usize, encoding: String, data: Vec<u8> },
}

/// When and where a message was made.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Head {
    pub(super) stamp: Stamp,
    pub(super) frame: String,
}

/// What a camera is said to be. Matrices are row-major; those that a message leaves out are zeros.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Calibration {
    pub(super) frame: String,
    /// Height and width in pixels.
    pub(super) size: [usize; 2],
    pub(super) model: String,
    pub(super) d: Vec<f64>,
    pub(super) k: [f64; 9],
    pub(super) r: [f64; 9],
    pub(super) p: [f64; 12],
}

/// Where a frame of reference lies in its parent.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Transform {
    pub(super) stamp: Stamp,
    pub(super) parent: String,
    pub(super) child: String,
    pub(super) translation: [f64; 3],
    /// (w, x, y, z).
    pub(super) rotation: [f64; 4],
    pub(super) fixed: bool,
}

/// Distortion coefficients that a calibration may have; no model has more than 14.
const MAX_COEFFICIENTS: usize = 32;

/// Stamp and frame of an image.
pub(super) fn head(kind: Kind, data: &[u8]) -> Result<Head> {
    Ok(match kind {
        Kind::FoxgloveCompressedImage => {
            let schema::CompressedImage { timestamp, frame_id, .. } = decode(data)?;
            Head { stamp: foxglove_stamp(timestamp)?, frame: frame_id }
        }
        Kind::FoxgloveRawImage => {
            let schema::RawImage { timestamp, frame_id, .. } = decode(data)?;
            Head { stamp: foxglove_stamp(timestamp)?, frame: frame_id }
        }
        _ => ros_head(&mut Cdr::new(data)?)?,
    })
}

/// The image in a message of a kind that has one.
pub(super) fn pixels(kind: Kind, data: &[u8]) -> Result<Pixels> {
    Ok(match kind {
        Kind::FoxgloveCompressedImage => Pixels::File(decode::<schema::CompressedImage>(data)?.data),
        Kind::FoxgloveRawImage => {
            let schema::RawImage { width, height, encoding, step, data, .. } = decode(data)?;
            Pixels::Raw { size: [height as usize, width as usize], step: step as usize, encoding, data }
        }
        Kind::RosCompressedImage => {
            let mut cdr = Cdr::new(data)?;
            ros_head(&mut cdr)?;
            cdr.text()?;
            Pixels::File(cdr.bytes()?.to_vec())
        }
        _ => {
            let mut cdr = Cdr::new(data)?;
            ros_head(&mut cdr)?;
            let size = [cdr.u32()? as usize, cdr.u32()? as usize];
            let encoding = cdr.text()?.to_owned();
            // Byte order matters to wider pixels only, and those are refused by their encoding.
            cdr.u8()?;
            let step = cdr.u32()? as usize;
            Pixels::Raw { size, step, encoding, data: cdr.bytes()?.to_vec() }
        }
    })
}

/// The calibration in a message of a kind that has one, and since when it holds.
pub(super) fn calibration(kind: Kind, data: &[u8]) -> Result<(Stamp, Calibration)> {
    let (stamp, calibration) = match kind {
        Kind::FoxgloveCalibration => {
            let message: schema::CameraCalibration = decode(data)?;
            let schema::CameraCalibration { timestamp, width, height, distortion_model, d, k, r, p, frame_id } =
                message;
            let calibration = Calibration {
                frame: frame_id,
                size: [height as usize, width as usize],
                model: distortion_model,
                d,
                k: fixed("K", &k)?,
                r: fixed("R", &r)?,
                p: fixed("P", &p)?,
            };
            (foxglove_stamp(timestamp)?, calibration)
        }
        _ => {
            let mut cdr = Cdr::new(data)?;
            let Head { stamp, frame } = ros_head(&mut cdr)?;
            let size = [cdr.u32()? as usize, cdr.u32()? as usize];
            let model = cdr.text()?.to_owned();
            let d = (0..cdr.count(8)?).map(|_| cdr.f64()).collect::<Result<Vec<_>>>()?;
            (stamp, Calibration { frame, size, model, d, k: cdr.array()?, r: cdr.array()?, p: cdr.array()? })
        }
    };
    let Calibration { d, k, r, p, .. } = &calibration;
    if d.len() > MAX_COEFFICIENTS {
        return Err(Error::format(format!("{} distortion coefficients, expected at most {MAX_COEFFICIENTS}", d.len())));
    }
    match d.iter().chain(k).chain(r).chain(p).find(|v| !v.is_finite()) {
        Some(v) => Err(Error::format(format!("calibration holds {v}, expected finite numbers"))),
        None => Ok((stamp, calibration)),
    }
}

/// The transforms in a message of a kind that has some.
pub(super) fn transforms(kind: Kind, data: &[u8]) -> Result<Vec<Transform>> {
    match kind {
        Kind::FoxgloveTransform => Ok(vec![foxglove_transform(decode(data)?)?]),
        Kind::FoxgloveTransforms => {
            decode::<schema::FrameTransforms>(data)?.transforms.into_iter().map(foxglove_transform).collect()
        }
        _ => {
            let fixed = kind == Kind::RosTransforms { fixed: true };
            let mut cdr = Cdr::new(data)?;
            // A stamp, two empty names and seven numbers.
            (0..cdr.count(72)?).map(|_| ros_transform(&mut cdr, fixed)).collect()
        }
    }
}

fn decode<M: Message + Default>(data: &[u8]) -> Result<M> {
    M::decode(data).map_err(|e| Error::format(format!("not the message that its schema names: {e}")))
}

/// A matrix of `N` numbers; zeros where there is none.
fn fixed<const N: usize>(name: &str, values: &[f64]) -> Result<[f64; N]> {
    match values {
        [] => Ok([0.0; N]),
        _ => values.try_into().map_err(|_| Error::format(format!("{name} has {} numbers, expected {N}", values.len()))),
    }
}

fn stamp(seconds: i64, nanos: i64) -> Result<Stamp> {
    let whole = u64::try_from(seconds).ok().and_then(|s| s.checked_mul(1_000_000_000));
    let part = u64::try_from(nanos).ok().filter(|&n| n < 1_000_000_000);
    let stamp = whole.zip(part).and_then(|(whole, part)| whole.checked_add(part));
    stamp.ok_or_else(|| {
        let message = format!("stamp of {seconds} s and {nanos} ns, expected seconds since 1970 and less than 1e9 ns");
        Error::format(message)
    })
}

fn foxglove_stamp(timestamp: Option<schema::Timestamp>) -> Result<Stamp> {
    let schema::Timestamp { seconds, nanos } = timestamp.unwrap_or_default();
    stamp(seconds, i64::from(nanos))
}

fn foxglove_transform(transform: schema::FrameTransform) -> Result<Transform> {
    let schema::FrameTransform { timestamp, parent_frame_id, child_frame_id, translation, rotation } = transform;
    let translation = translation.unwrap_or_default();
    // Left out, it turns nothing.
    let schema::Quaternion { x, y, z, w } = rotation.unwrap_or(schema::Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 });
    Ok(Transform {
        stamp: foxglove_stamp(timestamp)?,
        parent: parent_frame_id,
        child: child_frame_id,
        translation: [translation.x, translation.y, translation.z],
        rotation: [w, x, y, z],
        fixed: false,
    })
}

fn ros_head(cdr: &mut Cdr<'_>) -> Result<Head> {
    let (seconds, nanos) = (cdr.i32()?, cdr.u32()?);
    Ok(Head { stamp: stamp(seconds.into(), nanos.into())?, frame: frame_name(cdr.text()?) })
}

fn ros_transform(cdr: &mut Cdr<'_>, fixed: bool) -> Result<Transform> {
    let Head { stamp, frame: parent } = ros_head(cdr)?;
    let child = frame_name(cdr.text()?);
    let translation = cdr.array()?;
    let [x, y, z, w] = cdr.array()?;
    Ok(Transform { stamp, parent, child, translation, rotation: [w, x, y, z], fixed })
}

/// Names of frames without the slash that old programs put in front.
fn frame_name(name: &str) -> String {
    name.strip_prefix('/').unwrap_or(name).to_owned()
}

/// Pixels of an encoding as blue, green, red: how many bytes each has, and where they lie.
pub(super) fn channels(encoding: &str) -> Result<(usize, [usize; 3])> {
    match encoding {
        "bgr8" | "8UC3" => Ok((3, [0, 1, 2])),
        "rgb8" => Ok((3, [2, 1, 0])),
        "bgra8" => Ok((4, [0, 1, 2])),
        "rgba8" => Ok((4, [2, 1, 0])),
        "mono8" | "8UC1" => Ok((1, [0, 0, 0])),
        other => {
            let message = format!("image encoding {other:?}, expected rgb8, bgr8, rgba8, bgra8 or mono8");
            Err(Error::new(ErrorKind::Unsupported, message))
        }
    }
}

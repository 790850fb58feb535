//! Foxglove's messages as they lie in a log, and their descriptors, with which any reader of protobuf opens them.
//!
//! Names, numbers and types are those of the published schemas. A log carries the descriptors of the messages that it
//! holds, so that readers need none of their own.

use prost::Message;
use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{
    DescriptorProto, EnumDescriptorProto, EnumValueDescriptorProto, FieldDescriptorProto, FileDescriptorProto,
    FileDescriptorSet,
};

#[derive(Clone, Copy, PartialEq, Eq, Message)]
pub(super) struct Timestamp {
    #[prost(int64, tag = "1")]
    pub(super) seconds: i64,
    #[prost(int32, tag = "2")]
    pub(super) nanos: i32,
}

#[derive(Clone, Copy, PartialEq, Message)]
pub(super) struct Vector3 {
    #[prost(double, tag = "1")]
    pub(super) x: f64,
    #[prost(double, tag = "2")]
    pub(super) y: f64,
    #[prost(double, tag = "3")]
    pub(super) z: f64,
}

#[derive(Clone, Copy, PartialEq, Message)]
pub(super) struct Vector2 {
    #[prost(double, tag = "1")]
    pub(super) x: f64,
    #[prost(double, tag = "2")]
    pub(super) y: f64,
}

#[derive(Clone, Copy, PartialEq, Message)]
pub(super) struct Quaternion {
    #[prost(double, tag = "1")]
    pub(super) x: f64,
    #[prost(double, tag = "2")]
    pub(super) y: f64,
    #[prost(double, tag = "3")]
    pub(super) z: f64,
    #[prost(double, tag = "4")]
    pub(super) w: f64,
}

#[derive(Clone, Copy, PartialEq, Message)]
pub(super) struct Pose {
    #[prost(message, optional, tag = "1")]
    pub(super) position: Option<Vector3>,
    #[prost(message, optional, tag = "2")]
    pub(super) orientation: Option<Quaternion>,
}

/// A number of each cell, and where in the cell's bytes it lies.
#[derive(Clone, PartialEq, Eq, Message)]
pub(super) struct PackedElementField {
    #[prost(string, tag = "1")]
    pub(super) name: String,
    #[prost(fixed32, tag = "2")]
    pub(super) offset: u32,
    /// One of [`numeric`].
    #[prost(int32, tag = "3")]
    pub(super) r#type: i32,
}

/// Types of a [`PackedElementField`].
pub(super) mod numeric {
    pub(in crate::log) const UINT8: i32 = 1;
    pub(in crate::log) const UINT16: i32 = 3;
    pub(in crate::log) const FLOAT32: i32 = 7;
    pub(super) const NAMES: [&str; 9] =
        ["UNKNOWN", "UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "FLOAT32", "FLOAT64"];
}

/// Voxels: slices along z of rows along y of cells along x.
#[derive(Clone, PartialEq, Message)]
pub(super) struct VoxelGrid {
    #[prost(message, optional, tag = "1")]
    pub(super) timestamp: Option<Timestamp>,
    #[prost(string, tag = "2")]
    pub(super) frame_id: String,
    #[prost(message, optional, tag = "3")]
    pub(super) pose: Option<Pose>,
    #[prost(fixed32, tag = "4")]
    pub(super) row_count: u32,
    #[prost(fixed32, tag = "5")]
    pub(super) column_count: u32,
    #[prost(message, optional, tag = "6")]
    pub(super) cell_size: Option<Vector3>,
    #[prost(fixed32, tag = "7")]
    pub(super) slice_stride: u32,
    #[prost(fixed32, tag = "8")]
    pub(super) row_stride: u32,
    #[prost(fixed32, tag = "9")]
    pub(super) cell_stride: u32,
    #[prost(message, repeated, tag = "10")]
    pub(super) fields: Vec<PackedElementField>,
    #[prost(bytes = "vec", tag = "11")]
    pub(super) data: Vec<u8>,
}

/// Rows along y of cells along x.
#[derive(Clone, PartialEq, Message)]
pub(super) struct Grid {
    #[prost(message, optional, tag = "1")]
    pub(super) timestamp: Option<Timestamp>,
    #[prost(string, tag = "2")]
    pub(super) frame_id: String,
    #[prost(message, optional, tag = "3")]
    pub(super) pose: Option<Pose>,
    #[prost(fixed32, tag = "4")]
    pub(super) column_count: u32,
    #[prost(message, optional, tag = "5")]
    pub(super) cell_size: Option<Vector2>,
    #[prost(fixed32, tag = "6")]
    pub(super) row_stride: u32,
    #[prost(fixed32, tag = "7")]
    pub(super) cell_stride: u32,
    #[prost(message, repeated, tag = "8")]
    pub(super) fields: Vec<PackedElementField>,
    #[prost(bytes = "vec", tag = "9")]
    pub(super) data: Vec<u8>,
}

#[derive(Clone, PartialEq, Eq, Message)]
pub(super) struct CompressedImage {
    #[prost(message, optional, tag = "1")]
    pub(super) timestamp: Option<Timestamp>,
    #[prost(bytes = "vec", tag = "2")]
    pub(super) data: Vec<u8>,
    #[prost(string, tag = "3")]
    pub(super) format: String,
    #[prost(string, tag = "4")]
    pub(super) frame_id: String,
}

#[derive(Clone, PartialEq, Eq, Message)]
pub(super) struct RawImage {
    #[prost(message, optional, tag = "1")]
    pub(super) timestamp: Option<Timestamp>,
    #[prost(fixed32, tag = "2")]
    pub(super) width: u32,
    #[prost(fixed32, tag = "3")]
    pub(super) height: u32,
    #[prost(string, tag = "4")]
    pub(super) encoding: String,
    #[prost(fixed32, tag = "5")]
    pub(super) step: u32,
    #[prost(bytes = "vec", tag = "6")]
    pub(super) data: Vec<u8>,
    #[prost(string, tag = "7")]
    pub(super) frame_id: String,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct CameraCalibration {
    #[prost(message, optional, tag = "1")]
    pub(super) timestamp: Option<Timestamp>,
    #[prost(fixed32, tag = "2")]
    pub(super) width: u32,
    #[prost(fixed32, tag = "3")]
    pub(super) height: u32,
    #[prost(string, tag = "4")]
    pub(super) distortion_model: String,
    #[prost(double, repeated, tag = "5")]
    pub(super) d: Vec<f64>,
    #[prost(double, repeated, tag = "6")]
    pub(super) k: Vec<f64>,
    #[prost(double, repeated, tag = "7")]
    pub(super) r: Vec<f64>,
    #[prost(double, repeated, tag = "8")]
    pub(super) p: Vec<f64>,
    #[prost(string, tag = "9")]
    pub(super) frame_id: String,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct FrameTransform {
    #[prost(message, optional, tag = "1")]
    pub(super) timestamp: Option<Timestamp>,
    #[prost(string, tag = "2")]
    pub(super) parent_frame_id: String,
    #[prost(string, tag = "3")]
    pub(super) child_frame_id: String,
    #[prost(message, optional, tag = "4")]
    pub(super) translation: Option<Vector3>,
    #[prost(message, optional, tag = "5")]
    pub(super) rotation: Option<Quaternion>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct FrameTransforms {
    #[prost(message, repeated, tag = "1")]
    pub(super) transforms: Vec<FrameTransform>,
}

/// What a frame took and gave: numbers to plot, and what to compare.
#[derive(Clone, PartialEq, Message)]
pub(super) struct FrameStatus {
    #[prost(message, optional, tag = "1")]
    pub(super) timestamp: Option<Timestamp>,
    /// Seconds from the images to the classes.
    #[prost(double, tag = "2")]
    pub(super) latency: f64,
    /// XXH3-64 of the classes, as 16 hexadecimal digits.
    #[prost(string, tag = "3")]
    pub(super) digest: String,
    /// Voxels that are not empty.
    #[prost(fixed32, tag = "4")]
    pub(super) occupied: u32,
    /// Cameras that were left out.
    #[prost(string, repeated, tag = "5")]
    pub(super) masked: Vec<String>,
}

/// A message that a log can hold.
pub(super) trait Schema: Message {
    /// Full name of the message.
    const NAME: &'static str;
}

macro_rules! schemas {
    ($($message:ident = $name:literal),*) => {
        $(impl Schema for $message {
            const NAME: &'static str = $name;
        })*
    };
}

schemas!(
    CameraCalibration = "foxglove.CameraCalibration",
    CompressedImage = "foxglove.CompressedImage",
    FrameStatus = "voxcast.FrameStatus",
    FrameTransform = "foxglove.FrameTransform",
    FrameTransforms = "foxglove.FrameTransforms",
    Grid = "foxglove.Grid",
    RawImage = "foxglove.RawImage",
    VoxelGrid = "foxglove.VoxelGrid"
);

/// What a field is.
#[derive(Clone, Copy)]
enum Kind {
    Of(Type),
    Many(Type),
    Message(&'static str),
    Messages(&'static str),
    Numeric,
}

use Kind::{Many, Message as One, Messages, Numeric, Of};

const TIME: Kind = One("google.protobuf.Timestamp");

/// Full name of a message, and its fields by name, number and kind.
type Declaration = (&'static str, &'static [(&'static str, i32, Kind)]);

/// Every message after those that it refers to.
const DECLARATIONS: [Declaration; 14] = [
    ("google.protobuf.Timestamp", &[("seconds", 1, Of(Type::Int64)), ("nanos", 2, Of(Type::Int32))]),
    ("foxglove.Vector2", &[("x", 1, Of(Type::Double)), ("y", 2, Of(Type::Double))]),
    ("foxglove.Vector3", &[("x", 1, Of(Type::Double)), ("y", 2, Of(Type::Double)), ("z", 3, Of(Type::Double))]),
    (
        "foxglove.Quaternion",
        &[
            ("x", 1, Of(Type::Double)),
            ("y", 2, Of(Type::Double)),
            ("z", 3, Of(Type::Double)),
            ("w", 4, Of(Type::Double)),
        ],
    ),
    ("foxglove.Pose", &[("position", 1, One("foxglove.Vector3")), ("orientation", 2, One("foxglove.Quaternion"))]),
    (
        "foxglove.PackedElementField",
        &[("name", 1, Of(Type::String)), ("offset", 2, Of(Type::Fixed32)), ("type", 3, Numeric)],
    ),
    (
        "foxglove.VoxelGrid",
        &[
            ("timestamp", 1, TIME),
            ("frame_id", 2, Of(Type::String)),
            ("pose", 3, One("foxglove.Pose")),
            ("row_count", 4, Of(Type::Fixed32)),
            ("column_count", 5, Of(Type::Fixed32)),
            ("cell_size", 6, One("foxglove.Vector3")),
            ("slice_stride", 7, Of(Type::Fixed32)),
            ("row_stride", 8, Of(Type::Fixed32)),
            ("cell_stride", 9, Of(Type::Fixed32)),
            ("fields", 10, Messages("foxglove.PackedElementField")),
            ("data", 11, Of(Type::Bytes)),
        ],
    ),
    (
        "foxglove.Grid",
        &[
            ("timestamp", 1, TIME),
            ("frame_id", 2, Of(Type::String)),
            ("pose", 3, One("foxglove.Pose")),
            ("column_count", 4, Of(Type::Fixed32)),
            ("cell_size", 5, One("foxglove.Vector2")),
            ("row_stride", 6, Of(Type::Fixed32)),
            ("cell_stride", 7, Of(Type::Fixed32)),
            ("fields", 8, Messages("foxglove.PackedElementField")),
            ("data", 9, Of(Type::Bytes)),
        ],
    ),
    (
        "foxglove.CompressedImage",
        &[
            ("timestamp", 1, TIME),
            ("data", 2, Of(Type::Bytes)),
            ("format", 3, Of(Type::String)),
            ("frame_id", 4, Of(Type::String)),
        ],
    ),
    (
        "foxglove.RawImage",
        &[
            ("timestamp", 1, TIME),
            ("width", 2, Of(Type::Fixed32)),
            ("height", 3, Of(Type::Fixed32)),
            ("encoding", 4, Of(Type::String)),
            ("step", 5, Of(Type::Fixed32)),
            ("data", 6, Of(Type::Bytes)),
            ("frame_id", 7, Of(Type::String)),
        ],
    ),
    (
        "foxglove.CameraCalibration",
        &[
            ("timestamp", 1, TIME),
            ("width", 2, Of(Type::Fixed32)),
            ("height", 3, Of(Type::Fixed32)),
            ("distortion_model", 4, Of(Type::String)),
            ("D", 5, Many(Type::Double)),
            ("K", 6, Many(Type::Double)),
            ("R", 7, Many(Type::Double)),
            ("P", 8, Many(Type::Double)),
            ("frame_id", 9, Of(Type::String)),
        ],
    ),
    (
        "foxglove.FrameTransform",
        &[
            ("timestamp", 1, TIME),
            ("parent_frame_id", 2, Of(Type::String)),
            ("child_frame_id", 3, Of(Type::String)),
            ("translation", 4, One("foxglove.Vector3")),
            ("rotation", 5, One("foxglove.Quaternion")),
        ],
    ),
    ("foxglove.FrameTransforms", &[("transforms", 1, Messages("foxglove.FrameTransform"))]),
    (
        "voxcast.FrameStatus",
        &[
            ("timestamp", 1, TIME),
            ("latency", 2, Of(Type::Double)),
            ("digest", 3, Of(Type::String)),
            ("occupied", 4, Of(Type::Fixed32)),
            ("masked", 5, Many(Type::String)),
        ],
    ),
];

/// The `FileDescriptorSet` of a message and all that it refers to, as a log's schema holds it.
pub(super) fn descriptors(name: &str) -> Vec<u8> {
    let mut wanted = vec![name];
    let mut files = Vec::new();
    // Whoever refers to a message comes behind it.
    for (name, fields) in DECLARATIONS.iter().rev() {
        if wanted.contains(name) {
            wanted.extend(fields.iter().filter_map(|field| referred(field.2)));
            files.push(file(name, fields));
        }
    }
    files.reverse();
    FileDescriptorSet { file: files }.encode_to_vec()
}

fn referred(kind: Kind) -> Option<&'static str> {
    match kind {
        One(name) | Messages(name) => Some(name),
        _ => None,
    }
}

/// Where the published sources have a message.
fn file_name(message: &str) -> String {
    match message {
        "google.protobuf.Timestamp" => "google/protobuf/timestamp.proto".to_owned(),
        _ => format!("{}.proto", message.replace('.', "/")),
    }
}

fn file(name: &str, fields: &[(&'static str, i32, Kind)]) -> FileDescriptorProto {
    let (package, short) = name.rsplit_once('.').unwrap_or(("", name));
    let mut dependency: Vec<String> = fields.iter().filter_map(|field| referred(field.2)).map(file_name).collect();
    dependency.sort_unstable();
    dependency.dedup();
    let enum_type = if fields.iter().any(|field| matches!(field.2, Numeric)) { vec![numeric_type()] } else { vec![] };
    let message = DescriptorProto {
        name: Some(short.to_owned()),
        field: fields.iter().map(|&(field, number, kind)| describe(name, field, number, kind)).collect(),
        enum_type,
        ..DescriptorProto::default()
    };
    FileDescriptorProto {
        name: Some(file_name(name)),
        package: Some(package.to_owned()),
        dependency,
        message_type: vec![message],
        syntax: Some("proto3".to_owned()),
        ..FileDescriptorProto::default()
    }
}

fn numeric_type() -> EnumDescriptorProto {
    let value = |(number, name): (i32, &&str)| EnumValueDescriptorProto {
        name: Some((*name).to_owned()),
        number: Some(number),
        options: None,
    };
    EnumDescriptorProto {
        name: Some("NumericType".to_owned()),
        value: (0..).zip(&numeric::NAMES).map(value).collect(),
        ..EnumDescriptorProto::default()
    }
}

fn describe(message: &str, name: &str, number: i32, kind: Kind) -> FieldDescriptorProto {
    let (of, many, type_name) = match kind {
        Of(of) => (of, false, None),
        Many(of) => (of, true, None),
        One(name) => (Type::Message, false, Some(format!(".{name}"))),
        Messages(name) => (Type::Message, true, Some(format!(".{name}"))),
        Numeric => (Type::Enum, false, Some(format!(".{message}.NumericType"))),
    };
    FieldDescriptorProto {
        name: Some(name.to_owned()),
        number: Some(number),
        label: Some(if many { Label::Repeated } else { Label::Optional }.into()),
        r#type: Some(of.into()),
        type_name,
        ..FieldDescriptorProto::default()
    }
}

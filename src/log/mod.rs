//! Robot logs: results as MCAP files that Foxglove, Rerun and PlotJuggler open, and recorded cameras run from them.
//!
//! [`LogWriter`] writes Foxglove's messages (protobuf): the voxels, the images, their calibration and place, a map of the
//! ground, and what each frame took. [`Replay`] reads those, and ROS 2 bags (CDR): it finds the cameras, joins their images
//! to frames by their stamps, chains transforms, and gives scenes as a [`Session`](crate::Session) takes them. The same log
//! gives the same scenes every time, bit for bit. `docs/logs.md` says what is written and how it is read.

mod cdr;
mod file;
mod join;
mod lens;
mod message;
mod pinhole;
mod records;
mod replay;
mod schema;
mod sources;
mod transforms;
mod writer;

pub use file::{Ending, Extent};
pub use message::Encoded;
pub use replay::{Replay, ReplayFrame, ReplayOptions, Summary};
pub use writer::{LogFrame, LogWriter, Shot};

/// A moment: nanoseconds since 1970, or since the beginning of a simulation.
pub type Stamp = u64;

#[cfg(test)]
mod tests;

//! voxcast turns a ring of camera images into a semantic voxel grid on a plain CPU, with the same bits every time.
//!
//! It runs networks of the InverseMatrixVT3D family (arXiv 2401.12422): a ResNet with a feature pyramid for each camera,
//! two static sparse matrices per level that carry pixel features into voxels and a bird's-eye view, and a 3-D
//! convolutional decoder from coarse to fine.
//!
//! # The pipeline
//!
//! ```text
//! checkpoint, network ── import ──▶ model ──┐
//! calibration ────────── RigBuilder ▶ rig ──┼──▶ Session ── run ──▶ Occupancy
//! images ───────────────────────────────────┘
//! ```
//!
//! A *network* ([`Network`]) is the architecture as numbers. A *model* ([`Model`]) is a network with weights, folded and
//! packed as the kernels read them. A *rig* ([`Rig`]) holds the six projection matrices of one set of cameras. A
//! *session* ([`Session`]) owns the memory in which frames run.
//!
//! ```no_run
//! use std::path::Path;
//! use std::sync::Arc;
//! use voxcast::rig::RigBuilder;
//! use voxcast::{ImageView, Isa, Model, Session, SessionOptions, Threads};
//!
//! # fn main() -> voxcast::Result<()> {
//! # let calibrations: Vec<[f32; 16]> = vec![];
//! # let cameras: Vec<Vec<u8>> = vec![];
//! // Once. A rig of fixed cameras can be saved and mapped instead: `Rig::save`, `Rig::open`.
//! let model = Arc::new(Model::open(Path::new("model.safetensors"))?);
//! let mut builder = RigBuilder::new(model.network(), calibrations.len(), Isa::best())?;
//! let rig = Arc::new(builder.build(&calibrations)?);
//! let options = SessionOptions { threads: Threads::new(2)?, logits: true, ..SessionOptions::default() };
//! println!("{} bytes", Session::memory(&model, rig.cameras(), &options)?.total());
//! let mut session = Session::new(model, rig, &options)?;
//!
//! // Every frame. If the calibration moves, build another rig and pass it to `Session::set_rig`.
//! let images: Vec<ImageView> = cameras.iter().map(|bgr| ImageView::bgr(900, 1600, bgr)).collect();
//! let occupancy = session.run(&images)?;
//! let [_, y, z] = occupancy.grid.size;
//! let class = occupancy.classes[(10 * y + 20) * z + 3]; // voxel (10, 20, 3); 0 is empty
//! # let _ = class;
//! # Ok(())
//! # }
//! ```
//!
//! A checkpoint becomes a model by [`import::import`], or by `voxcast import` on the command line.
#![cfg_attr(
    feature = "import",
    doc = r#"
```no_run
# fn main() -> voxcast::Result<()> {
use std::path::Path;
use voxcast::{Network, checkpoint::Checkpoint, import::import, model::Options};

let network = Network::built_in("nuscenes-200").expect("a built-in name");
let checkpoint = Checkpoint::open("epoch_24.pth")?;
import(&checkpoint, &network, Options::default(), Path::new("model.safetensors"), &mut |_, _| ())?;
# Ok(())
# }
```
"#
)]
//!
//! # Shapes and layouts
//!
//! - Images are 8-bit **BGR**, rows top to bottom, `height * width * 3` bytes. Height and width, rounded up to multiples of
//!   32, must be [`Network::image`]; the padding below and to the right is zero after normalisation.
//! - A calibration is a row-major 4x4 matrix per camera, lidar-frame metres (x, y, z, 1) to (u d, v d, d, 1), with u and v
//!   in pixels of the unpadded image. Cameras come in the order of the training.
//! - Grids are [X, Y, Z] in the lidar frame, z fastest: voxel (x, y, z) is at `(x * Y + y) * Z + z`. [`Network::bounds`]
//!   are its metres.
//! - Inside, every tensor is channels last; f32 with weights of f32 or f16, or bytes with a scale in models of int8.
//!
//! # Memory and threads
//!
//! [`Session::new`] takes the arena and the output from the system, [`Session::memory`] says beforehand how much, and
//! frames reuse them. Weights and matrices are used where they are mapped. A session computes on the calling thread, with
//! threads of its own, or on a pool that it is given ([`Threads`]).
//!
//! # Determinism
//!
//! The same model, rig and images give the same bits for every number of threads, every instruction set ([`Isa`]) and
//! every run. `docs/determinism.md` has the order of every sum. Another graph ([`SessionOptions::unfolded`]) or another
//! precision is another computation and gives other bits. The floating-point environment must be the default one.
//!
//! # Errors
//!
//! Bytes from outside give an [`Error`] with a kind, the file where there is one, and a line that says what was found and
//! what was expected. They cause no panic and no allocation that their size does not justify. Functions that can panic say
//! so under "Panics". The library never prints, never reads the environment and never exits.
//!
//! # Features
//!
//! | feature | gives |
//! |---|---|
//! | `shipped` (default) | the network that ships, as a part of the program: 9.5 MB, which `voxcast demo` runs; with `cli` |
//! | `cli` (default) | the program `voxcast`; with all below but `capi` |
//! | `import` | `checkpoint`: reading `.pth` and `.safetensors` |
//! | `images` | `picture`, and JPEG and PNG in [`Scene::open`] and `Scene::save` |
//! | `npz` | `npz`: NumPy's `.npz`, written and read; `labels`: label files, read |
//! | `html` | `html`: results as a page to look at in a browser; with `images` and `npz` |
//! | `capi` | the functions of `include/voxcast.h`, for C; see `docs/embedding.md` |
//! | `mcap` | `log`: robot logs, written and replayed; with `images` |
//! | `eval` | `dataset` and `eval`: frames with labels, and scores; with `images` and `npz` |
//!
//! Without features the library reads models, rigs and `.safetensors` scenes, and runs them.

#[cfg(target_endian = "big")]
compile_error!(
    "voxcast uses models and rigs where they are mapped, and their numbers are little-endian: big-endian targets are not \
     supported"
);

pub mod base;
pub mod calibrate;
#[cfg(feature = "capi")]
mod capi;
pub mod check;
#[cfg(feature = "eval")]
pub mod eval;
pub mod file;
pub mod graph;
pub mod image;
#[cfg(feature = "mcap")]
pub mod log;
pub mod model;
pub mod network;
pub mod rig;
pub mod runtime;
pub mod scene;
pub mod show;
pub mod synth;

pub use base::{digest, error, note, random, threads};
pub use check::{compare, selftest};
#[cfg(feature = "eval")]
pub use eval::dataset;
pub use file::container;
#[cfg(feature = "npz")]
pub use file::{labels, npz};
pub use graph::parts as weights;
#[cfg(feature = "import")]
pub use model::checkpoint;
pub use model::{import, seeded};
pub use runtime::{plan, session};
pub use scene::camera;
#[cfg(feature = "html")]
pub use show::html;
#[cfg(feature = "images")]
pub use show::picture;

pub use error::{Error, ErrorKind, Result};
pub use image::ImageView;
pub use model::Model;
pub use network::Network;
pub use note::Note;
pub use rig::Rig;
pub use scene::Scene;
pub use session::{Budget, Confidence, Occupancy, Session, SessionOptions, Step};
pub use threads::Threads;
pub use voxcast_kernels::{Isa, IsaError};

#[cfg(test)]
extern crate self as voxcast;

#[cfg(test)]
#[path = "../tests/support/small.rs"]
#[allow(dead_code, unreachable_pub, reason = "shared with the tests in tests/, which use the rest")]
mod small;

/// The program in the README, compiled.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
pub struct Readme;

//! `voxcast._native`: the library for Python.
//!
//! ```text
//! error       errors and panics to exceptions
//! images      NumPy arrays as camera images
//! arrays      results as NumPy arrays, without copying
//! model, rig, scene, session, occupancy, page, evaluation
//!             a class each, and the functions that make it
//! ```
//!
//! `voxcast/__init__.py` is what users import. Every class is frozen: what can change is behind a mutex, which a call
//! takes or refuses; none waits for it, because it would wait with the interpreter's lock.

mod arrays;
mod error;
mod evaluation;
mod images;
mod machine;
mod model;
mod occupancy;
mod page;
mod rig;
mod scene;
mod session;

use pyo3::prelude::*;

/// The compiled part of voxcast.
#[pymodule]
mod _native {
    #[pymodule_export]
    use crate::evaluation::{Evaluation, Report, Worker, calibrate_confidence, merge};
    #[pymodule_export]
    use crate::model::{Model, import_file, import_tensors, network_json};
    #[pymodule_export]
    use crate::occupancy::{CameraStatus, Occupancy};
    #[pymodule_export]
    use crate::page::{Page, view};
    #[pymodule_export]
    use crate::rig::Rig;
    #[pymodule_export]
    use crate::scene::Scene;
    #[pymodule_export]
    use crate::session::{Memory, Session};

    use pyo3::prelude::*;

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}

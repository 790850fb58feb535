//! The projection matrices.

use crate::arrays::lend;
use crate::error::{Outcome, warn};
use crate::machine;
use crate::model::Model;
use crate::scene::{Scene, matrices};
use numpy::PyArray1;
use numpy::ndarray::Ix1;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::path::PathBuf;
use std::sync::Arc;
use voxcast::rig::RigBuilder;

/// The six sparse matrices that carry pixel features of one set of cameras into voxels and bird's-eye view.
#[pyclass(frozen, module = "voxcast")]
pub(crate) struct Rig {
    pub(crate) rig: Arc<voxcast::Rig>,
}

#[pymethods]
impl Rig {
    /// Builds the matrices of a calibration: a Scene, or lidar2img float32 [cameras, 4, 4].
    #[staticmethod]
    #[pyo3(signature = (model, calibration, *, threads = None, isa = None))]
    fn build(
        py: Python<'_>,
        model: &Model,
        calibration: &Bound<'_, PyAny>,
        threads: Option<usize>,
        isa: Option<&str>,
    ) -> Outcome<Self> {
        let lidar2img = matrices(calibration)?;
        let names = match calibration.cast::<Scene>() {
            Ok(scene) => scene.get().scene.names.clone(),
            Err(_) => (0..lidar2img.len()).map(|camera| format!("camera {camera}")).collect(),
        };
        let (threads, isa) = (machine::threads(threads)?, machine::isa(isa)?);
        let network = model.model.network();
        let rig = py.detach(|| {
            let builder = RigBuilder::new(network, lidar2img.len(), isa)?;
            builder.with_threads(threads).build(&lidar2img)
        })?;
        warn(py, &rig.visibility(network).notes(&names), 1)?;
        Ok(Self { rig: Arc::new(rig) })
    }

    /// Maps a rig of `cameras` cameras that `voxcast rig`, `Rig.save` or another program wrote. The file must not be changed
    /// while it is open.
    #[staticmethod]
    fn open(py: Python<'_>, path: PathBuf, model: &Model, cameras: usize) -> Outcome<Self> {
        let network = model.model.network();
        Ok(Self { rig: Arc::new(py.detach(|| voxcast::Rig::open(&path, network, cameras))?) })
    }

    /// Writes the rig, by way of a temporary file beside it.
    fn save(&self, py: Python<'_>, path: PathBuf, model: &Model) -> Outcome {
        Ok(py.detach(|| self.rig.save(&path, model.model.network()))?)
    }

    /// Number of cameras.
    #[getter]
    fn cameras(&self) -> usize {
        self.rig.cameras()
    }

    /// The matrices in CSR, read-only and not copied: a dict of "level1.volume", "level1.bev", ... to (ptr, col), both
    /// uint32. Row r of a volume is voxel r (x, y, z; z fastest), of a bev the column; columns are flat pixels (camera, v,
    /// u); every entry is 1 over the length of its row.
    fn matrices<'py>(slf: &Bound<'py, Self>) -> Outcome<Bound<'py, PyDict>> {
        let dict = PyDict::new(slf.py());
        for index in 0..3 {
            let level = slf.get().rig.level(index);
            for (name, matrix) in [("volume", level.volume), ("bev", level.bev)] {
                let lent = |values: &[u32]| -> Outcome<Bound<'py, PyArray1<u32>>> {
                    // SAFETY: the class is frozen, and its rig, which others may share, cannot be changed while shared.
                    unsafe { lend::<_, Ix1>(values, values.len(), slf.as_any()) }
                };
                dict.set_item(format!("level{}.{name}", index + 1), (lent(matrix.ptr)?, lent(matrix.col)?))?;
            }
        }
        Ok(dict)
    }

    fn __repr__(&self) -> String {
        format!("Rig({} cameras)", self.rig.cameras())
    }
}

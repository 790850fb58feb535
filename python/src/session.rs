//! Sessions.

use crate::error::{Outcome, own};
use crate::images::{with_image, with_images};
use crate::machine;
use crate::model::Model;
use crate::occupancy::{Occupancy, Spares};
use crate::rig::Rig;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use voxcast::{Budget, SessionOptions, Step};

/// A model with memory to run in. Frames allocate nothing but their results, and these use the memory of results that
/// nobody holds any more.
///
/// Session(model, rig, *, threads=None, logits=False, confidence=False, isa=None)
///
/// threads: as many as there are CPUs by default. logits: whether results have them. confidence: whether results say how
/// sure the network is. isa: "scalar", "avx2" and others, as on the command line; the fastest of this CPU by default. None of
/// these changes a bit of a result.
///
/// The interpreter's lock is free while a frame runs: sessions in several Python threads run side by side. One session
/// serves one thread at a time, and raises BusyError in another.
#[pyclass(frozen, module = "voxcast")]
pub(crate) struct Session {
    inner: Mutex<Inner>,
    model: Arc<voxcast::Model>,
    spares: Arc<Spares>,
    #[pyo3(get)]
    cameras: usize,
}

struct Inner {
    session: voxcast::Session,
    /// The last complete result, once it has been asked for.
    last: Option<Py<Occupancy>>,
}

fn options(threads: Option<usize>, logits: bool, confidence: bool, isa: Option<&str>) -> Outcome<SessionOptions> {
    let (threads, isa) = (machine::threads(threads)?, machine::isa(isa)?);
    Ok(SessionOptions { isa, threads, logits, confidence, ..SessionOptions::default() })
}

#[pymethods]
impl Session {
    #[new]
    #[pyo3(signature = (model, rig, *, threads = None, logits = false, confidence = false, isa = None))]
    fn new(
        py: Python<'_>,
        model: &Model,
        rig: &Rig,
        threads: Option<usize>,
        logits: bool,
        confidence: bool,
        isa: Option<&str>,
    ) -> Outcome<Self> {
        let options = options(threads, logits, confidence, isa)?;
        let (model, rig) = (model.model.clone(), rig.rig.clone());
        let session = py.detach(|| voxcast::Session::new(model.clone(), rig, &options))?;
        let cameras = session.cameras();
        let inner = Mutex::new(Inner { session, last: None });
        Ok(Self { inner, model, spares: Arc::default(), cameras })
    }

    /// What a session will take from the system, to the byte, before it is made. Results that the program holds come on
    /// top, half of `output` each; the model and the rig are mapped and shared.
    #[staticmethod]
    #[pyo3(signature = (model, cameras = None, *, threads = None, logits = false, confidence = false))]
    fn memory(
        model: &Model,
        cameras: Option<usize>,
        threads: Option<usize>,
        logits: bool,
        confidence: bool,
    ) -> Outcome<Memory> {
        let cameras = cameras.unwrap_or_else(|| model.model.network().cameras);
        let options = options(threads, logits, confidence, None)?;
        Ok(Memory::of(&voxcast::Session::memory(&model.model, cameras, &options)?))
    }

    /// What the session took, as Session.memory said.
    #[getter]
    fn taken(&self) -> Outcome<Memory> {
        Ok(Memory::of(&own(&self.inner, "session")?.session.taken()))
    }

    /// Runs one frame: every camera gets a new image, and all is computed.
    ///
    /// images: a Scene; or uint8 [cameras, height, width, 3] of any strides; or a list of uint8 [height, width, 3]. Sizes,
    /// padded to multiples of 32, are the network's. order: of arrays, "bgr" (OpenCV) or "rgb".
    #[pyo3(signature = (images, *, order = None))]
    fn run(&self, py: Python<'_>, images: &Bound<'_, PyAny>, order: Option<&str>) -> Outcome<Py<Occupancy>> {
        let mut inner = own(&self.inner, "session")?;
        inner.last = None;
        let session = &mut inner.session;
        with_images(images, order, |views| session.set_cameras(views))?;
        py.detach(|| session.step(Budget::Unlimited));
        self.result(py, &mut inner)?.ok_or_else(|| PyValueError::new_err("every camera is masked").into())
    }

    /// Gives camera `camera` its next image, uint8 [height, width, 3], which is copied. `step` computes.
    #[pyo3(signature = (camera, image, *, order))]
    fn set_camera(&self, camera: usize, image: &Bound<'_, PyAny>, order: &str) -> Outcome {
        let mut inner = own(&self.inner, "session")?;
        let session = &mut inner.session;
        with_image(camera, image, Some(order), |view| session.set_camera(camera, view))
    }

    /// Does some of what is to be done, for about `seconds` or for so many `slices`, or all of it: passes of the cameras
    /// that have a new image, then the fusion. Returns "idle" if there was nothing to do, "running" if the budget is
    /// spent, "complete" if a result is there.
    #[pyo3(signature = (*, seconds = None, slices = None))]
    fn step(&self, py: Python<'_>, seconds: Option<f64>, slices: Option<u32>) -> Outcome<&'static str> {
        let budget = match (seconds, slices) {
            (None, None) => Budget::Unlimited,
            (None, Some(slices)) => Budget::Slices(slices),
            (Some(seconds), None) => Budget::Time(
                Duration::try_from_secs_f64(seconds)
                    .map_err(|e| PyValueError::new_err(format!("seconds: found {seconds}: {e}")))?,
            ),
            (Some(_), Some(_)) => {
                return Err(PyValueError::new_err("seconds and slices are given, expected one of them").into());
            }
        };
        let mut inner = own(&self.inner, "session")?;
        let session = &mut inner.session;
        let step = py.detach(|| session.step(budget));
        Ok(match step {
            Step::Idle => "idle",
            Step::Running => "running",
            Step::Complete => {
                inner.last = None;
                "complete"
            }
        })
    }

    /// The last complete result; None before the first frame.
    #[getter]
    fn occupancy(&self, py: Python<'_>) -> Outcome<Option<Py<Occupancy>>> {
        let mut inner = own(&self.inner, "session")?;
        self.result(py, &mut inner)
    }

    /// Leaves camera `camera` out, or takes it in again, with the bits of a rig without its entries. It takes effect at
    /// once: the next `step` fuses again.
    #[pyo3(signature = (camera, masked = true))]
    fn mask(&self, camera: usize, masked: bool) -> Outcome {
        Ok(own(&self.inner, "session")?.session.set_masked(camera, masked)?)
    }

    /// Uses another rig of the same network and number of cameras from now on. No backbone runs again.
    fn set_rig(&self, rig: &Rig) -> Outcome {
        own(&self.inner, "session")?.session.set_rig(rig.rig.clone())?;
        Ok(())
    }

    /// The longest time in seconds that one slice of `step` took so far; None if none was cut.
    #[getter]
    fn longest_slice(&self) -> Outcome<Option<f64>> {
        let inner = own(&self.inner, "session")?;
        Ok(inner.session.longest_slice().map(|(time, _)| time.as_secs_f64()))
    }

    fn __repr__(&self) -> String {
        format!("Session({} cameras)", self.cameras)
    }
}

impl Session {
    /// The last complete result, taken out of the session when it is first asked for.
    fn result(&self, py: Python<'_>, inner: &mut Inner) -> Outcome<Option<Py<Occupancy>>> {
        if inner.last.is_none() {
            let taken = inner.session.take(self.spares.take())?;
            let result = taken.map(|owned| Occupancy::new(owned, self.model.clone(), self.spares.clone()));
            inner.last = result.map(|result| Py::new(py, result)).transpose()?;
        }
        Ok(inner.last.as_ref().map(|last| last.clone_ref(py)))
    }
}

/// Bytes that a session takes.
#[pyclass(frozen, get_all, eq, module = "voxcast")]
#[derive(PartialEq)]
pub(crate) struct Memory {
    /// Tensors and every worker's scratch.
    arena: usize,
    /// The latest image of every camera.
    images: usize,
    /// Two results: the last, and the one that is being written.
    output: usize,
    /// Operations, names and offsets.
    tables: usize,
    /// All of it.
    total: usize,
}

impl Memory {
    fn of(memory: &voxcast::session::Memory) -> Self {
        let voxcast::session::Memory { arena, images, output, tables } = *memory;
        Self { arena, images, output, tables, total: memory.total() }
    }
}

#[pymethods]
impl Memory {
    fn __repr__(&self) -> String {
        let Self { arena, images, output, tables, total } = self;
        format!("Memory(arena={arena}, images={images}, output={output}, tables={tables}, total={total})")
    }
}

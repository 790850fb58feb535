//! Results.

use crate::arrays::lend;
use crate::error::Outcome;
use numpy::ndarray::{Ix3, Ix4};
use numpy::{PyArray1, PyArray2, PyArray3, PyArray4};
use pyo3::prelude::*;
use std::sync::{Arc, Mutex, PoisonError};
use voxcast::picture::Palette;
use voxcast::session::OwnedOccupancy;

/// Results that nobody looks at any more, whose memory a session uses again.
#[derive(Default)]
pub(crate) struct Spares(Mutex<Vec<OwnedOccupancy>>);

impl Spares {
    /// As many as a program has that drops each result before the next frame, or after it.
    const MOST: usize = 2;

    pub(crate) fn take(&self) -> Option<OwnedOccupancy> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).pop()
    }

    fn give(&self, result: OwnedOccupancy) {
        let mut spares = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if spares.len() < Self::MOST {
            spares.push(result);
        }
    }
}

/// The result of a frame. It stays as it is, whatever its session does next.
///
/// Arrays are read-only and not copied; they keep the result alive. `array.copy()` can be written to.
#[pyclass(frozen, module = "voxcast")]
pub(crate) struct Occupancy {
    /// There until it is dropped.
    owned: Option<OwnedOccupancy>,
    model: Arc<voxcast::Model>,
    spares: Arc<Spares>,
}

impl Occupancy {
    pub(crate) fn new(owned: OwnedOccupancy, model: Arc<voxcast::Model>, spares: Arc<Spares>) -> Self {
        Self { owned: Some(owned), model, spares }
    }

    pub(crate) fn model(&self) -> &voxcast::Model {
        &self.model
    }

    /// One of the two probabilities, if there are any.
    fn confidence<'py>(
        slf: &Bound<'py, Self>,
        of: impl for<'a> Fn(voxcast::Confidence<'a>) -> &'a [u8],
    ) -> Outcome<Option<Bound<'py, PyArray3<u8>>>> {
        let view = slf.get().view();
        let Some(confidence) = view.confidence else { return Ok(None) };
        // SAFETY: the class is frozen; only dropping it gives its memory away.
        Ok(Some(unsafe { lend::<_, Ix3>(of(confidence), view.grid.size, slf.as_any()) }?))
    }

    pub(crate) fn view(&self) -> voxcast::Occupancy<'_> {
        match &self.owned {
            Some(owned) => owned.view(),
            None => unreachable!("only dropping takes it"),
        }
    }
}

impl Drop for Occupancy {
    fn drop(&mut self) {
        if let Some(owned) = self.owned.take() {
            self.spares.give(owned);
        }
    }
}

#[pymethods]
impl Occupancy {
    /// uint8 [X, Y, Z], the class of each voxel in the lidar's frame; 0 is empty.
    #[getter]
    fn classes<'py>(slf: &Bound<'py, Self>) -> Outcome<Bound<'py, PyArray3<u8>>> {
        let view = slf.get().view();
        // SAFETY: the class is frozen; only dropping it gives its memory away.
        unsafe { lend::<_, Ix3>(view.classes, view.grid.size, slf.as_any()) }
    }

    /// uint16 [X, Y, Z], by how many feature pixels each voxel is seen. Where it is 0, no camera sees the place, and its
    /// class is a guess: not "free" but "unknown".
    #[getter]
    fn support<'py>(slf: &Bound<'py, Self>) -> Outcome<Bound<'py, PyArray3<u16>>> {
        let view = slf.get().view();
        // SAFETY: as for the classes.
        unsafe { lend::<_, Ix3>(view.support, view.grid.size, slf.as_any()) }
    }

    /// float32 [X, Y, Z, classes], if the session keeps them; else None.
    #[getter]
    fn logits<'py>(slf: &Bound<'py, Self>) -> Outcome<Option<Bound<'py, PyArray4<f32>>>> {
        let this = slf.get();
        let view = this.view();
        let Some(logits) = view.logits else { return Ok(None) };
        let [x, y, z] = view.grid.size;
        let shape = (x, y, z, this.model.network().classes);
        // SAFETY: as for the classes.
        Ok(Some(unsafe { lend::<_, Ix4>(logits, shape, slf.as_any()) }?))
    }

    /// uint8 [X, Y, Z], the probability that each voxel is occupied, 0 to 255 for 0 to 1; None unless the session was made with
    /// confidence=True.
    #[getter]
    fn confidence_occupied<'py>(slf: &Bound<'py, Self>) -> Outcome<Option<Bound<'py, PyArray3<u8>>>> {
        Self::confidence(slf, |confidence| confidence.occupied)
    }

    /// uint8 [X, Y, Z], the probability of each voxel's class, 0 to 255 for 0 to 1; None unless the session was made with
    /// confidence=True.
    #[getter]
    fn confidence_class<'py>(slf: &Bound<'py, Self>) -> Outcome<Option<Bound<'py, PyArray3<u8>>>> {
        Self::confidence(slf, |confidence| confidence.class)
    }

    /// XXH3-64 of the classes, as `voxcast run` prints it: the same on every machine.
    #[getter]
    fn digest(&self, py: Python<'_>) -> String {
        py.detach(|| format!("{:016x}", self.view().digest()))
    }

    /// XXH3-64 of the logits; None without logits.
    #[getter]
    fn logits_digest(&self, py: Python<'_>) -> Option<String> {
        py.detach(|| self.view().logits_digest().map(|digest| format!("{digest:016x}")))
    }

    /// uint8, one bit per voxel in the order of the classes, the first in the lowest: whether it is occupied.
    /// numpy.unpackbits(bits, count=classes.size, bitorder="little") unpacks them.
    fn bits<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<u8>> {
        let view = self.view();
        let mut bits = vec![0; view.bits_len()];
        view.write_bits(&mut bits);
        PyArray1::from_vec(py, bits)
    }

    /// float32 [3, 2], [min, max] metres of x, y, z in the lidar's frame.
    #[getter]
    fn bounds<'py>(&self, py: Python<'py>) -> Outcome<Bound<'py, PyArray2<f32>>> {
        let rows: Vec<Vec<f32>> = self.model.network().bounds.iter().map(|row| row.to_vec()).collect();
        Ok(PyArray2::from_vec2(py, &rows).map_err(|e| voxcast::Error::mismatch(e.to_string()))?)
    }

    /// Names of the classes; 0 is empty.
    #[getter]
    fn class_names(&self) -> Vec<String> {
        let palette = Palette::of(self.model.network().classes);
        palette.classes().iter().map(|class| class.name.clone()).collect()
    }

    /// uint8 [classes, 3], the colour of each class, red first.
    #[getter]
    fn colours<'py>(&self, py: Python<'py>) -> Outcome<Bound<'py, PyArray2<u8>>> {
        let palette = Palette::of(self.model.network().classes);
        let rows: Vec<Vec<u8>> = palette.classes().iter().map(|class| class.rgb.to_vec()).collect();
        Ok(PyArray2::from_vec2(py, &rows).map_err(|e| voxcast::Error::mismatch(e.to_string()))?)
    }

    /// The part of each camera in the result.
    #[getter]
    fn cameras(&self) -> Vec<CameraStatus> {
        let status = |s: &voxcast::session::CameraStatus| CameraStatus { image: s.image, age: s.age, masked: s.masked };
        self.view().cameras.iter().map(status).collect()
    }

    fn __repr__(&self, py: Python<'_>) -> String {
        let [x, y, z] = self.view().grid.size;
        format!("Occupancy({x} x {y} x {z} voxels, digest {})", self.digest(py))
    }
}

/// A camera's part in a result.
#[pyclass(frozen, get_all, module = "voxcast")]
pub(crate) struct CameraStatus {
    /// Which of the camera's images its features come from, counted from 1; 0 if there was none.
    image: u64,
    /// Completed frames since then: 0 if the image was new in this frame.
    age: u64,
    /// Whether the camera was left out.
    masked: bool,
}

#[pymethods]
impl CameraStatus {
    fn __repr__(&self) -> String {
        let masked = if self.masked { "True" } else { "False" };
        format!("CameraStatus(image={}, age={}, masked={masked})", self.image, self.age)
    }
}

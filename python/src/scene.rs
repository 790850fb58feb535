//! Images and calibration.

use crate::arrays::lend;
use crate::error::{Outcome, warn};
use crate::images::{unfit, with_images};
use crate::model::Model;
use numpy::ndarray::Ix3;
use numpy::{PyArray3, PyReadonlyArray3};
use pyo3::prelude::*;
use std::path::PathBuf;
use voxcast::Error;
use voxcast::network::Grid;
use voxcast::scene::Image;
use voxcast::synth::Synthesiser;

/// Images of all cameras at one moment, and where each point of the lidar's frame lands in them.
///
/// Scene(images, lidar2img, *, order, names=None)
///
/// images: uint8 [cameras, height, width, 3], or a list of uint8 [height, width, 3]; they are copied. lidar2img: float32
/// [cameras, 4, 4], lidar-frame metres (x, y, z, 1) to (u d, v d, d, 1) with u, v in pixels. order: "bgr" or "rgb".
#[pyclass(frozen, module = "voxcast")]
pub(crate) struct Scene {
    pub(crate) scene: voxcast::Scene,
    /// Class of every voxel, and where the voxels are, if it is known.
    truth: Option<(Vec<u8>, Grid)>,
}

#[pymethods]
impl Scene {
    #[new]
    #[pyo3(signature = (images, lidar2img, *, order, names = None))]
    fn new(
        images: &Bound<'_, PyAny>,
        lidar2img: &Bound<'_, PyAny>,
        order: &str,
        names: Option<Vec<String>>,
    ) -> Outcome<Self> {
        let images = with_images(images, Some(order), |views| {
            let image = |view: &voxcast::ImageView<'_>| {
                let mut bgr = view.pixels.to_vec();
                if view.order == voxcast::image::ChannelOrder::Rgb {
                    bgr.chunks_exact_mut(3).for_each(|pixel| pixel.swap(0, 2));
                }
                Image { height: view.height, width: view.width, bgr }
            };
            Ok(views.iter().map(image).collect::<Vec<_>>())
        })?;
        let lidar2img = matrices(lidar2img)?;
        let names = names.unwrap_or_else(|| (0..images.len()).map(|camera| format!("camera {camera}")).collect());
        if [names.len(), lidar2img.len()] != [images.len(); 2] {
            let (n, m) = (names.len(), lidar2img.len());
            let message = format!("{n} names, {m} matrices, expected one of each for {} images", images.len());
            return Err(Error::mismatch(message).into());
        }
        Ok(Self { scene: voxcast::Scene { names, images, lidar2img }, truth: None })
    }

    /// Reads a directory with calibration.json and its images, or a .safetensors with `images` and `lidar2img`.
    #[staticmethod]
    fn open(py: Python<'_>, path: PathBuf) -> Outcome<Self> {
        let (scene, notes) = py.detach(|| voxcast::Scene::open_with_notes(&path))?;
        warn(py, &notes, 1)?;
        Ok(Self { scene, truth: None })
    }

    /// Draws a street for a model's cameras, with the class of every voxel. Equal seeds give equal streets.
    #[staticmethod]
    #[pyo3(signature = (model, seed = 1_000_006))]
    fn street(py: Python<'_>, model: &Model, seed: u64) -> Outcome<Self> {
        let network = model.model.network();
        let drawn = py.detach(|| Synthesiser::new(network).map(|synthesiser| synthesiser.frame(seed)))?;
        Ok(Self { scene: drawn.scene, truth: Some((drawn.labels, Grid::of(network))) })
    }

    /// Writes the scene as a directory with calibration.json and a PNG per camera.
    fn save(&self, py: Python<'_>, directory: PathBuf) -> Outcome {
        Ok(py.detach(|| self.scene.save(&directory))?)
    }

    /// Names of the cameras.
    #[getter]
    fn names(&self) -> Vec<String> {
        self.scene.names.clone()
    }

    /// Per camera a read-only uint8 [height, width, 3], blue first; the scene's own memory.
    #[getter]
    fn images<'py>(slf: &Bound<'py, Self>) -> Outcome<Vec<Bound<'py, PyArray3<u8>>>> {
        let lent = |image: &Image| {
            // SAFETY: the class is frozen and nothing in it changes its images.
            unsafe { lend::<_, Ix3>(&image.bgr, (image.height, image.width, 3), slf.as_any()) }
        };
        slf.get().scene.images.iter().map(lent).collect()
    }

    /// float32 [cameras, 4, 4]: lidar-frame metres (x, y, z, 1) to (u d, v d, d, 1).
    #[getter]
    fn lidar2img<'py>(slf: &Bound<'py, Self>) -> Outcome<Bound<'py, PyArray3<f32>>> {
        let matrices = &slf.get().scene.lidar2img;
        // SAFETY: the class is frozen and nothing in it changes its matrices.
        unsafe { lend::<_, Ix3>(matrices.as_flattened(), (matrices.len(), 4, 4), slf.as_any()) }
    }

    /// uint8 [X, Y, Z], the class of every voxel, of a street that was drawn; else None.
    #[getter]
    pub(crate) fn truth<'py>(slf: &Bound<'py, Self>) -> Outcome<Option<Bound<'py, PyArray3<u8>>>> {
        let Some((classes, grid)) = &slf.get().truth else { return Ok(None) };
        // SAFETY: the class is frozen and nothing in it changes its labels.
        Ok(Some(unsafe { lend::<_, Ix3>(classes, grid.size, slf.as_any()) }?))
    }

    fn __len__(&self) -> usize {
        self.scene.cameras()
    }

    fn __repr__(&self) -> String {
        format!("Scene({})", self.scene.names.join(", "))
    }
}

/// float32 [cameras, 4, 4], or the matrices of a scene.
pub(crate) fn matrices(value: &Bound<'_, PyAny>) -> Outcome<Vec<[f32; 16]>> {
    if let Ok(scene) = value.cast::<Scene>() {
        return Ok(scene.get().scene.lidar2img.clone());
    }
    let expected = "a Scene, or float32 [cameras, 4, 4]";
    let array: PyReadonlyArray3<'_, f32> = value.extract().map_err(|_| unfit("lidar2img", value, expected))?;
    let array = array.as_array();
    if array.shape()[1..] != [4, 4] {
        return Err(unfit("lidar2img", value, expected).into());
    }
    let matrix = |matrix: numpy::ndarray::ArrayView2<'_, f32>| std::array::from_fn(|i| matrix[[i / 4, i % 4]]);
    Ok(array.outer_iter().map(matrix).collect())
}

//! Results as a page for a browser or a notebook.

use crate::error::Outcome;
use crate::images::unfit;
use crate::occupancy::Occupancy;
use crate::scene::Scene;
use numpy::PyReadonlyArray3;
use pyo3::prelude::*;
use std::path::PathBuf;
use voxcast::Error;
use voxcast::eval::write_text;
use voxcast::picture::{self, Palette};

/// A result as one HTML page that needs no network: voxels to turn, truth beside prediction, images with the voxels on them.
/// In a notebook the page shows itself.
#[pyclass(frozen, module = "voxcast")]
pub(crate) struct Page {
    /// The whole page.
    #[pyo3(get)]
    html: String,
}

/// The page of a result. scene adds the images, truth uint8 [X, Y, Z] the labels to compare with (255: no label); a
/// street that was drawn brings its own.
#[pyfunction]
#[pyo3(signature = (occupancy, scene = None, truth = None, *, title = "voxcast", subtitle = ""))]
pub(crate) fn view(
    py: Python<'_>,
    occupancy: &Occupancy,
    scene: Option<&Bound<'_, Scene>>,
    truth: Option<&Bound<'_, PyAny>>,
    title: &str,
    subtitle: &str,
) -> Outcome<Page> {
    let own = match (truth, scene) {
        (None, Some(scene)) => Scene::truth(scene)?.map(Bound::into_any),
        (given, _) => given.cloned(),
    };
    let expected = "uint8 [X, Y, Z]";
    let array: Option<PyReadonlyArray3<'_, u8>> =
        own.as_ref().map(|truth| truth.extract().map_err(|_| unfit("truth", truth, expected))).transpose()?;
    let result = occupancy.view();
    if let Some(truth) = array.as_ref().filter(|truth| truth.as_array().shape() != result.grid.size) {
        let found = truth.as_array().shape().to_vec();
        return Err(Error::mismatch(format!("truth: shape {found:?}, expected {:?}", result.grid.size)).into());
    }
    let truth: Option<Vec<u8>> = array.map(|truth| truth.as_array().iter().copied().collect());
    let network = occupancy.model().network();
    let scene = scene.map(|scene| &scene.get().scene);
    let html = py.detach(|| -> voxcast::Result<String> {
        let grid = result.grid;
        let mut prediction =
            picture::Occupancy::new("", result.classes, grid, grid.forward())?.with_support(result.support)?;
        if let Some(confidence) = result.confidence {
            prediction = prediction.with_confidence(confidence.occupied)?;
        }
        let palette = Palette::of(network.classes);
        let truth = truth.as_deref();
        voxcast::html::Page { title, subtitle, prediction, truth, scene, palette: &palette }.to_html()
    })?;
    Ok(Page { html })
}

#[pymethods]
impl Page {
    /// Writes the page. The file appears whole or not at all.
    fn save(&self, py: Python<'_>, path: PathBuf) -> Outcome {
        Ok(py.detach(|| write_text(&path, &self.html))?)
    }

    /// For notebooks: the page in a frame of its own, which can run its program and nothing else.
    fn _repr_html_(&self) -> String {
        let escaped = self.html.replace('&', "&amp;").replace('"', "&quot;");
        format!(
            "<iframe srcdoc=\"{escaped}\" sandbox=\"allow-scripts\" title=\"voxcast\" \
             style=\"width:100%;height:640px;border:0\"></iframe>"
        )
    }

    fn __repr__(&self) -> String {
        format!("Page({} bytes)", self.html.len())
    }
}

//! Calibration: what range each tensor of a network takes on scenes, from which int8 models are made.

mod histogram;
mod mixed;

pub use histogram::Histogram;
pub use mixed::{Choice, Mixed};

use crate::base::error::{Error, ErrorKind, Result};
use crate::base::note::Note;
use crate::base::threads::Threads;
use crate::graph::parts::Precision;
use crate::graph::{Element, Graph, Op, Results, Scope};
use crate::image::Image;
use crate::model::Model;
use crate::model::ranges::{Range, Ranges};
use crate::rig::RigBuilder;
use crate::runtime::session::{Session, SessionOptions, views};
use crate::scene::Scene;
use std::collections::BTreeMap;
use std::sync::Arc;
use voxcast_kernels::Isa;

/// Runs a model on scenes and counts the magnitudes in every tensor that an int8 model of its network has a scale for.
#[derive(Debug)]
pub struct Calibrator {
    model: Arc<Model>,
    options: SessionOptions,
    graph: Graph,
    /// The session of the last scene; the next one uses it again if it has as many cameras.
    session: Option<Session>,
    histograms: BTreeMap<String, Histogram>,
    frames: usize,
}

impl Calibrator {
    /// A calibrator of `model`, whose weights are f32 or f16 and whose batch norms are folded.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] for another model.
    pub fn new(model: Arc<Model>, isa: Isa, threads: &Threads) -> Result<Self> {
        let refused = |found: &str, expected: &str| {
            let message = format!("a model {found}, expected one {expected} to calibrate");
            Err(Error::new(ErrorKind::Unsupported, message))
        };
        let model_options = model.options();
        if model_options.precision == Precision::I8 {
            return refused("of int8", "of f32 or f16");
        }
        if !model_options.rewrites.batch_norm {
            return refused("that keeps its batch norms", "with folded batch norms");
        }
        let options = SessionOptions { isa, threads: threads.clone(), logits: true, ..SessionOptions::default() };
        let results = Results { coarse_heads: true, logits: true, ..Results::default() };
        let graph = model.graph(false, results).with_hidden_layers();
        Ok(Self { model, options, graph, session: None, histograms: BTreeMap::new(), frames: 0 })
    }

    /// Runs a scene and counts. A camera whose image is of one colour throughout is left out, and said so.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`] if the scene is not the network's, or all its cameras are of one colour;
    /// [`ErrorKind::Format`] naming the tensor, if a number is not finite; those of [`Session::new`].
    pub fn see(&mut self, scene: &Scene) -> Result<Vec<Note>> {
        scene.check(self.model.network())?;
        let dead: Vec<bool> = scene.images.iter().map(is_flat).collect();
        if !dead.contains(&false) {
            return Err(Error::mismatch("every camera's image is of one colour throughout, expected a scene"));
        }
        let dead_cameras = (0..dead.len()).filter(|&camera| dead[camera]);
        let notes = dead_cameras.map(|camera| {
            let name = scene.names.get(camera).map_or("", String::as_str);
            Note::new(format!(
                "camera {camera} \"{name}\": its image is of one colour throughout; left out of the calibration"
            ))
        });
        let notes = notes.collect();
        let mut session = self.session_for(scene)?;
        for (camera, &dead) in dead.iter().enumerate() {
            session.set_masked(camera, dead)?;
        }
        let (graph, histograms) = (&self.graph, &mut self.histograms);
        let mut fault = None;
        session.run_observed(&views(scene), &mut |event| {
            let operation = event.operation;
            let tensor = graph.tensor(operation.output());
            let counted = tensor.element == Element::F32 && tensor.scope == Scope::Inner;
            if !counted || matches!(operation.op, Op::Head(_)) {
                return;
            }
            let written = operation.first_channel..operation.first_channel + operation.channels;
            let histogram = histograms.entry(tensor.name.clone()).or_default();
            let values: &[f32] = event.output.of();
            let finite = match written.len() == tensor.channels {
                true => histogram.add(values),
                false => values.chunks_exact(tensor.channels).all(|row| histogram.add(&row[written.clone()])),
            };
            if !finite {
                fault.get_or_insert_with(|| tensor.name.clone());
            }
        })?;
        self.session = Some(session);
        if let Some(name) = fault {
            return Err(Error::format(format!("tensor \"{name}\": a number that is not finite on this scene")));
        }
        self.frames += 1;
        Ok(notes)
    }

    /// A session with the scene's rig.
    fn session_for(&mut self, scene: &Scene) -> Result<Session> {
        let network = self.model.network();
        let builder = RigBuilder::new(network, scene.cameras(), self.options.isa)?;
        let rig = Arc::new(builder.with_threads(self.options.threads.clone()).build(&scene.lidar2img)?);
        match self.session.take().filter(|session| session.cameras() == scene.cameras()) {
            Some(mut session) => {
                session.set_rig(rig)?;
                Ok(session)
            }
            None => Session::of_graph(self.model.clone(), rig, self.graph.clone(), &self.options),
        }
    }

    /// What was seen, with the threshold of the smallest squared error for each tensor.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] if there was no frame.
    pub fn ranges(&self) -> Result<Ranges> {
        if self.frames == 0 {
            return Err(Error::new(ErrorKind::Unsupported, "no scene to calibrate on"));
        }
        let range = |h: &Histogram| Range { max: h.max(), threshold: h.threshold() };
        let tensors = self.histograms.iter().map(|(name, histogram)| (name.clone(), range(histogram)));
        Ok(Ranges::new(self.model.network(), self.frames, tensors.collect()))
    }
}

/// `count` of `len` frames, spread evenly: all of them if there are no more.
pub fn spread(len: usize, count: usize) -> impl Iterator<Item = usize> {
    let count = count.min(len);
    (0..count).map(move |i| i * len / count)
}

/// Whether every pixel of an image is the first.
fn is_flat(image: &Image) -> bool {
    let pixels = image.bgr.as_chunks::<3>().0;
    pixels.iter().all(|pixel| Some(pixel) == pixels.first())
}

#[cfg(test)]
mod tests;

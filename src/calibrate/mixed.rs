//! Mixed precision by measurement: which operations cost most when they are int8, and how few of them must stay in f32.

use crate::base::error::{Error, ErrorKind, Result};
use crate::base::threads::Threads;
use crate::graph::{Element, Results, TensorId};
use crate::model::import::{Integers, Source, import_int8_to_bytes, import_to_bytes};
use crate::model::{Model, Options};
use crate::network::Network;
use crate::rig::{Rig, RigBuilder};
use crate::runtime::session::{Session, SessionOptions, views};
use crate::scene::Scene;
use std::sync::Arc;
use voxcast_kernels::Isa;

/// What [`Mixed::find`] came to.
#[derive(Clone, Debug, PartialEq)]
pub struct Choice {
    /// Operations to be kept in f32, those that were asked for first, then those that lose most.
    pub keep_f32: Vec<String>,
    /// The ratio of signal to noise of the logits with these kept, in decibels.
    pub snr: f64,
    /// The same with none kept but those that were asked for.
    pub least: f64,
}

/// A network whose precisions are to be mixed, and the scenes on which its logits are compared with those of f32.
pub struct Mixed<'a> {
    source: &'a dyn Source,
    network: &'a Network,
    integers: Integers<'a>,
    options: SessionOptions,
    /// Each scene with its rig and the logits of f32.
    frames: Vec<(&'a Scene, Arc<Rig>, Vec<f32>)>,
    /// Operations with weights that would be int8; those that are so only together, together.
    candidates: Vec<Vec<String>>,
}

impl std::fmt::Debug for Mixed<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Mixed").field("candidates", &self.candidates).finish_non_exhaustive()
    }
}

impl<'a> Mixed<'a> {
    /// Computes the scenes in f32.
    ///
    /// # Errors
    /// Those of [`import_to_bytes`] and [`import_int8_to_bytes`]; [`ErrorKind::Unsupported`] without scenes.
    pub fn new(
        source: &'a dyn Source,
        network: &'a Network,
        integers: Integers<'a>,
        scenes: &'a [Scene],
        (isa, threads): (Isa, &Threads),
    ) -> Result<Self> {
        if scenes.is_empty() {
            return Err(Error::new(ErrorKind::Unsupported, "no scene to compare on"));
        }
        let options = SessionOptions { isa, threads: threads.clone(), logits: true, ..SessionOptions::default() };
        let mut mixed = Self { source, network, integers, options, frames: vec![], candidates: vec![] };
        let float = Options { rewrites: mixed.integers.rewrites, ..Options::default() };
        let float = Model::from_bytes(import_to_bytes(source, network, float, &mut |_, _| ())?)?;
        let float = Arc::new(float);
        for scene in scenes {
            let builder = RigBuilder::new(network, scene.cameras(), isa)?.with_threads(threads.clone());
            let rig = { builder }.build(&scene.lidar2img).map(Arc::new)?;
            let logits = mixed.logits(&float, scene, &rig)?;
            mixed.frames.push((scene, rig, logits));
        }
        mixed.candidates = mixed.candidates()?;
        Ok(mixed)
    }

    /// Operations with weights that are int8 where none but those asked for are kept. Those that fill one tensor side by side
    /// go together; the offsets of a deformable convolution go with it, whose name theirs begins with.
    fn candidates(&self) -> Result<Vec<Vec<String>>> {
        let graph = self.model(&[])?.graph(false, Results::default());
        let mut groups: Vec<(TensorId, Vec<String>)> = vec![];
        for operation in &graph.operations {
            let read = operation.inputs.first().is_some_and(|&x| graph.tensor(x).element == Element::I8);
            let offsets = graph.tensor(operation.output()).element == Element::I32;
            if !read || offsets || graph.multiply_adds(operation) == 0 {
                continue;
            }
            match groups.iter_mut().find(|(output, _)| *output == operation.output()) {
                Some((_, group)) => group.push(operation.name.clone()),
                None => groups.push((operation.output(), vec![operation.name.clone()])),
            }
        }
        Ok(groups.into_iter().map(|(_, group)| group).collect())
    }

    /// The model with `keep` kept in f32 beside those that were asked for.
    fn model(&self, keep: &[String]) -> Result<Arc<Model>> {
        let keep_f32 = [self.integers.keep_f32, keep].concat();
        let integers = Integers { keep_f32: &keep_f32, ..self.integers };
        let bytes = import_int8_to_bytes(self.source, self.network, &integers, &mut |_, _| ())?;
        Ok(Arc::new(Model::from_bytes(bytes)?))
    }

    fn logits(&self, model: &Arc<Model>, scene: &Scene, rig: &Arc<Rig>) -> Result<Vec<f32>> {
        let mut session = Session::new(model.clone(), rig.clone(), &self.options)?;
        let result = session.run(&views(scene))?;
        Ok(result.logits.unwrap_or_default().to_vec())
    }

    /// The squares of the logits of all scenes, and of their errors with `keep` kept.
    fn noise(&self, keep: &[String]) -> Result<[f64; 2]> {
        let model = self.model(keep)?;
        let mut sums = [0.0; 2];
        for (scene, rig, expected) in &self.frames {
            for (&found, &expected) in self.logits(&model, scene, rig)?.iter().zip(expected) {
                sums[0] += f64::from(expected).powi(2);
                sums[1] += (f64::from(found) - f64::from(expected)).powi(2);
            }
        }
        Ok(sums)
    }

    /// The ratio of signal to noise of the logits, in decibels.
    fn snr(&self, keep: &[String]) -> Result<f64> {
        let [signal, noise] = self.noise(keep)?;
        Ok(10.0 * (signal / noise).log10())
    }

    /// How many times [`Mixed::find`] runs the scenes, at most.
    pub fn runs(&self) -> usize {
        self.candidates.len() + 2 + self.candidates.len().next_power_of_two().ilog2() as usize
    }

    /// Finds the fewest operations to keep in f32 so that the logits' ratio of signal to noise is at least `target` decibels:
    /// each is int8 alone, which gives its noise; then those with the most noise are kept. `progress` is told how many of at
    /// most [`Mixed::runs`] runs are done.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] if the target cannot be had; those of [`Mixed::new`].
    pub fn find(&self, target: f64, progress: &mut dyn FnMut(usize)) -> Result<Choice> {
        let mut runs = 0;
        let mut ran = || {
            runs += 1;
            progress(runs);
        };
        let asked = self.integers.keep_f32;
        let least = self.snr(&[])?;
        ran();
        if least >= target {
            return Ok(Choice { keep_f32: asked.to_vec(), snr: least, least });
        }
        let mut losses = Vec::with_capacity(self.candidates.len());
        for (index, group) in self.candidates.iter().enumerate() {
            let mut others = self.candidates.clone();
            others.remove(index);
            losses.push((self.noise(&others.concat())?[1], group.clone()));
            ran();
        }
        losses.sort_by(|a, b| b.0.total_cmp(&a.0));
        let order: Vec<Vec<String>> = losses.into_iter().map(|(_, group)| group).collect();
        // With `few` kept it is too little, with `many` enough.
        let (mut few, mut many) = (0, order.len());
        let mut best = self.snr(&order.concat())?;
        ran();
        if best < target {
            let message = format!("{target} dB cannot be had: {best:.1} dB with all of {many} operations in f32");
            return Err(Error::new(ErrorKind::Unsupported, message));
        }
        while many - few > 1 {
            let half = few.midpoint(many);
            let snr = self.snr(&order[..half].concat())?;
            ran();
            if snr >= target {
                (many, best) = (half, snr);
            } else {
                few = half;
            }
        }
        Ok(Choice { keep_f32: [asked, &order[..many].concat()].concat(), snr: best, least })
    }
}

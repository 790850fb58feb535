//! A session: model, rig and arena, ready to run frames.

use crate::arena::Arena;
use crate::error::{Error, ErrorKind, Result};
pub use crate::exec::ImageView;
use crate::exec::{Call, Context, HeadOutput};
use crate::graph::{Graph, Op, Operation, Scope};
use crate::model::{Model, PartRef};
use crate::network::Network;
use crate::plan::Plan;
use crate::rig::{Csr, Level, Rig};
use crate::scene::Scene;
use crate::threads::Threads;
use std::sync::Arc;
use std::time::{Duration, Instant};
use voxcast_kernels::{Isa, Panels};

/// How a session runs. None of it can change a result but `unfolded`, which changes rounding.
#[derive(Clone, Debug)]
pub struct SessionOptions {
    /// Instruction set of the kernels.
    pub isa: Isa,
    /// Threads that compute.
    pub threads: Threads,
    /// Run the graph without the projection fold, so that every stage of the published network exists.
    pub unfolded: bool,
    /// Also keep the logits of level 0.
    pub logits: bool,
    /// Also run the heads of levels 1 to 3, for whoever observes their stages.
    pub coarse_heads: bool,
}

impl Default for SessionOptions {
    fn default() -> Self {
        Self { isa: Isa::best(), threads: Threads::calling(), unfolded: false, logits: false, coarse_heads: false }
    }
}

/// The result of a frame.
#[derive(Clone, Copy, Debug)]
pub struct Occupancy<'a> {
    /// Voxels along x, y, z.
    pub grid: [usize; 3],
    /// Class of each voxel, `[x, y, z]`, z fastest; 0 is empty.
    pub classes: &'a [u8],
    /// `[x, y, z, classes]`, if the session keeps them.
    pub logits: Option<&'a [f32]>,
}

/// What an observer is told after each operation.
#[derive(Debug)]
pub struct Event<'a> {
    /// The operation that ended.
    pub operation: &'a Operation,
    /// Its camera, if it runs per camera.
    pub camera: Option<usize>,
    /// Wall time.
    pub elapsed: Duration,
    /// What it wrote: the tensor, or a head's logits.
    pub output: &'a [f32],
}

/// Everything that a session takes from the system, known before it is made.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Memory {
    /// The arena: tensors and every worker's scratch.
    pub arena: usize,
    /// Classes, and logits where they are kept or observed.
    pub output: usize,
}

impl Memory {
    /// Bytes in all.
    pub fn total(&self) -> usize {
        self.arena + self.output
    }
}

/// A model with memory to run in. Frames after the first allocate nothing.
pub struct Session {
    model: Arc<Model>,
    rig: Arc<Rig>,
    graph: Graph,
    plan: Plan,
    /// Part names resolved once: for each operation, where its weights lie in the model.
    weights: Vec<Vec<PartRef>>,
    arena: Arena,
    isa: Isa,
    threads: Threads,
    cameras: usize,
    classes: Vec<u8>,
    coarse_classes: Vec<u8>,
    logits: Vec<f32>,
    keep_logits: bool,
}

impl std::fmt::Debug for Session {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Session").field("isa", &self.isa).field("threads", &self.threads).finish_non_exhaustive()
    }
}

/// Length of the largest head's logits, 0 if they are not kept.
fn logits_len(graph: &Graph, options: &SessionOptions) -> usize {
    if !(options.logits || options.coarse_heads) {
        return 0;
    }
    heads(graph).map(|o| graph.tensor(o.output).len()).max().unwrap_or(0)
}

/// Voxels of the largest coarse head, 0 if there is none.
fn coarse_len(graph: &Graph) -> usize {
    let coarse = heads(graph).filter(|o| o.op != Op::Head { level: 0 });
    coarse.map(|o| graph.tensor(o.output).rows()).max().unwrap_or(0)
}

/// `len` zeros, unless the system has no memory for them.
fn zeros<T: Clone + Default>(len: usize) -> Option<Vec<T>> {
    let mut zeros = Vec::new();
    zeros.try_reserve_exact(len).ok()?;
    zeros.resize(len, T::default());
    Some(zeros)
}

fn heads(graph: &Graph) -> impl Iterator<Item = &Operation> {
    graph.operations.iter().filter(|o| matches!(o.op, Op::Head { .. }))
}

impl Session {
    /// What [`Session::new`] will take from the system for `cameras` cameras.
    ///
    /// # Errors
    /// [`ErrorKind::TooLarge`] if it cannot be addressed.
    pub fn memory(model: &Model, cameras: usize, options: &SessionOptions) -> Result<Memory> {
        let graph = model.graph(options.unfolded, options.coarse_heads);
        let plan = Plan::new(&graph, cameras, options.threads.count())?;
        let voxels: usize = model.network().output_grid().iter().product();
        Ok(Memory { arena: plan.bytes(), output: voxels + coarse_len(&graph) + 4 * logits_len(&graph, options) })
    }

    /// Plans and allocates. The rig may be swapped later.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`] if the rig is not this network's; [`ErrorKind::TooLarge`] if there is not enough memory.
    pub fn new(model: Arc<Model>, rig: Arc<Rig>, options: &SessionOptions) -> Result<Self> {
        let graph = model.graph(options.unfolded, options.coarse_heads);
        let cameras = rig.cameras();
        check_rig(&rig, model.network(), cameras)?;
        let plan = Plan::new(&graph, cameras, options.threads.count())?;
        let too_large = |bytes: usize| {
            Error::new(ErrorKind::TooLarge, format!("the system has no {bytes} bytes for the session's arena"))
        };
        let weights = graph.operations.iter().map(|o| model.part_refs(&graph, o)).collect::<Result<_>>()?;
        let arena = Arena::new(plan.len()).ok_or_else(|| too_large(plan.bytes()))?;
        let voxels: usize = model.network().output_grid().iter().product();
        let output = || Error::new(ErrorKind::TooLarge, "the system has no memory for the session's output");
        let session = Self {
            weights,
            arena,
            isa: options.isa,
            threads: options.threads.clone(),
            cameras,
            classes: zeros(voxels).ok_or_else(output)?,
            coarse_classes: zeros(coarse_len(&graph)).ok_or_else(output)?,
            logits: zeros(logits_len(&graph, options)).ok_or_else(output)?,
            keep_logits: options.logits,
            model,
            rig,
            graph,
            plan,
        };
        session.context().check()?;
        Ok(session)
    }

    /// Operations, for whoever reports on them.
    pub fn graph(&self) -> &Graph {
        &self.graph
    }

    /// Where everything lies.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// What the session took, as [`Session::memory`] said it would.
    pub fn taken(&self) -> Memory {
        let arena = self.arena.bytes();
        Memory { arena, output: self.classes.len() + self.coarse_classes.len() + 4 * self.logits.len() }
    }

    /// Cameras of a frame.
    pub fn cameras(&self) -> usize {
        self.cameras
    }

    /// Uses another rig of the same network and number of cameras from the next frame on.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`] if it is not.
    pub fn set_rig(&mut self, rig: Arc<Rig>) -> Result<()> {
        check_rig(&rig, self.model.network(), self.cameras)?;
        self.rig = rig;
        Ok(())
    }

    /// Runs one frame.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`] if the number of images or an image's size is not the network's.
    ///
    /// # Determinism
    /// The same bits for the same model, rig and images, on every instruction set and thread count.
    pub fn run(&mut self, images: &[ImageView<'_>]) -> Result<Occupancy<'_>> {
        self.run_observed(images, &mut |_| ())
    }

    /// Runs one frame on a scene's images.
    ///
    /// # Errors
    /// As [`Session::run`].
    pub fn run_scene(&mut self, scene: &Scene) -> Result<Occupancy<'_>> {
        scene.check(self.model.network())?;
        self.run(&views(scene))
    }

    /// Runs one frame and tells `observer` of each operation as it ends.
    ///
    /// # Errors
    /// As [`Session::run`].
    pub fn run_observed(
        &mut self,
        images: &[ImageView<'_>],
        observer: &mut (dyn FnMut(Event<'_>) + Send),
    ) -> Result<Occupancy<'_>> {
        self.check_images(images)?;
        let threads = self.threads.clone();
        threads.enter(|| self.frame(images, observer));
        let logits = self.keep_logits.then_some(&self.logits[..]);
        Ok(Occupancy { grid: self.model.network().output_grid(), classes: &self.classes, logits })
    }

    fn check_images(&self, images: &[ImageView<'_>]) -> Result<()> {
        let expected = self.model.network().image;
        if images.len() != self.cameras {
            return Err(Error::mismatch(format!("{} images, the rig has {} cameras", images.len(), self.cameras)));
        }
        for (i, image) in images.iter().enumerate() {
            let padded = [image.height, image.width].map(|v| v.checked_next_multiple_of(32).unwrap_or(0));
            // The product is only taken of a size that pads to the network's, which is small.
            if padded != expected || image.bgr.len() != image.height * image.width * 3 {
                return Err(Error::mismatch(format!(
                    "image {i}: {} bytes for {}x{} (height x width), the network expects a size that pads to {}x{}",
                    image.bgr.len(),
                    image.height,
                    image.width,
                    expected[0],
                    expected[1]
                )));
            }
        }
        Ok(())
    }

    fn context(&self) -> Context<'_> {
        Context { isa: self.isa, graph: &self.graph, plan: &self.plan, cameras: self.cameras, threads: &self.threads }
    }

    fn frame(&mut self, images: &[ImageView<'_>], observer: &mut dyn FnMut(Event<'_>)) {
        let (passes, frame) =
            (0..self.graph.camera_operations, self.graph.camera_operations..self.graph.operations.len());
        for (camera, image) in images.iter().enumerate() {
            for index in passes.clone() {
                self.operation(index, camera, Some(*image), observer);
            }
        }
        for index in frame {
            self.operation(index, 0, None, observer);
        }
    }

    /// Runs operation `index` and tells the observer.
    fn operation(
        &mut self,
        index: usize,
        camera: usize,
        image: Option<ImageView<'_>>,
        observer: &mut dyn FnMut(Event<'_>),
    ) {
        let start = Instant::now();
        let context = Context {
            isa: self.isa,
            graph: &self.graph,
            plan: &self.plan,
            cameras: self.cameras,
            threads: &self.threads,
        };
        let operation = &self.graph.operations[index];
        let levels = [0, 1, 2].map(|i| self.rig.level(i));
        let mut parts = [Panels::F32(&[]); crate::weights::MAX_PARTS];
        for (panels, part) in parts.iter_mut().zip(&self.weights[index]) {
            *panels = self.model.resolve(part);
        }
        let view = self.arena.view();
        let tensor = self.graph.tensor(operation.output);
        let wanted = !self.logits.is_empty();
        let head = match operation.op {
            Op::Head { level } => Some(HeadOutput {
                classes: if level == 0 { &mut self.classes } else { &mut self.coarse_classes[..tensor.rows()] },
                logits: wanted.then(|| &mut self.logits[..tensor.len()]),
            }),
            _ => None,
        };
        let weights = &parts[..self.weights[index].len()];
        context.run(view, operation, weights, Call { camera, image, levels: &levels, head });
        let elapsed = start.elapsed();
        let output = match operation.op {
            Op::Head { .. } if wanted => &self.logits[..tensor.len()],
            Op::Head { .. } => &[],
            _ => context.output(view, operation, camera),
        };
        let camera = (index < self.graph.camera_operations).then_some(camera);
        debug_assert!(camera.is_some() || tensor.scope == Scope::Frame);
        observer(Event { operation, camera, elapsed, output });
    }
}

/// A scene's images as a session takes them.
pub fn views(scene: &Scene) -> Vec<ImageView<'_>> {
    scene.images.iter().map(|i| ImageView { height: i.height, width: i.width, bgr: &i.bgr }).collect()
}

/// Refuses a rig whose matrices do not fit the network.
fn check_rig(rig: &Rig, network: &Network, cameras: usize) -> Result<()> {
    if rig.cameras() != cameras {
        return Err(Error::mismatch(format!("the rig has {} cameras, expected {cameras}", rig.cameras())));
    }
    for level in 0..3 {
        let Level { volume, bev } = rig.level(level);
        let [x, y, z] = network.grids[level];
        let pixels = cameras * network.feature_pixels(level);
        for (name, Csr { ptr, col }, rows) in [("volume", volume, x * y * z), ("bev", bev, x * y)] {
            if ptr.len() != rows + 1 {
                return Err(Error::mismatch(format!(
                    "level {}: the rig's {name} matrix has {} rows, the network expects {rows}",
                    level + 1,
                    ptr.len().saturating_sub(1)
                )));
            }
            // Columns ascend within a row, so a row's last one is its largest.
            let ends = ptr[1..].iter().filter(|&&end| end > 0).map(|&end| col[end as usize - 1] as usize);
            if let Some(pixel) = ends.max().filter(|&pixel| pixel >= pixels) {
                return Err(Error::mismatch(format!(
                    "level {}: the rig's {name} matrix names pixel {pixel}, the network has {pixels}",
                    level + 1
                )));
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;

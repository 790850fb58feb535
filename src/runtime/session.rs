//! A session: model, rig and arena, ready to run frames.

mod camera;
mod frame;
mod memory;
mod moving;
mod output;
#[cfg(test)]
mod tests;

pub use camera::CameraStatus;
pub use frame::{Budget, Step};
pub use memory::Memory;
pub use moving::Moving;
pub use output::{Confidence, Occupancy, OwnedOccupancy};

use crate::base::error::{Error, ErrorKind, Result};
use crate::base::threads::Threads;
use crate::graph::{Elements, Graph, Operation};
use crate::image::ImageView;
use crate::model::{Model, PartRef};
use crate::network::{Grid, Network};
use crate::rig::{Csr, Level, Rig};
use crate::runtime::arena::Arena;
use crate::runtime::executor::Executor;
use crate::runtime::plan::{Plan, Region};
use crate::scene::Scene;
use camera::CameraState;
use frame::Frame;
use memory::Tables;
use output::{Output, zeros};
use std::sync::Arc;
use std::time::Duration;
use voxcast_kernels::Isa;

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
    /// Also keep how sure the network is of every voxel.
    pub confidence: bool,
    /// Also run the heads of levels 1 to 3, for whoever observes their stages.
    pub coarse_heads: bool,
    /// Work in one slice of [`Session::step`], in multiply-adds; a number that moves counts as 20. A slice is at least one
    /// tile of an operation for every thread, so that slices of large networks may be longer.
    pub slice_cost: u64,
}

impl Default for SessionOptions {
    fn default() -> Self {
        Self {
            isa: Isa::best(),
            threads: Threads::calling(),
            unfolded: false,
            logits: false,
            confidence: false,
            coarse_heads: false,
            slice_cost: 50_000_000,
        }
    }
}

/// What an observer is told after each operation.
#[derive(Debug)]
pub struct Event<'a> {
    /// The operation that ended.
    pub operation: &'a Operation,
    /// Its camera, if it runs per camera.
    pub camera: Option<usize>,
    /// Wall time of all its slices.
    pub elapsed: Duration,
    /// Wall time of the longest slice.
    pub longest: Duration,
    /// What it wrote; of a head the logits, or the classes where the session has no logits.
    pub output: Elements<'a>,
}

/// A model with memory to run in. Nothing is allocated after [`Session::new`].
///
/// [`Session::run`] computes a frame at once. A controller that gets its images one by one, or has little time at a time,
/// calls [`Session::set_camera`] and [`Session::step`]: only cameras with a new image go through the backbone again, and
/// the work is done in slices. Both ways give the same bits.
pub struct Session {
    model: Arc<Model>,
    rig: Arc<Rig>,
    executor: Executor,
    /// For each operation, where its weights lie in the model.
    weights: Vec<Vec<PartRef>>,
    arena: Arena,
    /// The latest image of every camera.
    images: Arena,
    slice_cost: u64,
    cameras: Vec<CameraState>,
    /// Cameras that are left out.
    masked: Vec<bool>,
    /// Counts the changes of rig and mask.
    visibility: u64,
    frame: Frame,
    /// The last complete result.
    front: Output,
    /// The result that is being written.
    back: Output,
    /// Whether the last complete result has left the session.
    taken_out: bool,
}

impl std::fmt::Debug for Session {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Executor { isa, threads, .. } = &self.executor;
        f.debug_struct("Session").field("isa", isa).field("threads", threads).finish_non_exhaustive()
    }
}

impl Session {
    /// What [`Session::new`] will take from the system for `cameras` cameras, to the byte.
    ///
    /// # Errors
    /// [`ErrorKind::TooLarge`] if it cannot be addressed.
    pub fn memory(model: &Model, cameras: usize, options: &SessionOptions) -> Result<Memory> {
        Tables::new(model, cameras, options)?.memory(cameras)
    }

    /// Plans and allocates. The rig may be swapped later.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`] if the rig is not this network's; [`ErrorKind::TooLarge`] if there is not enough memory.
    pub fn new(model: Arc<Model>, rig: Arc<Rig>, options: &SessionOptions) -> Result<Self> {
        let tables = Tables::new(&model, rig.cameras(), options)?;
        Self::of_tables(model, rig, tables, options)
    }

    /// A session that runs `graph`, whose stored parts the model has, instead of the model's own.
    ///
    /// # Errors
    /// As [`Session::new`].
    pub(crate) fn of_graph(model: Arc<Model>, rig: Arc<Rig>, graph: Graph, options: &SessionOptions) -> Result<Self> {
        let tables = Tables::of_graph(&model, graph, rig.cameras(), options)?;
        Self::of_tables(model, rig, tables, options)
    }

    fn of_tables(model: Arc<Model>, rig: Arc<Rig>, tables: Tables, options: &SessionOptions) -> Result<Self> {
        let count = rig.cameras();
        check_rig(&rig, model.network(), count)?;
        let Memory { arena: bytes, .. } = tables.memory(count)?;
        let Tables { graph, plan, weights } = tables;
        let no_arena =
            || Error::new(ErrorKind::TooLarge, format!("the system has no {bytes} bytes for the session's arena"));
        let no_memory =
            || Error::new(ErrorKind::TooLarge, "the system has no memory for the session's images and results");
        let arena = Arena::new(plan.bytes(Region::Arena)).ok_or_else(no_arena)?;
        let images = Arena::new(plan.bytes(Region::Input)).ok_or_else(no_memory)?;
        let output = || Output::new(&graph, &plan, count).ok_or_else(no_memory);
        let (front, back) = (output()?, output()?);
        let session = Self {
            arena,
            images,
            executor: Executor { isa: options.isa, graph, plan, cameras: count, threads: options.threads.clone() },
            slice_cost: options.slice_cost.max(1),
            masked: zeros(count).ok_or_else(no_memory)?,
            visibility: 1,
            frame: Frame::default(),
            front,
            back,
            taken_out: false,
            cameras: zeros(count).ok_or_else(no_memory)?,
            weights,
            model,
            rig,
        };
        session.executor.check()?;
        Ok(session)
    }

    /// The model.
    pub fn model(&self) -> &Arc<Model> {
        &self.model
    }

    /// Operations, for whoever reports on them.
    pub fn graph(&self) -> &Graph {
        &self.executor.graph
    }

    /// Where everything lies.
    pub fn plan(&self) -> &Plan {
        &self.executor.plan
    }

    /// What the session took, as [`Session::memory`] said it would.
    pub fn taken(&self) -> Memory {
        Memory {
            arena: self.arena.len(),
            images: self.images.len()
                + self.cameras.capacity() * size_of::<CameraState>()
                + self.masked.capacity() * size_of::<bool>(),
            output: self.front.bytes() + self.back.bytes(),
            tables: memory::tables(&self.executor.graph, &self.executor.plan, &self.weights),
        }
    }

    /// Whether results have logits.
    #[cfg(feature = "capi")]
    pub(crate) fn keeps_logits(&self) -> bool {
        self.front.has_logits()
    }

    /// Whether results say how sure the network is.
    #[cfg(feature = "capi")]
    pub(crate) fn keeps_confidence(&self) -> bool {
        self.front.has_confidence()
    }

    /// Cameras of a frame.
    pub fn cameras(&self) -> usize {
        self.cameras.len()
    }

    /// Uses another rig of the same network and number of cameras, and gives the one in use back: a caller who keeps it
    /// can have the next calibration built into its memory ([`RigBuilder::rebuild`](crate::rig::RigBuilder::rebuild)).
    /// Allocates and frees nothing.
    ///
    /// It takes effect at once. A frame whose fusion is under way fuses again from the start; no backbone runs again.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`] if the rig does not fit; the one in use stays.
    pub fn set_rig(&mut self, rig: Arc<Rig>) -> Result<Arc<Rig>> {
        check_rig(&rig, self.model.network(), self.cameras.len())?;
        let replaced = std::mem::replace(&mut self.rig, rig);
        self.visibility_changed();
        Ok(replaced)
    }

    /// Leaves camera `camera` out, or takes it in again: the means are over the pixels of the others, with the bits of a
    /// rig without its entries. A camera that has failed or is dirty need not have an image, and its backbone does not run.
    ///
    /// It takes effect at once, as [`Session::set_rig`] does. A camera that is taken in again shows its latest image.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`] if there is no such camera.
    pub fn set_masked(&mut self, camera: usize, masked: bool) -> Result<()> {
        self.check_camera(camera)?;
        if std::mem::replace(&mut self.masked[camera], masked) != masked {
            self.frame.leave(camera, &mut self.cameras[camera]);
            self.visibility_changed();
        }
        Ok(())
    }

    /// Copies camera `camera`'s next image, whose pass [`Session::step`] will run. Where the image before has not begun
    /// its pass, it is replaced.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`] if there is no such camera, or the image's size is not the network's.
    pub fn set_camera(&mut self, camera: usize, image: ImageView<'_>) -> Result<()> {
        self.check_camera(camera)?;
        image.check(camera, self.model.network().image)?;
        self.receive(camera, &image);
        self.frame.received(camera);
        Ok(())
    }

    /// Copies every camera's next image, and drops what [`Session::step`] had begun: the next steps compute the frame that
    /// [`Session::run`] would.
    ///
    /// # Errors
    /// As [`Session::run`].
    pub fn set_cameras(&mut self, images: &[ImageView<'_>]) -> Result<()> {
        self.receive_all(images.iter().copied())
    }

    /// Does some of what is to be done: passes of the cameras that have a new image, then the fusion of all features. At
    /// least one slice runs, unless there is nothing to do. See [`Budget`] and [`Step`].
    ///
    /// A camera's pass runs once per frame at most, so that images that come quickly cannot hold up the result.
    ///
    /// # Determinism
    /// Results do not depend on how the work is cut, nor on the order in which images came.
    pub fn step(&mut self, budget: Budget) -> Step {
        self.step_observed(budget, &mut |_| ())
    }

    /// [`Session::step`] that tells `observer` of each operation as it ends.
    pub fn step_observed(&mut self, budget: Budget, observer: &mut (dyn FnMut(Event<'_>) + Send)) -> Step {
        let threads = self.executor.threads.clone();
        threads.enter(|| self.advance(budget, observer))
    }

    /// The last complete result; none before the first frame. It stays as it is while [`Session::step`] works on the next.
    pub fn occupancy(&self) -> Option<Occupancy<'_>> {
        (self.frame.any_complete() && !self.taken_out).then(|| self.front.occupancy(Grid::of(self.model.network())))
    }

    /// Takes the last complete result out of the session, without copying it; none before the first frame, or where it was
    /// taken already. The session goes on with the memory of `spare`, a result of any session of its layout that nobody needs any more, and
    /// without one allocates as much. [`Session::memory`] does not count results that were taken.
    ///
    /// # Errors
    /// [`ErrorKind::TooLarge`] if the system has no memory; the result stays.
    pub fn take(&mut self, spare: Option<OwnedOccupancy>) -> Result<Option<OwnedOccupancy>> {
        if !self.frame.any_complete() || self.taken_out {
            return Ok(None);
        }
        let next = match spare.map(OwnedOccupancy::into_output).filter(|spare| spare.fits(&self.front)) {
            Some(spare) => spare,
            None => Output::like(&self.front)
                .ok_or_else(|| Error::new(ErrorKind::TooLarge, "the system has no memory for another result"))?,
        };
        let output = std::mem::replace(&mut self.front, next);
        self.taken_out = true;
        Ok(Some(OwnedOccupancy::new(Grid::of(self.model.network()), output)))
    }

    /// The longest time that one slice took so far, and the operation that it was a part of. Slices of [`Session::run`]
    /// are whole operations and do not count.
    pub fn longest_slice(&self) -> Option<(Duration, &Operation)> {
        self.frame.longest().map(|(time, index)| (time, &self.executor.graph.operations[index]))
    }

    /// Runs one frame: every camera gets a new image, and all is computed. What [`Session::step`] had begun is dropped.
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
        self.run_each(images.iter().copied(), observer)
    }

    /// [`Session::run_observed`] on images that need not lie side by side.
    pub(crate) fn run_each<'a>(
        &mut self,
        images: impl ExactSizeIterator<Item = ImageView<'a>> + Clone,
        observer: &mut (dyn FnMut(Event<'_>) + Send),
    ) -> Result<Occupancy<'_>> {
        self.receive_all(images)?;
        let step = self.step_observed(Budget::Unlimited, observer);
        debug_assert_eq!(step, Step::Complete, "every camera has a new image");
        Ok(self.occupancy().expect("a complete frame"))
    }

    /// Checks and copies an image for every camera.
    fn receive_all<'a>(&mut self, images: impl ExactSizeIterator<Item = ImageView<'a>> + Clone) -> Result<()> {
        let count = self.cameras.len();
        if images.len() != count {
            return Err(Error::mismatch(format!("{} images, the rig has {count} cameras", images.len())));
        }
        for (camera, image) in images.clone().enumerate() {
            image.check(camera, self.model.network().image)?;
        }
        self.frame.restart(&mut self.cameras);
        for (camera, image) in images.enumerate() {
            self.receive(camera, &image);
        }
        Ok(())
    }

    /// Copies an image, which was checked, to its camera's tensor.
    fn receive(&mut self, camera: usize, image: &ImageView<'_>) {
        let place = self.executor.place(self.executor.graph.operations[0].inputs[0], Some(camera));
        let len = image.height * image.width * 3;
        image.copy_to(&mut self.images.bytes_mut()[place.bytes][..len]);
        self.cameras[camera].receive([image.height, image.width]);
    }

    fn check_camera(&self, camera: usize) -> Result<()> {
        if camera >= self.cameras.len() {
            return Err(Error::mismatch(format!("camera {camera}, the rig has {} cameras", self.cameras.len())));
        }
        Ok(())
    }

    fn visibility_changed(&mut self) {
        self.visibility += 1;
        self.frame.visibility_changed();
    }
}

/// A scene's images as a session takes them.
pub fn views(scene: &Scene) -> Vec<ImageView<'_>> {
    scene.images.iter().map(|i| ImageView::bgr(i.height, i.width, &i.bgr)).collect()
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

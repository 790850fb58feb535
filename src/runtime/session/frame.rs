//! A frame under way: what runs next, how it is cut into slices, and when a result is complete.
//!
//! ```text
//! idle ── a camera has a new image ──▶ its pass, operation by operation ──▶ idle
//! idle ── features, rig or mask changed, every camera that counts has features ──▶ fusion ──▶ result, idle
//! ```

use super::camera::CameraState;
use super::output::Output;
use super::{CameraStatus, Event, Session};
use crate::graph::parts::MAX_PARTS;
use crate::graph::{Elements, Graph, Level, Moment, Operation};
use crate::runtime::arena::{Arena, Regions};
use crate::runtime::executor::Slice;
use std::time::{Duration, Instant};
use voxcast_kernels::gather::Mask;

/// How much of a frame [`Session::step`] may do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Budget {
    /// All of it. Operations are not cut.
    Unlimited,
    /// Slices for about this long. No slice begins once less time is left than the longest of this and the last frame
    /// took; one runs in any case. So a step is late only if a slice takes longer than all before it.
    Time(Duration),
    /// So many slices, at least one. Cut the same on every machine with this number of threads.
    Slices(u32),
}

/// What [`Session::step`] came to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// There is nothing to do: no camera that counts has a new image, or one has not had any yet.
    Idle,
    /// The budget is spent; the frame is not complete.
    Running,
    /// A frame is complete, and [`Session::occupancy`] is its result.
    Complete,
}

/// What runs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Phase {
    #[default]
    Idle,
    /// A camera's operations.
    Pass { camera: usize, image: u64 },
    /// The operations after all cameras.
    Fusion,
}

/// The frame under way.
#[derive(Debug, Default)]
pub(super) struct Frame {
    phase: Phase,
    /// Operation of the phase.
    index: usize,
    /// Its first tile that has not run.
    tile: usize,
    /// Time of its slices so far, and the longest.
    elapsed: Duration,
    longest: Duration,
    /// Whether features, rig or mask are not those of the last result.
    changed: bool,
    completed: u64,
    slices: SliceTimes,
}

/// The longest slices.
#[derive(Debug, Default)]
struct SliceTimes {
    /// Since the session was made, with the operation.
    ever: Option<(Duration, usize)>,
    last_frame: Duration,
    this_frame: Duration,
}

impl Frame {
    /// Begins anew, with every camera to be passed.
    pub(super) fn restart(&mut self, cameras: &mut [CameraState]) {
        self.phase = Phase::Idle;
        self.changed = true;
        for camera in cameras {
            camera.features = 0;
            camera.passed = false;
        }
    }

    /// Camera `camera` got an image. Its pass, if it has only begun to read the last one, starts again.
    pub(super) fn received(&mut self, camera: usize) {
        if self.index == 0 && matches!(self.phase, Phase::Pass { camera: c, .. } if c == camera) {
            self.phase = Phase::Idle;
        }
    }

    /// Camera `camera` was masked or is so no longer. A pass under way ends, and what it overwrote are no features.
    pub(super) fn leave(&mut self, camera: usize, state: &mut CameraState) {
        if matches!(self.phase, Phase::Pass { camera: c, .. } if c == camera) {
            self.phase = Phase::Idle;
            state.features = 0;
        }
    }

    /// Rig or mask changed. What was fused is of no use.
    pub(super) fn visibility_changed(&mut self) {
        self.changed = true;
        if self.phase == Phase::Fusion {
            self.phase = Phase::Idle;
        }
    }

    pub(super) fn any_complete(&self) -> bool {
        self.completed > 0
    }

    pub(super) fn longest(&self) -> Option<(Duration, usize)> {
        self.slices.ever
    }

    fn begin(&mut self, phase: Phase, index: usize) {
        (self.phase, self.index, self.tile) = (phase, index, 0);
        (self.elapsed, self.longest) = (Duration::ZERO, Duration::ZERO);
    }

    /// A slice of the operation took `time`; `cut` if slices are to be known.
    fn ran(&mut self, time: Duration, cut: bool) {
        self.elapsed += time;
        self.longest = self.longest.max(time);
        if cut {
            let SliceTimes { ever, this_frame, .. } = &mut self.slices;
            *this_frame = time.max(*this_frame);
            if ever.is_none_or(|(longest, _)| time > longest) {
                *ever = Some((time, self.index));
            }
        }
    }
}

impl Session {
    /// Runs slices until the budget is spent or nothing is left.
    pub(super) fn advance(&mut self, budget: Budget, observer: &mut dyn FnMut(Event<'_>)) -> Step {
        let start = Instant::now();
        let mut slices = 0;
        loop {
            if !self.choose() {
                return Step::Idle;
            }
            if self.slice(budget, observer) && self.end_phase() {
                return Step::Complete;
            }
            slices += 1;
            let spent = match budget {
                Budget::Unlimited => false,
                Budget::Slices(most) => slices >= most,
                Budget::Time(time) => {
                    let SliceTimes { last_frame, this_frame, .. } = self.frame.slices;
                    start.elapsed() + last_frame.max(this_frame) >= time
                }
            };
            if spent {
                return Step::Running;
            }
        }
    }

    /// Begins the next phase if none is under way. False if there is nothing to do.
    fn choose(&mut self) -> bool {
        if self.frame.phase != Phase::Idle {
            return true;
        }
        let counts = || self.cameras.iter().zip(&self.masked).map(|(camera, &masked)| (camera, !masked));
        if let Some(camera) = counts().position(|(camera, counts)| counts && camera.is_new() && !camera.passed) {
            let image = self.cameras[camera].received();
            // What the pass overwrites are no features until it is over.
            self.cameras[camera].features = 0;
            self.frame.begin(Phase::Pass { camera, image }, 0);
            return true;
        }
        let fusible = self.frame.changed && counts().all(|(camera, counts)| !counts || camera.features > 0);
        if fusible {
            self.frame.begin(Phase::Fusion, self.executor.graph.camera_operations);
        }
        fusible
    }

    /// Runs a slice. Whether it was the last of the phase.
    fn slice(&mut self, budget: Budget, observer: &mut dyn FnMut(Event<'_>)) -> bool {
        let parts = match budget {
            Budget::Unlimited => 1,
            Budget::Time(_) | Budget::Slices(_) => {
                let cost =
                    cost(&self.executor.graph, &self.executor.graph.operations[self.frame.index], &self.levels());
                usize::try_from(cost.div_ceil(self.slice_cost)).unwrap_or(usize::MAX).max(1)
            }
        };
        let start = Instant::now();
        let next = self.operation(parts);
        self.frame.ran(start.elapsed(), budget != Budget::Unlimited);
        if let Some(tile) = next {
            self.frame.tile = tile;
            return false;
        }
        self.tell(observer);
        let end = match self.frame.phase {
            Phase::Fusion => self.executor.graph.operations.len(),
            Phase::Pass { .. } | Phase::Idle => self.executor.graph.camera_operations,
        };
        let index = self.frame.index + 1;
        self.frame.begin(self.frame.phase, index);
        index == end
    }

    fn levels(&self) -> [Level<'_>; 3] {
        [0, 1, 2].map(|i| self.rig.level(i))
    }

    /// The camera whose pass is under way.
    fn camera(&self) -> Option<usize> {
        match self.frame.phase {
            Phase::Pass { camera, .. } => Some(camera),
            Phase::Fusion | Phase::Idle => None,
        }
    }

    /// Runs one of `parts` shares of the operation under way, from its next tile on, and returns the tile after.
    fn operation(&mut self, parts: usize) -> Option<usize> {
        let Frame { index, tile, .. } = self.frame;
        let camera = self.camera();
        let image = camera.map_or([0; 2], |camera| self.cameras[camera].size());
        let levels = [0, 1, 2].map(|i| self.rig.level(i));
        let mut stored = [Elements::EMPTY; MAX_PARTS];
        let parts_of = &self.weights[index];
        for (elements, part) in stored.iter_mut().zip(parts_of) {
            *elements = self.model.resolve(part);
        }
        let stored = &stored[..parts_of.len()];
        let moment = Moment { image, levels: &levels, masked: &self.masked };
        let regions = regions(&mut self.images, &mut self.arena, &mut self.back);
        self.executor.run(&regions, index, stored, camera, moment, Slice { first: tile, parts })
    }

    /// Tells the observer of the operation that has ended.
    fn tell(&mut self, observer: &mut dyn FnMut(Event<'_>)) {
        let Frame { index, elapsed, longest, .. } = self.frame;
        let camera = self.camera();
        let operation = &self.executor.graph.operations[index];
        let regions = regions(&mut self.images, &mut self.arena, &mut self.back);
        let output = self.executor.elements(&regions, operation.result(), camera);
        observer(Event { operation, camera, elapsed, longest, output });
    }

    /// The phase under way is over. Whether the frame is complete.
    fn end_phase(&mut self) -> bool {
        let phase = std::mem::take(&mut self.frame.phase);
        if let Phase::Pass { camera, image } = phase {
            let camera = &mut self.cameras[camera];
            (camera.features, camera.age, camera.passed) = (image, 0, true);
            self.frame.changed = true;
        }
        let complete = phase == Phase::Fusion;
        if complete {
            self.complete();
        }
        complete
    }

    /// Finishes the result and makes it the one that is read.
    fn complete(&mut self) {
        let network = self.model.network();
        let pixels = network.feature_pixels(0);
        let mask = self.masked.contains(&true).then_some(Mask { pixels, masked: &self.masked });
        let volume = self.rig.level(0).volume;
        self.back.count_support(self.visibility, volume, mask, network.grids[0], network.output_grid());
        for ((camera, &masked), status) in self.cameras.iter_mut().zip(&self.masked).zip(&mut self.back.cameras) {
            *status = CameraStatus { image: camera.features, age: camera.age, masked };
            camera.age += 1;
            camera.passed = false;
        }
        std::mem::swap(&mut self.front, &mut self.back);
        self.taken_out = false;
        let Frame { changed, completed, slices, .. } = &mut self.frame;
        *changed = false;
        *completed += 1;
        slices.last_frame = std::mem::take(&mut slices.this_frame);
    }
}

/// The memory of all tensors.
fn regions<'a>(images: &'a mut Arena, arena: &'a mut Arena, result: &'a mut Output) -> Regions<'a> {
    Regions { input: images.view(), arena: arena.view(), output: result.memory_mut().view() }
}

/// Multiply-adds of a large product that take about as long as `operation`: those that it executes at its own pace, or 20 for each
/// element that it moves, by which a core computes in registers as fast as it reads memory.
fn cost(graph: &Graph, operation: &Operation, levels: &[Level<'_>; 3]) -> u64 {
    let moved = operation.op.description().moved(&graph.site(operation), levels);
    let executed = graph.executed_multiply_adds(operation).saturating_mul(operation.op.description().pace());
    executed.max(20u64.saturating_mul(moved as u64))
}

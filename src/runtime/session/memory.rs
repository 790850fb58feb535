//! What a session takes from the system, told before it is made.

use crate::base::error::{Error, ErrorKind, Result};
use crate::graph::{Graph, Results};
use crate::model::{Model, PartRef};
use crate::runtime::plan::{Plan, Region};
use crate::runtime::session::SessionOptions;
use crate::runtime::session::camera::CameraState;
use crate::runtime::session::output::Output;

/// Everything that a session takes from the system, known before it is made, in bytes.
///
/// Not counted: the model and the rig, which sessions share, and the stacks of [`Threads`](crate::Threads).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Memory {
    /// The arena: tensors and every worker's scratch.
    pub arena: usize,
    /// The latest image of every camera.
    pub images: usize,
    /// Two results, of which one is written while the other is read.
    pub output: usize,
    /// Operations, names and offsets.
    pub tables: usize,
}

impl Memory {
    /// Bytes in all.
    pub fn total(&self) -> usize {
        self.arena + self.images + self.output + self.tables
    }
}

/// What a session knows before it has memory to run in.
pub(super) struct Tables {
    pub(super) graph: Graph,
    pub(super) plan: Plan,
    /// For each operation, where its weights lie in the model.
    pub(super) weights: Vec<Vec<PartRef>>,
}

impl Tables {
    pub(super) fn new(model: &Model, cameras: usize, options: &SessionOptions) -> Result<Self> {
        if options.unfolded && model.quantisation().is_some() {
            let message = "a model of int8 has no graph without the projection fold";
            return Err(Error::new(ErrorKind::Unsupported, message));
        }
        let confidence = options.confidence.then(|| model.temperature());
        let results = Results { logits: options.logits, coarse_heads: options.coarse_heads, confidence };
        Self::of_graph(model, model.graph(options.unfolded, results), cameras, options)
    }

    /// Those of a graph whose stored parts the model has.
    pub(super) fn of_graph(model: &Model, graph: Graph, cameras: usize, options: &SessionOptions) -> Result<Self> {
        let plan = Plan::new(&graph, cameras, options.threads.count())?;
        let weights = graph.operations.iter().map(|o| model.part_refs(&graph, o)).collect::<Result<_>>()?;
        Ok(Self { graph, plan, weights })
    }

    /// Bytes of a session with these tables.
    pub(super) fn memory(&self, cameras: usize) -> Result<Memory> {
        let too_large = || Error::new(ErrorKind::TooLarge, "the session needs more memory than can be addressed");
        let output = Output::bytes_for(&self.graph, &self.plan, cameras).and_then(|bytes| bytes.checked_mul(2));
        // Of each camera its record and its flag in the mask.
        let records = cameras.checked_mul(size_of::<CameraState>() + size_of::<bool>());
        let images = records.and_then(|bytes| bytes.checked_add(self.plan.bytes(Region::Input)));
        Ok(Memory {
            arena: self.plan.bytes(Region::Arena),
            images: images.ok_or_else(too_large)?,
            output: output.ok_or_else(too_large)?,
            tables: tables(&self.graph, &self.plan, &self.weights),
        })
    }
}

/// Bytes that the tables take from the allocator.
pub(super) fn tables(graph: &Graph, plan: &Plan, weights: &Vec<Vec<PartRef>>) -> usize {
    let parts: usize = weights.iter().map(|parts| parts.capacity() * size_of::<PartRef>()).sum();
    graph.heap_bytes() + plan.heap_bytes() + weights.capacity() * size_of::<Vec<PartRef>>() + parts
}

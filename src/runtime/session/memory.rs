//! What a session takes from the system, told before it is made.

use crate::base::error::{Error, ErrorKind, Result};
use crate::graph::{Graph, Op};
use crate::model::{Model, PartRef};
use crate::runtime::heap;
use crate::runtime::plan::Plan;
use crate::runtime::session::SessionOptions;
use crate::runtime::session::camera::Camera;
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
    /// Two results, of which one is written while the other is read, and the classes of coarse heads.
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
        let graph = model.graph(options.unfolded, options.coarse_heads);
        let plan = Plan::new(&graph, cameras, options.threads.count())?;
        let weights = graph.operations.iter().map(|o| model.part_refs(&graph, o)).collect::<Result<_>>()?;
        Ok(Self { graph, plan, weights })
    }

    fn bytes(&self) -> usize {
        let rows: usize = self.weights.iter().map(heap::vector).sum();
        heap::graph(&self.graph) + self.plan.heap_bytes() + heap::vector(&self.weights) + rows
    }
}

/// Lengths of the buffers that are not in the arena.
pub(super) struct Lengths {
    pub(super) voxels: usize,
    /// Logits of the largest head, 0 if nobody wants any.
    pub(super) logits: usize,
    /// Voxels of the largest coarse head, 0 if there is none.
    pub(super) coarse: usize,
    /// Bytes of one image.
    pub(super) image: usize,
}

impl Lengths {
    pub(super) fn new(graph: &Graph, options: &SessionOptions) -> Self {
        let heads = || graph.operations.iter().filter(|o| matches!(o.op, Op::Head { .. }));
        let wanted = options.logits || options.coarse_heads;
        let logits = heads().filter(|_| wanted).map(|o| graph.tensor(o.output).len()).max();
        let coarse = heads().filter(|o| o.op != Op::Head { level: 0 }).map(|o| graph.tensor(o.output).rows()).max();
        let [height, width] = graph.network.image;
        Self {
            voxels: graph.network.output_grid().iter().product(),
            logits: logits.unwrap_or(0),
            coarse: coarse.unwrap_or(0),
            image: height * width * 3,
        }
    }

    /// Bytes of a session with these tables and buffers.
    pub(super) fn memory(&self, tables: &Tables, cameras: usize) -> Result<Memory> {
        let too_large = || Error::new(ErrorKind::TooLarge, "the session needs more memory than can be addressed");
        let result = Output::bytes_for(self.voxels, self.logits, cameras).ok_or_else(too_large)?;
        // Of each camera its record and its flag in the mask.
        let cameras = self.image.checked_add(size_of::<Camera>() + 1).and_then(|one| one.checked_mul(cameras));
        Ok(Memory {
            arena: tables.plan.bytes(),
            images: cameras.ok_or_else(too_large)?,
            output: result.checked_mul(2).and_then(|r| r.checked_add(self.coarse)).ok_or_else(too_large)?,
            tables: tables.bytes(),
        })
    }
}

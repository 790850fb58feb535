//! Operation to kernel call: which bytes of the memory, which weights, and one tile of the output at a time for each
//! worker. No arithmetic, and no word of which operations there are: [`Description`](crate::graph::ops::Description) has
//! that.

use crate::base::error::{Error, ErrorKind, Result};
use crate::base::threads::Threads;
use crate::graph::ops::Machine;
use crate::graph::{
    Added, Call, Element, Elements, Graph, Lifetime, MAX_INPUTS, MAX_OUTPUTS, Moment, Operation, TensorId, Tile,
};
use crate::runtime::arena::Regions;
use crate::runtime::plan::{Place, Plan, Region};
use std::ops::Range;
use voxcast_kernels::Isa;

/// Everything but memory that operations need.
pub(crate) struct Executor {
    pub(crate) isa: Isa,
    pub(crate) graph: Graph,
    pub(crate) plan: Plan,
    pub(crate) cameras: usize,
    pub(crate) threads: Threads,
}

/// The part of an operation that a call runs: from tile `first`, one of about `parts` equal shares of the tiles.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Slice {
    pub(crate) first: usize,
    pub(crate) parts: usize,
}

/// The next tile of an operation, unless all have run.
pub(crate) type Next = Option<usize>;

impl Executor {
    /// Where the tensor lies that an operation sees: in a camera's pass its copy where each camera has one, else all.
    pub(crate) fn place(&self, id: TensorId, camera: Option<usize>) -> Place {
        let tensor = self.graph.tensor(id);
        let Place { region, bytes: Range { start, .. } } = self.plan.place(id);
        let bytes = match (tensor.lifetime, camera) {
            (Lifetime::Camera, Some(camera)) => {
                let start = start + camera * tensor.bytes();
                start..start + tensor.bytes()
            }
            _ => start..start + tensor.bytes() * tensor.copies(self.cameras),
        };
        Place { region, bytes }
    }

    /// What lies in tensor `id`, for whoever looks on.
    pub(crate) fn elements<'v>(&self, regions: &Regions<'v>, id: TensorId, camera: Option<usize>) -> Elements<'v> {
        // SAFETY: called between operations, when nothing is written.
        unsafe { self.read(regions, id, camera) }
    }

    /// The elements of tensor `id`.
    ///
    /// # Safety
    /// Nothing of it may be written while the result lives.
    unsafe fn read<'v>(&self, regions: &Regions<'v>, id: TensorId, camera: Option<usize>) -> Elements<'v> {
        let Place { region, bytes } = self.place(id, camera);
        // SAFETY: as the caller promises.
        Elements::new(self.graph.tensor(id).element, unsafe { regions.of(region).read(bytes) })
    }

    /// Checks, once per session, what [`Executor::run`] relies on: an operation writes only its outputs and its workers'
    /// scratch, and these meet neither each other nor anything that it reads, but for what the plan lets it overwrite.
    pub(crate) fn check(&self) -> Result<()> {
        let apart =
            |a: &Place, b: &Place| a.region != b.region || a.bytes.end <= b.bytes.start || b.bytes.end <= a.bytes.start;
        let scratch = (0..self.plan.workers()).map(|w| Place { region: Region::Arena, bytes: self.plan.scratch(w) });
        let scratch: Vec<Place> = scratch.collect();
        for (index, operation) in self.graph.operations.iter().enumerate() {
            let rows = self.graph.tensor(operation.output()).rows();
            let mut written: Vec<Place> = operation.outputs.iter().map(|&id| self.place(id, None)).collect();
            let output = written[0].clone();
            written.extend(scratch.iter().cloned());
            let replaced = self.plan.replaced(index);
            let sound = operation.inputs.len() <= MAX_INPUTS
                && operation.outputs.len() <= MAX_OUTPUTS
                && operation.outputs.iter().all(|&id| self.graph.tensor(id).rows() == rows)
                && written.iter().enumerate().all(|(i, one)| written[i + 1..].iter().all(|other| apart(one, other)))
                && replaced.is_none_or(|id| self.place(id, None) == output)
                && operation.reads().filter(|&id| Some(id) != replaced).all(|id| {
                    let read = self.place(id, None);
                    written.iter().all(|place| apart(place, &read))
                })
                && (replaced.is_none() || written[1..].iter().all(|place| apart(place, &output)));
            if !sound {
                let message = format!("the plan breaks operation \"{}\"", operation.name);
                return Err(Error::new(ErrorKind::Unsupported, message));
            }
        }
        Ok(())
    }

    /// Runs a slice of operation `index` on the current pool, in the pass of `camera` or after all cameras. `parts` are
    /// its stored parts.
    ///
    /// Tiles are the same whatever the slices, and each runs once: slices cannot show in a result.
    pub(crate) fn run(
        &self,
        regions: &Regions<'_>,
        index: usize,
        parts: &[Elements<'_>],
        camera: Option<usize>,
        moment: Moment<'_>,
        slice: Slice,
    ) -> Next {
        let operation = &self.graph.operations[index];
        let replaced = self.plan.replaced(index);
        // SAFETY: `check` found everything that the operation reads apart from all that it writes, but for what it
        // replaces, which is left to the tiles.
        let read = |id: TensorId| unsafe { self.read(regions, id, camera) };
        let mut inputs = [Elements::EMPTY; MAX_INPUTS];
        for (input, &id) in inputs.iter_mut().zip(&operation.inputs) {
            if Some(id) != replaced {
                *input = read(id);
            }
        }
        let added = match operation.residual {
            None => Added::Nothing,
            Some(residual) if Some(residual.tensor) == replaced => Added::InPlace,
            Some(residual) => Added::Apart { elements: read(residual.tensor), after: residual.after },
        };
        let site = self.graph.site(operation);
        let call = Call { isa: self.isa, site, inputs, added, parts, moment };
        let description = operation.op.description();
        let per_tile = description.tile(&site, Machine { isa: self.isa, workers: self.plan.workers() });
        let rows = site.rows();
        self.tiles(slice, rows.div_ceil(per_tile), &|worker, tile| {
            let positions = tile * per_tile..rows.min((tile + 1) * per_tile);
            let outputs = self.rows(regions, operation, camera, &positions);
            // SAFETY: each worker has its own scratch, which `check` found apart from everything else.
            let scratch = unsafe { regions.arena.write(self.plan.scratch(worker)) };
            description.execute(&call, Tile { positions, outputs, scratch });
        })
    }

    /// Some positions of everything that an operation writes.
    fn rows<'v>(
        &self,
        regions: &Regions<'v>,
        operation: &Operation,
        camera: Option<usize>,
        positions: &Range<usize>,
    ) -> [(Element, &'v mut [u8]); MAX_OUTPUTS] {
        let mut outputs: [(Element, &'v mut [u8]); MAX_OUTPUTS] = std::array::from_fn(|_| (Element::U8, &mut [][..]));
        for (output, &id) in outputs.iter_mut().zip(&operation.outputs) {
            let tensor = self.graph.tensor(id);
            let Place { region, bytes: Range { start, .. } } = self.place(id, camera);
            let [first, end] = [positions.start, positions.end].map(|row| start + row * tensor.row_bytes());
            // SAFETY: each tile has its own positions, and `check` found the outputs apart from each other and from
            // everything that is read.
            *output = (tensor.element, unsafe { regions.of(region).write(first..end) });
        }
        outputs
    }

    /// Runs the slice's share of `count` tiles.
    fn tiles(&self, slice: Slice, count: usize, tile: &(dyn Fn(usize, usize) + Sync)) -> Next {
        let workers = self.plan.workers();
        let share = count.div_ceil(slice.parts).next_multiple_of(workers);
        let end = count.min(slice.first.saturating_add(share));
        self.threads.for_each_tile(workers, end - slice.first, &|worker, index| tile(worker, slice.first + index));
        (end < count).then_some(end)
    }
}

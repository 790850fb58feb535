//! The plan: where each tensor lies, decided from lifetimes before anything runs.
//!
//! Inputs and outputs of the graph have memory of their own, which callers write and read. All else shares one arena: two
//! tensors may overlap when no operation needs both. Larger tensors are placed first, each at the lowest offset where it
//! meets no living neighbour ("greedy by size", Pisarchyk and Lee, arXiv 2001.03288); ties go to the tensor that was made
//! first, so a plan depends on nothing but the graph.

use crate::base::error::{Error, ErrorKind, Result};
use crate::graph::{Graph, Lifetime, Operation, Scope, TensorId};
use std::fmt;
use std::ops::Range;

/// Bytes of a cache line, at whose multiples tensors begin.
pub const ALIGNMENT: usize = 64;

/// A piece of memory with tensors in it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Region {
    /// What the caller writes.
    Input,
    /// What lies between operations, and every worker's scratch.
    Arena,
    /// What the caller reads.
    Output,
}

/// Where a tensor lies: all copies of it, one after the other.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Place {
    /// In which memory.
    pub region: Region,
    /// Which bytes of it, padded to whole cache lines. Empty for tensors that nothing uses.
    pub bytes: Range<usize>,
}

/// Where every tensor lies, and the scratch.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Plan {
    /// One per tensor of the graph.
    places: Vec<Place>,
    /// For each operation, the tensor that its first output overwrites.
    replaced: Vec<Option<TensorId>>,
    /// Scratch of each worker, in the arena.
    scratch: Vec<Range<usize>>,
    /// Bytes of the arena, the inputs and one set of outputs.
    arena: usize,
    input: usize,
    output: usize,
    lines: Vec<Line>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct Line {
    name: String,
    place: Place,
    life: Range<usize>,
}

/// A block of memory to place.
struct Block {
    name: String,
    len: usize,
    /// Operations from the first that writes it to the last that needs it.
    life: Range<usize>,
    tensors: Vec<TensorId>,
}

impl Plan {
    /// Plans `graph` for `cameras` cameras and `workers` threads.
    ///
    /// # Errors
    /// [`ErrorKind::TooLarge`] if the memory cannot be addressed.
    pub fn new(graph: &Graph, cameras: usize, workers: usize) -> Result<Self> {
        let nowhere = Place { region: Region::Arena, bytes: 0..0 };
        let mut plan = Self {
            places: vec![nowhere; graph.tensors.len()],
            replaced: graph.operations.iter().map(Operation::in_place).collect(),
            scratch: vec![],
            arena: 0,
            input: 0,
            output: 0,
            lines: vec![],
        };
        let everything = 0..graph.operations.len();
        let mut blocks = plan.blocks(graph, cameras)?;
        let scratch = scratch_bytes(graph);
        for worker in 0..workers {
            let name = format!("scratch of worker {worker}");
            blocks.push(Block { name, len: scratch, life: everything.clone(), tensors: vec![] });
        }
        let offsets = plan.arrange(&blocks)?;
        for (block, offset) in blocks.into_iter().zip(offsets) {
            let place = Place { region: Region::Arena, bytes: offset..offset + block.len };
            if block.tensors.is_empty() {
                plan.scratch.push(place.bytes.clone());
            }
            for TensorId(tensor) in block.tensors {
                plan.places[tensor] = place.clone();
            }
            plan.lines.push(Line { name: block.name, place, life: block.life });
        }
        plan.outside(graph, cameras, everything)?;
        // More cannot be one allocation, which on 32 bits is soon reached.
        if [plan.arena, plan.input, plan.output].into_iter().any(|bytes| bytes > isize::MAX as usize) {
            return Err(too_large());
        }
        Ok(plan)
    }

    /// Offsets of the blocks; sets the length of the arena.
    fn arrange(&mut self, blocks: &[Block]) -> Result<Vec<usize>> {
        let mut order: Vec<usize> = (0..blocks.len()).collect();
        order.sort_by_key(|&i| (std::cmp::Reverse(blocks[i].len), i));
        let mut offsets = vec![0; blocks.len()];
        let mut placed: Vec<usize> = vec![];
        for i in order {
            let mut taken: Vec<Range<usize>> = placed
                .iter()
                .filter(|&&j| overlap(&blocks[i].life, &blocks[j].life))
                .map(|&j| offsets[j]..offsets[j] + blocks[j].len)
                .collect();
            taken.sort_by_key(|r| r.start);
            let mut at = 0usize;
            for r in taken {
                if at.checked_add(blocks[i].len).is_some_and(|end| end <= r.start) {
                    break;
                }
                at = at.max(r.end);
            }
            offsets[i] = at;
            self.arena = self.arena.max(at.checked_add(blocks[i].len).ok_or_else(too_large)?);
            placed.push(i);
        }
        Ok(offsets)
    }

    /// Places inputs and outputs, each kind one after the other.
    fn outside(&mut self, graph: &Graph, cameras: usize, life: Range<usize>) -> Result<()> {
        for (id, tensor) in graph.ids().zip(&graph.tensors) {
            let (region, end) = match tensor.scope {
                Scope::Input => (Region::Input, &mut self.input),
                Scope::Output => (Region::Output, &mut self.output),
                Scope::Inner => continue,
            };
            let start = *end;
            *end = start.checked_add(padded_bytes(graph, id, cameras)?).ok_or_else(too_large)?;
            let place = Place { region, bytes: start..*end };
            self.places[id.0] = place.clone();
            self.lines.push(Line { name: tensor.name.clone(), place, life: life.clone() });
        }
        Ok(())
    }

    /// Every block of the arena that holds tensors. Tensors that are overwritten in place share one.
    fn blocks(&mut self, graph: &Graph, cameras: usize) -> Result<Vec<Block>> {
        let mut block_of: Vec<Option<usize>> = vec![None; graph.tensors.len()];
        let mut blocks: Vec<Block> = vec![];
        for (index, operation) in graph.operations.iter().enumerate() {
            let first = block_of[operation.output().0].is_none();
            if first && self.replaced[index].is_none() {
                self.replaced[index] = inherits(graph, index);
            }
            for tensor in operation.reads().chain(operation.outputs.iter().copied()) {
                if let Some(block) = block_of[tensor.0] {
                    blocks[block].life.end = blocks[block].life.end.max(index + 1);
                }
            }
            for (i, &output) in operation.outputs.iter().enumerate() {
                let tensor = graph.tensor(output);
                if tensor.scope != Scope::Inner || block_of[output.0].is_some() {
                    continue;
                }
                let heir = self.replaced[index].filter(|_| i == 0).and_then(|t| block_of[t.0]);
                let block = heir.unwrap_or_else(|| {
                    let name = if i == 0 { &operation.name } else { &tensor.name };
                    blocks.push(Block { name: name.clone(), len: 0, life: index..index + 1, tensors: vec![] });
                    blocks.len() - 1
                });
                let Block { len, life, tensors, .. } = &mut blocks[block];
                *len = (*len).max(padded_bytes(graph, output, cameras)?);
                life.end = life.end.max(index + 1);
                tensors.push(output);
                block_of[output.0] = Some(block);
                if tensor.lifetime == Lifetime::Camera {
                    *life = 0..graph.operations.len();
                }
            }
        }
        Ok(blocks)
    }

    /// Where the tensor lies; all cameras' copies one after the other where each has its own.
    pub fn place(&self, tensor: TensorId) -> Place {
        self.places[tensor.0].clone()
    }

    /// The tensor that the first output of operation `index` overwrites: an input that it works on in place, or the
    /// residual that its chains start from.
    pub fn replaced(&self, index: usize) -> Option<TensorId> {
        self.replaced[index]
    }

    /// Scratch of worker `worker`, in bytes of the arena.
    pub fn scratch(&self, worker: usize) -> Range<usize> {
        self.scratch[worker].clone()
    }

    /// Threads that were planned for.
    pub fn workers(&self) -> usize {
        self.scratch.len()
    }

    /// Bytes of a region; of one set of outputs.
    pub fn bytes(&self, region: Region) -> usize {
        match region {
            Region::Input => self.input,
            Region::Arena => self.arena,
            Region::Output => self.output,
        }
    }

    /// Bytes that the plan itself takes from the allocator.
    pub(crate) fn heap_bytes(&self) -> usize {
        let names: usize = self.lines.iter().map(|line| line.name.capacity()).sum();
        self.places.capacity() * size_of::<Place>()
            + self.replaced.capacity() * size_of::<Option<TensorId>>()
            + self.scratch.capacity() * size_of::<Range<usize>>()
            + self.lines.capacity() * size_of::<Line>()
            + names
    }
}

/// One line per block: offset, length, lifetime, name; inputs and outputs at the end.
impl fmt::Display for Plan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "arena {} bytes", self.arena)?;
        for Line { name, place: Place { region, bytes }, life } in &self.lines {
            write!(f, "{:>12} +{:<12} ", bytes.start, bytes.len())?;
            match region {
                Region::Arena => writeln!(f, "operations {:>3}..{:<3} {name}", life.start, life.end)?,
                Region::Input => writeln!(f, "input  of the graph  {name}")?,
                Region::Output => writeln!(f, "output of the graph  {name}")?,
            }
        }
        Ok(())
    }
}

fn overlap(a: &Range<usize>, b: &Range<usize>) -> bool {
    a.start < b.end && b.start < a.end
}

fn too_large() -> Error {
    Error::new(ErrorKind::TooLarge, "the network needs more memory than can be addressed")
}

/// Bytes of all copies of a tensor, padded to whole cache lines.
fn padded_bytes(graph: &Graph, tensor: TensorId, cameras: usize) -> Result<usize> {
    let t = graph.tensor(tensor);
    t.extent
        .iter()
        .chain([&t.channels, &t.copies(cameras), &t.element.bytes()])
        .try_fold(1usize, |product, &v| product.checked_mul(v))
        .filter(|&len| len < isize::MAX as usize / 16)
        .map(|len| len.next_multiple_of(ALIGNMENT))
        .ok_or_else(too_large)
}

/// The residual that operation `index` may overwrite: its chains start from it, and nothing reads it later.
fn inherits(graph: &Graph, index: usize) -> Option<TensorId> {
    let operation = &graph.operations[index];
    let residual = operation.residual.filter(|r| !r.after)?;
    let able = operation.op.description().overwrites_residual();
    let dead = !graph.operations[index + 1..].iter().any(|o| o.reads().any(|t| t == residual.tensor));
    let read = operation.inputs.contains(&residual.tensor);
    let [from, to] = [residual.tensor, operation.output()].map(|id| graph.tensor(id));
    let same = from.bytes() == to.bytes() && from.scope == Scope::Inner && to.scope == Scope::Inner;
    (able && dead && !read && same).then_some(residual.tensor)
}

/// Bytes of scratch that the most demanding operation needs per worker, in whole cache lines.
fn scratch_bytes(graph: &Graph) -> usize {
    let need = graph.operations.iter().map(|o| o.op.description().scratch(&graph.site(o)));
    need.max().unwrap_or(0).next_multiple_of(ALIGNMENT)
}

//! The plan: where in the one arena each tensor lies, decided from lifetimes before anything runs.
//!
//! Two tensors may share memory when no operation needs both. Larger tensors are placed first, each at the lowest offset
//! where it meets no living neighbour ("greedy by size", Pisarchyk and Lee, arXiv 2001.03288); ties go to the tensor
//! that was made first, so a plan depends on nothing but the graph.

use crate::base::error::{Error, ErrorKind, Result};
use crate::graph::{Graph, Op, Scope, TensorId};
use crate::runtime::heap;
use std::fmt;
use std::ops::Range;
use voxcast_kernels::{LANES, head, product};

/// Offsets and lengths of every tensor in the arena, in f32. Offsets are multiples of 16 (64 bytes).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Plan {
    /// One per tensor of the graph; empty for tensors that nothing uses.
    places: Vec<Range<usize>>,
    /// Scratch of each worker.
    scratch: Vec<Range<usize>>,
    /// Length of the whole arena.
    len: usize,
    lines: Vec<Line>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct Line {
    name: String,
    place: Range<usize>,
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
    /// [`ErrorKind::TooLarge`] if the arena cannot be addressed.
    pub fn new(graph: &Graph, cameras: usize, workers: usize) -> Result<Self> {
        let mut blocks = blocks(graph, cameras)?;
        let scratch = scratch_len(graph)?;
        let everything = 0..graph.operations.len();
        for worker in 0..workers {
            let name = format!("scratch of worker {worker}");
            blocks.push(Block { name, len: scratch, life: everything.clone(), tensors: vec![] });
        }
        let mut order: Vec<usize> = (0..blocks.len()).collect();
        order.sort_by_key(|&i| (std::cmp::Reverse(blocks[i].len), i));
        let mut offsets = vec![0; blocks.len()];
        let mut placed: Vec<usize> = vec![];
        let mut len = 0usize;
        for i in order {
            let mut taken: Vec<Range<usize>> = placed
                .iter()
                .filter(|&&j| overlap(&blocks[i].life, &blocks[j].life))
                .map(|&j| offsets[j]..offsets[j] + blocks[j].len)
                .collect();
            taken.sort_by_key(|r| r.start);
            let mut at = 0;
            for r in taken {
                if at + blocks[i].len <= r.start {
                    break;
                }
                at = at.max(r.end);
            }
            offsets[i] = at;
            len = len.max(at.checked_add(blocks[i].len).ok_or_else(too_large)?);
            placed.push(i);
        }
        if len > isize::MAX as usize / size_of::<f32>() {
            return Err(too_large());
        }
        let mut places = vec![0..0; graph.tensors.len()];
        let mut lines = vec![];
        for (block, &offset) in blocks.iter().zip(&offsets) {
            for &TensorId(tensor) in &block.tensors {
                places[tensor] = offset..offset + block.len;
            }
            let place = offset..offset + block.len;
            lines.push(Line { name: block.name.clone(), place, life: block.life.clone() });
        }
        let first = blocks.len() - workers;
        let scratch = (first..blocks.len()).map(|i| offsets[i]..offsets[i] + blocks[i].len).collect();
        Ok(Self { places, scratch, len, lines })
    }

    /// Where the tensor lies; all cameras' places one after the other for features.
    pub fn place(&self, tensor: TensorId) -> Range<usize> {
        self.places[tensor.0].clone()
    }

    /// Scratch of worker `worker`.
    pub fn scratch(&self, worker: usize) -> Range<usize> {
        self.scratch[worker].clone()
    }

    /// Threads that were planned for.
    pub fn workers(&self) -> usize {
        self.scratch.len()
    }

    /// f32 in the arena.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there is nothing to place.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Bytes of the arena.
    pub fn bytes(&self) -> usize {
        self.len * size_of::<f32>()
    }

    /// Bytes that the plan itself holds beside its own.
    pub(crate) fn heap_bytes(&self) -> usize {
        let names: usize = self.lines.iter().map(|line| line.name.capacity()).sum();
        heap::vector(&self.places) + heap::vector(&self.scratch) + heap::vector(&self.lines) + names
    }
}

/// One line per block: offset, length, lifetime, name.
impl fmt::Display for Plan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "arena {} bytes", self.bytes())?;
        for line in &self.lines {
            writeln!(
                f,
                "{:>12} +{:<12} operations {:>3}..{:<3} {}",
                line.place.start * 4,
                line.place.len() * 4,
                line.life.start,
                line.life.end,
                line.name
            )?;
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

/// f32 of one tensor, padded to whole cache lines.
fn padded_len(graph: &Graph, tensor: TensorId, cameras: usize) -> Result<usize> {
    let t = graph.tensor(tensor);
    let copies = if t.scope == Scope::Features { cameras } else { 1 };
    t.extent
        .iter()
        .chain([&t.channels, &copies])
        .try_fold(1usize, |product, &v| product.checked_mul(v))
        .filter(|&len| len < isize::MAX as usize / 64)
        .map(|len| len.next_multiple_of(LANES))
        .ok_or_else(too_large)
}

/// Every block of memory. Tensors that are overwritten in place share one.
fn blocks(graph: &Graph, cameras: usize) -> Result<Vec<Block>> {
    let mut block_of: Vec<Option<usize>> = vec![None; graph.tensors.len()];
    let mut blocks: Vec<Block> = vec![];
    for (index, operation) in graph.operations.iter().enumerate() {
        for tensor in operation.reads() {
            if let Some(block) = block_of[tensor.0] {
                blocks[block].life.end = blocks[block].life.end.max(index + 1);
            }
        }
        if matches!(operation.op, Op::Head { .. }) {
            continue;
        }
        let output = operation.output;
        if let Some(block) = block_of[output.0] {
            blocks[block].life.end = blocks[block].life.end.max(index + 1);
            continue;
        }
        let heir = operation.in_place().or_else(|| inherits(graph, index)).and_then(|t| block_of[t.0]);
        let block = heir.unwrap_or_else(|| {
            blocks.push(Block { name: operation.name.clone(), len: 0, life: index..index + 1, tensors: vec![] });
            blocks.len() - 1
        });
        blocks[block].len = blocks[block].len.max(padded_len(graph, output, cameras)?);
        blocks[block].life.end = blocks[block].life.end.max(index + 1);
        blocks[block].tensors.push(output);
        block_of[output.0] = Some(block);
        if graph.tensor(output).scope == Scope::Features {
            blocks[block].life = 0..graph.operations.len();
        }
    }
    Ok(blocks)
}

/// The residual that operation `index` may overwrite: it starts the chain of the output at the same place, and nothing
/// reads it later.
fn inherits(graph: &Graph, index: usize) -> Option<TensorId> {
    let operation = &graph.operations[index];
    let residual = operation.residual.filter(|r| !r.after)?;
    let conv = matches!(operation.op, Op::Conv { .. } | Op::DeformConv { .. });
    let dead = !graph.operations[index + 1..].iter().any(|o| o.reads().any(|t| t == residual.tensor));
    let read = operation.inputs.contains(&residual.tensor);
    let same = graph.tensor(residual.tensor).len() == graph.tensor(operation.output).len();
    (conv && dead && !read && same).then_some(residual.tensor)
}

/// f32 of scratch that the most demanding operation needs per worker.
fn scratch_len(graph: &Graph) -> Result<usize> {
    let mut len = product::SCRATCH;
    for operation in &graph.operations {
        let x = operation.inputs.first().map(|&x| graph.tensor(x));
        let need = match (&operation.op, x) {
            (Op::Head { .. }, Some(x)) => head::scratch_len(x.channels, operation.channels),
            (Op::WindowAttention { shape }, _) => shape.scratch_len(),
            _ => 0,
        };
        len = len.max(need);
    }
    Ok(len.next_multiple_of(LANES))
}

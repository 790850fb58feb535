//! Results: what a frame writes and what a caller reads.

use super::CameraStatus;
use crate::base::digest;
use crate::graph::{Csr, Element, Graph, Scope};
use crate::network::Grid;
use crate::runtime::arena::Arena;
use crate::runtime::plan::{Plan, Region};
use std::ops::Range;
use voxcast_kernels::gather::Mask;

/// The result of a frame.
#[derive(Clone, Copy, Debug)]
pub struct Occupancy<'a> {
    /// Where the voxels are: the network's output grid, in the lidar's frame.
    pub grid: Grid,
    /// Class of each voxel, `[x, y, z]`, z fastest; 0 is empty.
    pub classes: &'a [u8],
    /// `[x, y, z, classes]`, if the session keeps them.
    pub logits: Option<&'a [f32]>,
    /// How sure the network is of each voxel, if the session was asked to say so.
    pub confidence: Option<Confidence<'a>>,
    /// How many feature pixels of level 1 each voxel is seen by, `[x, y, z]`: the entries of its row of the volume's
    /// matrix, masked cameras left out, at most 65535. All voxels within one of level 1 share its number. Where it is 0,
    /// no camera sees the place, and the class is a guess from the surroundings: not "free" but "unknown".
    pub support: &'a [u16],
    /// The cameras' part in this result.
    pub cameras: &'a [CameraStatus],
}

/// How sure a network is: probabilities from 0 to 1 as codes from 0 to 255, `[x, y, z]` each, by a softmax of the logits over
/// the model's [temperature](crate::Model::temperature). How far they can be trusted is what `eval --calibration` measures.
/// The same on every machine. Where a logit is NaN or the largest is infinite, both are 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Confidence<'a> {
    /// The probability that the voxel is occupied: that its class is any but 0.
    pub occupied: &'a [u8],
    /// The probability of the voxel's class, which may be 0.
    pub class: &'a [u8],
}

impl Occupancy<'_> {
    /// XXH3-64 of the classes, by which results are compared at a glance. The same on every machine.
    pub fn digest(&self) -> u64 {
        digest::bytes(self.classes)
    }

    /// [`digest::floats`] of the logits, if the session keeps them. The same on every machine.
    pub fn logits_digest(&self) -> Option<u64> {
        self.logits.map(digest::floats)
    }

    /// Bytes that [`Occupancy::write_bits`] fills.
    pub fn bits_len(&self) -> usize {
        self.classes.len().div_ceil(8)
    }

    /// Writes one bit per voxel, in the order of the classes, the first in the lowest bit: whether the class is not 0.
    /// Bits after the last voxel are 0. NumPy reads it with `unpackbits(..., bitorder="little")`.
    ///
    /// # Panics
    /// If `out` is not [`Occupancy::bits_len`] long.
    pub fn write_bits(&self, out: &mut [u8]) {
        assert_eq!(out.len(), self.bits_len(), "bytes for one bit per voxel");
        out.iter_mut().zip(self.bits()).for_each(|(out, byte)| *out = byte);
    }

    /// What [`Occupancy::write_bits`] writes.
    pub(crate) fn bits(&self) -> impl Iterator<Item = u8> {
        let byte = |classes: &[u8]| classes.iter().rev().fold(0, |bits, &class| bits << 1 | u8::from(class != 0));
        self.classes.chunks(8).map(byte)
    }
}

/// A result that has left its session ([`Session::take`](super::Session::take)).
pub struct OwnedOccupancy {
    grid: Grid,
    output: Output,
}

impl std::fmt::Debug for OwnedOccupancy {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("OwnedOccupancy").field("grid", &self.grid.size).finish_non_exhaustive()
    }
}

impl OwnedOccupancy {
    pub(super) fn new(grid: Grid, output: Output) -> Self {
        Self { grid, output }
    }

    /// The result.
    pub fn view(&self) -> Occupancy<'_> {
        self.output.occupancy(self.grid)
    }

    /// The memory, for another result. What the support was counted for is forgotten: it may have been another session's.
    pub(super) fn into_output(self) -> Output {
        Output { visibility: 0, ..self.output }
    }
}

/// One result. A session has two: the last complete one, and the one that is being written.
pub(super) struct Output {
    /// The graph's outputs.
    memory: Arena,
    /// Bytes of the classes in it.
    classes: Range<usize>,
    /// Bytes of the logits of level 0 in it, if the graph has them.
    logits: Option<Range<usize>>,
    /// Bytes of the codes of "occupied" and of the class, if the graph has them.
    confidence: Option<[Range<usize>; 2]>,
    pub(super) support: Vec<u16>,
    pub(super) cameras: Vec<CameraStatus>,
    /// The rig and mask that `support` was counted for, by number.
    visibility: u64,
}

impl Output {
    /// Zeros, unless the system has no memory for them.
    pub(super) fn new(graph: &Graph, plan: &Plan, cameras: usize) -> Option<Self> {
        let places = |element| {
            let outputs = graph.ids().zip(&graph.tensors).filter(move |(_, t)| t.scope == Scope::Output);
            outputs.filter(move |(_, t)| t.element == element).map(|(id, tensor)| {
                let start = plan.place(id).bytes.start;
                start..start + tensor.bytes()
            })
        };
        let mut codes = places(Element::U8);
        let classes = codes.next()?;
        Some(Self {
            memory: Arena::new(plan.bytes(Region::Output))?,
            classes,
            logits: places(Element::F32).next(),
            confidence: codes.next().zip(codes.next()).map(|(occupied, class)| [occupied, class]),
            support: zeros(voxels(graph))?,
            cameras: zeros(cameras)?,
            visibility: 0,
        })
    }

    /// As much memory as `other` has, zeros, unless the system has none.
    pub(super) fn like(other: &Self) -> Option<Self> {
        Some(Self {
            memory: Arena::new(other.memory.len())?,
            classes: other.classes.clone(),
            logits: other.logits.clone(),
            confidence: other.confidence.clone(),
            support: zeros(other.support.len())?,
            cameras: zeros(other.cameras.len())?,
            visibility: 0,
        })
    }

    /// Whether it has as much memory as `other`, laid out the same.
    pub(super) fn fits(&self, other: &Self) -> bool {
        let lengths = |o: &Self| [o.memory.len(), o.support.len(), o.cameras.len()];
        let places = |o: &Self| (o.classes.clone(), o.logits.clone(), o.confidence.clone());
        lengths(self) == lengths(other) && places(self) == places(other)
    }

    /// Bytes that [`Output::new`] takes, unless they cannot be counted.
    pub(super) fn bytes_for(graph: &Graph, plan: &Plan, cameras: usize) -> Option<usize> {
        let parts = [
            Some(plan.bytes(Region::Output)),
            voxels(graph).checked_mul(size_of::<u16>()),
            cameras.checked_mul(size_of::<CameraStatus>()),
        ];
        parts.into_iter().try_fold(0usize, |sum, part| sum.checked_add(part?))
    }

    /// Bytes held.
    pub(super) fn bytes(&self) -> usize {
        self.memory.len() + size_of_val(&self.support[..]) + size_of_val(&self.cameras[..])
    }

    /// Where the graph's outputs are written.
    pub(super) fn memory_mut(&mut self) -> &mut Arena {
        &mut self.memory
    }

    /// Whether there are logits.
    #[cfg(feature = "capi")]
    pub(super) fn has_logits(&self) -> bool {
        self.logits.is_some()
    }

    /// Whether it is known how sure the network is.
    #[cfg(feature = "capi")]
    pub(super) fn has_confidence(&self) -> bool {
        self.confidence.is_some()
    }

    /// The result, whose voxels are those of `grid`.
    pub(super) fn occupancy(&self, grid: Grid) -> Occupancy<'_> {
        let bytes = self.memory.bytes();
        Occupancy {
            grid,
            classes: &bytes[self.classes.clone()],
            logits: self.logits.clone().map(|logits| bytemuck::cast_slice(&bytes[logits])),
            confidence: self.confidence.clone().map(|codes| {
                let [occupied, class] = codes.map(|codes| &bytes[codes]);
                Confidence { occupied, class }
            }),
            support: &self.support,
            cameras: &self.cameras,
        }
    }

    /// Counts each voxel's pixels, unless `visibility` says that they are counted already.
    pub(super) fn count_support(
        &mut self,
        visibility: u64,
        volume: Csr<'_>,
        mask: Option<Mask<'_>>,
        coarse: [usize; 3],
        grid: [usize; 3],
    ) {
        if std::mem::replace(&mut self.visibility, visibility) != visibility {
            count_support(&mut self.support, volume, mask, coarse, grid);
        }
    }
}

/// Counts the pixels of each voxel of `grid`. `volume` is the matrix of level 1, of `coarse` voxels, each of which holds a
/// whole number of the voxels of `grid`.
fn count_support(support: &mut [u16], volume: Csr<'_>, mask: Option<Mask<'_>>, coarse: [usize; 3], grid: [usize; 3]) {
    let [ratio_x, ratio_y, ratio_z] = std::array::from_fn(|a| grid[a] / coarse[a]);
    let (line, plane) = (grid[2], grid[1] * grid[2]);
    for (x, plane) in support.chunks_exact_mut(plane).enumerate() {
        for (y, line) in plane.chunks_exact_mut(line).enumerate() {
            let first = (x / ratio_x * coarse[1] + y / ratio_y) * coarse[2];
            for (voxels, row) in line.chunks_exact_mut(ratio_z).zip(first..) {
                let cols = &volume.col[volume.ptr[row] as usize..volume.ptr[row + 1] as usize];
                let count = mask.map_or(cols.len(), |mask| mask.kept(cols).columns());
                voxels.fill(u16::try_from(count).unwrap_or(u16::MAX));
            }
        }
    }
}

/// Voxels of a result.
fn voxels(graph: &Graph) -> usize {
    Grid::of(&graph.network).voxels()
}

/// `len` zeros, unless the system has no memory for them.
pub(super) fn zeros<T: Clone + Default>(len: usize) -> Option<Vec<T>> {
    let mut zeros = Vec::new();
    zeros.try_reserve_exact(len).ok()?;
    zeros.resize(len, T::default());
    Some(zeros)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::graph::Results;
    use crate::network::Network;

    #[test]
    fn bits_by_hand() {
        let classes = [0, 1, 0, 0, 18, 0, 0, 7, 0, 255, 0];
        let grid = Grid::new([11, 1, 1], [[0.0, 1.0]; 3]);
        let occupancy =
            Occupancy { grid, classes: &classes, logits: None, confidence: None, support: &[0; 11], cameras: &[] };
        let mut bits = [0xff; 2];
        occupancy.write_bits(&mut bits);
        assert_eq!((occupancy.bits_len(), bits), (2, [0b1001_0010, 0b10]));
    }

    #[test]
    fn support_by_hand() {
        // Two coarse voxels along y of 2x2x2 voxels each; three columns, of which camera 1 has two.
        let volume = Csr { ptr: &[0, 1, 3], col: &[2, 11, 12] };
        let (coarse, grid) = ([1, 2, 1], [2, 4, 2]);
        let mut support = [9; 16];
        count_support(&mut support, volume, None, coarse, grid);
        assert_eq!(support, [1, 1, 1, 1, 2, 2, 2, 2, 1, 1, 1, 1, 2, 2, 2, 2]);
        let mask = Mask { pixels: 10, masked: &[false, true] };
        count_support(&mut support, volume, Some(mask), coarse, grid);
        assert_eq!(support, [1, 1, 1, 1, 0, 0, 0, 0, 1, 1, 1, 1, 0, 0, 0, 0]);
        let many: Vec<u32> = (0..70_000).collect();
        count_support(&mut support, Csr { ptr: &[0, 70_000, 70_000], col: &many }, None, coarse, grid);
        assert_eq!(support[..8], [65_535, 65_535, 65_535, 65_535, 0, 0, 0, 0]);
    }

    #[test]
    fn support_is_counted_when_rig_or_mask_change() {
        let network = Network {
            image: [32, 32],
            grids: [[4, 4, 4], [2, 2, 2], [1, 1, 1]],
            ..Network::built_in("nuscenes-200").expect("built in")
        };
        let graph = Graph::build(&network, Results { logits: true, ..Results::default() });
        let plan = Plan::new(&graph, 2, 1).expect("small");
        let mut output = Output::new(&graph, &plan, 2).expect("small");
        assert_eq!(Some(output.bytes()), Output::bytes_for(&graph, &plan, 2));
        let result = output.occupancy(Grid::of(&network));
        assert_eq!((result.classes.len(), result.logits.map(<[f32]>::len)), (512, Some(512 * 17)));
        let ptr: Vec<u32> = (0..=64).collect();
        let one = Csr { ptr: &ptr, col: &[0; 64] };
        output.count_support(1, one, None, [4; 3], [8; 3]);
        assert_eq!(output.support, [1; 512]);
        let none = Csr { ptr: &[0; 65], col: &[] };
        output.count_support(1, none, None, [4; 3], [8; 3]);
        assert_eq!(output.support, [1; 512], "counted already");
        output.count_support(2, none, None, [4; 3], [8; 3]);
        assert_eq!(output.support, [0; 512]);
    }

    #[test]
    fn impossible_sizes_are_refused() {
        assert!(zeros::<u32>(usize::MAX / 8).is_none());
        assert_eq!(zeros::<u8>(3), Some(vec![0; 3]));
    }
}

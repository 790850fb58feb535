//! Results: what a frame writes and what a caller reads.

use super::CameraStatus;
use crate::base::digest;
use crate::rig::Csr;
use voxcast_kernels::gather::Mask;

/// The result of a frame.
#[derive(Clone, Copy, Debug)]
pub struct Occupancy<'a> {
    /// Voxels along x, y, z.
    pub grid: [usize; 3],
    /// Class of each voxel, `[x, y, z]`, z fastest; 0 is empty.
    pub classes: &'a [u8],
    /// `[x, y, z, classes]`, if the session keeps them.
    pub logits: Option<&'a [f32]>,
    /// How many feature pixels of level 1 each voxel is seen by, `[x, y, z]`: the entries of its row of the volume's
    /// matrix, masked cameras left out, at most 65535. All voxels within one of level 1 share its number. Where it is 0,
    /// no camera sees the place, and the class is a guess from the surroundings: not "free" but "unknown".
    pub support: &'a [u16],
    /// The cameras' part in this result.
    pub cameras: &'a [CameraStatus],
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
#[derive(Debug)]
pub struct OwnedOccupancy {
    grid: [usize; 3],
    output: Output,
    keep_logits: bool,
}

impl OwnedOccupancy {
    pub(super) fn new(grid: [usize; 3], output: Output, keep_logits: bool) -> Self {
        Self { grid, output, keep_logits }
    }

    /// The result.
    pub fn view(&self) -> Occupancy<'_> {
        let Output { classes, logits, support, cameras, .. } = &self.output;
        let logits = self.keep_logits.then_some(&logits[..]);
        Occupancy { grid: self.grid, classes, logits, support, cameras }
    }

    pub(super) fn into_output(self) -> Output {
        self.output
    }
}

/// The memory of one result. A session has two: the last complete one, and the one that is being written.
#[derive(Debug)]
pub(super) struct Output {
    pub(super) classes: Vec<u8>,
    /// Logits of level 0, or of the coarse head that wrote last; empty if nobody wants any.
    pub(super) logits: Vec<f32>,
    pub(super) support: Vec<u16>,
    pub(super) cameras: Vec<CameraStatus>,
    /// The rig and mask that `support` was counted for, by number.
    sight: u64,
}

impl Output {
    /// Zeros, unless the system has no memory for them.
    pub(super) fn new(voxels: usize, logits: usize, cameras: usize) -> Option<Self> {
        Some(Self {
            classes: zeros(voxels)?,
            logits: zeros(logits)?,
            support: zeros(voxels)?,
            cameras: zeros(cameras)?,
            sight: 0,
        })
    }

    /// As much memory as `other` has, zeros, unless the system has none.
    pub(super) fn like(other: &Self) -> Option<Self> {
        Self::new(other.classes.len(), other.logits.len(), other.cameras.len())
    }

    /// Whether it has as much memory as `other`.
    pub(super) fn fits(&self, other: &Self) -> bool {
        let lengths = |o: &Self| [o.classes.len(), o.logits.len(), o.support.len(), o.cameras.len()];
        lengths(self) == lengths(other)
    }

    /// Bytes that [`Output::new`] takes, unless they cannot be counted.
    pub(super) fn bytes_for(voxels: usize, logits: usize, cameras: usize) -> Option<usize> {
        let parts = [
            Some(voxels),
            voxels.checked_mul(size_of::<u16>()),
            logits.checked_mul(size_of::<f32>()),
            cameras.checked_mul(size_of::<CameraStatus>()),
        ];
        parts.into_iter().try_fold(0usize, |sum, part| sum.checked_add(part?))
    }

    /// Bytes held.
    pub(super) fn bytes(&self) -> usize {
        size_of_val(&self.classes[..])
            + size_of_val(&self.logits[..])
            + size_of_val(&self.support[..])
            + size_of_val(&self.cameras[..])
    }

    /// Counts each voxel's pixels, unless `sight` says that they are counted already. `volume` is level 1's, of `coarse`
    /// voxels, each of which holds a whole number of the voxels of `grid`.
    pub(super) fn count_support(
        &mut self,
        sight: u64,
        volume: Csr<'_>,
        mask: Option<Mask<'_>>,
        coarse: [usize; 3],
        grid: [usize; 3],
    ) {
        if std::mem::replace(&mut self.sight, sight) == sight {
            return;
        }
        let [ratio_x, ratio_y, ratio_z] = std::array::from_fn(|a| grid[a] / coarse[a]);
        let (line, plane) = (grid[2], grid[1] * grid[2]);
        for (x, plane) in self.support.chunks_exact_mut(plane).enumerate() {
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

    #[test]
    fn bits_by_hand() {
        let classes = [0, 1, 0, 0, 18, 0, 0, 7, 0, 255, 0];
        let occupancy =
            Occupancy { grid: [11, 1, 1], classes: &classes, logits: None, support: &[0; 11], cameras: &[] };
        let mut bits = [0xff; 2];
        occupancy.write_bits(&mut bits);
        assert_eq!((occupancy.bits_len(), bits), (2, [0b1001_0010, 0b10]));
    }

    #[test]
    fn support_by_hand() {
        // Two coarse voxels along y of 2x2x2 voxels each; three columns, of which camera 1 has two.
        let volume = Csr { ptr: &[0, 1, 3], col: &[2, 11, 12] };
        let mut output = Output::new(16, 0, 2).expect("small");
        output.count_support(1, volume, None, [1, 2, 1], [2, 4, 2]);
        assert_eq!(output.support, [1, 1, 1, 1, 2, 2, 2, 2, 1, 1, 1, 1, 2, 2, 2, 2]);
        let mask = Mask { pixels: 10, masked: &[false, true] };
        output.count_support(1, volume, Some(mask), [1, 2, 1], [2, 4, 2]);
        assert_eq!(output.support[7], 2, "counted already");
        output.count_support(2, volume, Some(mask), [1, 2, 1], [2, 4, 2]);
        assert_eq!(output.support, [1, 1, 1, 1, 0, 0, 0, 0, 1, 1, 1, 1, 0, 0, 0, 0]);
        assert_eq!(output.bytes(), Output::bytes_for(16, 0, 2).expect("small"));
        let many: Vec<u32> = (0..70_000).collect();
        output.count_support(3, Csr { ptr: &[0, 70_000, 70_000], col: &many }, None, [1, 2, 1], [2, 4, 2]);
        assert_eq!(output.support[..8], [65_535, 65_535, 65_535, 65_535, 0, 0, 0, 0]);
    }

    #[test]
    fn impossible_sizes_are_refused() {
        assert!(zeros::<u32>(usize::MAX / 8).is_none());
        assert_eq!(zeros::<u8>(3), Some(vec![0; 3]));
        assert!(Output::bytes_for(usize::MAX / 2, 0, 0).is_none());
        assert!(Output::bytes_for(8, usize::MAX / 2, 0).is_none());
    }
}

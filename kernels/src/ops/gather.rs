//! Mean of camera features per voxel or bird's-eye-view cell: a 0/1 sparse matrix in compressed rows times features.
//!
//! ```text
//! sum[c]    = x[col[ptr[r]]][c] + x[col[ptr[r] + 1]][c] + ...          ascending, starting from 0
//! out[r][c] = end(sum[c] / max(1, entries of r))                        end: + bias[c], ReLU; both optional
//! ```
//!
//! A [`Mask`] leaves out the pixels of some cameras: sum and count are then those of a matrix without their entries.
//!
//! Channels are the vector axis: a feature pixel is one contiguous piece of memory, and a row's sum stays in registers
//! while its pixels stream by. That all pixels of a row exist is checked before, so that nothing else is done meanwhile.

use crate::isa::Isa;
use crate::simd::{Kernel, LANES, Simd, dispatch, relu};
use core::ops::Range;

/// Vectors summed at once: 64 channels, eight AVX2 registers, sixteen of NEON.
const VECTORS: usize = 4;

/// Cameras whose pixels count as if the matrix did not name them.
#[derive(Clone, Copy, Debug)]
pub struct Mask<'a> {
    /// Feature pixels of one camera; those of camera i are `i * pixels..(i + 1) * pixels`.
    pub pixels: usize,
    /// Whether each camera is left out.
    pub masked: &'a [bool],
}

impl<'a> Mask<'a> {
    /// The ascending columns `cols` of a row without those of masked cameras, as runs in order.
    ///
    /// # Panics
    /// The iterator, if a column is not a pixel of one of the cameras.
    pub fn kept(self, cols: &'a [u32]) -> Kept<'a> {
        Kept { mask: Some(self), rest: cols }
    }
}

/// Runs of a row's columns. See [`Mask::kept`].
#[derive(Clone, Debug)]
pub struct Kept<'a> {
    mask: Option<Mask<'a>>,
    rest: &'a [u32],
}

impl Kept<'_> {
    /// Columns in all runs.
    pub fn columns(self) -> usize {
        self.map(<[u32]>::len).sum()
    }
}

impl<'a> Iterator for Kept<'a> {
    type Item = &'a [u32];

    #[inline]
    fn next(&mut self) -> Option<&'a [u32]> {
        let Some(Mask { pixels, masked }) = self.mask else {
            let all = core::mem::take(&mut self.rest);
            return (!all.is_empty()).then_some(all);
        };
        while let Some(&first) = self.rest.first() {
            let camera = first as usize / pixels;
            let alike = masked[camera..].iter().take_while(|&&m| m == masked[camera]).count();
            let end = (camera + alike) * pixels;
            // At least one, so that columns that do not ascend cannot hold this up.
            let len = self.rest.partition_point(|&col| (col as usize) < end).max(1);
            let (run, rest) = self.rest.split_at(len);
            self.rest = rest;
            if !masked[camera] {
                return Some(run);
            }
        }
        None
    }
}

/// A gather's arguments.
#[derive(Clone, Copy, Debug)]
pub struct Gather<'a, T = f32, B = f32> {
    /// `rows + 1` ascending offsets into `col`.
    pub ptr: &'a [u32],
    /// Feature pixel of each entry, below `features.len() / stride`; ascending within a row if there is a mask.
    pub col: &'a [u32],
    /// Cameras to leave out.
    pub mask: Option<Mask<'a>>,
    /// Feature pixels, `stride` values apart.
    pub features: &'a [T],
    /// Distance between feature pixels.
    pub stride: usize,
    /// First channel that is gathered.
    pub first_channel: usize,
    /// Channels that are gathered.
    pub channels: usize,
    /// Added to the mean, one value per channel.
    pub bias: Option<&'a [B]>,
    /// Whether negative results become 0.
    pub relu: bool,
}

/// Gathers the rows `rows` into `out`, which holds exactly those, densely.
///
/// # Panics
/// If `ptr`, `col` or a slice's size breaks the rules of [`Gather`].
///
/// # Determinism
/// The same bits on every instruction set and for every division into rows.
pub fn gather(isa: Isa, args: &Gather<'_>, rows: Range<usize>, out: &mut [f32]) {
    args.check(&rows, out);
    dispatch(isa, Run { args, rows, out });
}

struct Run<'a> {
    args: &'a Gather<'a>,
    rows: Range<usize>,
    out: &'a mut [f32],
}

impl<T, B> Gather<'_, T, B> {
    /// Checks everything but the entries of `ptr` and `col`.
    pub(super) fn check(&self, rows: &Range<usize>, out: &[T]) {
        let behind = self.stride.checked_sub(self.first_channel);
        assert!(behind.is_some_and(|c| c >= self.channels), "channels out of range");
        assert!(u32::try_from(self.stride).is_ok(), "the stride is out of range");
        let total = self.ptr.len().saturating_sub(1);
        assert!(rows.start <= rows.end && rows.end <= total, "rows {rows:?} of {total}");
        assert_eq!(out.len(), rows.len() * self.channels, "the output does not hold the rows");
        assert!(self.bias.is_none_or(|b| b.len() >= self.channels), "the bias is shorter than the channels");
    }

    /// The entries of a row that no mask leaves out.
    pub(super) fn row(&self, row: usize) -> Kept<'_> {
        Kept { mask: self.mask, rest: &self.col[self.ptr[row] as usize..self.ptr[row + 1] as usize] }
    }

    /// Where gathered channel `channel` of pixel `col` is among the features. An offset that no slice has where this is
    /// beyond the address space; 64 bits hold it, because neither a pixel nor the stride exceeds 32.
    #[inline(always)]
    pub(super) fn offset(&self, col: u32, channel: usize) -> usize {
        let offset = u64::from(col) * self.stride as u64 + (self.first_channel + channel) as u64;
        usize::try_from(offset).unwrap_or(usize::MAX)
    }

    /// Checks that the pixels `cols` exist.
    ///
    /// # Panics
    /// If one does not.
    #[inline(always)]
    pub(super) fn check_pixels(&self, cols: &[u32]) {
        if let Some(last) = cols.iter().copied().max() {
            let end = self.offset(last, 0).saturating_add(self.channels);
            assert!(end <= self.features.len(), "pixel {last} is out of range");
        }
    }
}

impl Kernel for Run<'_> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        let a = self.args;
        for (row, out) in self.rows.zip(self.out.chunks_exact_mut(a.channels.max(1))) {
            let row = a.row(row);
            row.clone().for_each(|cols| a.check_pixels(cols));
            for (c, out) in out.iter_mut().enumerate() {
                let mut sum = 0.0;
                for &col in row.clone().flatten() {
                    sum += a.features[a.offset(col, c)];
                }
                *out = sum / row.clone().columns().max(1) as f32;
                if let Some(bias) = a.bias {
                    *out += bias[c];
                }
                if a.relu {
                    *out = relu(*out);
                }
            }
        }
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let a = self.args;
        for (row, out) in self.rows.zip(self.out.chunks_exact_mut(a.channels.max(1))) {
            let row = a.row(row);
            row.clone().for_each(|cols| a.check_pixels(cols));
            let count = s.splat(row.clone().columns().max(1) as f32);
            let mut channel = 0;
            while channel < a.channels {
                let left = a.channels - channel;
                let out = &mut out[channel..];
                if left >= VECTORS * LANES {
                    let mut sums = [s.splat(0.0); VECTORS];
                    for cols in row.clone() {
                        for &col in cols {
                            for v in 0..VECTORS {
                                // SAFETY: this pixel exists, and with it all channels that are gathered, of which
                                // these are some.
                                let x =
                                    unsafe { s.load_ptr(a.features.as_ptr().add(a.offset(col, channel + v * LANES))) };
                                sums[v] = s.add(sums[v], x);
                            }
                        }
                    }
                    for v in 0..VECTORS {
                        let at = v * LANES;
                        finish(s, a, channel + at, count, sums[v], &mut out[at..at + LANES]);
                    }
                    channel += VECTORS * LANES;
                } else {
                    let width = left.min(LANES);
                    let mut sum = s.splat(0.0);
                    for cols in row.clone() {
                        for &col in cols {
                            sum = s.add(sum, s.load_part(&a.features[a.offset(col, channel)..][..width]));
                        }
                    }
                    finish(s, a, channel, count, sum, &mut out[..width]);
                    channel += width;
                }
            }
        }
    }
}

/// Divides, adds the bias, applies ReLU and stores up to 16 channels.
#[inline(always)]
fn finish<S: Simd>(s: S, a: &Gather<'_>, channel: usize, count: S::V, sum: S::V, out: &mut [f32]) {
    let mut value = s.div(sum, count);
    if let Some(bias) = a.bias {
        value = s.add(value, s.load_part(&bias[channel..channel + out.len()]));
    }
    if a.relu {
        value = s.relu(value);
    }
    s.store_part(out, value);
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests;

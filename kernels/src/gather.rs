//! Mean of camera features per voxel or bird's-eye-view cell: a 0/1 sparse matrix in compressed rows times features.
//!
//! ```text
//! sum[c]    = x[col[ptr[r]]][c] + x[col[ptr[r] + 1]][c] + ...          ascending, starting from 0
//! out[r][c] = end(sum[c] / max(1, ptr[r + 1] - ptr[r]))                 end: + bias[c], rectifier; both optional
//! ```
//!
//! Channels are the vector axis: a feature pixel is one contiguous piece of memory, and a row's sum stays in registers
//! while its pixels stream by. The next row's first pixels are named to the cache while the current row is summed.

use crate::isa::Isa;
use crate::simd::{Kernel, LANES, Simd, dispatch, relu};
use std::ops::Range;

/// Vectors summed at once: 64 channels, eight AVX2 registers.
const VECTORS: usize = 4;

/// A gather's arguments.
#[derive(Clone, Copy, Debug)]
pub struct Gather<'a> {
    /// `rows + 1` ascending offsets into `col`.
    pub ptr: &'a [u32],
    /// Feature pixel of each entry, below `features.len() / stride`.
    pub col: &'a [u32],
    /// Feature pixels, `stride` numbers apart.
    pub features: &'a [f32],
    /// Distance between feature pixels.
    pub stride: usize,
    /// First channel that is gathered.
    pub first_channel: usize,
    /// Channels that are gathered.
    pub channels: usize,
    /// Added to the mean, one number per channel.
    pub bias: Option<&'a [f32]>,
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
    assert!(args.first_channel + args.channels <= args.stride, "channels out of range");
    assert!(rows.end < args.ptr.len(), "rows out of range");
    assert_eq!(out.len(), rows.len() * args.channels, "the output does not hold the rows");
    assert!(args.bias.is_none_or(|b| b.len() >= args.channels), "the bias is shorter than the channels");
    dispatch(isa, Run { args, rows, out });
}

struct Run<'a> {
    args: &'a Gather<'a>,
    rows: Range<usize>,
    out: &'a mut [f32],
}

impl Gather<'_> {
    fn row(&self, row: usize) -> &[u32] {
        &self.col[self.ptr[row] as usize..self.ptr[row + 1] as usize]
    }

    #[inline(always)]
    fn pixel(&self, col: u32, channel: usize, len: usize) -> &[f32] {
        &self.features[col as usize * self.stride + self.first_channel + channel..][..len]
    }
}

impl Kernel for Run<'_> {
    type Output = ();

    fn reference(self) {
        let a = self.args;
        for (row, out) in self.rows.zip(self.out.chunks_exact_mut(a.channels)) {
            for (c, out) in out.iter_mut().enumerate() {
                let cols = a.row(row);
                let mut sum = 0.0;
                for &col in cols {
                    sum += a.pixel(col, c, 1)[0];
                }
                *out = sum / cols.len().max(1) as f32;
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
        for (row, out) in self.rows.zip(self.out.chunks_exact_mut(a.channels)) {
            let cols = a.row(row);
            let count = s.splat(cols.len().max(1) as f32);
            let mut channel = 0;
            while channel < a.channels {
                let left = a.channels - channel;
                let out = &mut out[channel..];
                if left >= VECTORS * LANES {
                    let mut sums = [s.splat(0.0); VECTORS];
                    for &col in cols {
                        let (pixel, _) = a.pixel(col, channel, VECTORS * LANES).as_chunks();
                        for v in 0..VECTORS {
                            sums[v] = s.add(sums[v], s.load(&pixel[v]));
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
                    for &col in cols {
                        sum = s.add(sum, s.load_part(a.pixel(col, channel, width)));
                    }
                    finish(s, a, channel, count, sum, &mut out[..width]);
                    channel += width;
                }
            }
        }
    }
}

/// Divides, adds the bias, rectifies and stores up to 16 channels.
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

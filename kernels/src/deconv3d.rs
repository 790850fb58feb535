//! Transposed convolution in three dimensions with kernel 4, stride 2, padding 1: it doubles every axis.
//!
//! An output of parity p (its index modulo 2) meets only two of the four taps per axis, so each of the eight parities is
//! a plain 2x2x2 convolution of the input with no padding but at the border, and every output is written once:
//!
//! ```text
//! out[2i + p] = end(bias + sum over taps t in {0, 1} per axis and c of x[i + t - 1 + p][c] * weight[3 - p - 2t][c])
//! ```
//!
//! k runs over (t_d, t_h, t_w, c) ascending. Weights are eight packed matrices of `8 * channels` rows, one after the
//! other, parity `(p_d * 2 + p_h) * 2 + p_w`; [`kernel_tap`] says which of the four taps each of their rows is.

use crate::conv::{Conv, Geometry};
use crate::isa::Isa;
use crate::panels::{Panels, packed_len};
use crate::product::{Product, Residual, Target, product};
use crate::simd::{Kernel, Simd, dispatch};
use std::ops::Range;

/// Index into the kernel's four taps of tap `tap` (0 or 1) of the sub-convolution for parity `parity`.
pub const fn kernel_tap(parity: usize, tap: usize) -> usize {
    3 - parity - 2 * tap
}

/// A transposed convolution's arguments.
#[derive(Clone, Copy, Debug)]
pub struct Deconv3d<'a> {
    /// Input extent; the output's is twice that on every axis.
    pub extent: [usize; 3],
    /// Input channels.
    pub channels: usize,
    /// Output channels.
    pub columns: usize,
    /// `[extent, channels]`.
    pub input: &'a [f32],
    /// The eight packed matrices.
    pub weights: Panels<'a>,
    /// One number per output channel, padded to a multiple of 16.
    pub bias: &'a [f32],
    /// Whether negative results become 0.
    pub relu: bool,
    /// `[2 * extent, columns]`, added after the rectifier.
    pub add: Option<&'a [f32]>,
}

/// Computes the planes `planes` of the output's first axis into `out`, which holds exactly those, densely. `scratch`
/// holds [`crate::product::SCRATCH`] numbers of any value.
///
/// # Panics
/// If a slice does not have the size that the shapes ask for.
///
/// # Determinism
/// The same bits on every instruction set and for every division into planes.
pub fn deconv3d(isa: Isa, args: &Deconv3d<'_>, planes: Range<usize>, out: &mut [f32], scratch: &mut [f32]) {
    let [d, h, w] = args.extent;
    let plane = 4 * h * w * args.columns;
    assert_eq!(args.weights.len(), 8 * args.parity_len(), "packed weights do not match the shape");
    assert!(planes.end <= 2 * d, "planes out of range");
    assert_eq!(out.len(), planes.len() * plane, "the output does not hold the planes");
    assert!(args.add.is_none_or(|a| a.len() == 2 * d * plane), "the added tensor has another shape");
    dispatch(isa, Run { args, planes, out, scratch });
}

impl<'a> Deconv3d<'a> {
    fn parity_len(&self) -> usize {
        packed_len(8 * self.channels, self.columns)
    }

    /// The sub-convolution of one parity.
    fn part(&self, parity: [usize; 3]) -> Conv<'a> {
        let index = (parity[0] * 2 + parity[1]) * 2 + parity[2];
        let range = index * self.parity_len()..(index + 1) * self.parity_len();
        let residual = match self.add {
            Some(rows) => Residual::After { rows, stride: self.columns },
            None => Residual::None,
        };
        let conv = Conv {
            geometry: Geometry {
                input: self.extent,
                channels: self.channels,
                kernel: [2; 3],
                stride: [1; 3],
                dilation: [1; 3],
                padding: parity.map(|p| 1 - p),
                output: self.extent,
            },
            input: self.input,
            product: Product {
                weights: match self.weights {
                    Panels::F32(w) => Panels::F32(&w[range]),
                    Panels::F16(w) => Panels::F16(&w[range]),
                },
                bias: self.bias,
                depth: 8 * self.channels,
                columns: self.columns,
                relu: self.relu,
                residual,
            },
        };
        conv.geometry.check(conv.input);
        conv.product.check();
        conv
    }
}

/// Rows of one input plane, as positions of one parity in one output plane.
struct Interleaved {
    extent: [usize; 3],
    columns: usize,
    parity: [usize; 3],
}

impl Interleaved {
    /// (row within the output plane, output plane)
    #[inline(always)]
    fn place(&self, row: usize) -> (usize, usize) {
        let [_, h, w] = self.extent;
        let (y, z) = (row / w % h * 2 + self.parity[1], row % w * 2 + self.parity[2]);
        (y * 2 * w + z, row / (h * w) * 2 + self.parity[0])
    }
}

impl Target for Interleaved {
    #[inline(always)]
    fn offset(&self, row: usize) -> usize {
        self.place(row).0 * self.columns
    }
    #[inline(always)]
    fn residual_row(&self, row: usize) -> usize {
        let (row, plane) = self.place(row);
        plane * 4 * self.extent[1] * self.extent[2] + row
    }
}

struct Run<'a> {
    args: &'a Deconv3d<'a>,
    planes: Range<usize>,
    out: &'a mut [f32],
    scratch: &'a mut [f32],
}

impl Run<'_> {
    /// Calls `part` with each sub-convolution, its input rows, its places, and the output plane.
    #[inline(always)]
    fn each(self, mut part: impl FnMut(&Conv<'_>, Range<usize>, &Interleaved, &mut [f32], &mut [f32])) {
        let args = self.args;
        let [_, h, w] = args.extent;
        for (x, out) in self.planes.zip(self.out.chunks_exact_mut((4 * h * w * args.columns).max(1))) {
            for yz in 0..4 {
                let parity = [x % 2, yz / 2, yz % 2];
                let target = Interleaved { extent: args.extent, columns: args.columns, parity };
                let rows = x / 2 * h * w..(x / 2 + 1) * h * w;
                part(&args.part(parity), rows, &target, out, self.scratch);
            }
        }
    }
}

impl Kernel for Run<'_> {
    type Output = ();

    fn reference(self) {
        self.each(|conv, rows, target, out, _| {
            for row in rows {
                for n in 0..conv.product.columns {
                    let residual_row = target.residual_row(row);
                    out[target.offset(row) + n] =
                        conv.product.reference(residual_row, n, 0.0, |k| conv.element(row, k));
                }
            }
        });
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        self.each(
            #[inline(always)]
            |conv, rows, target, out, scratch| product(s, &conv.product, conv, target, rows, out, scratch),
        );
    }
}

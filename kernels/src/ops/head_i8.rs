//! The [occupancy head](mod@crate::head) in 8 bits: three linear layers per voxel, ReLU after the first two, and the largest
//! class.
//!
//! ```text
//! a = clamp(requantise(max(W1 x + b1, 0), m1)),  b = clamp(requantise(max(W2 a + b2, 0), m2))               8 bits
//! sums = W3 b + b3,  class = first k with the largest sums[k],  logits = sums * scale                      32 bits, f32
//! ```
//!
//! All classes share one scale, so the largest sum is the largest logit; a logit is the nearest f32 to the sum, multiplied once.
//! Each layer is a product of [`crate::product::int8`]. A block of voxels goes through all three while it is in the cache.
//! Channels are a multiple of 4. Beside the classes, logits can be kept, and [how sure](crate::head::Confidence) the head is.

use crate::isa::Isa;
use crate::matmul::driver::{Linear, Source};
use crate::matmul::int8::{self, Narrow, Raw};
use crate::matmul::product::Multiply;
use crate::matmul::{BLOCK_ROWS, ProductI8, ResidualI8};
use crate::ops::head::{Confidence, Results, largest};
use crate::simd::{Kernel, LANES, Simd, dispatch};
use core::ops::Range;

/// The head's arguments.
#[derive(Clone, Copy, Debug)]
pub struct HeadI8<'a> {
    /// `[voxels, channels]`, -127..=127.
    pub input: &'a [i8],
    /// Whether elements of the input may be negative; else they are 0..=127.
    pub signed: bool,
    /// Channels of a voxel and of both hidden layers.
    pub channels: usize,
    /// Classes, at most 256.
    pub classes: usize,
    /// The three layers.
    pub layers: [LayerI8<'a>; 3],
    /// Multipliers of the hidden layers, padded to multiples of 16.
    pub multipliers: [&'a [i32]; 2],
    /// What one step of the last layer's sums is.
    pub scale: f32,
}

/// A layer's weights.
#[derive(Clone, Copy, Debug)]
pub struct LayerI8<'a> {
    /// Packed weights, as [`crate::product::int8::layout`] says.
    pub weights: &'a [i8],
    /// Their [`crate::product::int8::layout::sums`].
    pub sums: &'a [i32],
    /// Their [`crate::product::int8::layout::pairs`].
    pub pairs: &'a [u8],
    /// Bias in units of the sums, padded to a multiple of 16.
    pub bias: &'a [i32],
}

/// i32 of scratch that one call needs.
pub const fn scratch_len(channels: usize, classes: usize) -> usize {
    product_len(channels, classes) + BLOCK_ROWS * (2 * hidden_len(channels) + classes)
}

/// i32 of scratch of the largest of the products.
const fn product_len(channels: usize, classes: usize) -> usize {
    int8::scratch_len(channels, if channels > classes { channels } else { classes })
}

/// i32 that hold a voxel's hidden layer.
const fn hidden_len(channels: usize) -> usize {
    channels.div_ceil(size_of::<i32>())
}

/// Classifies the voxels `rows` into `results`.
///
/// # Panics
/// If a slice does not have the size that the shapes ask for, or the channels are no multiple of 4; those of
/// [`Confidence`]. `scratch` needs [`scratch_len`] values of any value.
///
/// # Determinism
/// The same bits on every instruction set and for every division into rows.
pub fn head_i8(isa: Isa, args: &HeadI8<'_>, rows: Range<usize>, results: Results<'_>, scratch: &mut [i32]) {
    results.check(rows.len(), args.classes);
    assert!(scratch.len() >= scratch_len(args.channels, args.classes), "the scratch is too small");
    (0..2).for_each(|layer| args.layer(layer).to::<Narrow>().check(rows.len(), scratch));
    args.layer(2).to::<Raw>().check(rows.len(), scratch);
    let held = rows.end.checked_mul(args.channels).is_some_and(|n| n <= args.input.len());
    assert!(rows.start <= rows.end && held, "rows {rows:?} are not in the input");
    dispatch(isa, Run { args, rows, results, scratch });
}

impl<'a> HeadI8<'a> {
    fn layer(&self, layer: usize) -> ProductI8<'a> {
        let LayerI8 { weights, sums, pairs, bias } = self.layers[layer];
        ProductI8 {
            weights,
            sums,
            pairs,
            bias,
            depth: self.channels,
            columns: if layer == 2 { self.classes } else { self.channels },
            signed: layer == 0 && self.signed,
            relu: layer < 2,
            residual: ResidualI8::None,
            // The last layer's sums stay as they are.
            multiplier: if layer == 2 { bias } else { self.multipliers[layer] },
        }
    }
}

/// Rows that lie in memory, densely.
struct Rows<'a> {
    data: &'a [i8],
    stride: usize,
}

impl Source for Rows<'_> {
    type Element = i8;
    type At = usize;
    type Part = usize;

    #[inline(always)]
    fn element(&self, row: usize, k: usize) -> i8 {
        self.data[row * self.stride + k]
    }
    #[inline(always)]
    fn at(&self, row: usize) -> usize {
        row
    }
    #[inline(always)]
    fn next(&self, row: usize) -> usize {
        row + 1
    }
    #[inline(always)]
    fn part(&self, k: usize) -> (usize, usize) {
        (k, self.stride - k)
    }
    #[inline(always)]
    fn piece<'a, S: Simd>(&'a self, _: S, row: usize, k: usize, spare: &'a mut [i8]) -> &'a [i8] {
        &self.data[row * self.stride + k..][..spare.len()]
    }
}

struct Run<'a> {
    args: &'a HeadI8<'a>,
    rows: Range<usize>,
    results: Results<'a>,
    scratch: &'a mut [i32],
}

/// Where a block of voxels goes through the layers.
struct Room<'a> {
    a: &'a mut [i8],
    b: &'a mut [i8],
    sums: &'a mut [i32],
    product: &'a mut [i32],
}

impl Run<'_> {
    /// Calls `block` with the first voxel and count of each block of rows and with room for it; then keeps the classes, and
    /// has `logits` made of the sums if they are asked for. `sure` writes how sure the head is of a block, of its sums and
    /// classes.
    #[inline(always)]
    fn blocks(
        mut self,
        mut block: impl FnMut(usize, usize, &mut Room<'_>),
        logits: impl Fn(&[i32], &mut [f32]),
        sure: impl Fn(&[i32], &[u8], Confidence<'_>),
    ) {
        let HeadI8 { channels, classes, .. } = *self.args;
        let (product, rest) = self.scratch.split_at_mut(product_len(channels, classes));
        let (a, rest) = rest.split_at_mut(BLOCK_ROWS * hidden_len(channels));
        let (b, rest) = rest.split_at_mut(BLOCK_ROWS * hidden_len(channels));
        let sums = &mut rest[..BLOCK_ROWS * classes];
        let mut room = Room { a: bytemuck::cast_slice_mut(a), b: bytemuck::cast_slice_mut(b), sums, product };
        for first in self.rows.clone().step_by(BLOCK_ROWS) {
            let count = BLOCK_ROWS.min(self.rows.end - first);
            block(first, count, &mut room);
            let at = first - self.rows.start;
            let sums = &room.sums[..count * classes];
            let chosen = &mut self.results.classes[at..at + count];
            for (class, sums) in chosen.iter_mut().zip(sums.chunks_exact(classes)) {
                *class = largest(sums);
            }
            if let Some(out) = &mut self.results.logits {
                logits(sums, &mut out[at * classes..(at + count) * classes]);
            }
            if let Some(confidence) = &mut self.results.confidence {
                sure(sums, chosen, confidence.part(at..at + count));
            }
        }
    }
}

impl Kernel for Run<'_> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        let HeadI8 { input, channels, classes, scale, .. } = *self.args;
        let layers = [0, 1, 2].map(|i| self.args.layer(i));
        self.blocks(
            #[inline(always)]
            |first, count, room| {
                for row in 0..count {
                    let (x, here) = (&input[(first + row) * channels..], row * channels..(row + 1) * channels);
                    let (a, b) = (&mut room.a[here.clone()], &mut room.b[here]);
                    layers[0].to::<Narrow>().reference(row, a, |k| x[k]);
                    layers[1].to::<Narrow>().reference(row, b, |k| a[k]);
                    let sums = &mut room.sums[row * classes..(row + 1) * classes];
                    layers[2].to::<Raw>().reference(row, sums, |k| b[k]);
                }
            },
            |sums, out| {
                for (sum, out) in sums.iter().zip(out) {
                    *out = *sum as f32 * scale;
                }
            },
            |sums, chosen, confidence| confidence.reference(classes, chosen, sums, |sum| sum as f32 * scale),
        );
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let HeadI8 { input, channels, classes, scale, .. } = *self.args;
        let layers = [0, 1, 2].map(|i| self.args.layer(i));
        let hidden = Linear { first: 0, stride: channels };
        self.blocks(
            #[inline(always)]
            |first, count, Room { a, b, sums, product }| {
                // A loop, so that the product is compiled once for both layers.
                for layer in 0..2 {
                    let (data, to) = if layer == 0 { (&input[first * channels..], &mut **a) } else { (&**a, &mut **b) };
                    let source = Rows { data, stride: channels };
                    layers[layer].to::<Narrow>().compute(s, &source, &hidden, 0..count, to, product);
                }
                let (source, target) = (Rows { data: b, stride: channels }, Linear { first: 0, stride: classes });
                layers[2].to::<Raw>().compute(s, &source, &target, 0..count, sums, product);
            },
            #[inline(always)]
            |sums, out| {
                let scale = s.splat(scale);
                for (sums, out) in sums.chunks(LANES).zip(out.chunks_mut(LANES)) {
                    s.store_part(out, s.mul(s.to_float(s.load_int_part(sums)), scale));
                }
            },
            #[inline(always)]
            |sums, chosen, confidence| {
                confidence.run(
                    s,
                    classes,
                    chosen,
                    sums,
                    #[inline(always)]
                    |sum| sum as f32 * scale,
                );
            },
        );
    }
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests;

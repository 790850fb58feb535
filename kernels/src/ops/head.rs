//! The occupancy head: three linear layers per voxel, ReLU after the first two, and the largest class.
//!
//! ```text
//! a = relu(W1 x + b1),  b = relu(W2 a + b2),  logits = W3 b + b3,  class = first k with the largest logits[k]
//! ```
//!
//! Each layer is a [`crate::product`]. A block of voxels goes through all three while it is in the cache, so the logits
//! of the whole grid need not exist. A later class wins only if its logit is greater, so NaN never wins over a value
//! that comes first. Beside the classes, logits can be kept, and [how sure](Confidence) the head is.

pub(crate) mod confidence;

pub use confidence::Confidence;

use crate::isa::Isa;
use crate::matmul::driver::{Linear, Source};
use crate::matmul::product::Multiply;
use crate::matmul::{BLOCK_ROWS, Panels, Product, Residual, SCRATCH};
use crate::simd::{Kernel, Simd, dispatch};
use core::convert::identity;
use core::ops::Range;

/// The head's arguments.
#[derive(Clone, Copy, Debug)]
pub struct Head<'a> {
    /// `[voxels, channels]`.
    pub input: &'a [f32],
    /// Channels of a voxel and of both hidden layers.
    pub channels: usize,
    /// Classes, at most 256.
    pub classes: usize,
    /// Packed weights of the three layers.
    pub weights: [Panels<'a>; 3],
    /// Biases of the three layers, padded to multiples of 16.
    pub biases: [&'a [f32]; 3],
}

/// What a head writes of its rows.
#[derive(Debug)]
pub struct Results<'a> {
    /// The class of each voxel.
    pub classes: &'a mut [u8],
    /// All logits, `[voxels, classes]`, if they are kept.
    pub logits: Option<&'a mut [f32]>,
    /// How sure the head is, if that is asked for.
    pub confidence: Option<Confidence<'a>>,
}

impl Results<'_> {
    /// Checks that there is room for `rows` rows.
    ///
    /// # Panics
    /// If there is not, or the confidence's scale is not positive and finite.
    pub(crate) fn check(&self, rows: usize, classes: usize) {
        assert!((1..=256).contains(&classes), "a class must fit a byte");
        assert_eq!(self.classes.len(), rows, "the classes do not hold the rows");
        assert!(self.logits.as_ref().is_none_or(|l| l.len() == rows * classes), "the logits do not hold the rows");
        if let Some(confidence) = &self.confidence {
            confidence.check(rows);
        }
    }
}

/// f32 of scratch that one call needs.
pub const fn scratch_len(channels: usize, classes: usize) -> usize {
    SCRATCH + BLOCK_ROWS * (2 * channels + classes)
}

/// Classifies the voxels `rows` into `results`.
///
/// # Panics
/// If a slice does not have the size that the shapes ask for; those of [`Confidence`]. `scratch` needs [`scratch_len`] values of any value.
///
/// # Determinism
/// The same bits on every instruction set and for every division into rows.
pub fn head(isa: Isa, args: &Head<'_>, rows: Range<usize>, results: Results<'_>, scratch: &mut [f32]) {
    results.check(rows.len(), args.classes);
    (0..3).for_each(|layer| args.layer(layer).check(rows.len(), scratch));
    let held = rows.end.checked_mul(args.channels).is_some_and(|n| n <= args.input.len());
    assert!(rows.start <= rows.end && held, "rows {rows:?} are not in the input");
    assert!(scratch.len() >= scratch_len(args.channels, args.classes), "the scratch is too small");
    dispatch(isa, Run { args, rows, results, scratch });
}

impl<'a> Head<'a> {
    fn layer(&self, layer: usize) -> Product<'a> {
        Product {
            weights: self.weights[layer],
            bias: self.biases[layer],
            depth: self.channels,
            columns: if layer == 2 { self.classes } else { self.channels },
            relu: layer < 2,
            residual: Residual::None,
        }
    }
}

/// Rows that lie in memory, densely.
pub(crate) struct Rows<'a, E> {
    pub(crate) data: &'a [E],
    pub(crate) stride: usize,
}

impl<E: Copy> Source for Rows<'_, E> {
    type Element = E;
    type At = usize;
    type Part = usize;

    #[inline(always)]
    fn element(&self, row: usize, k: usize) -> E {
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
    fn piece<'a, S: Simd>(&'a self, _: S, row: usize, k: usize, spare: &'a mut [E]) -> &'a [E] {
        &self.data[row * self.stride + k..][..spare.len()]
    }
}

/// The first of the largest.
#[inline(always)]
pub(crate) fn largest<T: PartialOrd>(logits: &[T]) -> u8 {
    let mut best = 0;
    for k in 1..logits.len() {
        if logits[k] > logits[best] {
            best = k;
        }
    }
    best as u8
}

struct Run<'a> {
    args: &'a Head<'a>,
    rows: Range<usize>,
    results: Results<'a>,
    scratch: &'a mut [f32],
}

impl Run<'_> {
    /// Calls `block` with the first voxel and count of each block of rows and with room for its two hidden layers, its
    /// logits and a product's scratch; then keeps what was asked for. `sure` writes how sure the head is of a block, of its
    /// logits and classes.
    #[inline(always)]
    fn blocks(
        mut self,
        mut block: impl FnMut(usize, usize, [&mut [f32]; 4]),
        sure: impl Fn(&[f32], &[u8], Confidence<'_>),
    ) {
        let Head { channels, classes, .. } = *self.args;
        let (product, rest) = self.scratch.split_at_mut(SCRATCH);
        let (a, rest) = rest.split_at_mut(BLOCK_ROWS * channels);
        let (b, rest) = rest.split_at_mut(BLOCK_ROWS * channels);
        let logits = &mut rest[..BLOCK_ROWS * classes];
        for first in self.rows.clone().step_by(BLOCK_ROWS) {
            let count = BLOCK_ROWS.min(self.rows.end - first);
            block(first, count, [a, b, logits, product]);
            let at = first - self.rows.start;
            let logits = &logits[..count * classes];
            let chosen = &mut self.results.classes[at..at + count];
            for (class, logits) in chosen.iter_mut().zip(logits.chunks_exact(classes)) {
                *class = largest(logits);
            }
            if let Some(out) = &mut self.results.logits {
                out[at * classes..(at + count) * classes].copy_from_slice(logits);
            }
            if let Some(confidence) = &mut self.results.confidence {
                sure(logits, chosen, confidence.part(at..at + count));
            }
        }
    }
}

impl Kernel for Run<'_> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        let args = self.args;
        self.blocks(
            #[inline(always)]
            |first, count, [a, b, logits, _]| {
                let input = &args.input[first * args.channels..];
                for layer in 0..3 {
                    let (data, to) = between(layer, input, a, b, logits);
                    let p = args.layer(layer);
                    let source = Rows { data, stride: p.depth };
                    for (row, to) in to.chunks_exact_mut(p.columns.max(1)).take(count).enumerate() {
                        p.reference(
                            row,
                            to,
                            #[inline(always)]
                            |k| source.element(row, k),
                        );
                    }
                }
            },
            #[inline(always)]
            |logits, chosen, confidence| confidence.reference(args.classes, chosen, logits, identity),
        );
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let args = self.args;
        self.blocks(
            #[inline(always)]
            |first, count, [a, b, logits, scratch]| {
                let input = &args.input[first * args.channels..];
                for layer in 0..3 {
                    let (data, to) = between(layer, input, a, b, logits);
                    let p = args.layer(layer);
                    let (source, target) = (Rows { data, stride: p.depth }, Linear { first: 0, stride: p.columns });
                    p.compute(s, &source, &target, 0..count, to, scratch);
                }
            },
            #[inline(always)]
            |logits, chosen, confidence| confidence.run(s, args.classes, chosen, logits, identity),
        );
    }
}

/// What a layer reads and writes.
#[inline(always)]
fn between<'a>(
    layer: usize,
    input: &'a [f32],
    a: &'a mut [f32],
    b: &'a mut [f32],
    logits: &'a mut [f32],
) -> (&'a [f32], &'a mut [f32]) {
    match layer {
        0 => (input, a),
        1 => (a, b),
        _ => (b, logits),
    }
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests;

//! The occupancy head: three linear layers per voxel, a rectifier after the first two, and the largest class.
//!
//! ```text
//! a = relu(W1 x + b1),  b = relu(W2 a + b2),  logits = W3 b + b3,  class = first k with the largest logits[k]
//! ```
//!
//! Each layer is a [`crate::product`]. A block of voxels goes through all three while it is in the cache, so the logits
//! of the whole grid need not exist. A later class wins only if its logit is greater, so NaN never wins over a number
//! that comes first.

use crate::isa::Isa;
use crate::panels::Panels;
use crate::product::{Linear, Product, ROWS, Residual, SCRATCH, Source, product};
use crate::simd::{Kernel, Simd, dispatch};
use std::ops::Range;

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

/// f32 of scratch that one call needs.
pub const fn scratch_len(channels: usize, classes: usize) -> usize {
    SCRATCH + ROWS * (2 * channels + classes)
}

/// Classifies the voxels `rows` into `classes_out`, one byte each; `logits_out`, if given, takes their logits.
///
/// # Panics
/// If a slice does not have the size that the shapes ask for; `scratch` needs [`scratch_len`] numbers of any value.
///
/// # Determinism
/// The same bits on every instruction set and for every division into rows.
pub fn head(
    isa: Isa,
    args: &Head<'_>,
    rows: Range<usize>,
    classes_out: &mut [u8],
    logits_out: Option<&mut [f32]>,
    scratch: &mut [f32],
) {
    (0..3).for_each(|layer| args.layer(layer).check());
    assert!((1..=256).contains(&args.classes), "a class must fit a byte");
    assert!(rows.end * args.channels <= args.input.len(), "rows out of range");
    assert_eq!(classes_out.len(), rows.len(), "the classes do not hold the rows");
    assert!(
        logits_out.as_ref().is_none_or(|l| l.len() == rows.len() * args.classes),
        "the logits do not hold the rows"
    );
    assert!(scratch.len() >= scratch_len(args.channels, args.classes), "the scratch is too small");
    dispatch(isa, Run { args, rows, classes_out, logits_out, scratch });
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
struct Rows<'a> {
    data: &'a [f32],
    stride: usize,
}

impl Source for Rows<'_> {
    #[inline(always)]
    fn fill<S: Simd>(&self, _: S, row: usize, k: usize, piece: &mut [f32]) {
        piece.copy_from_slice(&self.data[row * self.stride + k..][..piece.len()]);
    }
    #[inline(always)]
    fn stored(&self, row: usize, k: usize, len: usize) -> Option<&[f32]> {
        Some(&self.data[row * self.stride + k..][..len])
    }
}

/// The first of the largest.
#[inline(always)]
fn largest(logits: &[f32]) -> u8 {
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
    classes_out: &'a mut [u8],
    logits_out: Option<&'a mut [f32]>,
    scratch: &'a mut [f32],
}

impl Run<'_> {
    /// Calls `block` with the first voxel and count of each block of rows and with room for its two hidden layers, its
    /// logits and a product's scratch; then keeps what was asked for.
    #[inline(always)]
    fn blocks(mut self, mut block: impl FnMut(usize, usize, [&mut [f32]; 4])) {
        let Head { channels, classes, .. } = *self.args;
        let (product, rest) = self.scratch.split_at_mut(SCRATCH);
        let (a, rest) = rest.split_at_mut(ROWS * channels);
        let (b, rest) = rest.split_at_mut(ROWS * channels);
        let logits = &mut rest[..ROWS * classes];
        for first in self.rows.clone().step_by(ROWS) {
            let count = ROWS.min(self.rows.end - first);
            block(first, count, [a, b, logits, product]);
            let at = first - self.rows.start;
            let logits = &logits[..count * classes];
            for (class, logits) in self.classes_out[at..at + count].iter_mut().zip(logits.chunks_exact(classes)) {
                *class = largest(logits);
            }
            if let Some(out) = &mut self.logits_out {
                out[at * classes..(at + count) * classes].copy_from_slice(logits);
            }
        }
    }
}

impl Kernel for Run<'_> {
    type Output = ();

    fn reference(self) {
        let args = self.args;
        self.blocks(|first, count, [a, b, logits, _]| {
            let layer = |layer: usize, from: &[f32], to: &mut [f32]| {
                let p = args.layer(layer);
                for row in 0..count {
                    for n in 0..p.columns {
                        to[row * p.columns + n] = p.reference(row, n, 0.0, |k| from[row * p.depth + k]);
                    }
                }
            };
            layer(0, &args.input[first * args.channels..], a);
            layer(1, a, b);
            layer(2, b, logits);
        });
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let args = self.args;
        self.blocks(
            #[inline(always)]
            |first, count, [a, b, logits, scratch]| {
                layer(s, &args.layer(0), &args.input[first * args.channels..], a, count, scratch);
                layer(s, &args.layer(1), a, b, count, scratch);
                layer(s, &args.layer(2), b, logits, count, scratch);
            },
        );
    }
}

/// One layer on `count` rows.
#[inline(always)]
fn layer<S: Simd>(s: S, p: &Product<'_>, data: &[f32], to: &mut [f32], count: usize, scratch: &mut [f32]) {
    let source = Rows { data, stride: p.depth };
    product(s, p, &source, &Linear { first: 0, stride: p.columns }, 0..count, to, scratch);
}

//! The occupancy head: three linear layers per voxel, ReLU after the first two, and the largest class.
//!
//! ```text
//! a = relu(W1 x + b1),  b = relu(W2 a + b2),  logits = W3 b + b3,  class = first k with the largest logits[k]
//! ```
//!
//! Each layer is a product, one chain of fused multiply-adds per output that starts at the bias, k ascending. A later class wins
//! only if its logit is greater, so NaN never wins over a value that comes first. Beside the classes, logits can be kept, and
//! [how sure](Confidence) the head is.
//!
//! Lanes are voxels: as many voxels as a vector has go through all layers at once, and what one layer writes, channel by channel, is
//! what the next one reads. So there are no columns of padding (17 classes would be 32), hidden layers stay in the
//! first-level cache, and the largest class is found in all voxels at once. Only the input has to be transposed.

pub(crate) mod confidence;

pub use confidence::Confidence;

use crate::isa::Isa;
use crate::matmul::layout::packed_index;
use crate::matmul::product::Multiply;
use crate::matmul::{Panels, Product, Residual};
use crate::simd::{Kernel, LANES, Simd, dispatch};
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
    matrices_len(channels, classes) + LANES * (3 * channels + 2 * classes)
}

/// f32 of the three matrices side by side. What is stored last of a matrix may reach beyond its end.
const fn matrices_len(channels: usize, classes: usize) -> usize {
    channels * (2 * channels + classes) + LANES
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
    (0..3).for_each(|layer| args.layer(layer).check_right());
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

impl Kernel for Run<'_> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        let Self { args, rows, mut results, scratch } = self;
        let (a, rest) = scratch.split_at_mut(args.channels);
        let (b, rest) = rest.split_at_mut(args.channels);
        let logits = &mut rest[..args.classes];
        for (i, row) in rows.enumerate() {
            let input = &args.input[row * args.channels..][..args.channels];
            for layer in 0..3 {
                let (from, to) = between(layer, input, a, b, logits);
                args.layer(layer).reference(
                    row,
                    to,
                    #[inline(always)]
                    |k| from[k],
                );
            }
            results.classes[i] = largest(logits);
            if let Some(out) = &mut results.logits {
                out[i * args.classes..][..args.classes].copy_from_slice(logits);
            }
            if let Some(confidence) = &mut results.confidence {
                confidence.part(i..i + 1).reference(args.classes, &results.classes[i..=i], logits, identity);
            }
        }
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { args, rows, mut results, scratch } = self;
        let Head { channels, classes, .. } = *args;
        let (matrices, rest) = scratch.split_at_mut(matrices_len(channels, classes));
        let (x, rest) = rest.split_at_mut(channels * LANES);
        let (a, rest) = rest.split_at_mut(channels * LANES);
        let (b, rest) = rest.split_at_mut(channels * LANES);
        let (logits, rest) = rest.split_at_mut(classes * LANES);
        let by_voxel = &mut rest[..classes * LANES];
        let mut starts = [0; 3];
        let mut end = 0;
        for layer in 0..3 {
            starts[layer] = end;
            args.layer(layer).spread(s, &mut matrices[end..]);
            end += channels * args.layer(layer).columns;
        }
        for first in rows.clone().step_by(LANES) {
            let count = LANES.min(rows.end - first);
            transpose(s, &args.input[first * channels..(first + count) * channels], channels, x);
            for layer in 0..3 {
                let (from, to) = between(layer, x, a, b, logits);
                let Product { bias, columns, relu, .. } = args.layer(layer);
                let matrix = &matrices[starts[layer]..][..channels * columns];
                Columns { matrix, from, relu }.all(s, bias, to);
            }
            let at = first - rows.start;
            let chosen = &mut results.classes[at..at + count];
            for (class, largest) in chosen.iter_mut().zip(largest_of_lanes(s, logits)) {
                *class = largest as u8;
            }
            if results.logits.is_some() || results.confidence.is_some() {
                for (k, logits) in logits.as_chunks::<LANES>().0.iter().enumerate() {
                    for (voxel, logit) in logits.iter().enumerate() {
                        by_voxel[voxel * classes + k] = *logit;
                    }
                }
                let logits = &by_voxel[..count * classes];
                if let Some(out) = &mut results.logits {
                    out[at * classes..(at + count) * classes].copy_from_slice(logits);
                }
                if let Some(confidence) = &mut results.confidence {
                    confidence.part(at..at + count).run(s, classes, chosen, logits, identity);
                }
            }
        }
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

impl Product<'_> {
    /// Writes the weights into `out`, row by row without padding.
    #[inline(always)]
    fn spread<S: Simd>(&self, s: S, out: &mut [f32]) {
        // In this order, what is stored beyond the end of a row is overwritten by the next one.
        for k in 0..self.depth {
            for column in (0..self.columns).step_by(LANES) {
                let i = packed_index(self.depth, k, column);
                let to = out[k * self.columns + column..].first_chunk_mut().expect("there is room behind the matrices");
                match self.weights {
                    Panels::F32(w) => *to = *w[i..].first_chunk().expect("panels are whole"),
                    Panels::F16(w) => s.store(to, s.widen(w[i..].first_chunk().expect("panels are whole"))),
                }
            }
        }
    }
}

/// Writes rows of `channels` channels, at most 16 of them, into `out`, channel by channel. Voxels that do not exist are 0.
#[inline(always)]
fn transpose<S: Simd>(s: S, rows: &[f32], channels: usize, out: &mut [f32]) {
    let mut done = 0;
    if rows.len() == channels * LANES {
        while done + LANES <= channels {
            let to = &mut out[done * LANES..][..LANES * LANES];
            // SAFETY: there are 16 rows, each of which has 16 more channels from `done` on, and as many in `to`.
            unsafe { s.transpose_ptr(rows[done..].as_ptr(), channels, to.as_mut_ptr()) }
            done += LANES;
        }
    }
    for (c, out) in out.as_chunks_mut::<LANES>().0.iter_mut().enumerate().skip(done) {
        *out = [0.0; LANES];
        for (lane, row) in out.iter_mut().zip(rows.chunks_exact(channels)) {
            *lane = row[c];
        }
    }
}

/// The first of the largest logits of each lane.
#[inline(always)]
fn largest_of_lanes<S: Simd>(s: S, logits: &[f32]) -> [i32; LANES] {
    let (logits, _) = logits.as_chunks::<LANES>();
    let (mut best, mut class) = (s.load(&logits[0]), s.splat_int(0));
    for (logits, k) in logits.iter().zip(0..).skip(1) {
        let logit = s.load(logits);
        // Classes ascend, so the larger is the later.
        class = s.max_int(class, s.keep(s.exceeds(logit, best), s.splat_int(k)));
        best = s.max(logit, best);
    }
    s.int_lanes(class)
}

/// A layer over the voxels of a vector.
struct Columns<'a> {
    /// `[k, columns]`.
    matrix: &'a [f32],
    /// `[k, voxels]`.
    from: &'a [f32],
    relu: bool,
}

impl Columns<'_> {
    /// Writes all columns, `[columns, voxels]`, as many at a time as a tile has rows, or nearly.
    #[inline(always)]
    fn all<S: Simd>(&self, s: S, bias: &[f32], to: &mut [f32]) {
        let (to, _) = to.as_chunks_mut::<LANES>();
        let columns = to.len();
        let mut tiles = columns.div_ceil(S::TILE.rows);
        let mut first = 0;
        while first < columns {
            let count = (columns - first).div_ceil(tiles);
            let (bias, to) = (&bias[first..first + count], &mut to[first..first + count]);
            macro_rules! tile {
                ($($n:literal)*) => {
                    match count {
                        $($n if $n <= S::TILE.rows => self.some::<S, $n>(s, columns, first, bias, to),)*
                        _ => unreachable!("a tile has at most 12 rows"),
                    }
                };
            }
            tile!(1 2 3 4 5 6 7 8 9 10 11 12);
            first += count;
            tiles -= 1;
        }
    }

    /// Writes the `N` columns from `first` on, of `columns`.
    #[inline(always)]
    fn some<S: Simd, const N: usize>(&self, s: S, columns: usize, first: usize, bias: &[f32], to: &mut [[f32; LANES]]) {
        let (bias, to): (&[f32; N], &mut [_; N]) =
            (bias.try_into().expect("N of them"), to.try_into().expect("N of them"));
        let mut sums = [s.splat(0.0); N];
        for r in 0..N {
            sums[r] = s.splat(bias[r]);
        }
        for (x, weights) in self.from.as_chunks::<LANES>().0.iter().zip(self.matrix.chunks_exact(columns)) {
            let x = s.load(x);
            let weights: &[f32; N] = weights[first..first + N].try_into().expect("N of them");
            for r in 0..N {
                sums[r] = s.mul_add(x, s.splat(weights[r]), sums[r]);
            }
        }
        for r in 0..N {
            s.store(&mut to[r], if self.relu { s.relu(sums[r]) } else { sums[r] });
        }
    }
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests;

//! The arguments of a product in f32, and its specification.

use super::driver::{self, BLOCK_LEN, Linear, PANEL_LEN, Source, Target};
use super::epilogue::{End, Residual};
use super::layout::{Panels, packed_index};
use super::tile::Single;
use crate::isa::Isa;
#[cfg(not(feature = "std"))]
use crate::math::Float as _;
use crate::simd::{Kernel, LANES, Simd, dispatch};
use core::ops::Range;

/// f32 of scratch that one call needs.
pub const SCRATCH: usize = BLOCK_LEN + PANEL_LEN;

/// The right matrix and what happens at both ends of each chain.
#[derive(Clone, Copy, Debug)]
pub struct Product<'a> {
    /// Packed weights of `depth` x `columns`.
    pub weights: Panels<'a>,
    /// One value per column, padded with anything to a multiple of 16.
    pub bias: &'a [f32],
    /// Length of every chain.
    pub depth: usize,
    /// Output columns.
    pub columns: usize,
    /// Whether negative results become 0.
    pub relu: bool,
    /// What is added.
    pub residual: Residual<'a>,
}

/// A right matrix with what happens at both ends of its sums: what convolutions, the head and others multiply by.
pub(crate) trait Multiply {
    /// Element of the left matrix.
    type Left: Copy;
    /// Element of the output.
    type Out;
    /// Element of the scratch.
    type Scratch;

    /// Output columns.
    fn columns(&self) -> usize;

    /// # Panics
    /// If a slice does not fit a product of `rows` rows, or the scratch is too small.
    fn check(&self, rows: usize, scratch: &[Self::Scratch]);

    /// The specification of row `row`: `a(k)` is the left row, `out` holds the outputs and before that whatever was
    /// there, `residual_row` is the row in the residual's tensor.
    fn reference(&self, residual_row: usize, out: &mut [Self::Out], a: impl Fn(usize) -> Self::Left);

    /// Computes `rows` of the product with the left matrix `left`. The scratch is one that passed [`Multiply::check`].
    fn compute<S: Simd>(
        &self,
        s: S,
        left: &impl Source<Element = Self::Left>,
        target: &impl Target,
        rows: Range<usize>,
        out: &mut [Self::Out],
        scratch: &mut [Self::Scratch],
    );

    /// [`Multiply::check`] for the rows `rows` of `total` that go to `out`, `stride` apart.
    ///
    /// # Panics
    /// As [`Multiply::check`], and if `out` does not hold the rows.
    fn check_rows(
        &self,
        rows: &Range<usize>,
        total: usize,
        stride: usize,
        out: &[Self::Out],
        scratch: &[Self::Scratch],
    ) {
        self.check(rows.end, scratch);
        assert!(rows.start <= rows.end && rows.end <= total, "rows {rows:?} of {total}");
        assert!(stride >= self.columns(), "output rows overlap");
        assert!(out.len() >= span(rows.len(), stride, self.columns()), "the output is shorter than its rows");
    }
}

impl Product<'_> {
    /// # Panics
    /// If weights or bias do not have the size that the shapes ask for.
    pub(crate) fn check_right(&self) {
        let padded = self.columns.checked_next_multiple_of(LANES).expect("the columns overflow");
        assert_eq!(Some(self.weights.len()), padded.checked_mul(self.depth), "packed weights do not match the shape");
        assert!(self.bias.len() >= padded, "the bias is shorter than the columns");
    }

    pub(crate) fn end(&self) -> End<'_> {
        End { bias: Some(self.bias), relu: self.relu, residual: self.residual }
    }
}

impl Multiply for Product<'_> {
    type Left = f32;
    type Out = f32;
    type Scratch = f32;

    fn columns(&self) -> usize {
        self.columns
    }

    fn check(&self, rows: usize, scratch: &[f32]) {
        self.check_right();
        if let Residual::Before { rows: added, stride } | Residual::After { rows: added, stride } = self.residual {
            assert!(added.len() >= span(rows, stride, self.columns), "the residual is shorter than the rows");
        }
        assert!(scratch.len() >= SCRATCH, "the scratch is too small");
    }

    /// Sixteen chains advance side by side, so that an element of the left row is looked up once for all.
    #[inline(always)]
    fn reference(&self, residual_row: usize, out: &mut [f32], a: impl Fn(usize) -> f32) {
        let end = self.end();
        for (panel, out) in out.chunks_mut(LANES).enumerate() {
            let column = panel * LANES;
            let mut sums = [0.0; LANES];
            for (i, out) in out.iter().enumerate() {
                sums[i] = end.start(residual_row, column + i, *out);
            }
            for k in 0..self.depth {
                let (x, weights) = (a(k), self.weights.lanes(packed_index(self.depth, k, column)));
                for (sum, weight) in sums.iter_mut().zip(weights) {
                    *sum = x.mul_add(weight, *sum);
                }
            }
            for (i, out) in out.iter_mut().enumerate() {
                *out = end.finish(residual_row, column + i, sums[i]);
            }
        }
    }

    #[inline(always)]
    fn compute<S: Simd>(
        &self,
        s: S,
        left: &impl Source<Element = f32>,
        target: &impl Target,
        rows: Range<usize>,
        out: &mut [f32],
        scratch: &mut [f32],
    ) {
        let (block, panels) = scratch[..SCRATCH].split_at_mut(BLOCK_LEN);
        let product =
            driver::Product { left, weights: &self.weights, target, depth: self.depth, columns: self.columns };
        product.compute(s, Single, &mut self.end(), rows, out, block, panels);
    }
}

/// Numbers from the first of `rows` rows, `stride` apart, to the last one's end.
pub(crate) fn span(rows: usize, stride: usize, columns: usize) -> usize {
    rows.checked_sub(1).map_or(0, |before| before.saturating_mul(stride).saturating_add(columns))
}

/// A product whose output rows go one after the other: what a convolution is.
pub(crate) struct Rows<'a, P: Multiply, A> {
    pub(crate) product: &'a P,
    pub(crate) source: &'a A,
    pub(crate) rows: Range<usize>,
    /// Distance between rows of `out`, which starts at the first of them.
    pub(crate) stride: usize,
    pub(crate) out: &'a mut [P::Out],
    pub(crate) scratch: &'a mut [P::Scratch],
}

impl<P: Multiply, A: Source<Element = P::Left>> Rows<'_, P, A> {
    /// # Panics
    /// As [`Multiply::check_rows`].
    #[inline]
    pub(crate) fn check(&self, total: usize) {
        self.product.check_rows(&self.rows, total, self.stride, self.out, self.scratch);
    }

    /// Computes the rows, of `total`, on `isa`.
    ///
    /// # Panics
    /// As [`Multiply::check_rows`].
    #[inline]
    pub(crate) fn compute(self, isa: Isa, total: usize) {
        self.check(total);
        dispatch(isa, self);
    }
}

impl<P: Multiply, A: Source<Element = P::Left>> Kernel for Rows<'_, P, A> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        let first = self.rows.start;
        for row in self.rows {
            let out = &mut self.out[(row - first) * self.stride..][..self.product.columns()];
            self.product.reference(
                row,
                out,
                #[inline(always)]
                |k| self.source.element(row, k),
            );
        }
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let target = Linear { first: self.rows.start, stride: self.stride };
        self.product.compute(s, self.source, &target, self.rows, self.out, self.scratch);
    }
}

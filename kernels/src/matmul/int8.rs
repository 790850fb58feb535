//! The product of 8-bit matrices. Sums are exact, so their order is free; the ends are integers too.
//!
//! ```text
//! sum[row][n]  = bias[n] + a[row][0] * w[0][n] + a[row][1] * w[1][n] + ...                        i32, exact
//! end before   : sum += residual * r[n];  if relu: sum = max(sum, 0)
//! end after    : if relu: sum = max(sum, 0);  sum += residual * r[n]
//! out[row][n]  = clamp(requantise(sum, multiplier[n]))       i8, or i32 without the clamp
//! ```
//!
//! `requantise` and `clamp` are those of [`crate::quantised`]. Elements and weights are -127..=127. That no sum leaves i32 is
//! proved of the weights once, by [`layout::fits`]; without that proof sums wrap around, on every instruction set alike.
//!
//! The parts are those of the product in f32 ([`crate::product`]): the same blocks, tiles and virtual left matrix, another
//! arithmetic. Sums that are not complete wait in the scratch, since an output of 8 bits cannot hold them.

mod epilogue;
pub mod layout;
#[cfg(test)]
mod tests;

pub(crate) use epilogue::{Narrow, Outcome, Raw, Wide};

use super::driver::{self, BLOCK_ROWS, Source, Target, depth, stride};
use super::product::{Multiply, span};
use super::tile::Arithmetic;
use crate::simd::bytes::{Form, GROUP};
use crate::simd::{LANES, Simd, TileRows};
use core::marker::PhantomData;
use core::ops::Range;
use epilogue::End;
use layout::{Panels, packed_index};

/// i32 that hold a block of rows.
const BLOCK_LEN: usize = BLOCK_ROWS * stride::<i8>() / size_of::<i32>();
/// Sums of more products may have to wait, on an instruction set whose tile has two panels.
const DEPTH: usize = depth::<i8>() / 2;

/// i32 of scratch that a product of `depth` x `columns` needs.
pub const fn scratch_len(depth: usize, columns: usize) -> usize {
    BLOCK_LEN + if depth > DEPTH { BLOCK_ROWS * columns.next_multiple_of(LANES) } else { 0 }
}

/// The right matrix and what becomes of each sum.
#[derive(Clone, Copy, Debug)]
pub struct ProductI8<'a> {
    /// Packed weights of `depth` x `columns`, as [`layout`] says, -127..=127.
    pub weights: &'a [i8],
    /// [`layout::sums`] of the weights.
    pub sums: &'a [i32],
    /// [`layout::pairs`] of the weights.
    pub pairs: &'a [u8],
    /// One value per column in units of the sums, padded with anything to a multiple of 16.
    pub bias: &'a [i32],
    /// Products per sum, a multiple of 4.
    pub depth: usize,
    /// Output columns.
    pub columns: usize,
    /// Whether left elements may be negative; else they are 0..=127.
    pub signed: bool,
    /// Whether negative sums become 0.
    pub relu: bool,
    /// What is added.
    pub residual: ResidualI8<'a>,
    /// One multiplier per column, from 0 up to 2^31 - 1, padded with anything to a multiple of 16.
    pub multiplier: &'a [i32],
}

/// What is added to the sum, and when. `multiplier` holds per column, padded with anything to a multiple of 16, what one step of
/// the residual is in units of the sums.
#[derive(Clone, Copy, Debug)]
pub enum ResidualI8<'a> {
    /// Nothing.
    None,
    /// What `out` holds before the call. Outputs are in the same place.
    InPlace {
        /// One per column.
        multiplier: &'a [i32],
        /// Whether it is added after ReLU.
        after: bool,
    },
    /// Read from a tensor of the shape of the output.
    Apart {
        /// The tensor, from its first row on.
        rows: &'a [i8],
        /// Distance between its rows.
        stride: usize,
        /// One per column.
        multiplier: &'a [i32],
        /// Whether it is added after ReLU.
        after: bool,
    },
}

/// Bytes times bytes, summed in 32 bits.
#[derive(Clone, Copy)]
struct Bytes<'a> {
    signed: bool,
    /// [`layout::pairs`]
    pairs: &'a [u8],
}

impl<S: Simd> Arithmetic<S> for Bytes<'_> {
    type Left = i8;
    type Right = i8;
    type Sums = S::I;

    const PANELS: usize = S::BYTE_PANELS;

    #[inline(always)]
    fn tile_rows(self, s: S) -> usize {
        s.byte_rows()
    }

    #[inline(always)]
    fn rows<B: TileRows<S>>(self, s: S, left: usize, body: B) -> usize {
        s.rows_of_bytes(left, body)
    }

    #[inline(always)]
    unsafe fn multiply<const N: usize, const P: usize>(
        self,
        s: S,
        column: usize,
        left: [*const i8; N],
        panels: [&[i8]; P],
        depth: usize,
        sums: [[S::I; P]; N],
    ) -> [[S::I; P]; N] {
        assert!(
            depth.is_multiple_of(GROUP) && panels.iter().all(|w| w.len() == depth * LANES),
            "the weights are not as deep as the piece"
        );
        let form = Form { signed: self.signed, pairs: self.pairs[column / LANES..][..P].iter().all(|pair| *pair == 1) };
        // SAFETY: the caller promises the rows; the depth is whole groups of four, and the panels are 16 columns of it.
        unsafe { s.multiply_bytes(form, left, panels.map(<[i8]>::as_ptr), depth, sums) }
    }
}

impl<'a> ProductI8<'a> {
    /// The product whose outputs are `O`'s.
    pub(crate) fn to<O: Outcome>(self) -> Ending<'a, O> {
        Ending { product: self, outcome: PhantomData }
    }

    /// The residual's multipliers and whether it is added after ReLU.
    #[inline(always)]
    fn joins(&self) -> Option<(&'a [i32], bool)> {
        match self.residual {
            ResidualI8::None => None,
            ResidualI8::InPlace { multiplier, after } | ResidualI8::Apart { multiplier, after, .. } => {
                Some((multiplier, after))
            }
        }
    }
}

/// A product and the kind of its outputs.
#[derive(Clone, Copy)]
pub(crate) struct Ending<'a, O> {
    pub(crate) product: ProductI8<'a>,
    outcome: PhantomData<O>,
}

impl<O: Outcome> Multiply for Ending<'_, O> {
    type Left = i8;
    type Out = O::Out;
    type Scratch = i32;

    fn columns(&self) -> usize {
        self.product.columns
    }

    /// # Panics
    /// If a slice does not fit a product of `rows` rows, or the scratch is smaller than [`scratch_len`].
    fn check(&self, rows: usize, scratch: &[i32]) {
        let ProductI8 { weights, sums, pairs, bias, depth, columns, multiplier, .. } = self.product;
        let padded = columns.checked_next_multiple_of(LANES).expect("the columns overflow");
        assert!(depth.is_multiple_of(GROUP), "the depth is no multiple of 4");
        assert_eq!(Some(weights.len()), padded.checked_mul(depth), "packed weights do not match the shape");
        assert!(sums.len() >= padded && pairs.len() >= padded / LANES, "what is known of the weights is too short");
        assert!(bias.len() >= padded, "the bias is shorter than the columns");
        assert!(multiplier.len() >= padded, "the multipliers are fewer than the columns");
        if let Some((multiplier, _)) = self.product.joins() {
            assert!(multiplier.len() >= padded, "the residual's multipliers are fewer than the columns");
        }
        if let ResidualI8::Apart { rows: added, stride, .. } = self.product.residual {
            assert!(added.len() >= span(rows, stride, columns), "the residual is shorter than the rows");
        }
        assert!(scratch.len() >= scratch_len(depth, columns), "the scratch is too small");
    }

    #[inline(always)]
    fn reference(&self, residual_row: usize, out: &mut [O::Out], a: impl Fn(usize) -> i8) {
        let product = &self.product;
        for (panel, out) in out.chunks_mut(LANES).enumerate() {
            let column = panel * LANES;
            let mut sums: [i32; LANES] = *product.bias[column..].first_chunk().expect("the bias is padded");
            for k in 0..product.depth {
                let x = i32::from(a(k));
                for (n, sum) in sums.iter_mut().enumerate() {
                    let weight = product.weights[packed_index(product.depth, k, column + n)];
                    *sum = sum.wrapping_add(x * i32::from(weight));
                }
            }
            for (n, out) in out.iter_mut().enumerate() {
                let column = column + n;
                let added = match product.residual {
                    ResidualI8::Apart { rows, stride, .. } => rows[residual_row * stride + column].into(),
                    _ => O::value(*out),
                };
                let relu = |sum: i32| if product.relu { sum.max(0) } else { sum };
                let sum = match product.joins() {
                    None => relu(sums[n]),
                    Some((multiplier, after)) => {
                        let added = added.wrapping_mul(multiplier[column]);
                        if after { relu(sums[n]).wrapping_add(added) } else { relu(sums[n].wrapping_add(added)) }
                    }
                };
                *out = O::of(sum, product.multiplier[column]);
            }
        }
    }

    #[inline(always)]
    fn compute<S: Simd>(
        &self,
        s: S,
        left: &impl Source<Element = i8>,
        target: &impl Target,
        rows: Range<usize>,
        out: &mut [O::Out],
        scratch: &mut [i32],
    ) {
        let ProductI8 { weights, pairs, depth, columns, signed, .. } = self.product;
        let (block, waiting) = scratch.split_at_mut(BLOCK_LEN);
        let block = bytemuck::cast_slice_mut(block);
        let mut end = End::<O>::new(s, &self.product, rows.start, waiting);
        let product = driver::Product { left, weights: &Panels(weights), target, depth, columns };
        product.compute(s, Bytes { signed, pairs }, &mut end, rows, out, block, &mut []);
    }
}

//! Both ends of a product's chains: where they start, and what becomes of their sums.

use super::driver::Target;
use super::tile::{Arithmetic, Single};
use crate::simd::{LANES, Simd, relu};

/// Up to 16 outputs of one row, side by side.
pub(crate) struct Place<'a, T> {
    /// The first one's column.
    pub(crate) column: usize,
    /// The row in the whole product.
    pub(crate) row: usize,
    pub(crate) target: &'a T,
}

/// What a product does besides multiplying and adding. `out` is the place's outputs: exactly 16 if `WHOLE`.
///
/// A chain that is too long for one block of k is paused between two of them.
pub(crate) trait Epilogue<S: Simd, A: Arithmetic<S>> {
    /// Element of the output.
    type Out;

    /// The sums before the first product. `out` is as it was before the call.
    fn start<T: Target, const WHOLE: bool>(&self, s: S, place: &Place<'_, T>, out: &[Self::Out]) -> A::Sums;
    /// The sums that [`Epilogue::pause`] was given.
    fn resume<T: Target, const WHOLE: bool>(&self, s: S, place: &Place<'_, T>, out: &[Self::Out]) -> A::Sums;
    /// Keeps sums that are not complete.
    fn pause<T: Target, const WHOLE: bool>(&mut self, s: S, place: &Place<'_, T>, sums: A::Sums, out: &mut [Self::Out]);
    /// Writes the outputs of complete sums.
    fn finish<T: Target, const WHOLE: bool>(
        &mut self,
        s: S,
        place: &Place<'_, T>,
        sums: A::Sums,
        out: &mut [Self::Out],
    );
}

/// What is added to the sum, and when.
#[derive(Clone, Copy, Debug)]
pub enum Residual<'a> {
    /// Nothing.
    None,
    /// What `out` holds before the call joins the bias as the start of the chain. Outputs are in the same place.
    InPlace,
    /// As `InPlace`, read from a tensor of the shape of the output, rows `stride` apart.
    Before {
        /// The tensor, from its first row on.
        rows: &'a [f32],
        /// Distance between its rows.
        stride: usize,
    },
    /// Added after the rectifier.
    After {
        /// The tensor, from its first row on.
        rows: &'a [f32],
        /// Distance between its rows.
        stride: usize,
    },
}

/// The ends of chains of f32: bias, residual and ReLU. A paused sum waits in the output.
#[derive(Clone, Copy)]
pub(crate) struct End<'a> {
    /// One value per column, padded to a multiple of 16; chains start at 0 without it.
    pub(crate) bias: Option<&'a [f32]>,
    pub(crate) relu: bool,
    pub(crate) residual: Residual<'a>,
}

impl End<'_> {
    /// The specification of [`Epilogue::start`] for one output.
    #[inline(always)]
    pub(crate) fn start(&self, residual_row: usize, column: usize, out: f32) -> f32 {
        let start = self.bias.map_or(0.0, |bias| bias[column]);
        match self.residual {
            Residual::InPlace => start + out,
            Residual::Before { rows, stride } => start + rows[residual_row * stride + column],
            _ => start,
        }
    }

    /// The specification of [`Epilogue::finish`] for one output.
    #[inline(always)]
    pub(crate) fn finish(&self, residual_row: usize, column: usize, sum: f32) -> f32 {
        let end = if self.relu { relu(sum) } else { sum };
        match self.residual {
            Residual::After { rows, stride } => end + rows[residual_row * stride + column],
            _ => end,
        }
    }
}

impl<S: Simd> Epilogue<S, Single> for End<'_> {
    type Out = f32;

    #[inline(always)]
    fn start<T: Target, const WHOLE: bool>(&self, s: S, place: &Place<'_, T>, out: &[f32]) -> S::V {
        let start = match self.bias {
            Some(bias) => s.load_part(&bias[place.column..place.column + LANES]),
            None => s.splat(0.0),
        };
        match self.residual {
            Residual::InPlace => s.add(start, load::<S, WHOLE>(s, out)),
            Residual::Before { rows, stride } => {
                s.add(start, load::<S, WHOLE>(s, added(rows, stride, place, out.len())))
            }
            _ => start,
        }
    }

    #[inline(always)]
    fn resume<T: Target, const WHOLE: bool>(&self, s: S, _: &Place<'_, T>, out: &[f32]) -> S::V {
        load::<S, WHOLE>(s, out)
    }

    #[inline(always)]
    fn pause<T: Target, const WHOLE: bool>(&mut self, s: S, _: &Place<'_, T>, sums: S::V, out: &mut [f32]) {
        store::<S, WHOLE>(s, out, sums);
    }

    #[inline(always)]
    fn finish<T: Target, const WHOLE: bool>(&mut self, s: S, place: &Place<'_, T>, mut sums: S::V, out: &mut [f32]) {
        if self.relu {
            sums = s.relu(sums);
        }
        if let Residual::After { rows, stride } = self.residual {
            sums = s.add(sums, load::<S, WHOLE>(s, added(rows, stride, place, out.len())));
        }
        store::<S, WHOLE>(s, out, sums);
    }
}

/// The residual's values for `len` outputs.
#[inline(always)]
fn added<'a, T: Target>(rows: &'a [f32], stride: usize, place: &Place<'_, T>, len: usize) -> &'a [f32] {
    &rows[place.target.residual_row(place.row) * stride + place.column..][..len]
}

/// Up to 16 values; exactly 16 if `WHOLE`.
#[inline(always)]
fn load<S: Simd, const WHOLE: bool>(s: S, x: &[f32]) -> S::V {
    if WHOLE { s.load(x.first_chunk().expect("16 columns")) } else { s.load_part(x) }
}

/// As [`load`].
#[inline(always)]
fn store<S: Simd, const WHOLE: bool>(s: S, x: &mut [f32], v: S::V) {
    if WHOLE {
        s.store(x.first_chunk_mut().expect("16 columns"), v);
    } else {
        s.store_part(x, v);
    }
}

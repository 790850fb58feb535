//! Both ends of a product's chains: where they start, and what becomes of their sums.

use super::driver::Target;
use super::tile::{Arithmetic, Single};
use crate::simd::{LANES, Simd, relu};
use core::ops::Range;

/// Where the outputs of a tile of `N` rows are.
pub(crate) struct Place<'a, T, const N: usize> {
    /// The first column.
    pub(crate) column: usize,
    /// Columns of the whole product. If `WHOLE`, as the methods below call it, the tile's all exist; else the last vector of
    /// them may lack some.
    pub(crate) columns: usize,
    /// The first row in the whole product.
    pub(crate) row: usize,
    pub(crate) target: &'a T,
    /// Where each row of the product starts in the output.
    pub(crate) offsets: &'a [usize; N],
}

impl<T: Target, const N: usize> Place<'_, T, N> {
    /// First column of vector `j`.
    #[inline(always)]
    pub(crate) fn column(&self, j: usize) -> usize {
        self.column + j * LANES
    }

    /// Columns of vector `j`.
    #[inline(always)]
    pub(crate) fn len<const WHOLE: bool>(&self, j: usize) -> usize {
        if WHOLE { LANES } else { LANES.min(self.columns - self.column(j)) }
    }

    /// Vector `j` of row `r` in the output.
    #[inline(always)]
    pub(crate) fn range<const WHOLE: bool>(&self, r: usize, j: usize) -> Range<usize> {
        let start = self.offsets[r] + self.column(j);
        start..start + self.len::<WHOLE>(j)
    }

    /// Vector `j` of row `r` in a residual whose rows are `stride` apart.
    #[inline(always)]
    pub(crate) fn residual<const WHOLE: bool>(&self, r: usize, j: usize, stride: usize) -> Range<usize> {
        let start = self.target.residual_row(self.row + r) * stride + self.column(j);
        start..start + self.len::<WHOLE>(j)
    }
}

/// What a product does besides multiplying and adding, a tile of `N` rows by `P` vectors at a time.
///
/// A chain that is too long for one block of k is paused between two of them.
pub(crate) trait Epilogue<S: Simd, A: Arithmetic<S>> {
    /// Element of the output.
    type Out;

    /// The sums before the first product. The tile's place in `out` is as it was before the call.
    fn start<T: Target, const N: usize, const P: usize, const WHOLE: bool>(
        &self,
        s: S,
        place: &Place<'_, T, N>,
        out: &[Self::Out],
    ) -> [[A::Sums; P]; N];

    /// The sums that [`Epilogue::pause`] was given.
    fn resume<T: Target, const N: usize, const P: usize, const WHOLE: bool>(
        &self,
        s: S,
        place: &Place<'_, T, N>,
        out: &[Self::Out],
    ) -> [[A::Sums; P]; N];

    /// Keeps sums that are not complete.
    fn pause<T: Target, const N: usize, const P: usize, const WHOLE: bool>(
        &mut self,
        s: S,
        place: &Place<'_, T, N>,
        sums: [[A::Sums; P]; N],
        out: &mut [Self::Out],
    );

    /// Writes the outputs of complete sums.
    fn finish<T: Target, const N: usize, const P: usize, const WHOLE: bool>(
        &mut self,
        s: S,
        place: &Place<'_, T, N>,
        sums: [[A::Sums; P]; N],
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
    /// Added after ReLU.
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
    fn start<T: Target, const N: usize, const P: usize, const WHOLE: bool>(
        &self,
        s: S,
        place: &Place<'_, T, N>,
        out: &[f32],
    ) -> [[S::V; P]; N] {
        let mut start = [s.splat(0.0); P];
        if let Some(bias) = self.bias {
            for j in 0..P {
                start[j] = s.load_part(&bias[place.column(j)..place.column(j) + LANES]);
            }
        }
        let mut sums = [start; N];
        match self.residual {
            Residual::InPlace => add::<S, N, P, WHOLE>(s, &mut sums, |r, j| &out[place.range::<WHOLE>(r, j)]),
            Residual::Before { rows, stride } => {
                add::<S, N, P, WHOLE>(s, &mut sums, |r, j| &rows[place.residual::<WHOLE>(r, j, stride)]);
            }
            _ => {}
        }
        sums
    }

    #[inline(always)]
    fn resume<T: Target, const N: usize, const P: usize, const WHOLE: bool>(
        &self,
        s: S,
        place: &Place<'_, T, N>,
        out: &[f32],
    ) -> [[S::V; P]; N] {
        let mut sums = [[s.splat(0.0); P]; N];
        for r in 0..N {
            for j in 0..P {
                sums[r][j] = load::<S, WHOLE>(s, &out[place.range::<WHOLE>(r, j)]);
            }
        }
        sums
    }

    #[inline(always)]
    fn pause<T: Target, const N: usize, const P: usize, const WHOLE: bool>(
        &mut self,
        s: S,
        place: &Place<'_, T, N>,
        sums: [[S::V; P]; N],
        out: &mut [f32],
    ) {
        for r in 0..N {
            for j in 0..P {
                store::<S, WHOLE>(s, &mut out[place.range::<WHOLE>(r, j)], sums[r][j]);
            }
        }
    }

    #[inline(always)]
    fn finish<T: Target, const N: usize, const P: usize, const WHOLE: bool>(
        &mut self,
        s: S,
        place: &Place<'_, T, N>,
        mut sums: [[S::V; P]; N],
        out: &mut [f32],
    ) {
        if self.relu {
            for r in 0..N {
                for j in 0..P {
                    sums[r][j] = s.relu(sums[r][j]);
                }
            }
        }
        if let Residual::After { rows, stride } = self.residual {
            add::<S, N, P, WHOLE>(s, &mut sums, |r, j| &rows[place.residual::<WHOLE>(r, j, stride)]);
        }
        self.pause::<T, N, P, WHOLE>(s, place, sums, out);
    }
}

/// `sums[r][j] += x(r, j)`
#[inline(always)]
fn add<'a, S: Simd, const N: usize, const P: usize, const WHOLE: bool>(
    s: S,
    sums: &mut [[S::V; P]; N],
    x: impl Fn(usize, usize) -> &'a [f32],
) {
    for r in 0..N {
        for j in 0..P {
            sums[r][j] = s.add(sums[r][j], load::<S, WHOLE>(s, x(r, j)));
        }
    }
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

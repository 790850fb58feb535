//! Both ends of sums of bytes: bias, residual, ReLU and the way to the output's scale.

use super::{ProductI8, ResidualI8};
use crate::matmul::driver::{BLOCK_ROWS, Target};
use crate::matmul::epilogue::{Epilogue, Place};
use crate::quantised::{clamp, requantise};
use crate::simd::{LANES, Simd};
use core::marker::PhantomData;

/// What a signed left element is read too large by, where it is.
const SHIFT: i32 = 128;

/// What becomes of a sum.
pub(crate) trait Outcome {
    /// Element of the output.
    type Out: Copy;
    /// The output of a sum.
    fn of(sum: i32, multiplier: i32) -> Self::Out;
    /// An output as a residual.
    fn value(out: Self::Out) -> i32;
    /// [`Outcome::of`] up to 16 sums.
    fn store<S: Simd>(s: S, out: &mut [Self::Out], sums: S::I, multiplier: S::I);
    /// [`Outcome::value`] of up to 16 outputs.
    fn load<S: Simd>(s: S, out: &[Self::Out]) -> S::I;
}

/// An 8-bit tensor.
#[derive(Clone, Copy)]
pub(crate) struct Narrow;

impl Outcome for Narrow {
    type Out = i8;

    #[inline(always)]
    fn of(sum: i32, multiplier: i32) -> i8 {
        clamp(requantise(sum, multiplier), false)
    }
    #[inline(always)]
    fn value(out: i8) -> i32 {
        out.into()
    }
    #[inline(always)]
    fn store<S: Simd>(s: S, out: &mut [i8], sums: S::I, multiplier: S::I) {
        s.store_bytes_part(out, s.quantised(s.requantise(sums, multiplier), false));
    }
    #[inline(always)]
    fn load<S: Simd>(s: S, out: &[i8]) -> S::I {
        s.bytes_to_int(s.load_bytes_part(out))
    }
}

/// Integers in the output's scale that are not clamped.
#[derive(Clone, Copy)]
pub(crate) struct Wide;

impl Outcome for Wide {
    type Out = i32;

    #[inline(always)]
    fn of(sum: i32, multiplier: i32) -> i32 {
        requantise(sum, multiplier)
    }
    #[inline(always)]
    fn value(out: i32) -> i32 {
        out
    }
    #[inline(always)]
    fn store<S: Simd>(s: S, out: &mut [i32], sums: S::I, multiplier: S::I) {
        Raw::store(s, out, s.requantise(sums, multiplier), multiplier);
    }
    #[inline(always)]
    fn load<S: Simd>(s: S, out: &[i32]) -> S::I {
        s.load_int_part(out)
    }
}

/// The sums themselves.
#[derive(Clone, Copy)]
pub(crate) struct Raw;

impl Outcome for Raw {
    type Out = i32;

    #[inline(always)]
    fn of(sum: i32, _: i32) -> i32 {
        sum
    }
    #[inline(always)]
    fn value(out: i32) -> i32 {
        out
    }
    #[inline(always)]
    fn store<S: Simd>(s: S, out: &mut [i32], sums: S::I, _: S::I) {
        s.store_int_part(out, sums);
    }
    #[inline(always)]
    fn load<S: Simd>(s: S, out: &[i32]) -> S::I {
        s.load_int_part(out)
    }
}

/// The ends of a product's sums. Sums that are not complete wait for the rest of their block of rows.
pub(super) struct End<'a, O> {
    product: &'a ProductI8<'a>,
    /// Whether left elements are read [`SHIFT`] too large.
    shifted: bool,
    /// The first row of the first block.
    first: usize,
    waiting: &'a mut [i32],
    outcome: PhantomData<O>,
}

impl<'a, O: Outcome> End<'a, O> {
    #[inline(always)]
    pub(super) fn new<S: Simd>(s: S, product: &'a ProductI8<'a>, first: usize, waiting: &'a mut [i32]) -> Self {
        Self { product, shifted: product.signed && s.shifts_bytes(), first, waiting, outcome: PhantomData }
    }

    /// Where vector `j` of row `r` waits.
    #[inline(always)]
    fn wait<T: Target, const N: usize>(&self, place: &Place<'_, T, N>, r: usize, j: usize) -> usize {
        let row = (place.row + r - self.first) % BLOCK_ROWS;
        row * self.product.columns.next_multiple_of(LANES) + place.column(j)
    }
}

/// 16 values of a column's own, from column `column` on.
#[inline(always)]
fn columns<S: Simd>(s: S, x: &[i32], column: usize) -> S::I {
    s.load_int(x[column..].first_chunk().expect("columns are padded"))
}

impl<S: Simd, O: Outcome> Epilogue<S, super::Bytes<'_>> for End<'_, O> {
    type Out = O::Out;

    #[inline(always)]
    fn start<T: Target, const N: usize, const P: usize, const WHOLE: bool>(
        &self,
        s: S,
        place: &Place<'_, T, N>,
        _: &[O::Out],
    ) -> [[S::I; P]; N] {
        let mut start = [s.splat_int(0); P];
        for j in 0..P {
            start[j] = columns(s, self.product.bias, place.column(j));
            if self.shifted {
                let sums = columns(s, self.product.sums, place.column(j));
                start[j] = s.add_int(start[j], s.mul_int(sums, s.splat_int((-SHIFT).cast_unsigned())));
            }
        }
        [start; N]
    }

    #[inline(always)]
    fn resume<T: Target, const N: usize, const P: usize, const WHOLE: bool>(
        &self,
        s: S,
        place: &Place<'_, T, N>,
        _: &[O::Out],
    ) -> [[S::I; P]; N] {
        let mut sums = [[s.splat_int(0); P]; N];
        for r in 0..N {
            for j in 0..P {
                sums[r][j] = columns(s, self.waiting, self.wait(place, r, j));
            }
        }
        sums
    }

    #[inline(always)]
    fn pause<T: Target, const N: usize, const P: usize, const WHOLE: bool>(
        &mut self,
        s: S,
        place: &Place<'_, T, N>,
        sums: [[S::I; P]; N],
        _: &mut [O::Out],
    ) {
        for r in 0..N {
            for j in 0..P {
                let at = self.wait(place, r, j);
                s.store_int_part(&mut self.waiting[at..at + LANES], sums[r][j]);
            }
        }
    }

    #[inline(always)]
    fn finish<T: Target, const N: usize, const P: usize, const WHOLE: bool>(
        &mut self,
        s: S,
        place: &Place<'_, T, N>,
        sums: [[S::I; P]; N],
        out: &mut [O::Out],
    ) {
        let ProductI8 { relu, residual, multiplier, .. } = *self.product;
        let joins = self.product.joins();
        for j in 0..P {
            let multiplier = columns(s, multiplier, place.column(j));
            for r in 0..N {
                let mut sum = sums[r][j];
                let range = place.range::<WHOLE>(r, j);
                let floor = s.splat_int(0);
                if let Some((multiplier, after)) = joins {
                    let x = match residual {
                        ResidualI8::Apart { rows, stride, .. } => {
                            s.bytes_to_int(s.load_bytes_part(&rows[place.residual::<WHOLE>(r, j, stride)]))
                        }
                        _ => O::load(s, &out[range.clone()]),
                    };
                    let x = s.mul_int(x, columns(s, multiplier, place.column(j)));
                    if relu && after {
                        sum = s.max_int(sum, floor);
                    }
                    sum = s.add_int(sum, x);
                    if relu && !after {
                        sum = s.max_int(sum, floor);
                    }
                } else if relu {
                    sum = s.max_int(sum, floor);
                }
                O::store(s, &mut out[range], sum, multiplier);
            }
        }
    }
}

//! One factor and one addend per channel, in place: a normalisation that could not be folded into a convolution.
//!
//! ```text
//! y = x * scale[c] + shift[c]        rounded once
//! y = y + residual[row][c]           if there is a residual that comes before ReLU
//! y = if y < 0 { 0 } else { y }      if asked for; NaN stays
//! y = y + residual[row][c]           if there is a residual that comes after it
//! ```
//!
//! The body does sixteen channels at a time.

use crate::isa::Isa;
#[cfg(not(feature = "std"))]
use crate::math::Float as _;
use crate::simd::{Kernel, LANES, Simd, dispatch, relu};

/// The arguments of a scaling.
#[derive(Clone, Copy, Debug)]
pub struct ScaleShift<'a> {
    /// One factor per channel, padded with anything to a multiple of 16.
    pub scale: &'a [f32],
    /// One addend per channel, padded likewise.
    pub shift: &'a [f32],
    /// Channels that are scaled.
    pub channels: usize,
    /// First of them; the others of a row stay.
    pub first_channel: usize,
    /// Channels of a row.
    pub stride: usize,
    /// `[rows, stride]`, of which the scaled channels are added.
    pub residual: Option<&'a [f32]>,
    /// Whether the residual is added after ReLU instead of before.
    pub residual_after: bool,
    /// Whether negative results become 0.
    pub relu: bool,
}

impl ScaleShift<'_> {
    fn check(&self, rows: &[f32]) {
        let padded = self.channels.next_multiple_of(LANES);
        assert!(self.channels > 0, "an extent is zero");
        assert_eq!(self.scale.len(), padded, "the scale has another length");
        assert_eq!(self.shift.len(), padded, "the shift has another length");
        assert!(self.first_channel + self.channels <= self.stride, "the channels leave the row");
        assert!(rows.len().is_multiple_of(self.stride), "the tensor is not whole rows");
        assert!(self.residual.is_none_or(|r| r.len() == rows.len()), "the residual has another shape");
    }
}

/// Replaces the channels of `rows`, `[rows, stride]`. To divide rows among threads, divide the residual alike.
///
/// # Panics
/// If a slice does not have the size that the shapes ask for.
///
/// # Determinism
/// The same bits on every instruction set and for every division into rows.
pub fn scale_shift(isa: Isa, args: &ScaleShift<'_>, rows: &mut [f32]) {
    args.check(rows);
    dispatch(isa, Run { args, rows });
}

struct Run<'a> {
    args: &'a ScaleShift<'a>,
    rows: &'a mut [f32],
}

impl Kernel for Run<'_> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        let a = self.args;
        for (i, x) in self.rows.iter_mut().enumerate() {
            let Some(c) = (i % a.stride).checked_sub(a.first_channel).filter(|&c| c < a.channels) else { continue };
            let mut y = x.mul_add(a.scale[c], a.shift[c]);
            if let Some(residual) = a.residual.filter(|_| !a.residual_after) {
                y += residual[i];
            }
            if a.relu {
                y = relu(y);
            }
            if let Some(residual) = a.residual.filter(|_| a.residual_after) {
                y += residual[i];
            }
            *x = y;
        }
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let a = self.args;
        for (row, x) in self.rows.chunks_exact_mut(a.stride).enumerate() {
            for (panel, x) in x[a.first_channel..][..a.channels].chunks_mut(LANES).enumerate() {
                let c = panel * LANES;
                let mut y = s.mul_add(s.load_part(x), s.load_part(&a.scale[c..]), s.load_part(&a.shift[c..]));
                let residual = a.residual.map(|r| {
                    let at = row * a.stride + a.first_channel + c;
                    s.load_part(&r[at..at + x.len()])
                });
                if let Some(residual) = residual.filter(|_| !a.residual_after) {
                    y = s.add(y, residual);
                }
                if a.relu {
                    y = s.relu(y);
                }
                if let Some(residual) = residual.filter(|_| a.residual_after) {
                    y = s.add(y, residual);
                }
                s.store_part(x, y);
            }
        }
    }
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{Fill, Rng, assert_lively, assert_order_shows, assert_same_bits, pad_rows};

    struct Case {
        channels: usize,
        first_channel: usize,
        stride: usize,
        relu: bool,
        residual_after: bool,
        x: Vec<f32>,
        scale: Vec<f32>,
        shift: Vec<f32>,
        residual: Option<Vec<f32>>,
    }

    impl Case {
        fn new(rows: usize, channels: usize, residual: bool, relu: bool, seed: u64, fill: Fill) -> Self {
            let mut rng = Rng::new(seed);
            let x = fill(&mut rng, rows * channels);
            let scale = pad_rows(&fill(&mut rng, channels), channels, f32::NAN);
            let shift = pad_rows(&fill(&mut rng, channels), channels, f32::NAN);
            let residual = residual.then(|| fill(&mut rng, rows * channels));
            Self {
                channels,
                first_channel: 0,
                stride: channels,
                relu,
                residual_after: false,
                x,
                scale,
                shift,
                residual,
            }
        }

        /// The same channels amid others, with values of their own.
        fn within(mut self, before: usize, after: usize, residual_after: bool, seed: u64, fill: Fill) -> Self {
            let rows = self.x.len() / self.stride;
            let mut rng = Rng::new(seed);
            (self.first_channel, self.stride) = (before, before + self.channels + after);
            self.x = fill(&mut rng, rows * self.stride);
            self.residual = self.residual.map(|_| fill(&mut rng, rows * self.stride));
            self.residual_after = residual_after;
            self
        }

        fn args(&self) -> ScaleShift<'_> {
            let Self {
                channels, first_channel, stride, relu, residual_after, ref scale, ref shift, ref residual, ..
            } = *self;
            ScaleShift {
                scale,
                shift,
                channels,
                first_channel,
                stride,
                residual: residual.as_deref(),
                residual_after,
                relu,
            }
        }

        fn all(&self, isa: Isa) -> Vec<f32> {
            let mut rows = self.x.clone();
            scale_shift(isa, &self.args(), &mut rows);
            rows
        }
    }

    #[test]
    fn by_hand() {
        let mut case = Case::new(2, 2, true, false, 0, Rng::ordinary);
        case.x = vec![1.0, 2.0, 3.0, -4.0];
        case.scale = pad_rows(&[2.0, 10.0], 2, 0.0);
        case.shift = pad_rows(&[0.5, -1.0], 2, 0.0);
        for isa in Isa::available() {
            case.residual = None;
            case.relu = false;
            assert_eq!(case.all(isa), [2.5, 19.0, 6.5, -41.0]);
            case.relu = true;
            assert_eq!(case.all(isa), [2.5, 19.0, 6.5, 0.0]);
            // ReLU comes after the residual: -41 + 50 stays.
            case.residual = Some(vec![0.0, -20.0, 1.0, 50.0]);
            assert_eq!(case.all(isa), [2.5, 0.0, 7.5, 9.0]);
            case.residual_after = true;
            assert_eq!(case.all(isa), [2.5, -1.0, 7.5, 50.0]);
            // Only the second of two channels: it takes the first factor and addend.
            (case.channels, case.first_channel) = (1, 1);
            assert_eq!(case.all(isa), [1.0, -15.5, 3.0, 50.0]);
            (case.channels, case.first_channel, case.residual_after) = (2, 0, false);
        }
    }

    const SHAPES: [[usize; 2]; 8] = [[1, 16], [40, 1], [7, 5], [4, 15], [5, 16], [3, 17], [2, 33], [6, 64]];

    #[test]
    fn every_isa_gives_the_scalar_bits() {
        for [rows, channels] in SHAPES {
            for (residual, relu) in [(false, false), (false, true), (true, false), (true, true)] {
                for fill in [Rng::wide as Fill, Rng::special] {
                    for [before, after] in [[0, 0], [3, 0], [16, 5]] {
                        let case = Case::new(rows, channels, residual, relu, 4, fill);
                        let case = case.within(before, after, before == 3, 5, fill);
                        let want = case.all(Isa::Scalar);
                        assert_lively(&want, &format!("{rows} x {channels}"));
                        for isa in Isa::available() {
                            assert_same_bits(
                                &case.all(isa),
                                &want,
                                &format!("{isa:?} {rows} x {channels} after {before}"),
                            );
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn the_fused_rounding_shows() {
        let case = Case::new(9, 33, false, false, 7, Rng::ordinary);
        let twice = case.x.iter().enumerate().map(|(i, x)| x * case.scale[i % 33] + case.shift[i % 33]);
        assert_order_shows(&twice.collect::<Vec<_>>(), &case.all(Isa::Scalar), "rounded twice");
    }

    fn case() -> Case {
        Case::new(3, 4, true, true, 0, Rng::ordinary)
    }

    #[test]
    #[should_panic(expected = "an extent is zero")]
    fn no_channels() {
        scale_shift(Isa::Scalar, &ScaleShift { channels: 0, ..case().args() }, &mut []);
    }

    #[test]
    #[should_panic(expected = "the scale has another length")]
    fn unpadded_scale() {
        scale_shift(Isa::Scalar, &ScaleShift { scale: &[0.0; 4], ..case().args() }, &mut [0.0; 12]);
    }

    #[test]
    #[should_panic(expected = "the shift has another length")]
    fn unpadded_shift() {
        scale_shift(Isa::Scalar, &ScaleShift { shift: &[0.0; 4], ..case().args() }, &mut [0.0; 12]);
    }

    #[test]
    #[should_panic(expected = "the tensor is not whole rows")]
    fn part_of_a_row() {
        scale_shift(Isa::Scalar, &case().args(), &mut [0.0; 11]);
    }

    #[test]
    #[should_panic(expected = "the residual has another shape")]
    fn short_residual() {
        scale_shift(Isa::Scalar, &case().args(), &mut [0.0; 8]);
    }
}

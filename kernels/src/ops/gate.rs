//! Fusion of a volume with its bird's-eye view: each voxel decides how much of its column's BEV feature to take.
//!
//! ```text
//! for each column xy, for each z:
//!     lane[j]   = 0 + volume[xy][z][j] * w[j] + volume[xy][z][j + 16] * w[j + 16] + ...     16 fma chains
//!     gate      = sigmoid(tree(lane) + bias)
//!     volume[xy][z][c] = gate * bev[xy][c] + volume[xy][z][c]                               rounded once
//! tree: halves, quarters, eighths, pairs: lane[j] += lane[j + 8], then + 4, + 2, + 1
//! ```
//!
//! Channels from the last one up to the next multiple of 16 count as volume = 0 and stay in their chain.
//!
//! The body keeps a dot product's chains in one vector. It takes sixteen voxels at a time, so that their sigmoids are
//! one vector too.

use crate::isa::Isa;
#[cfg(not(feature = "std"))]
use crate::math::Float as _;
use crate::math::{exp_v, sigmoid};
use crate::simd::{Kernel, LANES, Simd, dispatch, tree_sum};

/// A gate's arguments.
#[derive(Clone, Copy, Debug)]
pub struct Gate<'a> {
    /// `[columns, channels]`.
    pub bev: &'a [f32],
    /// Voxels per column.
    pub depth: usize,
    /// Channels of both tensors.
    pub channels: usize,
    /// One weight per channel, padded with zeros to a multiple of 16.
    pub weights: &'a [f32],
    /// Added to the dot product.
    pub bias: f32,
}

impl Gate<'_> {
    fn check(&self, volume: &[f32]) {
        assert!(self.channels > 0 && self.depth > 0, "an extent is zero");
        assert!(self.bev.len().is_multiple_of(self.channels), "the BEV is not whole rows");
        assert_eq!(self.weights.len(), self.channels.next_multiple_of(LANES), "the weights have another length");
        assert_eq!(volume.len(), self.bev.len() * self.depth, "the volume has another shape");
    }
}

/// Adds to `volume`, `[columns, depth, channels]`, in place. To divide columns among threads, divide the BEV alike.
///
/// # Panics
/// If an extent is zero or a slice does not have the size that the shapes ask for.
///
/// # Determinism
/// The same bits on every instruction set and for every division into columns.
pub fn gate(isa: Isa, args: &Gate<'_>, volume: &mut [f32]) {
    args.check(volume);
    dispatch(isa, Run { args, volume });
}

struct Run<'a> {
    args: &'a Gate<'a>,
    volume: &'a mut [f32],
}

impl Kernel for Run<'_> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        let a = self.args;
        for (i, voxel) in self.volume.chunks_exact_mut(a.channels).enumerate() {
            let mut lanes = [0.0; LANES];
            for (c, w) in a.weights.iter().enumerate() {
                let x = if c < a.channels { voxel[c] } else { 0.0 };
                lanes[c % LANES] = x.mul_add(*w, lanes[c % LANES]);
            }
            let gate = sigmoid(tree_sum(lanes) + a.bias);
            for c in 0..a.channels {
                voxel[c] = gate.mul_add(a.bev[i / a.depth * a.channels + c], voxel[c]);
            }
        }
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let a = self.args;
        for (block, voxels) in self.volume.chunks_mut(LANES * a.channels).enumerate() {
            let mut dots = [0.0; LANES];
            for (dot, voxel) in dots.iter_mut().zip(voxels.chunks_exact(a.channels)) {
                let mut sum = s.splat(0.0);
                for (x, w) in voxel.chunks(LANES).zip(a.weights.chunks_exact(LANES)) {
                    sum = s.mul_add(s.load_part(x), s.load_part(w), sum);
                }
                *dot = tree_sum(s.lanes(sum));
            }
            let dots = s.add(s.load(&dots), s.splat(a.bias));
            let exp = exp_v(s, s.mul(dots, s.splat(-1.0)));
            let gates = s.lanes(s.div(s.splat(1.0), s.add(s.splat(1.0), exp)));
            for (i, voxel) in voxels.chunks_exact_mut(a.channels).enumerate() {
                let bev = &a.bev[(block * LANES + i) / a.depth * a.channels..][..a.channels];
                for (x, bev) in voxel.chunks_mut(LANES).zip(bev.chunks(LANES)) {
                    let y = s.mul_add(s.splat(gates[i]), s.load_part(bev), s.load_part(x));
                    s.store_part(x, y);
                }
            }
        }
    }
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{Fill, Rng, assert_lively, assert_order_shows, assert_same_bits, pad_rows, reverse_columns};

    struct Case {
        shape: [usize; 3],
        volume: Vec<f32>,
        bev: Vec<f32>,
        weights: Vec<f32>,
        bias: f32,
    }

    impl Case {
        fn new(shape: [usize; 3], seed: u64, fill: Fill) -> Self {
            let [columns, depth, channels] = shape;
            let mut rng = Rng::new(seed);
            let volume = fill(&mut rng, columns * depth * channels);
            let bev = fill(&mut rng, columns * channels);
            let weights = pad_rows(&rng.wide(channels), channels, 0.0);
            Self { shape, volume, bev, weights, bias: rng.unit() }
        }

        fn args(&self) -> Gate<'_> {
            let [_, depth, channels] = self.shape;
            Gate { bev: &self.bev, depth, channels, weights: &self.weights, bias: self.bias }
        }

        fn all(&self, isa: Isa) -> Vec<f32> {
            let mut volume = self.volume.clone();
            gate(isa, &self.args(), &mut volume);
            volume
        }
    }

    #[test]
    fn by_hand() {
        // Dot products 2 * 1 - 1 * 2 = 0 and 300 and -300: the gates are 1/2, 1 and (almost) 0.
        let mut case = Case::new([3, 1, 2], 0, Rng::ordinary);
        case.volume = vec![1.0, 2.0, 300.0, 300.0, 0.0, 300.0];
        case.bev = vec![10.0, 20.0, 1.0, 2.0, 1.0, 2.0];
        case.weights = pad_rows(&[2.0, -1.0], 2, 0.0);
        case.bias = 0.0;
        for isa in Isa::available() {
            assert_eq!(case.all(isa), [6.0, 12.0, 301.0, 302.0, 1.0 / (1.0 + crate::math::exp(300.0)), 300.0]);
        }
    }

    /// Channels around 16, voxels around a block of 16 and columns that straddle blocks.
    const SHAPES: [[usize; 3]; 9] =
        [[1, 1, 16], [3, 5, 1], [2, 8, 5], [4, 4, 15], [17, 1, 16], [2, 7, 17], [5, 3, 33], [3, 16, 64], [1, 33, 64]];

    #[test]
    fn every_isa_gives_the_scalar_bits() {
        for shape in SHAPES {
            for fill in [Rng::ordinary as Fill, Rng::wide, special_bev] {
                let case = Case::new(shape, 11, fill);
                let want = case.all(Isa::Scalar);
                assert_lively(&want, &format!("{shape:?}"));
                for isa in Isa::available() {
                    assert_same_bits(&case.all(isa), &want, &format!("{isa:?} {shape:?}"));
                }
            }
        }
    }

    /// Infinities and NaN, rare enough that most voxels, of up to 64 channels each, stay finite.
    fn special_bev(rng: &mut Rng, n: usize) -> Vec<f32> {
        let mut x = rng.wide(n);
        for (i, v) in [f32::INFINITY, f32::NAN, f32::NEG_INFINITY].into_iter().enumerate().take(n / 64) {
            x[i * 64 + 5] = v;
        }
        x
    }

    #[test]
    fn the_order_of_a_sum_shows() {
        let mut case = Case::new([3, 16, 64], 7, Rng::ordinary);
        case.weights = Rng::new(8).ordinary(64);
        let want = case.all(Isa::Scalar);
        (case.volume, case.bev) = (reverse_columns(&case.volume, 64), reverse_columns(&case.bev, 64));
        case.weights.reverse();
        assert_order_shows(&reverse_columns(&case.all(Isa::Scalar), 64), &want, "channels");
    }

    fn case() -> Case {
        Case::new([3, 2, 4], 0, Rng::ordinary)
    }

    #[test]
    #[should_panic(expected = "an extent is zero")]
    fn no_depth() {
        gate(Isa::Scalar, &Gate { depth: 0, ..case().args() }, &mut []);
    }

    #[test]
    #[should_panic(expected = "the BEV is not whole rows")]
    fn part_of_a_row() {
        gate(Isa::Scalar, &Gate { bev: &[0.0; 7], ..case().args() }, &mut [0.0; 14]);
    }

    #[test]
    #[should_panic(expected = "the weights have another length")]
    fn unpadded_weights() {
        gate(Isa::Scalar, &Gate { weights: &[0.0; 4], ..case().args() }, &mut [0.0; 24]);
    }

    #[test]
    #[should_panic(expected = "the volume has another shape")]
    fn short_volume() {
        gate(Isa::Scalar, &case().args(), &mut [0.0; 20]);
    }
}

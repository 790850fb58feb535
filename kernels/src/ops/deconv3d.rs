//! Transposed convolution in three dimensions with kernel 4, stride 2, padding 1: it doubles every axis.
//!
//! An output of parity p (its index modulo 2) meets only two of the four taps per axis, so each of the eight parities is
//! a plain 2x2x2 convolution of the input with no padding but at the border, and every output is written once:
//!
//! ```text
//! out[2i + p] = end(bias + sum over taps t in {0, 1} per axis and c of x[i + t - 1 + p][c] * weight[3 - p - 2t][c])
//! ```
//!
//! k runs over (t_d, t_h, t_w, c) ascending. Weights are eight packed matrices of `8 * channels` rows, one after the
//! other, parity `(p_d * 2 + p_h) * 2 + p_w`; [`kernel_tap`] says which of the four taps each of their rows is.

use crate::isa::Isa;
use crate::matmul::driver::{Source, Target};
use crate::matmul::layout::packed_len;
use crate::matmul::product::Multiply;
use crate::matmul::{Panels, Product, Residual};
use crate::ops::conv::{Geometry, Walk};
use crate::simd::{Kernel, Simd, dispatch};
use core::ops::Range;

/// Index into the kernel's four taps of tap `tap` (0 or 1) of the sub-convolution for parity `parity`.
pub const fn kernel_tap(parity: usize, tap: usize) -> usize {
    3 - parity - 2 * tap
}

/// A transposed convolution's arguments.
#[derive(Clone, Copy, Debug)]
pub struct Deconv3d<'a> {
    /// Input extent; the output's is twice that on every axis.
    pub extent: [usize; 3],
    /// Input channels.
    pub channels: usize,
    /// Output channels.
    pub columns: usize,
    /// `[extent, channels]`.
    pub input: &'a [f32],
    /// The eight packed matrices.
    pub weights: Panels<'a>,
    /// One value per output channel, padded to a multiple of 16.
    pub bias: &'a [f32],
    /// Whether negative results become 0.
    pub relu: bool,
    /// `[2 * extent, columns]`, added after ReLU.
    pub add: Option<&'a [f32]>,
}

/// Computes the planes `planes` of the output's first axis into `out`, which holds exactly those, densely. `scratch`
/// holds [`crate::matmul::SCRATCH`] values of any value.
///
/// # Panics
/// If a slice does not have the size that the shapes ask for.
///
/// # Determinism
/// The same bits on every instruction set and for every division into planes.
pub fn deconv3d(isa: Isa, args: &Deconv3d<'_>, planes: Range<usize>, out: &mut [f32], scratch: &mut [f32]) {
    assert_eq!(args.weights.len(), 8 * args.parity_len(), "packed weights do not match the shape");
    let plane = args.check(&planes, out, scratch);
    assert!(args.add.is_none_or(|a| a.len() == 2 * args.extent[0] * plane), "the added tensor has another shape");
    dispatch(isa, Run { args, planes, out, scratch });
}

impl<'a> Deconv3d<'a> {
    fn parity_len(&self) -> usize {
        packed_len(8 * self.channels, self.columns)
    }
}

impl<'a> Parts for Deconv3d<'a> {
    type Product = Product<'a>;

    fn extent(&self) -> [usize; 3] {
        self.extent
    }

    fn part(&self, parity: usize) -> (Walk<'a, f32>, Product<'a>) {
        let range = parity * self.parity_len()..(parity + 1) * self.parity_len();
        let residual = match self.add {
            Some(rows) => Residual::After { rows, stride: self.columns },
            None => Residual::None,
        };
        let product = Product {
            weights: match self.weights {
                Panels::F32(w) => Panels::F32(&w[range]),
                Panels::F16(w) => Panels::F16(&w[range]),
            },
            bias: self.bias,
            depth: 8 * self.channels,
            columns: self.columns,
            relu: self.relu,
            residual,
        };
        (Walk { geometry: geometry(self.extent, self.channels, parity), input: self.input }, product)
    }
}

/// A transposed convolution as eight plain ones, one per parity.
pub(crate) trait Parts {
    /// The product of each of them.
    type Product: Multiply<Left: Default>;

    /// Input extent.
    fn extent(&self) -> [usize; 3];

    /// The convolution of parity `(p_d * 2 + p_h) * 2 + p_w`.
    fn part(&self, parity: usize) -> (Walk<'_, <Self::Product as Multiply>::Left>, Self::Product);

    /// The size of a plane of the output.
    ///
    /// # Panics
    /// If a slice does not have the size that the shapes ask for.
    fn check(
        &self,
        planes: &Range<usize>,
        out: &[<Self::Product as Multiply>::Out],
        scratch: &[<Self::Product as Multiply>::Scratch],
    ) -> usize {
        let [d, h, w] = self.extent();
        let (walk, product) = self.part(0);
        walk.geometry.check(walk.input);
        product.check(0, scratch);
        let plane = 4 * h * w * product.columns();
        assert!(planes.start <= planes.end && planes.end <= 2 * d, "planes {planes:?} of {}", 2 * d);
        assert_eq!(out.len(), planes.len() * plane, "the output does not hold the planes");
        plane
    }
}

/// How the convolution of one parity walks the input.
pub(crate) fn geometry(extent: [usize; 3], channels: usize, parity: usize) -> Geometry {
    Geometry {
        input: extent,
        channels,
        kernel: [2; 3],
        stride: [1; 3],
        dilation: [1; 3],
        padding: axes(parity).map(|p| 1 - p),
        output: extent,
    }
}

/// A parity's parities per axis.
fn axes(parity: usize) -> [usize; 3] {
    [parity / 4, parity / 2 % 2, parity % 2]
}

/// Rows of one input plane, as positions of one parity in one output plane.
struct Interleaved {
    extent: [usize; 3],
    columns: usize,
    parity: [usize; 3],
}

impl Interleaved {
    /// (row within the output plane, output plane)
    #[inline(always)]
    fn place(&self, row: usize) -> (usize, usize) {
        let [_, h, w] = self.extent;
        let (y, z) = (row / w % h * 2 + self.parity[1], row % w * 2 + self.parity[2]);
        (y * 2 * w + z, row / (h * w) * 2 + self.parity[0])
    }
}

impl Target for Interleaved {
    #[inline(always)]
    fn offset(&self, row: usize) -> usize {
        self.place(row).0 * self.columns
    }
    #[inline(always)]
    fn residual_row(&self, row: usize) -> usize {
        let (row, plane) = self.place(row);
        plane * 4 * self.extent[1] * self.extent[2] + row
    }
}

/// The planes `planes` of the output, densely in `out`.
pub(crate) struct Run<'a, D: Parts> {
    pub(crate) args: &'a D,
    pub(crate) planes: Range<usize>,
    pub(crate) out: &'a mut [<D::Product as Multiply>::Out],
    pub(crate) scratch: &'a mut [<D::Product as Multiply>::Scratch],
}

impl<D: Parts> Run<'_, D> {
    /// Calls `part` with each sub-convolution, its input rows, its places, and the output plane.
    #[inline(always)]
    fn each(
        self,
        mut part: impl FnMut(
            (Walk<'_, <D::Product as Multiply>::Left>, D::Product),
            Range<usize>,
            &Interleaved,
            &mut [<D::Product as Multiply>::Out],
            &mut [<D::Product as Multiply>::Scratch],
        ),
    ) {
        let extent = self.args.extent();
        let [_, h, w] = extent;
        let columns = self.args.part(0).1.columns();
        for (x, out) in self.planes.zip(self.out.chunks_exact_mut((4 * h * w * columns).max(1))) {
            for yz in 0..4 {
                let parity = x % 2 * 4 + yz;
                let target = Interleaved { extent, columns, parity: axes(parity) };
                let rows = x / 2 * h * w..(x / 2 + 1) * h * w;
                part(self.args.part(parity), rows, &target, out, self.scratch);
            }
        }
    }
}

impl<D: Parts> Kernel for Run<'_, D> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        self.each(
            #[inline(always)]
            |(walk, product), rows, target, out, _| {
                for row in rows {
                    let out = &mut out[target.offset(row)..][..product.columns()];
                    product.reference(
                        target.residual_row(row),
                        out,
                        #[inline(always)]
                        |k| walk.element(row, k),
                    );
                }
            },
        );
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        self.each(
            #[inline(always)]
            |(walk, product), rows, target, out, scratch| product.compute(s, &walk, target, rows, out, scratch),
        );
    }
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests {
    use super::*;
    use crate::matmul::SCRATCH;
    use crate::matmul::layout::pack;
    use crate::testing::{
        Fill, Rng, Tally, assert_close, assert_lively, assert_order_shows, assert_same_bits, pad_rows,
        reverse_channels, reverse_columns, round_to,
    };
    use half::f16;
    use proptest::prelude::*;
    use proptest::test_runner::{Config, TestRunner};

    struct Case {
        extent: [usize; 3],
        channels: usize,
        columns: usize,
        relu: bool,
        input: Vec<f32>,
        single: Vec<f32>,
        half: Option<Vec<f16>>,
        bias: Vec<f32>,
        add: Option<Vec<f32>>,
        /// `[channels, columns, 4, 4, 4]`, as PyTorch has them.
        natural: Vec<f32>,
    }

    /// Half precision, added tensor, ReLU.
    type Way = [bool; 3];

    impl Case {
        fn new(extent: [usize; 3], [channels, columns]: [usize; 2], way: Way, seed: u64, fill: Fill) -> Self {
            let mut rng = Rng::new(seed);
            let natural = round_to(way[0], fill(&mut rng, channels * columns * 64));
            let len = packed_len(8 * channels, columns);
            let mut single = vec![f32::NAN; 8 * len];
            for (parity, single) in single.chunks_exact_mut(len.max(1)).enumerate() {
                let parity = [parity / 4, parity / 2 % 2, parity % 2];
                let weight = |k: usize, n: usize| {
                    let (tap, c) = (k / channels, k % channels);
                    let tap = [tap / 4, tap / 2 % 2, tap % 2];
                    let [d, h, w]: [usize; 3] = std::array::from_fn(|i| kernel_tap(parity[i], tap[i]));
                    natural[(c * columns + n) * 64 + (d * 4 + h) * 4 + w]
                };
                pack(8 * channels, columns, weight, single);
            }
            let voxels = extent.iter().product::<usize>();
            Self {
                extent,
                channels,
                columns,
                relu: way[2],
                half: way[0].then(|| single.iter().map(|w| f16::from_f32(*w)).collect()),
                single,
                input: fill(&mut rng, voxels * channels),
                bias: pad_rows(&fill(&mut rng, columns), columns, f32::NAN),
                add: way[1].then(|| fill(&mut rng, 8 * voxels * columns)),
                natural,
            }
        }

        fn args(&self) -> Deconv3d<'_> {
            Deconv3d {
                extent: self.extent,
                channels: self.channels,
                columns: self.columns,
                input: &self.input,
                weights: self.half.as_ref().map_or(Panels::F32(&self.single), |w| Panels::F16(w)),
                bias: &self.bias,
                relu: self.relu,
                add: self.add.as_deref(),
            }
        }

        fn planes(&self, isa: Isa, planes: Range<usize>) -> Vec<f32> {
            let mut out = vec![f32::NAN; planes.len() * 4 * self.extent[1] * self.extent[2] * self.columns];
            deconv3d(isa, &self.args(), planes, &mut out, &mut [f32::NAN; SCRATCH]);
            out
        }

        fn all(&self, isa: Isa) -> Vec<f32> {
            self.planes(isa, 0..2 * self.extent[0])
        }

        /// `ConvTranspose3d(kernel_size=4, stride=2, padding=1)` in f64 as it is defined: every input voxel scatters its
        /// products over 4 x 4 x 4 outputs.
        fn naive(&self) -> Vec<f64> {
            let [d, h, w] = self.extent;
            let mut out = vec![0.0; 8 * d * h * w * self.columns];
            for (i, x) in self.input.iter().enumerate() {
                let (voxel, c) = (i / self.channels, i % self.channels);
                let voxel = [voxel / (h * w), voxel / w % h, voxel % w];
                for (tap, n) in (0..64).flat_map(|tap| (0..self.columns).map(move |n| (tap, n))) {
                    let tap_at = [tap / 16, tap / 4 % 4, tap % 4];
                    let at: [usize; 3] = std::array::from_fn(|i| (2 * voxel[i] + tap_at[i]).wrapping_sub(1));
                    if (0..3).all(|i| at[i] < 2 * self.extent[i]) {
                        let weight = f64::from(self.natural[(c * self.columns + n) * 64 + tap]);
                        let at = (at[0] * 2 * h + at[1]) * 2 * w + at[2];
                        out[at * self.columns + n] += f64::from(*x) * weight;
                    }
                }
            }
            for (i, out) in out.iter_mut().enumerate() {
                *out += f64::from(self.bias[i % self.columns]);
                if self.relu {
                    *out = out.max(0.0);
                }
                *out += self.add.as_ref().map_or(0.0, |add| f64::from(add[i]));
            }
            out
        }
    }

    #[test]
    fn by_hand() {
        // One voxel of 2 in one channel: output (z, y, x) is twice the tap (z + 1, y + 1, x + 1), plus the bias.
        let mut case = Case::new([1, 1, 1], [1, 1], [false; 3], 0, |_, n| (0..n).map(|i| i as f32).collect());
        case.input = vec![2.0];
        case.bias[0] = 0.5;
        for isa in Isa::available() {
            let taps = [21.0, 22.0, 25.0, 26.0, 37.0, 38.0, 41.0, 42.0];
            assert_eq!(case.all(isa), taps.map(|tap| 2.0 * tap + 0.5));
            case.relu = true;
            case.bias[0] = -60.0;
            case.add = Some(vec![0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]);
            assert_eq!(case.all(isa), [0.0, 1.0, 2.0, 3.0, 18.0, 21.0, 28.0, 31.0]);
            (case.relu, case.bias[0], case.add) = (false, 0.5, None);
        }
    }

    #[test]
    fn by_hand_along_one_axis() {
        // Along x the voxels 1 and 10 with the four taps 1, 2, 3, 4 (those of z and y at 1): stride 2, one cut on each
        // side, so that the outputs are 2, 3 + 10, 4 + 20, 30.
        let mut case = Case::new([1, 1, 2], [1, 1], [false; 3], 0, |_, n| {
            (0..n).map(|i| if i / 4 == 5 { (i % 4 + 1) as f32 } else { 0.0 }).collect()
        });
        case.input = vec![1.0, 10.0];
        case.bias[0] = 0.0;
        for isa in Isa::available() {
            assert_eq!(case.all(isa)[..4], [2.0, 13.0, 24.0, 30.0]);
            assert_eq!(case.all(isa)[4..], [0.0; 12]);
        }
    }

    /// Planes of 1, 5, 6, 7, 96 and 97 rows, columns around 16, channels that take 8 * c across 256 and 512.
    fn table() -> Vec<([usize; 3], [usize; 2], Way)> {
        vec![
            ([1, 1, 1], [1, 1], [false; 3]),
            ([2, 1, 5], [3, 15], [false, true, true]),
            ([3, 2, 3], [16, 16], [true, true, false]),
            ([2, 7, 1], [5, 17], [true, false, true]),
            ([2, 3, 4], [32, 27], [false, true, false]),
            ([1, 4, 3], [33, 33], [false, false, true]),
            ([3, 1, 2], [75, 16], [true, true, true]),
            ([2, 12, 8], [4, 32], [false, false, false]),
            ([1, 97, 1], [2, 16], [false, true, true]),
            ([2, 3, 2], [0, 5], [false, true, false]),
        ]
    }

    #[test]
    fn every_isa_gives_the_scalar_bits() {
        let tally = Tally::default();
        for (extent, width, way) in table() {
            let case = Case::new(extent, width, way, 3, Rng::wide);
            let want = case.all(Isa::Scalar);
            tally.count(&want);
            for isa in Isa::available() {
                assert_same_bits(&case.all(isa), &want, &format!("{} {extent:?} {width:?} {way:?}", isa.name()));
            }
        }
        tally.assert_half();
    }

    #[test]
    fn infinities_and_nan_come_out_where_the_scalar_code_has_them() {
        for (extent, width, way) in table() {
            let case = Case::new(extent, width, way, 4, Rng::special);
            let want = case.all(Isa::Scalar);
            for isa in Isa::available() {
                assert_same_bits(&case.all(isa), &want, &format!("{} {extent:?} {width:?} {way:?}", isa.name()));
            }
        }
        let case = Case::new([2, 5, 6], [2, 4], [false; 3], 5, Rng::special);
        let want = case.all(Isa::Scalar);
        assert_lively(&want, "16 products");
        assert!(want.iter().any(|v| v.is_nan()), "nothing special came out");
    }

    #[test]
    fn any_shape_and_any_split_gives_the_scalar_bits() {
        let channels = prop_oneof![1usize..9, 30usize..35];
        let way = [0.5, 0.5, 0.25].map(prop::bool::weighted);
        let tally = Tally::default();
        let run = |(extent, channels, columns, way, seed, split): ([usize; 3], _, usize, Way, u64, usize)| {
            let case = Case::new(extent, [channels, columns], way, seed, Rng::fill_of(seed));
            let want = case.all(Isa::Scalar);
            tally.count_finite(seed, &want);
            for isa in Isa::available() {
                assert_same_bits(&case.all(isa), &want, "whole");
                let (planes, split) = (2 * extent[0], split % (2 * extent[0] + 1));
                let parts = [case.planes(isa, 0..split), case.planes(isa, split..planes)].concat();
                assert_same_bits(&parts, &want, "in two parts");
            }
            Ok(())
        };
        let mut runner = TestRunner::new(Config { cases: 64, ..Config::default() });
        let extent = [1usize..5, 1usize..6, 1usize..7];
        runner.run(&(extent, channels, 1usize..36, way, any::<u64>(), any::<usize>()), run).unwrap();
        tally.assert_half();
    }

    #[test]
    fn the_order_of_a_chain_shows() {
        for (extent, width, way) in table().into_iter().filter(|(_, width, way)| width[0] > 1 && !way[0]) {
            let mut case = Case::new(extent, width, way, 7, Rng::ordinary);
            let want = case.all(Isa::Scalar);
            case.input = reverse_columns(&case.input, width[0]);
            case.single = reverse_channels(&case.single, width[0]);
            assert_order_shows(&case.all(Isa::Scalar), &want, &format!("{extent:?} {width:?}"));
        }
    }

    #[test]
    fn the_scalar_code_agrees_with_f64() {
        for (extent, width, way) in table() {
            let case = Case::new(extent, width, way, 6, Rng::ordinary);
            // As for the product: the chains are no longer.
            assert_close(&case.all(Isa::Scalar), &case.naive(), 3e-5, &format!("{extent:?} {width:?} {way:?}"));
        }
    }

    /// A transposed convolution of 2 x 3 x 2 voxels, broken in one place. No plane is computed: the checks do not wait.
    fn broken(damage: impl FnOnce(&mut Case)) {
        let mut case = Case::new([2, 3, 2], [2, 5], [false, true, false], 0, Rng::ordinary);
        damage(&mut case);
        deconv3d(Isa::best(), &case.args(), 0..0, &mut [], &mut [0.0; SCRATCH]);
    }

    #[test]
    fn no_planes() {
        broken(|_| {});
    }

    #[test]
    #[should_panic(expected = "the input has another shape")]
    fn short_input() {
        broken(|case| case.input.truncate(23));
    }

    #[test]
    #[should_panic(expected = "an extent is zero")]
    fn no_voxels() {
        broken(|case| case.extent[1] = 0);
    }

    #[test]
    #[should_panic(expected = "packed weights do not match the shape")]
    fn weights_of_seven_parities() {
        broken(|case| case.single.truncate(7 * 16 * 16));
    }

    #[test]
    #[should_panic(expected = "the bias is shorter than the columns")]
    fn unpadded_bias() {
        broken(|case| case.bias.truncate(5));
    }

    #[test]
    #[should_panic(expected = "the added tensor has another shape")]
    fn short_added_tensor() {
        broken(|case| case.add.as_mut().unwrap().truncate(479));
    }

    #[test]
    #[should_panic(expected = "planes 3..5 of 4")]
    fn planes_outside() {
        let case = Case::new([2, 3, 2], [2, 5], [false; 3], 0, Rng::ordinary);
        deconv3d(Isa::best(), &case.args(), 3..5, &mut [0.0; 240], &mut [0.0; SCRATCH]);
    }

    #[test]
    #[should_panic(expected = "planes 3..2 of 4")]
    fn planes_backwards() {
        let case = Case::new([2, 3, 2], [2, 5], [false; 3], 0, Rng::ordinary);
        deconv3d(Isa::best(), &case.args(), Range { start: 3, end: 2 }, &mut [], &mut [0.0; SCRATCH]);
    }

    #[test]
    #[should_panic(expected = "the output does not hold the planes")]
    fn short_output() {
        let case = Case::new([2, 3, 2], [2, 5], [false; 3], 0, Rng::ordinary);
        deconv3d(Isa::best(), &case.args(), 0..2, &mut [0.0; 239], &mut [0.0; SCRATCH]);
    }

    #[test]
    #[should_panic(expected = "the scratch is too small")]
    fn short_scratch() {
        let case = Case::new([2, 3, 2], [2, 5], [false; 3], 0, Rng::ordinary);
        deconv3d(Isa::Scalar, &case.args(), 0..0, &mut [], &mut [0.0; SCRATCH - 1]);
    }
}

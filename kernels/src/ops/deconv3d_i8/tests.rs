use super::*;
use crate::cases::isas;
use crate::matmul::int8::layout::{pack, pairs, sums};
use crate::matmul::int8::scratch_len;
use crate::ops::deconv3d::kernel_tap;
use crate::testing::Rng;
use crate::testing::int8::{OwnedI8, WayI8, assert_same, assert_telling, ways};

struct Case {
    extent: [usize; 3],
    channels: usize,
    input: Vec<i8>,
    /// Everything but weights of one parity.
    end: OwnedI8,
    weights: Vec<i8>,
    /// `[channels, columns, 4, 4, 4]`, as PyTorch has them.
    natural: Vec<i8>,
}

impl Case {
    fn new(extent: [usize; 3], [channels, columns]: [usize; 2], way: WayI8, seed: u64) -> Self {
        let mut rng = Rng::new(seed);
        let natural = OwnedI8::natural(&mut rng, channels * columns * 64, way);
        let voxels = extent.iter().product::<usize>();
        let mut end = OwnedI8::drawn(&mut rng, [8 * voxels, 8 * channels, columns], way, |_, _| 0);
        // The added tensor is dense.
        end.added_stride = columns;
        end.added.truncate(8 * voxels * columns);
        end.joins = way.joins.map(|_| [true, true]);
        let input = rng.left(voxels * channels, way.signed);
        let weights = packed(&natural, channels, columns);
        Self { extent, channels, input, end, weights, natural }
    }

    fn planes(&self, isa: Isa, planes: Range<usize>) -> Vec<i8> {
        let (depth, columns) = (8 * self.channels, self.end.columns);
        let (sums, pairs): (Vec<_>, Vec<_>) =
            (sums(&self.weights, depth).collect(), pairs(&self.weights, depth).collect());
        let args = Deconv3dI8 {
            extent: self.extent,
            channels: self.channels,
            columns,
            input: &self.input,
            signed: self.end.signed,
            weights: &self.weights,
            sums: &sums,
            pairs: &pairs,
            bias: &self.end.bias,
            relu: self.end.relu,
            add: self.end.joins.map(|_| (&self.end.added[..], &self.end.joining[..])),
            multiplier: &self.end.multiplier,
        };
        let mut out = vec![i8::MIN; planes.len() * 4 * self.extent[1] * self.extent[2] * columns];
        deconv3d_i8(isa, &args, planes, &mut out, &mut vec![i32::MIN; scratch_len(depth, columns)]);
        out
    }

    fn all(&self, isa: Isa) -> Vec<i8> {
        self.planes(isa, 0..2 * self.extent[0])
    }

    /// `ConvTranspose3d(kernel_size=4, stride=2, padding=1)` as it is defined: every input voxel scatters its products over
    /// 4 x 4 x 4 outputs.
    fn naive(&self) -> Vec<i8> {
        let ([d, h, w], columns) = (self.extent, self.end.columns);
        let mut sums = vec![0; 8 * d * h * w * columns];
        for (i, x) in self.input.iter().enumerate() {
            let (voxel, c) = (i / self.channels, i % self.channels);
            let voxel = [voxel / (h * w), voxel / w % h, voxel % w];
            for (tap, n) in (0..64).flat_map(|tap| (0..columns).map(move |n| (tap, n))) {
                let tap_at = [tap / 16, tap / 4 % 4, tap % 4];
                let at: [usize; 3] = std::array::from_fn(|i| (2 * voxel[i] + tap_at[i]).wrapping_sub(1));
                if (0..3).all(|i| at[i] < 2 * self.extent[i]) {
                    let weight = i64::from(self.natural[(c * columns + n) * 64 + tap]);
                    sums[((at[0] * 2 * h + at[1]) * 2 * w + at[2]) * columns + n] += i64::from(*x) * weight;
                }
            }
        }
        sums.into_iter().enumerate().map(|(i, sum)| self.end.naive_end(i / columns, i % columns, 0, sum)).collect()
    }
}

/// The eight packed matrices.
fn packed(natural: &[i8], channels: usize, columns: usize) -> Vec<i8> {
    let len = packed_len(8 * channels, columns);
    let mut weights = vec![99; 8 * len];
    for (parity, weights) in weights.chunks_exact_mut(len).enumerate() {
        let parity = [parity / 4, parity / 2 % 2, parity % 2];
        let weight = |k: usize, n: usize| {
            let (tap, c) = (k / channels, k % channels);
            let tap = [tap / 4, tap / 2 % 2, tap % 2];
            let [d, h, w]: [usize; 3] = std::array::from_fn(|i| kernel_tap(parity[i], tap[i]));
            natural[(c * columns + n) * 64 + (d * 4 + h) * 4 + w]
        };
        pack(8 * channels, columns, weight, weights);
    }
    weights
}

#[test]
fn by_hand() {
    // One voxel of 2 in one channel of four: sum (z, y, x) is twice the tap (z + 1, y + 1, x + 1), plus the bias; a quarter.
    let way = WayI8 { joins: Some([true, true]), ..ways()[0] };
    let mut case = Case::new([1, 1, 1], [4, 1], way, 0);
    case.weights = packed(&(0..256).map(|i| if i < 64 { i as i8 } else { 99 }).collect::<Vec<_>>(), 4, 1);
    case.input = vec![2, 0, 0, 0];
    case.end.multiplier[0] = 1 << 30;
    case.end.bias[0] = 2;
    for isa in isas() {
        // Taps 21, 22, 25, 26, 37, 38, 41, 42; sums 44, 46, 52, 54, 76, 78, 84, 86.
        (case.end.joins, case.end.relu) = (None, false);
        assert_eq!(case.all(isa), [11, 12, 13, 14, 19, 20, 21, 22]);
        // Less 62 sums -18, -16, -10, -8, 14, 16, 22, 24; then 4 times the added is a step of it.
        (case.end.bias[0], case.end.relu) = (-60, true);
        (case.end.joins, case.end.joining[0]) = (Some([true, true]), 4);
        case.end.added = vec![0, 1, 2, 3, 4, 5, 6, -127];
        assert_eq!(case.all(isa), [0, 1, 2, 3, 8, 9, 12, -121]);
        case.end.bias[0] = 2;
    }
}

#[test]
fn every_isa_is_exact() {
    let mut whole = Vec::new();
    let shapes = [
        ([1, 1, 1], [4, 1]),
        ([2, 1, 5], [4, 15]),
        ([3, 2, 3], [16, 16]),
        ([2, 7, 1], [8, 17]),
        ([2, 3, 4], [32, 27]),
        ([1, 4, 3], [36, 33]),
        ([3, 1, 2], [200, 16]),
        ([2, 12, 8], [4, 32]),
        ([1, 97, 1], [4, 16]),
    ];
    for (i, (extent, width)) in shapes.into_iter().enumerate() {
        for way in [ways()[i], ways()[(3 * i + 20) % 40]] {
            let case = Case::new(extent, width, way, 3);
            let want = case.naive();
            for isa in Isa::available() {
                assert_same(&case.all(isa), &want, &format!("{} {extent:?} {width:?} {way:?}", isa.name()));
                let split = case.planes(isa, 0..1).len();
                assert_same(&case.planes(isa, 0..1), &want[..split], "the first plane");
                assert_same(&case.planes(isa, 1..2 * extent[0]), &want[split..], "the other planes");
            }
            whole.extend(want);
        }
    }
    assert_telling(&whole, "all");
}

/// A transposed convolution of six voxels, broken in one place.
fn broken(damage: impl FnOnce(&mut Case)) {
    let mut case = Case::new([1, 2, 3], [4, 5], WayI8 { joins: Some([true, true]), ..ways()[0] }, 0);
    damage(&mut case);
    case.all(Isa::Scalar);
}

#[test]
#[should_panic(expected = "packed weights do not match the shape")]
fn short_weights() {
    broken(|case| case.weights.truncate(7 * 8 * 64));
}

#[test]
#[should_panic(expected = "the added tensor has another shape")]
fn short_added() {
    broken(|case| case.end.added.truncate(8 * 6 * 5 - 1));
}

#[test]
#[should_panic(expected = "the input has another shape")]
fn short_input() {
    broken(|case| case.input.truncate(23));
}

#[test]
#[should_panic(expected = "planes 1..3 of 2")]
fn planes_outside() {
    let case = Case::new([1, 2, 3], [4, 5], ways()[0], 0);
    case.planes(Isa::Scalar, 1..3);
}

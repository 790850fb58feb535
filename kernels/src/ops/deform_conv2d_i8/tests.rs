use super::*;
use crate::cases::isas;
use crate::matmul::int8::scratch_len;
use crate::testing::int8::{OwnedI8, PLAIN, WayI8, assert_same, assert_telling, ways};
use crate::testing::{Rng, write_rows};
use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};

struct Case {
    geometry: Geometry,
    input: Vec<i8>,
    offsets: Vec<i32>,
    owned: OwnedI8,
    before: Vec<i8>,
}

/// A kernel's walk over an image, whose outputs are as many as PyTorch's.
fn geometry(
    [h, w]: [usize; 2],
    channels: usize,
    kernel: usize,
    stride: usize,
    dilation: usize,
    pad: usize,
) -> Geometry {
    let output =
        |extent: usize| (extent + 2 * pad).checked_sub(dilation * (kernel - 1) + 1).map_or(0, |room| room / stride + 1);
    Geometry {
        input: [1, h, w],
        channels,
        kernel: [1, kernel, kernel],
        stride: [1, stride, stride],
        dilation: [1, dilation, dilation],
        padding: [0, pad, pad],
        output: [1, output(h), output(w)],
    }
}

/// Offsets of every kind: small, whole, far outside, the largest. Then mask logits, some of them extreme.
fn offsets(rng: &mut Rng, rows: usize, taps: usize) -> Vec<i32> {
    let one = |i: usize| {
        let mask = i % (3 * taps) >= 2 * taps;
        match rng.bits() % 32 {
            0 => rng.bits() as i32,
            1 => [i32::MIN, i32::MAX][rng.bits() as usize % 2],
            2..6 => 0,
            6..10 if !mask => PIXEL * rng.within(8),
            _ => rng.within(800),
        }
    };
    (0..rows * 3 * taps).map(one).collect()
}

impl Case {
    fn new(geometry: Geometry, columns: usize, way: WayI8, seed: u64) -> Self {
        let mut rng = Rng::new(seed);
        let (rows, depth) = (geometry.rows(), geometry.depth());
        let natural = OwnedI8::natural(&mut rng, columns * depth, way);
        let owned = OwnedI8::drawn(&mut rng, [rows, depth, columns], way, |k, n| natural[n * depth + k]);
        let input = rng.left(geometry.input.iter().product::<usize>() * geometry.channels, way.signed);
        let offsets = offsets(&mut rng, rows, depth / geometry.channels);
        Self { geometry, input, offsets, owned, before: rng.left(rows * columns, true) }
    }

    /// One tap on a 2 x 3 image of one channel of four, 4 8 16; 32 64 -128 + 1, whose outputs are the samples.
    fn samples(offsets: [[i32; 3]; 6]) -> Self {
        let mut case = Self::new(geometry([2, 3], 4, 1, 1, 1, 0), 1, PLAIN, 0);
        case.input = [4, 8, 16, 32, 64, -127].iter().flat_map(|x| [99, *x, 0, 0]).collect();
        case.owned = OwnedI8::new(4, &[0], |k, _| if k == 1 { 4 } else { 0 });
        case.offsets = offsets.concat();
        case
    }

    fn args(&self) -> DeformConv2dI8<'_> {
        let Self { geometry, ref input, ref offsets, .. } = *self;
        DeformConv2dI8 { geometry, input, offsets, product: self.owned.product() }
    }

    fn rows(&self, isa: Isa, rows: Range<usize>) -> Vec<i8> {
        let columns = self.owned.columns;
        let args = self.args();
        let mut scratch = vec![i32::MIN; scratch_len(self.owned.depth, columns)];
        write_rows(rows.len(), columns + 1, &self.before[rows.start * columns..rows.end * columns], |out| {
            deform_conv2d_i8(isa, &args, rows.clone(), columns + 1, out, &mut scratch);
        })
    }

    fn all(&self, isa: Isa) -> Vec<i8> {
        self.rows(isa, 0..self.geometry.rows())
    }

    fn assert_every_isa(&self, what: &str) -> Vec<i8> {
        let want = self.all(Isa::Scalar);
        for isa in Isa::available() {
            assert_same(&self.all(isa), &want, &format!("{} {what}", isa.name()));
        }
        want
    }
}

/// A mask of exactly 1, and of 1/2.
const OPEN: i32 = 600;
const HALF: i32 = 0;

#[test]
fn by_hand() {
    let still = Case::samples([[0, 0, OPEN]; 6]);
    let half = Case::samples([[0, 0, HALF]; 6]);
    let right = Case::samples([[0, PIXEL, OPEN]; 6]);
    let between = Case::samples([[PIXEL / 2, PIXEL / 4, OPEN]; 6]);
    let closed = Case::samples([[0, 0, i32::MIN]; 6]);
    for isa in isas() {
        assert_eq!(still.all(isa), [4, 8, 16, 32, 64, -127]);
        // -63.5 goes upwards.
        assert_eq!(half.all(isa), [2, 4, 8, 16, 32, -63]);
        assert_eq!(right.all(isa), [8, 16, 0, 64, -127, 0]);
        // (3 * 4 + 8 + 3 * 32 + 64) / 8 = 22.5, (24 + 16 + 192 - 127) / 8 = 13.125, (48 - 381) / 8 = -41.625 and, with
        // nothing below, (96 + 64) / 8 = 20, (192 - 127) / 8 = 8.125, -381 / 8 = -47.625.
        assert_eq!(between.all(isa), [23, 13, -42, 20, 8, -48]);
        assert_eq!(closed.all(isa), [0; 6]);
    }
}

#[test]
fn samples_on_the_border_and_beyond() {
    // Positions (y, x) of the six outputs.
    let at = |positions: [[i32; 2]; 6]| {
        let offset = |i: usize| [positions[i][0] - i as i32 / 3 * PIXEL, positions[i][1] - i as i32 % 3 * PIXEL, OPEN];
        Case::samples(std::array::from_fn(offset))
    };
    let cases = [
        // Exactly -1 and exactly H or W are outside.
        ([[-256, 0], [512, 0], [0, -256], [0, 768], [-256, -256], [512, 768]], [0; 6]),
        // Half a pixel and a quarter of one outside.
        ([[-128, 0], [384, 512], [256, -128], [0, 640], [-128, -128], [448, 704]], [2, -63, 16, 8, 1, -8]),
    ];
    for (positions, want) in cases {
        for isa in isas() {
            assert_eq!(at(positions).all(isa), want, "{} {positions:?}", isa.name());
        }
    }
    // As far as an offset goes.
    let mut case = Case::samples([[i32::MAX, 0, OPEN]; 6]);
    case.offsets[4..8].copy_from_slice(&[i32::MIN, OPEN, 0, i32::MAX]);
    case.offsets[9..11].copy_from_slice(&[i32::MIN, i32::MIN]);
    for isa in isas() {
        assert_eq!(case.all(isa), [0; 6], "{}", isa.name());
    }
    // A step inside: 1/256 of a pixel of 64, and of 127, is a quarter and a half of a step.
    let mut case = at([[256, 511]; 6]);
    case.geometry.padding = [0, 0, 0];
    for isa in isas() {
        // 64 / 256 - 127 * 255 / 256
        assert_eq!(case.all(isa), [-126; 6], "{}", isa.name());
    }
}

#[test]
fn dy_comes_before_dx_and_masks_after_both() {
    // Two taps side by side. The first moves one down, the second one right; masks 1 and 1/2.
    let mut case = Case::samples([[0; 3]; 6]);
    case.geometry = Geometry { kernel: [1, 1, 2], output: [1, 1, 1], ..case.geometry };
    case.owned = OwnedI8::new(8, &[0], |k, _| [0, 4, 0, 0, 0, 1, 0, 0][k]);
    case.before.truncate(1);
    case.offsets = vec![PIXEL, 0, 0, PIXEL, OPEN, HALF];
    for isa in isas() {
        // 32 from below; half of 16, a quarter of which counts.
        assert_eq!(case.all(isa), [34]);
    }
}

fn table() -> Vec<(Geometry, usize)> {
    vec![
        (geometry([1, 1], 4, 1, 1, 1, 0), 1),
        (geometry([1, 1], 8, 3, 1, 1, 1), 16),
        (geometry([1, 7], 16, 3, 1, 1, 1), 17),
        (geometry([7, 1], 20, 3, 1, 1, 1), 15),
        (geometry([9, 11], 16, 3, 1, 1, 1), 32),
        (geometry([6, 16], 36, 3, 1, 1, 1), 27),
        (geometry([5, 6], 200, 3, 1, 1, 1), 33),
        (geometry([8, 12], 64, 1, 1, 1, 0), 16),
        (geometry([10, 13], 36, 3, 2, 1, 1), 16),
        (geometry([9, 8], 8, 3, 1, 2, 2), 16),
        (geometry([11, 9], 4, 2, 3, 1, 0), 16),
        (geometry([3, 4], 20, 5, 1, 1, 6), 8),
    ]
}

#[test]
fn every_isa_gives_the_scalar_bits() {
    let mut whole = Vec::new();
    for (i, (g, columns)) in table().into_iter().enumerate() {
        for way in [PLAIN, ways()[3 * i], ways()[(5 * i + 7) % 40]] {
            whole.extend(Case::new(g, columns, way, 3).assert_every_isa(&format!("{g:?} {way:?}")));
        }
    }
    assert_telling(&whole, "all");
}

#[test]
fn any_shape_and_any_split_gives_the_scalar_bits() {
    let walk = ([1usize..9, 1usize..9], 1usize..18, 1usize..4, 1usize..4, 1usize..4, 0usize..4);
    let run = |((image, groups, kernel, stride, dilation, pad), columns, way, seed, split): (
        ([usize; 2], usize, _, _, _, _),
        usize,
        usize,
        u64,
        usize,
    )| {
        let case = Case::new(geometry(image, 4 * groups, kernel, stride, dilation, pad), columns, ways()[way], seed);
        let want = case.assert_every_isa("whole");
        for isa in Isa::available() {
            let (rows, split) = (case.geometry.rows(), split % (case.geometry.rows() + 1));
            let parts = [case.rows(isa, 0..split), case.rows(isa, split..rows)].concat();
            assert_same(&parts, &want, "in two parts");
        }
        Ok(())
    };
    let mut runner = TestRunner::new(Config { cases: 64, ..Config::default() });
    runner.run(&(walk, 1usize..36, 0usize..40, any::<u64>(), any::<usize>()), run).unwrap();
}

/// Weights that pick one k per output: what comes out are samples. They are those of exact arithmetic within the bound that
/// the formula's documentation gives.
#[test]
fn samples_agree_with_f64() {
    for (g, _) in table() {
        let (depth, channels) = (g.depth().min(48), g.channels);
        let mut case = Case::new(g, 1, PLAIN, 6);
        case.owned = OwnedI8::new(g.depth(), &vec![0; depth], |k, n| if k == n { 4 } else { 0 });
        case.before = vec![0; g.rows() * depth];
        let [_, h, w] = g.input;
        let taps = g.depth() / channels;
        for (i, got) in case.all(Isa::Scalar).into_iter().enumerate() {
            let (row, k) = (i / depth, i % depth);
            let (tap, c) = (k / channels, k % channels);
            let offsets = &case.offsets[row * 3 * taps..];
            let start = |out: usize, tap: usize, axis: usize| {
                (out * g.stride[axis] + tap * g.dilation[axis]) as f64 - g.padding[axis] as f64
            };
            let y = start(row / g.output[2], tap / g.kernel[2], 1) + f64::from(offsets[2 * tap]) / 256.0;
            let x = start(row % g.output[2], tap % g.kernel[2], 2) + f64::from(offsets[2 * tap + 1]) / 256.0;
            let mask = 1.0 / (1.0 + (-f64::from(offsets[2 * taps + tap]) / 64.0).exp());
            // Every pixel weighs by its distance, as bilinear interpolation has it.
            let pixels = (0..h * w).map(|at| {
                let near = |a: f64, b: usize| (1.0 - (a - b as f64).abs()).max(0.0);
                near(y, at / w) * near(x, at % w) * f64::from(case.input[at * channels + c])
            });
            let want = mask * pixels.sum::<f64>();
            assert!((f64::from(got) - want).abs() < 0.58, "{g:?} {i}: {got}, not {want}");
        }
    }
}

/// The product of the samples is the product's: 1x1 taps that do not move.
#[test]
fn without_offsets_it_is_a_convolution() {
    use crate::ops::conv_i8::{ConvI8, conv_i8};
    for way in ways() {
        let mut case = Case::new(geometry([6, 7], 20, 3, 1, 1, 1), 33, way, 9);
        let taps = 9;
        for (i, offset) in case.offsets.iter_mut().enumerate() {
            *offset = if i % (3 * taps) < 2 * taps { 0 } else { OPEN };
        }
        let args = ConvI8 { geometry: case.geometry, input: &case.input, product: case.owned.product() };
        let mut out = case.before.clone();
        conv_i8(Isa::Scalar, &args, 0..42, 33, &mut out, &mut vec![0; scratch_len(180, 33)]);
        assert_same(&case.assert_every_isa("no offsets"), &out, &format!("{way:?}"));
    }
}

/// A 3x3 deformable convolution of a 4 x 5 image, broken in one place.
fn broken(damage: impl FnOnce(&mut Case)) {
    let mut case = Case::new(geometry([4, 5], 4, 3, 1, 1, 1), 3, PLAIN, 0);
    damage(&mut case);
    case.all(Isa::Scalar);
}

#[test]
#[should_panic(expected = "the input has another shape")]
fn short_input() {
    broken(|case| case.input.truncate(79));
}

#[test]
#[should_panic(expected = "a deformable convolution is two-dimensional")]
fn a_volume() {
    broken(|case| {
        case.geometry.input[0] = 2;
        case.input.extend_from_within(..);
    });
}

#[test]
#[should_panic(expected = "the offsets belong to another kernel")]
fn offsets_without_masks() {
    broken(|case| case.offsets.truncate(20 * 18));
}

#[test]
#[should_panic(expected = "the channels are no multiple of 4")]
fn channels_that_are_no_groups() {
    broken(|case| {
        case.geometry.channels = 5;
        case.input.resize(100, 0);
    });
}

#[test]
#[should_panic(expected = "the weights belong to another kernel")]
fn weights_of_another_kernel() {
    broken(|case| case.owned.depth = 40);
}

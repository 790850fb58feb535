use super::*;
use crate::matmul::SCRATCH;
use crate::testing::{
    Fill, JOINS, Owned, PLAIN, Rng, Tally, Way, assert_close, assert_lively, assert_order_shows, assert_same_bits,
    reverse_channels, reverse_columns, round_to, ways, write_rows,
};
use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};

/// A square kernel's walk over an image.
#[derive(Clone, Copy, Debug)]
struct Walk {
    image: [usize; 2],
    channels: usize,
    kernel: [usize; 2],
    stride: usize,
    dilation: usize,
    padding: usize,
}

impl Walk {
    fn geometry(self) -> Geometry {
        let Self { image: [h, w], channels, kernel: [kh, kw], stride, dilation, padding } = self;
        let output = |extent: usize, kernel: usize| {
            (extent + 2 * padding).checked_sub(dilation * (kernel - 1) + 1).map_or(0, |room| room / stride + 1)
        };
        Geometry {
            input: [1, h, w],
            channels,
            kernel: [1, kh, kw],
            stride: [1, stride, stride],
            dilation: [1, dilation, dilation],
            padding: [0, padding, padding],
            output: [1, output(h, kh), output(w, kw)],
        }
    }
}

struct Case {
    geometry: Geometry,
    input: Vec<f32>,
    offsets: Vec<f32>,
    owned: Owned,
    before: Vec<f32>,
    /// `[columns, channels, kernel]`, as PyTorch has them.
    natural: Vec<f32>,
}

impl Case {
    fn new(walk: Walk, columns: usize, way: Way, seed: u64, fill: Fill) -> Self {
        let geometry = walk.geometry();
        let mut rng = Rng::new(seed);
        let (depth, channels, taps) = (geometry.depth(), geometry.channels, geometry.depth() / geometry.channels);
        let natural = round_to(way.half, fill(&mut rng, columns * depth));
        let bias = fill(&mut rng, columns);
        let owned =
            Owned::new(depth, &bias, way.half, |k, n| natural[(n * channels + k % channels) * taps + k / channels]);
        let owned = owned.end(&mut rng, fill, geometry.rows(), way.joins, 1, way.relu);
        let input = fill(&mut rng, walk.image[0] * walk.image[1] * channels);
        let offsets = offsets(&mut rng, geometry.rows(), taps);
        let before = fill(&mut rng, geometry.rows() * columns);
        Self { geometry, input, offsets, owned, before, natural }
    }

    fn args(&self) -> DeformConv2d<'_> {
        let Self { geometry, ref input, ref offsets, .. } = *self;
        DeformConv2d { geometry, input, offsets, product: self.owned.product() }
    }

    fn rows(&self, isa: Isa, rows: Range<usize>) -> Vec<f32> {
        let columns = self.owned.columns;
        let args = self.args();
        write_rows(rows.len(), columns + 1, &self.before[rows.start * columns..rows.end * columns], |out| {
            deform_conv2d(isa, &args, rows.clone(), columns + 1, out, &mut [f32::NAN; SCRATCH]);
        })
    }

    fn all(&self, isa: Isa) -> Vec<f32> {
        self.rows(isa, 0..self.geometry.rows())
    }

    /// torchvision's `deform_conv2d` in f64, on its layouts: image `[channels, h, w]`, offsets `[2 * taps, h, w]`, mask
    /// `[taps, h, w]`, weights `[columns, channels, kernel]`.
    fn naive(&self) -> Vec<f64> {
        let Geometry { input: [_, h, w], channels, kernel: [_, kh, kw], stride, dilation, padding, .. } = self.geometry;
        let [_, oh, ow] = self.geometry.output;
        let (taps, rows) = (kh * kw, oh * ow);
        let transpose = |x: &[f32], inner: usize| -> Vec<f64> {
            let outer = x.len() / inner;
            (0..x.len()).map(|i| f64::from(x[i % outer * inner + i / outer])).collect()
        };
        let image = transpose(&self.input, channels);
        let offsets = transpose(&self.offsets, 3 * taps);
        let (offset, mask) = offsets.split_at(2 * taps * rows);
        let bilinear = |c: usize, y: f64, x: f64| {
            // Also for NaN, of which torchvision makes an address.
            if !(y > -1.0 && y < h as f64 && x > -1.0 && x < w as f64) {
                return 0.0;
            }
            let pixel = |y: f64, x: f64| {
                let inside = y >= 0.0 && y < h as f64 && x >= 0.0 && x < w as f64;
                if inside { image[(c * h + y as usize) * w + x as usize] } else { 0.0 }
            };
            let (y0, x0) = (y.floor(), x.floor());
            let (ly, lx) = (y - y0, x - x0);
            let top = pixel(y0, x0) * (1.0 - lx) + pixel(y0, x0 + 1.0) * lx;
            let bottom = pixel(y0 + 1.0, x0) * (1.0 - lx) + pixel(y0 + 1.0, x0 + 1.0) * lx;
            top * (1.0 - ly) + bottom * ly
        };
        let mut out = Vec::new();
        for (row, n) in (0..rows).flat_map(|row| (0..self.owned.columns).map(move |n| (row, n))) {
            let mut sum = 0.0;
            for (c, tap) in (0..channels).flat_map(|c| (0..taps).map(move |tap| (c, tap))) {
                let start = |out: usize, tap: usize, axis: usize| {
                    (out * stride[axis] + tap * dilation[axis]) as f64 - padding[axis] as f64
                };
                let y = start(row / ow, tap / kw, 1) + offset[2 * tap * rows + row];
                let x = start(row % ow, tap % kw, 2) + offset[(2 * tap + 1) * rows + row];
                let mask = 1.0 / (1.0 + (-mask[tap * rows + row]).exp());
                sum += bilinear(c, y, x) * mask * f64::from(self.natural[(n * channels + c) * taps + tap]);
            }
            out.push(self.owned.naive_end(row, n, self.before[row * self.owned.columns + n], sum));
        }
        out
    }
}

/// Offsets of every kind: small, whole, on and around the borders of a small image, far outside, NaN. All finite ones are
/// multiples of 2^-10 below 2^13, so that positions are exact in f32. Then mask logits, some of them extreme.
fn offsets(rng: &mut Rng, rows: usize, taps: usize) -> Vec<f32> {
    let mut one = |i: usize| {
        let x = rng.unit();
        if i % (3 * taps) >= 2 * taps {
            return match rng.bits() % 16 {
                0 => 1000.0 * x,
                1 => 0.0,
                _ => 5.0 * x,
            };
        }
        match rng.bits() % 32 {
            0 => 7000.0 * x,
            1 => f32::NAN,
            2 => f32::INFINITY,
            3 => f32::NEG_INFINITY,
            4 => -0.0,
            5..12 => (9.0 * x).round(),
            _ => 3.0 * x,
        }
    };
    (0..rows * 3 * taps)
        .map(&mut one)
        .map(|x| if x.abs() < 8192.0 { (x * 1024.0).round() / 1024.0 } else { x })
        .collect()
}

fn table() -> Vec<(Walk, usize)> {
    let walk = |image, channels, kernel, stride, dilation, padding| Walk {
        image,
        channels,
        kernel: [kernel; 2],
        stride,
        dilation,
        padding,
    };
    vec![
        (walk([1, 1], 1, 1, 1, 1, 0), 1),
        (walk([1, 1], 5, 3, 1, 1, 1), 16),
        (walk([1, 7], 15, 3, 1, 1, 1), 17),
        (walk([7, 1], 17, 3, 1, 1, 1), 15),
        (walk([9, 11], 16, 3, 1, 1, 1), 32),
        (walk([6, 16], 29, 3, 1, 1, 1), 27),
        (walk([5, 6], 67, 3, 1, 1, 1), 33),
        (walk([8, 12], 64, 1, 1, 1, 0), 16),
        (walk([10, 13], 33, 3, 2, 1, 1), 16),
        (walk([9, 8], 7, 3, 1, 2, 2), 16),
        (walk([6, 5], 3, 2, 1, 1, 1), 18),
        (walk([11, 9], 3, 2, 3, 1, 0), 16),
        (walk([4, 3], 6, 7, 1, 1, 3), 16),
        (walk([3, 4], 20, 5, 1, 1, 6), 8),
        (Walk { kernel: [3, 1], ..walk([5, 4], 4, 1, 1, 1, 1) }, 16),
        (Walk { kernel: [1, 4], ..walk([5, 4], 4, 1, 1, 1, 1) }, 16),
        (walk([2, 2], 3, 3, 1, 1, 0), 4),
    ]
}

/// A 1x1 kernel of weight 1 over one channel of a 2 x 3 image, whose mask logit 0 is a mask of 1/2.
fn one_tap(offsets: [[f32; 2]; 6]) -> Case {
    let walk = Walk { image: [2, 3], channels: 1, kernel: [1; 2], stride: 1, dilation: 1, padding: 0 };
    let mut case = Case::new(walk, 1, PLAIN, 0, Rng::ordinary);
    case.owned = Owned::new(1, &[0.0], false, |_, _| 1.0);
    case.input = vec![2.0, 4.0, 8.0, 16.0, 32.0, 64.0];
    case.offsets = offsets.iter().flat_map(|[dy, dx]| [*dy, *dx, 0.0]).collect();
    case
}

#[test]
fn by_hand() {
    let still = one_tap([[0.0; 2]; 6]);
    let right = one_tap([[0.0, 1.0]; 6]);
    let between = one_tap([[0.5, 0.25]; 6]);
    for isa in Isa::available() {
        assert_eq!(still.all(isa), [1.0, 2.0, 4.0, 8.0, 16.0, 32.0]);
        assert_eq!(right.all(isa), [2.0, 4.0, 0.0, 16.0, 32.0, 0.0]);
        // (2 * 3 + 4 + 16 * 3 + 32) / 8 / 2, and so on; behind the last row and column there is nothing.
        assert_eq!(between.all(isa), [5.625, 11.25, 13.5, 5.0, 10.0, 12.0]);
    }
}

#[test]
fn samples_on_the_border_and_beyond() {
    // Positions (y, x) of the six outputs; (0, 0), (0, 1), ... are where they would be without offsets.
    let at = |positions: [[f32; 2]; 6]| {
        one_tap(std::array::from_fn(|i| [positions[i][0] - (i / 3) as f32, positions[i][1] - (i % 3) as f32]))
    };
    let below = |x: f32| f32::from_bits(x.to_bits() - 1);
    let cases = [
        // Exactly -1 and exactly H or W are outside.
        ([[-1.0, 0.0], [2.0, 0.0], [0.0, -1.0], [0.0, 3.0], [-1.0, -1.0], [2.0, 3.0]], [0.0; 6]),
        // Whole positions inside, the last row and column among them.
        ([[0.0, 0.0], [1.0, 2.0], [1.0, 0.0], [0.0, 2.0], [1.0, 1.0], [0.0, 1.0]], [1.0, 32.0, 8.0, 4.0, 16.0, 2.0]),
        // Half a pixel and a quarter of one outside.
        (
            [[-0.5, 0.0], [1.5, 2.0], [1.0, -0.5], [0.0, 2.5], [-0.5, -0.5], [1.75, 2.75]],
            [0.5, 16.0, 4.0, 2.0, 0.25, 2.0],
        ),
        // Far away, and nowhere.
        (
            [
                [-1e30, 0.0],
                [1e30, 0.0],
                [0.0, f32::NAN],
                [f32::NAN, 0.0],
                [f32::INFINITY, 0.0],
                [0.0, f32::NEG_INFINITY],
            ],
            [0.0; 6],
        ),
    ];
    for (positions, want) in cases {
        for isa in Isa::available() {
            assert_eq!(at(positions).all(isa), want, "{} {positions:?}", isa.name());
        }
    }
    // On the border nothing is read, or the weight 0 of an infinite neighbour would show.
    let mut case = at(cases[0].0);
    case.input.fill(f32::INFINITY);
    for isa in Isa::available() {
        assert_eq!(case.all(isa), [0.0; 6], "{}", isa.name());
    }
    // Just inside: y = -1 + 2^-24 still takes 2^-24 of the pixel at 0.
    let mut case = one_tap([[-below(1.0), 0.0]; 6]);
    case.geometry.output = [1, 1, 1];
    case.offsets.truncate(3);
    case.before.truncate(1);
    for isa in Isa::available() {
        assert_eq!(case.all(isa), [2f32.powi(-24)]);
    }
}

#[test]
fn dy_comes_before_dx_and_masks_after_both() {
    // Two taps side by side. The first moves one down, the second one right; masks 1/2 and (nearly) 0.
    let walk = Walk { image: [2, 3], channels: 1, kernel: [1, 2], stride: 1, dilation: 1, padding: 0 };
    let mut case = Case::new(walk, 1, PLAIN, 0, Rng::ordinary);
    case.owned = Owned::new(2, &[0.0], false, |k, _| [1.0, 1000.0][k]);
    case.input = vec![2.0, 4.0, 8.0, 16.0, 32.0, 64.0];
    case.geometry.output = [1, 1, 1];
    case.before.truncate(1);
    for isa in Isa::available() {
        case.offsets = vec![1.0, 0.0, 0.0, 1.0, 0.0, 0.0];
        assert_eq!(case.all(isa), [8.0 + 4000.0]);
        case.offsets[5] = -87.0;
        assert!((case.all(isa)[0] - 8.0).abs() < 1e-6, "a logit of -87 masks");
    }
}

#[test]
fn every_isa_gives_the_scalar_bits() {
    let tally = Tally::default();
    for (i, (walk, columns)) in table().into_iter().enumerate() {
        for way in [PLAIN, ways()[i % 16], ways()[(i + 7) % 16]] {
            let case = Case::new(walk, columns, way, 3, Rng::wide);
            let want = case.all(Isa::Scalar);
            if !way.relu {
                tally.count(&want);
            }
            for isa in Isa::available() {
                assert_same_bits(&case.all(isa), &want, &format!("{} {walk:?} {way:?}", isa.name()));
            }
        }
    }
    tally.assert_half();
}

#[test]
fn infinities_and_nan_come_out_where_the_scalar_code_has_them() {
    for (walk, columns) in table() {
        let mut case = Case::new(walk, columns, PLAIN, 4, Rng::special);
        for (i, x) in Rng::new(5).special(case.offsets.len()).into_iter().enumerate().filter(|(_, x)| !x.is_finite()) {
            case.offsets[i] = x;
        }
        let want = case.all(Isa::Scalar);
        if walk.image == [8, 12] {
            assert!(want.iter().any(|v| v.is_nan()), "nothing special came out");
        }
        if walk.kernel == [1, 4] {
            assert_lively(&want, "16 products");
        }
        for isa in Isa::available() {
            assert_same_bits(&case.all(isa), &want, &format!("{} {walk:?}", isa.name()));
        }
    }
}

#[test]
fn the_order_of_a_chain_shows() {
    for (walk, columns) in table().into_iter().filter(|(walk, _)| walk.channels > 6) {
        let mut case = Case::new(walk, columns, PLAIN, 7, Rng::ordinary);
        let want = case.all(Isa::Scalar);
        case.input = reverse_columns(&case.input, walk.channels);
        case.owned.single = reverse_channels(&case.owned.single, walk.channels);
        assert_order_shows(&case.all(Isa::Scalar), &want, &format!("{walk:?}"));
    }
}

#[test]
fn any_shape_and_any_split_gives_the_scalar_bits() {
    let walk =
        ([1usize..9, 1usize..9], prop_oneof![1usize..20, 28usize..34], [1usize..4, 1usize..4], 1usize..4, 1usize..4);
    let walk = (walk, 0usize..4).prop_map(|((image, channels, kernel, stride, dilation), padding)| Walk {
        image,
        channels,
        kernel,
        stride,
        dilation,
        padding,
    });
    let way = (any::<bool>(), prop::sample::select(JOINS.to_vec()), prop::bool::weighted(0.25));
    let tally = Tally::default();
    let run = |(walk, columns, (half, joins, relu), seed, split): (Walk, usize, _, u64, usize)| {
        let case = Case::new(walk, columns, Way { half, joins, relu }, seed, Rng::fill_of(seed));
        let want = case.all(Isa::Scalar);
        tally.count_finite(seed, &want);
        for isa in Isa::available() {
            assert_same_bits(&case.all(isa), &want, "whole");
            let (rows, split) = (case.geometry.rows(), split % (case.geometry.rows() + 1));
            let parts = [case.rows(isa, 0..split), case.rows(isa, split..rows)].concat();
            assert_same_bits(&parts, &want, "in two parts");
        }
        Ok(())
    };
    let mut runner = TestRunner::new(Config { cases: 96, ..Config::default() });
    runner.run(&(walk, 1usize..36, way, any::<u64>(), any::<usize>()), run).unwrap();
    tally.assert_half();
}

#[test]
fn the_scalar_code_agrees_with_f64() {
    for (i, (walk, columns)) in table().into_iter().enumerate() {
        for way in [PLAIN, ways()[i % 16]] {
            let case = Case::new(walk, columns, way, 6, Rng::ordinary);
            // Four products and a mask before each of the chain's add a few roundings of values below 1.
            assert_close(&case.all(Isa::Scalar), &case.naive(), 3e-5, &format!("{walk:?} {way:?}"));
        }
    }
}

/// A 3x3 deformable convolution of a 4 x 5 image, broken in one place.
fn broken(damage: impl FnOnce(&mut Case)) {
    let walk = Walk { image: [4, 5], channels: 2, kernel: [3; 2], stride: 1, dilation: 1, padding: 1 };
    let mut case = Case::new(walk, 3, PLAIN, 0, Rng::ordinary);
    damage(&mut case);
    case.all(Isa::Scalar);
}

#[test]
#[should_panic(expected = "the input has another shape")]
fn short_input() {
    broken(|case| case.input.truncate(39));
}

#[test]
#[should_panic(expected = "an extent is zero")]
fn no_input() {
    // A position between -1 and 0 would still ask for a nearest pixel.
    broken(|case| {
        case.geometry.input[1] = 0;
        case.input.clear();
        case.offsets.fill(-0.5);
    });
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
#[should_panic(expected = "a deformable convolution is two-dimensional")]
fn padding_of_the_depth_axis() {
    broken(|case| case.geometry.padding[0] = 1);
}

#[test]
#[should_panic(expected = "the offsets belong to another kernel")]
fn offsets_without_masks() {
    broken(|case| case.offsets.truncate(20 * 18));
}

#[test]
#[should_panic(expected = "the weights belong to another kernel")]
fn weights_of_another_kernel() {
    broken(|case| case.owned.depth = 17);
}

#[test]
#[should_panic(expected = "packed weights do not match the shape")]
fn weights_of_fewer_columns() {
    broken(|case| case.owned.single.truncate(17));
}

#[test]
#[should_panic(expected = "rows 0..7 of 6")]
fn rows_outside() {
    let case = one_tap([[0.0; 2]; 6]);
    deform_conv2d(Isa::Scalar, &case.args(), 0..7, 1, &mut [0.0; 7], &mut [0.0; SCRATCH]);
}

#[test]
#[should_panic(expected = "the scratch is too small")]
fn short_scratch() {
    let case = one_tap([[0.0; 2]; 6]);
    deform_conv2d(Isa::Scalar, &case.args(), 0..6, 1, &mut [0.0; 6], &mut [0.0; SCRATCH - 1]);
}

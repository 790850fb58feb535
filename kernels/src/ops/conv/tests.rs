use super::*;
use crate::matmul::SCRATCH;
use crate::testing::{
    Fill, JOINS, Joins, Owned, PLAIN, Rng, Tally, Way, assert_close, assert_lively, assert_order_shows,
    assert_same_bits, reverse_channels, reverse_columns, round_to, ways, write_rows,
};
use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};

/// The output extent that PyTorch gives a convolution with as many zeros after the input as before it.
fn output(input: [usize; 3], g: &Geometry) -> [usize; 3] {
    std::array::from_fn(|i| {
        let reach = g.dilation[i] * (g.kernel[i] - 1) + 1;
        (input[i] + 2 * g.padding[i]).checked_sub(reach).map_or(0, |room| room / g.stride[i] + 1)
    })
}

pub(crate) fn geometry(
    input: [usize; 3],
    channels: usize,
    kernel: [usize; 3],
    stride: [usize; 3],
    dilation: [usize; 3],
    padding: [usize; 3],
) -> Geometry {
    let g = Geometry { input, channels, kernel, stride, dilation, padding, output: [0; 3] };
    Geometry { output: output(input, &g), ..g }
}

struct Case {
    geometry: Geometry,
    input: Vec<f32>,
    owned: Owned,
    before: Vec<f32>,
    /// `[columns, channels, kernel]`, as PyTorch has them.
    natural: Vec<f32>,
}

impl Case {
    fn new(geometry: Geometry, columns: usize, way: Way, seed: u64, fill: Fill) -> Self {
        let mut rng = Rng::new(seed);
        let depth = geometry.depth();
        let natural = round_to(way.half, fill(&mut rng, columns * depth));
        let bias = fill(&mut rng, columns);
        let owned = Owned::new(depth, &bias, way.half, |k, n| natural[n * depth + natural_index(&geometry, k)]);
        let owned = owned.end(&mut rng, fill, geometry.rows(), way.joins, 1, way.relu);
        let input = fill(&mut rng, geometry.input.iter().product::<usize>() * geometry.channels);
        let before = fill(&mut rng, geometry.rows() * columns);
        Self { geometry, input, owned, before, natural }
    }

    fn rows(&self, isa: Isa, rows: Range<usize>) -> Vec<f32> {
        let columns = self.owned.columns;
        let args = Conv { geometry: self.geometry, input: &self.input, product: self.owned.product() };
        write_rows(rows.len(), columns + 2, &self.before[rows.start * columns..rows.end * columns], |out| {
            conv(isa, &args, rows.clone(), columns + 2, out, &mut [f32::NAN; SCRATCH]);
        })
    }

    fn all(&self, isa: Isa) -> Vec<f32> {
        self.rows(isa, 0..self.geometry.rows())
    }

    /// The formula in f64.
    fn naive(&self) -> Vec<f64> {
        let wide = |x: &[f32]| x.iter().copied().map(f64::from).collect::<Vec<_>>();
        let columns = self.owned.columns;
        let sums = naive_sums(&self.geometry, &wide(&self.input), &wide(&self.natural), columns);
        let end = |(i, sum)| self.owned.naive_end(i / columns, i % columns, self.before[i], sum);
        sums.into_iter().enumerate().map(end).collect()
    }
}

/// The sums of products, on tensors in PyTorch's layouts: `[channels, d, h, w]` and `[columns, channels, kernel]`.
pub(crate) fn naive_sums(geometry: &Geometry, input: &[f64], natural: &[f64], columns: usize) -> Vec<f64> {
    let Geometry { input: [d, h, w], channels, kernel, stride, dilation, padding, .. } = *geometry;
    let [kd, kh, kw] = kernel;
    let mut image = vec![0.0; input.len()];
    for (i, x) in input.iter().enumerate() {
        image[i % channels * (d * h * w) + i / channels] = *x;
    }
    let mut out = Vec::new();
    for (row, n) in (0..geometry.rows()).flat_map(|row| (0..columns).map(move |n| (row, n))) {
        let [_, oh, ow] = geometry.output;
        let position = [row / ow / oh, row / ow % oh, row % ow];
        let mut sum = 0.0;
        for (i, weight) in natural[n * channels * kd * kh * kw..][..channels * kd * kh * kw].iter().enumerate() {
            let (c, tap) = (i / (kd * kh * kw), [i / (kh * kw) % kd, i / kw % kh, i % kw]);
            let at: [isize; 3] = std::array::from_fn(|i| {
                (position[i] * stride[i] + tap[i] * dilation[i]) as isize - padding[i] as isize
            });
            if (0..3).all(|i| at[i] >= 0 && at[i] < geometry.input[i] as isize) {
                let [z, y, x] = at.map(|v| v as usize);
                sum += image[((c * d + z) * h + y) * w + x] * weight;
            }
        }
        out.push(sum);
    }
    out
}

/// Which of PyTorch's weights `[channels, kernel]` of a column is multiplied at `k`.
pub(crate) fn natural_index(geometry: &Geometry, k: usize) -> usize {
    let Geometry { channels, kernel: [_, kh, kw], .. } = *geometry;
    let (tap, c) = (k / channels, k % channels);
    c * (geometry.depth() / channels) + (tap / (kh * kw) * kh + tap / kw % kh) * kw + tap % kw
}

/// Three numbers per axis-triple are spelled out only where they differ.
pub(crate) const ONE: [usize; 3] = [1; 3];

/// (name, geometry, columns). Tiles, panels and blocks of k are straddled in every kind of convolution, and the first and
/// second axes always differ.
pub(crate) fn table() -> Vec<(&'static str, Geometry, usize)> {
    let flat = |h, w| [1, h, w];
    let g = geometry;
    vec![
        ("a first layer, three blocks of a line", g(flat(9, 400), 3, [1, 7, 7], [1, 2, 2], ONE, [0, 3, 3]), 33),
        ("lines of which all taps are padding", g([2, 3, 2], 2, [2, 3, 5], [1, 2, 3], [2, 1, 1], [3, 4, 7]), 17),
        (
            "six channels side by side, apart along other axes",
            g([3, 7, 20], 6, [2, 3, 4], ONE, [1, 3, 1], [1, 2, 0]),
            16,
        ),
        ("1x1, one row", g(flat(1, 1), 3, ONE, ONE, ONE, [0; 3]), 1),
        ("1x1, 97 rows, 257 channels", g(flat(1, 97), 257, ONE, ONE, ONE, [0; 3]), 17),
        ("1x1, stride 2", g(flat(11, 8), 20, ONE, [1, 2, 2], ONE, [0; 3]), 33),
        ("1x1, strides 2 and 3, in a volume", g([5, 7, 8], 4, ONE, [2, 3, 2], ONE, [0; 3]), 16),
        ("1x1 with padding", g(flat(4, 5), 6, ONE, ONE, ONE, [0, 1, 2]), 15),
        ("1x1, stride 2 with padding", g(flat(4, 5), 6, ONE, [1, 2, 2], ONE, [0, 1, 1]), 15),
        ("3x3", g(flat(9, 11), 16, [1, 3, 3], ONE, ONE, [0, 1, 1]), 32),
        ("3x3, 29 channels: 261 products", g(flat(6, 16), 29, [1, 3, 3], ONE, ONE, [0, 1, 1]), 27),
        ("3x3, 67 channels: 603 products", g(flat(8, 12), 67, [1, 3, 3], ONE, ONE, [0, 1, 1]), 16),
        ("3x3, stride 2", g(flat(10, 13), 7, [1, 3, 3], [1, 2, 2], ONE, [0, 1, 1]), 17),
        ("3x3, no padding", g(flat(5, 9), 5, [1, 3, 3], ONE, ONE, [0; 3]), 33),
        ("3x3, dilation 2", g(flat(8, 9), 5, [1, 3, 3], ONE, [1, 2, 2], [0, 2, 2]), 15),
        ("3x3, dilation 6, wider than the input", g(flat(7, 5), 9, [1, 3, 3], ONE, [1, 6, 6], [0, 6, 6]), 16),
        ("3x3, dilation 2 down only", g(flat(8, 9), 5, [1, 3, 3], ONE, [1, 2, 1], [0, 2, 1]), 16),
        ("3x3, dilation 2 across only", g(flat(8, 9), 5, [1, 3, 3], ONE, [1, 1, 2], [0, 1, 2]), 16),
        ("3x3, padding beyond the kernel", g(flat(3, 2), 3, [1, 3, 3], ONE, ONE, [0, 4, 3]), 5),
        ("3x3, padding beyond the input", g(flat(2, 1), 20, [1, 5, 5], ONE, ONE, [0, 4, 4]), 5),
        ("7x7, stride 2", g(flat(19, 23), 3, [1, 7, 7], [1, 2, 2], ONE, [0, 3, 3]), 16),
        ("7x7 on less than a kernel", g(flat(3, 2), 6, [1, 7, 7], ONE, ONE, [0, 3, 3]), 17),
        ("7x1", g(flat(9, 4), 5, [1, 7, 1], ONE, ONE, [0, 3, 0]), 16),
        ("1x7", g(flat(4, 9), 5, [1, 1, 7], ONE, ONE, [0, 0, 3]), 16),
        ("2x2", g(flat(6, 5), 9, [1, 2, 2], ONE, ONE, [0, 1, 1]), 16),
        ("2x2, stride 3: pixels between the windows", g(flat(10, 11), 9, [1, 2, 2], [1, 3, 3], ONE, [0; 3]), 17),
        ("4x4, stride 4", g(flat(8, 12), 17, [1, 4, 4], [1, 4, 4], ONE, [0; 3]), 31),
        ("3x3x3", g([5, 4, 6], 8, [3; 3], ONE, ONE, ONE), 32),
        ("3x3x3, 10 channels: 270 products", g([4, 5, 5], 10, [3; 3], ONE, ONE, ONE), 33),
        ("3x3x3, stride 2", g([5, 6, 7], 6, [3; 3], [2; 3], ONE, ONE), 16),
        ("3x3x3, dilation 2", g([6, 5, 4], 6, [3; 3], ONE, [2; 3], [2; 3]), 16),
        ("2x2x2", g([3, 4, 5], 33, [2; 3], ONE, ONE, [1, 0, 1]), 16),
        ("3x1x2, all else different too", g([7, 5, 6], 4, [3, 1, 2], [2, 1, 3], [1, 2, 3], [2, 0, 1]), 18),
        ("no output", g(flat(2, 2), 3, [1, 3, 3], ONE, ONE, [0; 3]), 4),
    ]
}

#[test]
fn by_hand() {
    // The image [1 2 3; 4 5 6] and the kernel [1 10; 100 1000], a zero on every side.
    let g = geometry([1, 2, 3], 1, [1, 2, 2], ONE, ONE, [0, 1, 1]);
    let mut case = Case::new(g, 1, PLAIN, 0, Rng::ordinary);
    case.input = vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
    case.owned = Owned::new(4, &[0.5], false, |k, _| [1.0, 10.0, 100.0, 1000.0][k]);
    for isa in Isa::available() {
        let want = [[1000.5, 2100.5, 3200.5, 300.5], [4010.5, 5421.5, 6532.5, 603.5], [40.5, 54.5, 65.5, 6.5]];
        assert_eq!(case.all(isa), want.concat());
    }
}

#[test]
fn by_hand_in_a_volume_with_two_channels() {
    // Channels 1 and 10 of a voxel weigh 1 and 2 in the first plane, 3 and 4 in the second.
    let g = geometry([2, 1, 2], 2, [2, 1, 1], ONE, ONE, [0; 3]);
    let mut case = Case::new(g, 1, PLAIN, 0, Rng::ordinary);
    case.input = vec![1.0, 10.0, 2.0, 20.0, 3.0, 30.0, 4.0, 40.0];
    case.owned = Owned::new(4, &[0.0], false, |k, _| [1.0, 2.0, 3.0, 4.0][k]);
    for isa in Isa::available() {
        assert_eq!(case.all(isa), [1.0 + 20.0 + 9.0 + 120.0, 2.0 + 40.0 + 12.0 + 160.0]);
    }
}

#[test]
fn every_isa_gives_the_scalar_bits() {
    let tally = Tally::default();
    for (i, (name, g, columns)) in table().into_iter().enumerate() {
        for way in [PLAIN, ways()[i % 16], ways()[(i + 7) % 16]] {
            let case = Case::new(g, columns, way, 3, Rng::wide);
            let want = case.all(Isa::Scalar);
            if way.joins != Joins::Nowhere && !way.relu {
                // Without a residual, windows in the padding all give the bias.
                tally.count(&want);
            }
            for isa in Isa::available() {
                assert_same_bits(&case.all(isa), &want, &format!("{} {name} {way:?}", isa.name()));
            }
        }
    }
    tally.assert_half();
}

#[test]
fn infinities_and_nan_come_out_where_the_scalar_code_has_them() {
    let mut few = 0;
    for (name, g, columns) in table() {
        let case = Case::new(g, columns, PLAIN, 4, Rng::special);
        let want = case.all(Isa::Scalar);
        for isa in Isa::available() {
            assert_same_bits(&case.all(isa), &want, &format!("{} {name}", isa.name()));
        }
        if g.depth() < 20 && g.rows() > 1 {
            assert_lively(&want, name);
            few += 1;
        }
    }
    assert!(few > 0, "no short chains");
}

#[test]
fn the_order_of_a_chain_shows() {
    for (name, g, columns) in
        table().into_iter().filter(|(_, g, _)| g.channels > 1 && g.padding == [0; 3] && g.rows() > 0)
    {
        let mut case = Case::new(g, columns, PLAIN, 7, Rng::ordinary);
        let want = case.all(Isa::Scalar);
        case.input = reverse_columns(&case.input, g.channels);
        case.owned.single = reverse_channels(&case.owned.single, g.channels);
        assert_order_shows(&case.all(Isa::Scalar), &want, name);
    }
}

#[test]
fn padding_stays_in_the_chain() {
    // 0 * inf is NaN: a body that skips the taps outside differs at the border.
    let g = geometry([1, 3, 9], 1, [1, 3, 3], ONE, ONE, [0, 1, 1]);
    let mut case = Case::new(g, 1, PLAIN, 1, Rng::ordinary);
    case.owned.single[0] = f32::INFINITY;
    for isa in Isa::available() {
        let out = case.all(isa);
        for (i, v) in out.iter().enumerate() {
            assert_eq!(v.is_nan(), i < 9 || i % 9 == 0, "{} {i}", isa.name());
        }
    }
}

/// Outputs beyond the symmetric formula, and fewer than it gives: what is behind the input counts as zero.
#[test]
fn the_output_extent_is_free() {
    for (kernel, stride, padding) in [(1, 1, 0), (1, 2, 0), (1, 1, 1), (3, 1, 1), (3, 2, 0), (2, 1, 0)] {
        for extent in [[1, 2, 3], [1, 4, 5], [1, 6, 5], [1, 4, 9], [3, 5, 7], [1, 1, 1]] {
            let g = geometry([1, 4, 5], 6, [1, kernel, kernel], [1, stride, stride], ONE, [0, padding, padding]);
            let g = Geometry { output: extent, ..g };
            let case = Case::new(g, 17, PLAIN, 5, Rng::ordinary);
            let what = format!("kernel {kernel}, stride {stride}, padding {padding}, output {extent:?}");
            let want = case.all(Isa::Scalar);
            assert_close(&want, &case.naive(), 1e-5, &what);
            for isa in Isa::available() {
                assert_same_bits(&case.all(isa), &want, &format!("{} {what}", isa.name()));
            }
        }
    }
}

fn any_geometry() -> impl Strategy<Value = Geometry> {
    let three = |low: usize, high: usize| [low..=high, low..=high, low..=high];
    let kernel = prop_oneof![Just([1; 3]), three(1, 3), three(1, 4)];
    let stride = prop_oneof![3 => Just([1; 3]), 2 => three(1, 3)];
    let dilation = prop_oneof![3 => Just([1; 3]), 2 => three(1, 6)];
    (
        three(1, 7),
        prop_oneof![1usize..20, 60usize..70],
        kernel,
        stride,
        dilation,
        three(0, 3),
        three(0, 2),
        any::<bool>(),
    )
        .prop_map(|(input, channels, kernel, stride, dilation, padding, more, flat)| {
            let mut g = geometry(input, channels, kernel, stride, dilation, padding);
            // Padding after the input need not equal that before it.
            g.output = std::array::from_fn(|i| g.output[i] + usize::from(more[i] == 2));
            if flat {
                (g.input[0], g.output[0], g.kernel[0], g.padding[0]) = (1, 1, 1, 0);
            }
            g
        })
}

#[test]
fn any_shape_and_any_split_gives_the_scalar_bits() {
    let way = (any::<bool>(), prop::sample::select(JOINS.to_vec()), prop::bool::weighted(0.25));
    let tally = Tally::default();
    let run = |(g, columns, (half, joins, relu), seed, split): (Geometry, usize, _, u64, usize)| {
        let case = Case::new(g, columns, Way { half, joins, relu }, seed, Rng::fill_of(seed));
        let want = case.all(Isa::Scalar);
        tally.count_finite(seed, &want);
        for isa in Isa::available() {
            assert_same_bits(&case.all(isa), &want, "whole");
            let (rows, split) = (g.rows(), split % (g.rows() + 1));
            let parts = [case.rows(isa, 0..split), case.rows(isa, split..rows)].concat();
            assert_same_bits(&parts, &want, "in two parts");
        }
        Ok(())
    };
    let mut runner = TestRunner::new(Config { cases: 96, ..Config::default() });
    runner.run(&(any_geometry(), 1usize..36, way, any::<u64>(), any::<usize>()), run).unwrap();
    tally.assert_half();
}

#[test]
fn the_scalar_code_agrees_with_f64() {
    for (i, (name, g, columns)) in table().into_iter().enumerate() {
        for way in [PLAIN, ways()[i % 16]] {
            let case = Case::new(g, columns, way, 6, Rng::ordinary);
            // As for the product: the chains are no longer.
            assert_close(&case.all(Isa::Scalar), &case.naive(), 3e-5, &format!("{name} {way:?}"));
        }
    }
}

/// A 3x3 convolution of a 4 x 5 image, broken in one place.
fn broken(damage: impl FnOnce(&mut Case)) {
    let mut case = Case::new(geometry([1, 4, 5], 2, [1, 3, 3], ONE, ONE, [0, 1, 1]), 3, PLAIN, 0, Rng::ordinary);
    damage(&mut case);
    case.all(Isa::Scalar);
}

#[test]
#[should_panic(expected = "the input has another shape")]
fn short_input() {
    broken(|case| case.input.truncate(39));
}

#[test]
#[should_panic(expected = "the input has another shape")]
fn long_input() {
    broken(|case| case.input.push(0.0));
}

#[test]
#[should_panic(expected = "an extent is zero")]
fn no_input() {
    broken(|case| case.geometry.input[2] = 0);
}

#[test]
#[should_panic(expected = "an extent is zero")]
fn no_taps() {
    broken(|case| case.geometry.kernel[1] = 0);
}

#[test]
#[should_panic(expected = "an extent is zero")]
fn no_stride() {
    broken(|case| case.geometry.stride[1] = 0);
}

#[test]
#[should_panic(expected = "an extent is zero")]
fn no_dilation() {
    broken(|case| case.geometry.dilation[0] = 0);
}

#[test]
#[should_panic(expected = "the geometry overflows")]
fn positions_that_cannot_be_counted() {
    broken(|case| case.geometry.dilation[2] = usize::MAX / 2);
}

#[test]
#[should_panic(expected = "the geometry overflows")]
fn padding_that_cannot_be_counted() {
    broken(|case| case.geometry.padding[1] = usize::MAX / 2);
}

#[test]
#[should_panic(expected = "the geometry overflows")]
fn outputs_that_cannot_be_counted() {
    let case = Case::new(geometry([1, 4, 5], 2, ONE, ONE, ONE, [0; 3]), 3, PLAIN, 0, Rng::ordinary);
    Geometry { output: [1 << 30; 3], ..case.geometry }.check(&case.input);
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
#[should_panic(expected = "rows 0..21 of 20")]
fn rows_outside() {
    let case = Case::new(geometry([1, 4, 5], 2, ONE, ONE, ONE, [0; 3]), 3, PLAIN, 0, Rng::ordinary);
    let args = Conv { geometry: case.geometry, input: &case.input, product: case.owned.product() };
    conv(Isa::Scalar, &args, 0..21, 3, &mut [0.0; 63], &mut [0.0; SCRATCH]);
}

#[test]
#[should_panic(expected = "the scratch is too small")]
fn short_scratch() {
    let case = Case::new(geometry([1, 4, 5], 2, ONE, ONE, ONE, [0; 3]), 3, PLAIN, 0, Rng::ordinary);
    let args = Conv { geometry: case.geometry, input: &case.input, product: case.owned.product() };
    conv(Isa::Scalar, &args, 0..20, 3, &mut [0.0; 60], &mut [0.0; SCRATCH - 1]);
}

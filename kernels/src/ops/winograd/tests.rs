use super::*;
use crate::conv::{Conv, conv};
use crate::deconv3d::{Deconv3d, deconv3d};
use crate::matmul::layout::{pack, packed_len};
use crate::matmul::{Panels, Product, SCRATCH};
use crate::testing::{
    Fill, JOINS, Joins, Rng, Tally, assert_close, assert_order_shows, assert_same_bits, pad_rows, reverse_columns,
    reverse_rows, write_rows,
};
use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};

/// Those of a convolution.
const SCHEMES: [Scheme; 2] = [Scheme::Two, Scheme::Four];

fn image(plane: [usize; 2], channels: usize, columns: usize, scheme: Scheme) -> Shape {
    Shape { plane, layers: 1, layer_taps: 1, channels, columns, scheme }
}

fn volume(plane: [usize; 2], layers: usize, channels: usize, columns: usize, scheme: Scheme) -> Shape {
    Shape { plane, layers, layer_taps: 3, channels, columns, scheme }
}

fn doubled(plane: [usize; 2], layers: usize, channels: usize, columns: usize) -> Shape {
    Shape::of_deconv3d([plane[0], plane[1], layers], channels, columns).expect("channels in sixteens")
}

/// The direct convolution that computes the same.
fn geometry(shape: &Shape) -> Geometry {
    let [h, w] = shape.plane;
    let (input, kernel, padding) = match shape.layer_taps {
        1 => ([1, h, w], [1, 3, 3], [0, 1, 1]),
        _ => ([h, w, shape.layers], [3; 3], [1; 3]),
    };
    let channels = shape.channels;
    Geometry { input, channels, kernel, stride: [1; 3], dilation: [1; 3], padding, output: input }
}

struct Case {
    shape: Shape,
    input: Vec<f32>,
    /// `[parts, taps of the plane, taps of the layers, channels, columns]`.
    natural: Vec<f32>,
    weights: Vec<f32>,
    /// Padded with NaN, which must not show.
    bias: Vec<f32>,
    joins: Joins,
    relu: bool,
    added: Vec<f32>,
    before: Vec<f32>,
}

impl Case {
    fn new(shape: Shape, joins: Joins, relu: bool, seed: u64, fill: Fill) -> Self {
        let mut rng = Rng::new(seed);
        let outputs = shape.rows() * shape.columns;
        let natural = fill(&mut rng, shape.parts() * shape.direct_depth() * shape.columns);
        let bias = pad_rows(&fill(&mut rng, shape.columns), shape.columns, f32::NAN);
        let input = fill(&mut rng, shape.inputs() * shape.channels);
        let added = fill(&mut rng, shape.rows() * (shape.columns + 1));
        let before = fill(&mut rng, outputs);
        Self { shape, input, natural, weights: vec![], bias, joins, relu, added, before }.packed()
    }

    /// With transformed weights.
    fn packed(mut self) -> Self {
        self.weights = vec![f32::NAN; self.shape.weights_len()];
        let (depth, columns) = (self.shape.direct_depth(), self.shape.columns);
        let weight = |part, k, n| f64::from(self.natural[(part * depth + k) * columns + n]);
        self.shape.pack(weight, &mut self.weights);
        self
    }

    fn residual(&self) -> Residual<'_> {
        let (rows, stride) = (&self.added[..], self.shape.columns + 1);
        match self.joins {
            Joins::Nowhere => Residual::None,
            Joins::InPlace => Residual::InPlace,
            Joins::Before => Residual::Before { rows, stride },
            Joins::After => Residual::After { rows, stride },
        }
    }

    fn args(&self) -> Winograd<'_> {
        let Self { shape, ref input, ref weights, ref bias, relu, .. } = *self;
        Winograd { shape, input, weights, bias, relu, residual: self.residual() }
    }

    fn rows(&self, isa: Isa, tile_rows: Range<usize>) -> Vec<f32> {
        let columns = self.shape.columns;
        let positions = self.shape.positions(&tile_rows);
        let before = &self.before[positions.start * columns..positions.end * columns];
        write_rows(positions.len(), columns + 2, before, |out| {
            let mut scratch = vec![f32::NAN; self.shape.scratch_len()];
            winograd(isa, &self.args(), tile_rows, columns + 2, out, &mut scratch);
        })
    }

    fn all(&self, isa: Isa) -> Vec<f32> {
        self.rows(isa, 0..self.shape.tiles()[0])
    }

    /// The direct kernel's result.
    fn direct(&self, isa: Isa) -> Vec<f32> {
        let (depth, columns) = (self.shape.direct_depth(), self.shape.columns);
        let part_len = packed_len(depth, columns);
        let mut weights = vec![0.0; self.shape.parts() * part_len];
        for (part, weights) in weights.chunks_exact_mut(part_len).enumerate() {
            pack(depth, columns, |k, n| self.natural[(part * depth + k) * columns + n], weights);
        }
        let weights = Panels::F32(&weights);
        if self.shape.scheme == Scheme::Three {
            let Shape { plane: [x, y], layers, channels, .. } = self.shape;
            let (input, bias, relu) = (&self.input[..], &self.bias[..], self.relu);
            let args = Deconv3d { extent: [x, y, layers], channels, columns, input, weights, bias, relu, add: None };
            let mut out = vec![f32::NAN; self.shape.rows() * columns];
            deconv3d(isa, &args, 0..2 * x, &mut out, &mut [f32::NAN; SCRATCH]);
            return out;
        }
        let geometry = geometry(&self.shape);
        let product = Product { weights, bias: &self.bias, depth, columns, relu: self.relu, residual: self.residual() };
        let mut out = self.before.clone();
        let args = Conv { geometry, input: &self.input, product };
        conv(isa, &args, 0..geometry.rows(), columns, &mut out, &mut [f32::NAN; SCRATCH]);
        out
    }

    /// The formula of the direct convolution, transposed or not, in f64.
    fn naive(&self) -> Vec<f64> {
        let Shape { plane: [h, w], layers, layer_taps, channels, columns, scheme } = self.shape;
        let (taps, step) = (scheme.taps(), if scheme == Scheme::Three { 2 } else { 1 });
        let mut out = Vec::new();
        for (row, n) in (0..self.shape.rows()).flat_map(|row| (0..columns).map(move |n| (row, n))) {
            let out_at =
                [row / (layers * step) / (w * step), row / (layers * step) % (w * step), row % (layers * step)];
            let part = out_at.iter().fold(0, |part, at| part * step + at % step);
            // One beyond the first input under the taps.
            let [y, x, z] = out_at.map(|at| if step == 2 { at / 2 + at % 2 } else { at });
            let mut sum = f64::from(self.bias[n]);
            let added = f64::from(self.added[row * (columns + 1) + n]);
            match self.joins {
                Joins::InPlace => sum += f64::from(self.before[row * columns + n]),
                Joins::Before => sum += added,
                _ => {}
            }
            for tap in 0..taps * taps * layer_taps {
                let (plane, layer) = (tap / layer_taps, tap % layer_taps);
                let [y, x, z] = [y + plane / taps, x + plane % taps, z + layer + usize::from(layer_taps == 1)];
                if (1..=h).contains(&y) && (1..=w).contains(&x) && (1..=layers).contains(&z) {
                    let position = ((y - 1) * w + x - 1) * layers + z - 1;
                    for c in 0..channels {
                        sum += f64::from(self.input[position * channels + c])
                            * f64::from(
                                self.natural[(part * self.shape.direct_depth() + tap * channels + c) * columns + n],
                            );
                    }
                }
            }
            if self.relu {
                sum = sum.max(0.0);
            }
            out.push(if self.joins == Joins::After { sum + added } else { sum });
        }
        out
    }
}

/// Tiles, blocks of tiles, of layers, of k and of columns are straddled, and the axes always differ.
fn table() -> Vec<(&'static str, Shape)> {
    let mut table = Vec::new();
    for scheme in SCHEMES {
        table.extend([
            ("one position", image([1, 1], 16, 1, scheme)),
            ("less than a tile", image([3, 1], 16, 16, scheme)),
            ("one tile", image([4, 4], 16, 17, scheme)),
            ("a tile and one more", image([5, 9], 32, 27, scheme)),
            ("groups of 32 and a half", image([6, 7], 80, 33, scheme)),
            ("several blocks of tiles", image([23, 41], 16, 15, scheme)),
            ("two blocks of k", image([5, 6], 416, 18, scheme)),
            ("two blocks of columns", image([6, 3], 16, 131, scheme)),
            ("a volume of one layer", volume([5, 3], 1, 16, 16, scheme)),
            ("a volume", volume([6, 9], 4, 32, 33, scheme)),
            ("two blocks of layers", volume([3, 5], LAYERS + 2, 16, 5, scheme)),
            ("a volume, two blocks of k", volume([2, 5], 2, 144, 16, scheme)),
        ]);
    }
    table.extend([
        ("one voxel doubled", doubled([1, 1], 1, 16, 1)),
        ("less than a tile doubled", doubled([2, 1], 3, 16, 16)),
        ("one tile doubled", doubled([3, 3], 2, 32, 17)),
        ("a tile and one more doubled", doubled([4, 7], 4, 32, 33)),
        ("two blocks of layers doubled", doubled([3, 4], LAYERS + 2, 16, 5)),
        ("two blocks of columns doubled", doubled([3, 2], 2, 16, 131)),
        ("several blocks of tiles doubled", doubled([13, 17], 2, 16, 15)),
        ("two blocks of k doubled", doubled([2, 5], 2, 208, 16)),
    ]);
    table
}

/// Every combination of a residual and ReLU.
fn ends() -> impl Iterator<Item = (Joins, bool)> {
    JOINS.into_iter().flat_map(|joins| [(joins, false), (joins, true)])
}

#[test]
fn every_isa_gives_the_scalar_bits() {
    let tally = Tally::default();
    for (i, (name, shape)) in table().into_iter().enumerate() {
        for (joins, relu) in [(Joins::Nowhere, false), ends().nth(i % 8).unwrap(), ends().nth((i + 3) % 8).unwrap()] {
            let case = Case::new(shape, joins, relu, 3, Rng::wide);
            let want = case.all(Isa::Scalar);
            if !relu {
                tally.count(&want);
            }
            for isa in Isa::available() {
                let what = format!("{} {name} {:?} {joins:?} {relu}", isa.name(), shape.scheme);
                assert_same_bits(&case.all(isa), &want, &what);
            }
        }
    }
    tally.assert_half();
}

#[test]
fn a_number_that_is_not_finite_spoils_its_tiles_alone() {
    for scheme in SCHEMES {
        let shape = volume([12, 9], 5, 16, 3, scheme);
        let mut case = Case::new(shape, Joins::Nowhere, false, 8, Rng::ordinary);
        let sound = case.all(Isa::Scalar);
        let [y, x, z] = [4, 5, 2];
        for bad in [f32::INFINITY, f32::NEG_INFINITY, f32::NAN] {
            case.input[((y * 9 + x) * 5 + z) * 16 + 7] = bad;
            let want = case.all(Isa::Scalar);
            let mut spoilt = 0;
            for (i, (v, sound)) in want.iter().zip(&sound).enumerate() {
                let at = [i / 3 / 5 / 9, i / 3 / 5 % 9, i / 3 % 5];
                // A tile's inputs reach one position beyond it.
                let near = |a: usize, at: usize, of: usize| {
                    let first = at / scheme.outputs() * scheme.outputs();
                    (first..first + scheme.inputs()).contains(&(of + 1)) && a < 2
                };
                let reached = near(0, at[0], y) && near(1, at[1], x) && at[2].abs_diff(z) <= 1;
                spoilt += usize::from(!v.is_finite());
                assert!(v.to_bits() == sound.to_bits() || (reached && !v.is_finite()), "{scheme:?} {at:?}: {v}");
            }
            assert!(spoilt > 0);
            for isa in Isa::available() {
                assert_same_bits(&case.all(isa), &want, isa.name());
            }
        }
    }
}

#[test]
fn by_hand() {
    // The image [1 2; 3 4] on a zero border; the taps count 1 to 9. Channels other than the first are 0.
    for scheme in SCHEMES {
        let mut case = Case::new(image([2, 2], 16, 1, scheme), Joins::Nowhere, false, 0, Rng::ordinary);
        case.input.fill(0.0);
        case.natural.fill(0.0);
        for i in 0..4 {
            case.input[i * 16] = (i + 1) as f32;
        }
        for tap in 0..9 {
            case.natural[tap * 16] = (tap + 1) as f32;
        }
        case.bias[0] = 0.5;
        let case = case.packed();
        // 5*1 + 6*2 + 8*3 + 9*4 and so on: the image under the kernel's centre, one place after the other.
        let want = [77.5, 67.5, 47.5, 37.5];
        for isa in Isa::available() {
            assert_close(&case.all(isa), &want, 1e-6, isa.name());
        }
    }
}

#[test]
fn doubled_by_hand() {
    // Along the first axis the voxels 1 and 10 with the taps 1, 2, 3, 4 of the transposed convolution, of which an output with
    // parity p meets 4 - p - 2t: the outputs are 2, 3 + 10, 4 + 20, 30, in the first line along the others.
    let mut case = Case::new(doubled([2, 1], 1, 16, 1), Joins::Nowhere, false, 0, Rng::ordinary);
    case.input.fill(0.0);
    case.natural.fill(0.0);
    (case.input[0], case.input[16], case.bias[0]) = (1.0, 10.0, 0.0);
    for (parity, tap) in (0..2).flat_map(|parity| (0..2).map(move |tap| (parity, tap))) {
        // The tap along y and z that meets the only voxel at their first output is the second one.
        let k = (tap * 4 + 3) * 16;
        case.natural[parity * 4 * 8 * 16 + k] = (4 - parity - 2 * tap) as f32;
    }
    let case = case.packed();
    for isa in Isa::available() {
        let found: Vec<f32> = case.all(isa).chunks_exact(4).map(|line| line[0]).collect();
        assert_eq!(found, [2.0, 13.0, 24.0, 30.0], "{}", isa.name());
    }
}

#[test]
fn a_number_that_is_not_finite_spoils_of_every_parity_what_its_tiles_make_of_it() {
    let mut case = Case::new(doubled([7, 8], 3, 16, 3), Joins::Nowhere, false, 8, Rng::ordinary);
    let sound = case.all(Isa::Scalar);
    let of = [2, 3, 1];
    case.input[((of[0] * 8 + of[1]) * 3 + of[2]) * 16 + 5] = f32::NAN;
    let want = case.all(Isa::Scalar);
    for (i, (v, sound)) in want.iter().zip(&sound).enumerate() {
        let at = [i / 3 / 6 / 16, i / 3 / 6 % 16, i / 3 % 6];
        let reached = (0..3).all(|a| {
            let (parity, at) = (at[a] % 2, at[a] / 2);
            // Along the plane a tile has four inputs, of which the outer ones meet one output each; along the layers two.
            let (first, inner) = if a < 2 { (at / 3 * 3, at % 3) } else { (at, 0) };
            match (of[a] + 1).checked_sub(first + parity) {
                Some(0) => inner == 0,
                Some(1) => true,
                Some(2) => a < 2,
                Some(3) => a < 2 && inner == 2,
                _ => false,
            }
        });
        assert_eq!(v.is_nan(), reached, "{at:?}: {v}");
        assert!(reached || v.to_bits() == sound.to_bits(), "{at:?}: {v}");
    }
    for isa in Isa::available() {
        assert_same_bits(&case.all(isa), &want, isa.name());
    }
}

#[test]
fn the_order_of_a_chain_shows() {
    // One tap across layers: reversed channels are reversed k.
    for (name, shape) in table().into_iter().filter(|(_, shape)| shape.layer_taps == 1 && shape.rows() > 9) {
        let mut case = Case::new(shape, Joins::Nowhere, false, 7, Rng::ordinary);
        let want = case.all(Isa::Scalar);
        case.input = reverse_columns(&case.input, shape.channels);
        case.natural = case
            .natural
            .chunks_exact(shape.channels * shape.columns)
            .flat_map(|tap| reverse_rows(tap, shape.columns))
            .collect();
        assert_order_shows(&case.packed().all(Isa::Scalar), &want, name);
    }
}

#[test]
fn groups_are_part_of_the_order() {
    let case = Case::new(image([9, 8], 64, 16, Scheme::Four), Joins::Nowhere, false, 9, Rng::ordinary);
    let want = case.all(Isa::Scalar);
    // Channels 0 to 31 and 32 to 63 change places: with one chain over all, nearly all sums would differ. Two groups' sums
    // are added to 0 in either order with the same result.
    let swap = |x: &[f32], row: usize| -> Vec<f32> {
        x.chunks_exact(row).flat_map(|r| [&r[row / 2..], &r[..row / 2]].concat()).collect()
    };
    let swapped =
        Case { input: swap(&case.input, 64), natural: swap(&case.natural, 64 * 16), ..case }.packed().all(Isa::Scalar);
    assert_same_bits(&swapped, &want, "two groups");
}

#[test]
fn any_shape_and_any_split_gives_the_scalar_bits() {
    let tally = Tally::default();
    let shape = (
        [1usize..14, 1usize..14],
        1usize..5,
        prop::sample::select(vec![1usize, 2, 3]),
        prop::sample::select(vec![16usize, 32, 48, 64, 80]),
        1usize..36,
        prop::sample::select(SCHEMES.to_vec()),
    )
        .prop_map(|(plane, layers, layer_taps, channels, columns, scheme)| match layer_taps {
            1 => image(plane, channels, columns, scheme),
            2 => doubled(plane, layers, channels, columns),
            _ => volume(plane, layers, channels, columns, scheme),
        });
    let run = |(shape, joins, relu, seed, split): (Shape, _, _, u64, usize)| {
        let case = Case::new(shape, joins, relu, seed, Rng::fill_of(seed));
        let want = case.all(Isa::Scalar);
        tally.count_finite(seed, &want);
        for isa in Isa::available() {
            assert_same_bits(&case.all(isa), &want, "whole");
            let (rows, split) = (shape.tiles()[0], split % (shape.tiles()[0] + 1));
            let parts = [case.rows(isa, 0..split), case.rows(isa, split..rows)].concat();
            assert_same_bits(&parts, &want, "in two parts");
        }
        Ok(())
    };
    let joins = prop::sample::select(JOINS.to_vec());
    let mut runner = TestRunner::new(Config { cases: 64, ..Config::default() });
    runner.run(&(shape, joins, prop::bool::weighted(0.25), any::<u64>(), any::<usize>()), run).unwrap();
    tally.assert_half();
}

#[test]
fn the_scalar_code_agrees_with_f64() {
    for (i, (name, shape)) in table().into_iter().enumerate() {
        for (joins, relu) in [(Joins::Nowhere, false), ends().nth(i % 8).unwrap()] {
            let case = Case::new(shape, joins, relu, 6, Rng::ordinary);
            let what = format!("{name} {:?} {joins:?} {relu}", shape.scheme);
            // Twice what the direct convolution is held to.
            assert_close(&case.all(Isa::Scalar), &case.naive(), 6e-5, &what);
        }
    }
}

/// Of rectified inputs, as most layers have them: the error that a layer adds is at most twice that of a direct sum, wherever
/// [`Shape::accurate`] says so.
#[test]
fn errors_are_at_most_twice_those_of_direct_sums() {
    let [two, four] = SCHEMES;
    let mut shapes = vec![image([12, 12], 16, 16, two), volume([8, 8], 3, 16, 16, two), image([12, 12], 64, 16, two)];
    for channels in [32, 48, 64, 128, 256] {
        shapes.push(image([16, 16], channels, 16, four));
    }
    shapes.extend([volume([8, 8], 4, 16, 16, four), volume([8, 8], 4, 32, 16, four), volume([8, 8], 2, 64, 16, four)]);
    for channels in [16, 32, 64, 128, 256] {
        shapes.push(doubled([6, 6], 2, channels, 16));
    }
    for shape in shapes {
        assert!(shape.accurate(), "{shape:?}");
        let mut case = Case::new(shape, Joins::Nowhere, false, 11, Rng::ordinary);
        case.input.iter_mut().for_each(|x| *x = x.max(0.0));
        let exact = case.naive();
        let error = |got: Vec<f32>| -> f64 {
            got.iter().zip(&exact).map(|(g, w)| (f64::from(*g) - w).powi(2)).sum::<f64>().sqrt()
        };
        let (here, direct) = (error(case.all(Isa::best())), error(case.direct(Isa::best())));
        assert!(here <= 2.0 * direct, "{shape:?}: {:.2} times the direct sum's error", here / direct);
    }
}

/// A convolution of a 4 x 5 image, broken in one place.
fn broken(damage: impl FnOnce(&mut Case)) {
    let mut case = Case::new(image([4, 5], 16, 3, Scheme::Four), Joins::Before, false, 0, Rng::ordinary);
    let len = case.shape.scratch_len();
    damage(&mut case);
    winograd(Isa::Scalar, &case.args(), 0..1, 3, &mut [0.0; 60], &mut vec![0.0; len]);
}

#[test]
#[should_panic(expected = "the input has another shape")]
fn short_input() {
    broken(|case| case.input.truncate(319));
}

#[test]
#[should_panic(expected = "channels come in sixteens")]
fn channels_between() {
    broken(|case| case.shape.channels = 17);
}

#[test]
#[should_panic(expected = "an extent is zero")]
fn no_layers() {
    broken(|case| case.shape.layers = 0);
}

#[test]
#[should_panic(expected = "2 taps across layers")]
fn two_taps_across_layers() {
    broken(|case| case.shape.layer_taps = 2);
}

#[test]
#[should_panic(expected = "3 taps across layers")]
fn three_taps_of_a_transposed_convolution() {
    broken(|case| (case.shape.layer_taps, case.shape.scheme) = (3, Scheme::Three));
}

#[test]
fn volumes_of_many_megabytes_fit_32_bits() {
    let bytes = i32::MAX as usize;
    for scheme in SCHEMES {
        assert!(volume([100, 100], 16, 64, 64, scheme).fits(bytes));
        assert!(image([928, 1600], 64, 64, scheme).fits(bytes));
        assert!(!image([1 << 13, 1 << 12], 16, 16, scheme).fits(bytes), "2 GiB of inputs");
        assert!(!image([8, 8], 1 << 15, 16, scheme).fits(bytes), "2 GiB of scratch");
        assert!(!image([8, 8], 1 << 11, 1 << 11, scheme).fits(bytes), "2 GiB of weights, at most");
    }
    assert!(doubled([100, 100], 8, 64, 32).fits(bytes));
    assert!(!doubled([256, 256], 64, 16, 16).fits(bytes), "2 GiB of outputs");
}

#[test]
#[should_panic(expected = "the shape overflows")]
fn positions_that_cannot_be_counted() {
    broken(|case| case.shape.plane[0] = usize::MAX / 64);
}

#[test]
#[should_panic(expected = "transformed weights do not match the shape")]
fn weights_of_another_scheme() {
    broken(|case| case.weights.truncate(16 * 16 * 16));
}

#[test]
#[should_panic(expected = "the bias is shorter than the columns")]
fn short_bias() {
    broken(|case| case.bias.truncate(15));
}

#[test]
#[should_panic(expected = "the residual is shorter than the rows")]
fn short_residual() {
    broken(|case| case.added.truncate(78));
}

#[test]
#[should_panic(expected = "rows of tiles 0..2 of 1")]
fn tiles_outside() {
    let case = Case::new(image([4, 5], 16, 3, Scheme::Four), Joins::Nowhere, false, 0, Rng::ordinary);
    winograd(Isa::Scalar, &case.args(), 0..2, 3, &mut [0.0; 60], &mut vec![0.0; case.shape.scratch_len()]);
}

#[test]
#[should_panic(expected = "the scratch is too small")]
fn short_scratch() {
    let case = Case::new(image([4, 5], 16, 3, Scheme::Four), Joins::Nowhere, false, 0, Rng::ordinary);
    winograd(Isa::Scalar, &case.args(), 0..1, 3, &mut [0.0; 60], &mut vec![0.0; case.shape.scratch_len() - 1]);
}

#[test]
#[should_panic(expected = "the output is shorter than its rows")]
fn short_output() {
    let case = Case::new(image([4, 5], 16, 3, Scheme::Four), Joins::Nowhere, false, 0, Rng::ordinary);
    winograd(Isa::Scalar, &case.args(), 0..1, 3, &mut [0.0; 59], &mut vec![0.0; case.shape.scratch_len()]);
}

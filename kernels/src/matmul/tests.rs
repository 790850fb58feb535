use super::driver::{DEPTH, Source};
use super::product::{Multiply, Product, Rows, SCRATCH};
use crate::isa::Isa;
use crate::simd::Simd;
use crate::testing::{
    Fill, JOINS, Joins, Owned, Rng, Tally, assert_close, assert_lively, assert_order_shows, assert_same_bits,
    reverse_channels, reverse_columns, round_to, write_rows,
};
use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};
use std::ops::Range;

/// The plainest left matrix: one that exists. It lies in memory if `stored`, and is copied piece by piece if not.
struct Case {
    rows: usize,
    stored: bool,
    left: Vec<f32>,
    owned: Owned,
    before: Vec<f32>,
}

impl Source for Case {
    type Element = f32;
    type At = usize;
    type Part = usize;

    fn element(&self, row: usize, k: usize) -> f32 {
        self.left[row * self.owned.depth + k]
    }
    fn at(&self, row: usize) -> usize {
        row
    }
    fn next(&self, row: usize) -> usize {
        row + 1
    }
    fn part(&self, k: usize) -> (usize, usize) {
        // Pieces of odd lengths, so that blocks end inside them and hold one or many.
        (k, if self.stored { DEPTH } else { 70 - k % 70 })
    }
    fn piece<'a, S: Simd>(&'a self, _: S, row: usize, k: usize, spare: &'a mut [f32]) -> &'a [f32] {
        let here = &self.left[row * self.owned.depth + k..][..spare.len()];
        if self.stored || (row + k).is_multiple_of(3) {
            return here;
        }
        spare.copy_from_slice(here);
        spare
    }
}

/// Which of the sixteen ways through the code: left matrix stored, half precision, residual, ReLU.
#[derive(Clone, Copy, Debug)]
struct Way {
    stored: bool,
    half: bool,
    joins: Joins,
    relu: bool,
}

impl Case {
    fn new([rows, columns, depth]: [usize; 3], way: Way, seed: u64, fill: Fill) -> Self {
        let mut rng = Rng::new(seed);
        let weights = round_to(way.half, fill(&mut rng, depth * columns));
        let bias = fill(&mut rng, columns);
        let owned = Owned::new(depth, &bias, way.half, |k, n| weights[k * columns + n]);
        let owned = owned.end(&mut rng, fill, rows, way.joins, 3, way.relu);
        let (left, before) = (fill(&mut rng, rows * depth), fill(&mut rng, rows * columns));
        Self { rows, stored: way.stored, left, owned, before }
    }

    fn rows(&self, isa: Isa, rows: Range<usize>) -> Vec<f32> {
        let columns = self.owned.columns;
        let mut scratch = vec![f32::NAN; SCRATCH];
        let before = &self.before[rows.start * columns..rows.end * columns];
        write_rows(rows.len(), columns + 5, before, |out| {
            let (product, scratch) = (&self.owned.product(), &mut scratch);
            Rows { product, source: self, rows, stride: columns + 5, out, scratch }.compute(isa, self.rows);
        })
    }

    fn all(&self, isa: Isa) -> Vec<f32> {
        self.rows(isa, 0..self.rows)
    }
}

const PLAIN: Way = Way { stored: true, half: false, joins: Joins::Nowhere, relu: false };

#[test]
fn by_hand() {
    // [1 2 3; 4 5 6] times [1 -2; 0 1; 2 -3] is [7 -9; 16 -21].
    let mut case = Case::new([2, 2, 3], PLAIN, 0, Rng::ordinary);
    case.left = vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
    let weights = [[1.0, -2.0], [0.0, 1.0], [2.0, -3.0]];
    case.owned = Owned::new(3, &[10.0, 20.0], false, |k, n| weights[k][n]);
    case.before = vec![1.0, -100.0, -100.0, 2.0];
    for isa in Isa::available() {
        case.owned = case.owned.end(&mut Rng::new(0), Rng::ordinary, 0, Joins::Nowhere, 0, false);
        assert_eq!(case.all(isa), [17.0, 11.0, 26.0, -1.0]);
        case.owned.relu = true;
        assert_eq!(case.all(isa), [17.0, 11.0, 26.0, 0.0]);
        case.owned.joins = Joins::InPlace;
        assert_eq!(case.all(isa), [18.0, 0.0, 0.0, 1.0]);
        (case.owned.added, case.owned.added_stride) = (vec![-20.0, -12.0, 99.0, -6.0, 0.5], 3);
        case.owned.joins = Joins::Before;
        assert_eq!(case.all(isa), [0.0, 0.0, 20.0, 0.0]);
        case.owned.joins = Joins::After;
        assert_eq!(case.all(isa), [-3.0, -1.0, 20.0, 0.5]);
    }
}

#[test]
fn nothing_to_multiply_leaves_the_bias() {
    for isa in Isa::available() {
        assert_eq!(Case::new([0, 5, 7], PLAIN, 1, Rng::wide).all(isa), []);
        assert_eq!(Case::new([7, 0, 5], PLAIN, 1, Rng::wide).all(isa), []);
        let case = Case::new([7, 17, 0], PLAIN, 1, Rng::wide);
        assert_same_bits(&case.all(isa), &case.owned.bias[..17].repeat(7), "depth 0");
    }
}

#[test]
fn a_chain_is_fused_and_ascends() {
    // With x = 1 + 2^-12, x * x - (1 + 2^-11) is 2^-24 if fused and 0 if rounded in between; and 2^25 + 1 - 2^25 + 1
    // is 1 from the left and 2 from the right.
    for isa in Isa::available() {
        let x = 1.0 + 2f32.powi(-12);
        let mut case = Case::new([1, 1, 1], PLAIN, 0, Rng::ordinary);
        case.owned = Owned::new(1, &[-(1.0 + 2f32.powi(-11))], false, |_, _| x);
        case.left = vec![x];
        assert_eq!(case.all(isa), [2f32.powi(-24)]);
        case.owned = Owned::new(4, &[0.0], false, |k, _| [33_554_432.0, 1.0, -33_554_432.0, 1.0][k]);
        case.left = vec![1.0; 4];
        assert_eq!(case.all(isa), [1.0]);
    }
}

/// Every number of rows, columns and k around a tile, a panel and a block of every instruction set, each with another way
/// through the code.
fn table() -> impl Iterator<Item = ([usize; 3], Way)> {
    let ways = [false, true].map(|relu| {
        [false, true].map(|half| [false, true].map(|stored| JOINS.map(|joins| Way { stored, half, joins, relu })))
    });
    let ways: Vec<Way> = ways.into_iter().flatten().flatten().flatten().collect();
    let rows = [1, 5, 6, 7, 11, 12, 13, 96, 97, 193];
    let columns = [1, 15, 16, 17, 27, 32, 33, 48, 65];
    let depths = [1, 16, 192, 193, 384, 385, 600];
    let shapes = rows.into_iter().flat_map(move |r| columns.map(|c| depths.map(|d| [r, c, d]))).flatten();
    // 630 shapes and 32 ways: a step of 11 pairs every way with shapes of every kind.
    shapes.enumerate().map(move |(i, shape)| (shape, ways[i * 11 % 32]))
}

#[test]
fn every_isa_gives_the_scalar_bits() {
    let tally = Tally::default();
    for (shape, way) in table() {
        let case = Case::new(shape, way, 5, Rng::wide);
        let want = case.all(Isa::Scalar);
        tally.count(&want);
        for isa in Isa::available() {
            assert_same_bits(&case.all(isa), &want, &format!("{} {shape:?} {way:?}", isa.name()));
        }
    }
    tally.assert_half();
}

#[test]
fn infinities_and_nan_come_out_where_the_scalar_code_has_them() {
    for (shape, way) in table().filter(|(shape, _)| shape[0] < 10 && shape[2] < 20) {
        let case = Case::new(shape, way, 6, Rng::special);
        let want = case.all(Isa::Scalar);
        for isa in Isa::available() {
            assert_same_bits(&case.all(isa), &want, &format!("{} {shape:?} {way:?}", isa.name()));
        }
    }
    let want = Case::new([50, 50, 5], PLAIN, 6, Rng::special).all(Isa::Scalar);
    assert_lively(&want, "5 products");
    assert!(want.iter().any(|v| v.is_nan()) && want.iter().any(|v| v.is_infinite()), "nothing special came out");
}

#[test]
fn the_order_of_a_chain_shows() {
    for (shape, way) in table().filter(|([rows, columns, depth], _)| rows * columns > 100 && *depth > 1) {
        let mut case = Case::new(shape, Way { half: false, ..way }, 7, Rng::ordinary);
        let want = case.all(Isa::Scalar);
        let depth = shape[2];
        case.left = reverse_columns(&case.left, depth);
        case.owned.single = reverse_channels(&case.owned.single, depth);
        assert_order_shows(&case.all(Isa::Scalar), &want, &format!("{shape:?} {way:?}"));
    }
}

#[test]
fn relu_keeps_nan_and_the_sign_of_zero() {
    for isa in Isa::available() {
        let mut case = Case::new([1, 4, 1], Way { relu: true, ..PLAIN }, 0, Rng::ordinary);
        case.left = vec![0.0];
        case.owned.single.fill(-1.0);
        case.owned.bias[..4].copy_from_slice(&[-0.0, f32::NAN, -f32::MIN_POSITIVE, f32::NEG_INFINITY]);
        let out = case.all(isa);
        assert!(out[0].to_bits() == (-0.0f32).to_bits() && out[1].is_nan(), "{out:?}");
        assert_same_bits(&out[2..], &[0.0, 0.0], isa.name());
    }
}

#[test]
fn any_shape_and_any_split_gives_the_scalar_bits() {
    let way = (any::<bool>(), any::<bool>(), prop::sample::select(JOINS.to_vec()), prop::bool::weighted(0.25));
    let shape = (0usize..220, 0usize..50, prop_oneof![0usize..40, 240usize..270, 500usize..530]);
    let tally = Tally::default();
    let run = |((rows, columns, depth), (stored, half, joins, relu), seed, split): (_, _, u64, usize)| {
        let way = Way { stored, half, joins, relu };
        let case = Case::new([rows, columns, depth], way, seed, Rng::fill_of(seed));
        let want = case.all(Isa::Scalar);
        tally.count_finite(seed, &want);
        for isa in Isa::available() {
            assert_same_bits(&case.all(isa), &want, "whole");
            let split = split % (rows + 1);
            let parts = [case.rows(isa, 0..split), case.rows(isa, split..rows)].concat();
            assert_same_bits(&parts, &want, "in two parts");
        }
        Ok(())
    };
    let mut runner = TestRunner::new(Config { cases: 64, ..Config::default() });
    runner.run(&(shape, way, any::<u64>(), any::<usize>()), run).unwrap();
    tally.assert_half();
}

#[test]
fn the_scalar_code_agrees_with_f64() {
    for (shape, way) in table() {
        let [rows, columns, depth] = shape;
        let mut rng = Rng::new(9);
        let mut case = Case::new(shape, way, 8, Rng::ordinary);
        let natural = round_to(way.half, rng.ordinary(columns * depth));
        let weights = Owned::new(depth, &case.owned.bias[..columns], way.half, |k, n| natural[n * depth + k]);
        (case.owned.single, case.owned.half) = (weights.single, weights.half);
        let want: Vec<f64> = (0..rows * columns)
            .map(|i| {
                let (row, n) = (i / columns, i % columns);
                let products =
                    (0..depth).map(|k| f64::from(case.left[row * depth + k]) * f64::from(natural[n * depth + k]));
                case.owned.naive_end(row, n, case.before[i], products.sum())
            })
            .collect();
        // A sum of 600 products below 1 wanders to about 30, where a rounding is at most 1e-6. Roundings wander too: 600
        // of them make 1e-5 of the largest sums, and three times that is allowed.
        assert_close(&case.all(Isa::Scalar), &want, 3e-5, &format!("{shape:?} {way:?}"));
    }
}

/// A product of three rows, broken in one place.
fn broken(shape: [usize; 3], joins: Joins, damage: impl FnOnce(&mut Case)) {
    let mut case = Case::new(shape, Way { joins, ..PLAIN }, 0, Rng::ordinary);
    damage(&mut case);
    case.all(Isa::Scalar);
}

#[test]
#[should_panic(expected = "packed weights do not match the shape")]
fn short_weights() {
    broken([3, 16, 4], Joins::Nowhere, |case| case.owned.single.truncate(63));
}

#[test]
#[should_panic(expected = "packed weights do not match the shape")]
fn weights_for_more_columns() {
    broken([3, 16, 4], Joins::Nowhere, |case| case.owned.single.resize(128, 0.0));
}

#[test]
#[should_panic(expected = "packed weights do not match the shape")]
fn a_shape_whose_size_wraps_to_that_of_the_weights() {
    let case = Case::new([1, 16, 0], PLAIN, 0, Rng::ordinary);
    let product = Product { depth: 1 << (usize::BITS - 4), ..case.owned.product() };
    product.check(1, &[0.0; SCRATCH]);
}

#[test]
#[should_panic(expected = "the columns overflow")]
fn columns_that_cannot_be_padded() {
    let case = Case::new([1, 16, 0], PLAIN, 0, Rng::ordinary);
    Product { columns: usize::MAX, ..case.owned.product() }.check(1, &[0.0; SCRATCH]);
}

#[test]
#[should_panic(expected = "the bias is shorter than the columns")]
fn unpadded_bias() {
    broken([3, 17, 4], Joins::Nowhere, |case| case.owned.bias.truncate(17));
}

#[test]
#[should_panic(expected = "the residual is shorter than the rows")]
fn short_residual_before() {
    broken([3, 5, 4], Joins::Before, |case| case.owned.added.truncate(2 * 8 + 4));
}

#[test]
#[should_panic(expected = "the residual is shorter than the rows")]
fn short_residual_after() {
    broken([3, 5, 4], Joins::After, |case| case.owned.added.truncate(2 * 8 + 4));
}

#[test]
fn the_residual_needs_no_gap_after_its_last_row() {
    broken([3, 5, 4], Joins::After, |case| case.owned.added.truncate(2 * 8 + 5));
}

#[test]
#[should_panic(expected = "the scratch is too small")]
fn short_scratch() {
    let case = Case::new([1, 1, 1], PLAIN, 0, Rng::ordinary);
    case.owned.product().check(1, &[0.0; SCRATCH - 1]);
}

#[test]
#[should_panic(expected = "rows 2..4 of 3")]
fn rows_outside() {
    let case = Case::new([3, 1, 1], PLAIN, 0, Rng::ordinary);
    case.owned.product().check_rows(&(2..4), 3, 1, &[0.0; 2], &[0.0; SCRATCH]);
}

#[test]
#[should_panic(expected = "rows 2..1 of 3")]
fn rows_backwards() {
    let case = Case::new([3, 1, 1], PLAIN, 0, Rng::ordinary);
    let rows = Range { start: 2, end: 1 };
    case.owned.product().check_rows(&rows, 3, 1, &[], &[0.0; SCRATCH]);
}

#[test]
#[should_panic(expected = "output rows overlap")]
fn stride_below_the_columns() {
    let case = Case::new([3, 2, 1], PLAIN, 0, Rng::ordinary);
    case.owned.product().check_rows(&(0..3), 3, 1, &[0.0; 6], &[0.0; SCRATCH]);
}

#[test]
#[should_panic(expected = "the output is shorter than its rows")]
fn short_output() {
    let case = Case::new([3, 2, 1], PLAIN, 0, Rng::ordinary);
    case.owned.product().check_rows(&(0..3), 3, 5, &[0.0; 11], &[0.0; SCRATCH]);
}

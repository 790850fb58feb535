use super::*;
use crate::cases::isas;
use crate::isa::Isa;
use crate::matmul::product::Rows;
use crate::testing::int8::{OwnedI8, PLAIN, WayI8, assert_same, assert_telling, padded, ways};
use crate::testing::{Gap, Rng, write_rows};
use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};

/// A left matrix that exists. It lies in memory if `stored`, and is copied piece by piece if not.
struct Case {
    rows: usize,
    stored: bool,
    left: Vec<i8>,
    owned: OwnedI8,
    before: Vec<i8>,
    /// `[depth, columns]`
    natural: Vec<i8>,
}

impl Source for Case {
    type Element = i8;
    type At = usize;
    type Part = usize;

    fn element(&self, row: usize, k: usize) -> i8 {
        self.left[row * self.owned.depth + k]
    }
    fn at(&self, row: usize) -> usize {
        row
    }
    fn next(&self, row: usize) -> usize {
        row + 1
    }
    fn part(&self, k: usize) -> (usize, usize) {
        // Pieces of an odd number of groups, so that blocks end inside them and hold one or many.
        (k, if self.stored { depth::<i8>() } else { 284 - k % 284 })
    }
    fn piece<'a, S: Simd>(&'a self, _: S, row: usize, k: usize, spare: &'a mut [i8]) -> &'a [i8] {
        let here = &self.left[row * self.owned.depth + k..][..spare.len()];
        if self.stored || (row + k / 4).is_multiple_of(3) {
            return here;
        }
        spare.copy_from_slice(here);
        spare
    }
}

impl Case {
    fn new([rows, columns, depth]: [usize; 3], stored: bool, way: WayI8, seed: u64) -> Self {
        let mut rng = Rng::new(seed);
        let natural = OwnedI8::natural(&mut rng, depth * columns, way);
        let owned = OwnedI8::drawn(&mut rng, [rows, depth, columns], way, |k, n| natural[k * columns + n]);
        let (left, before) = (rng.left(rows * depth, way.signed), rng.left(rows * columns, true));
        Self { rows, stored, left, owned, before, natural }
    }

    /// Weights w(k, n) and a left row of `left` for every row.
    fn constant(rows: usize, columns: usize, left: &[i8], w: impl Fn(usize, usize) -> i8) -> Self {
        let owned = OwnedI8::new(left.len(), &vec![0; columns], &w);
        let natural = (0..left.len() * columns).map(|i| w(i / columns, i % columns)).collect();
        Self { rows, stored: true, left: left.repeat(rows), owned, before: vec![0; rows * columns], natural }
    }

    fn run<O: Outcome<Out: Gap>>(&self, isa: Isa, rows: Range<usize>, before: &[O::Out]) -> Vec<O::Out> {
        let (product, stride) = (self.owned.product().to::<O>(), self.owned.columns + 5);
        let mut scratch = vec![i32::MIN; scratch_len(self.owned.depth, self.owned.columns)];
        write_rows(rows.len(), stride, before, |out| {
            Rows { product: &product, source: self, rows, stride, out, scratch: &mut scratch }.compute(isa, self.rows);
        })
    }

    fn rows(&self, isa: Isa, rows: Range<usize>) -> Vec<i8> {
        let columns = self.owned.columns;
        self.run::<Narrow>(isa, rows.clone(), &self.before[rows.start * columns..rows.end * columns])
    }

    fn all(&self, isa: Isa) -> Vec<i8> {
        self.rows(isa, 0..self.rows)
    }

    fn wide<O: Outcome<Out = i32>>(&self, isa: Isa) -> Vec<i32> {
        let before: Vec<i32> = self.before.iter().copied().map(i32::from).collect();
        self.run::<O>(isa, 0..self.rows, &before)
    }

    /// Calls `end` with the row, column, output before and sum of products of every output.
    fn naive<T>(&self, end: impl Fn(usize, usize, i8, i64) -> T) -> Vec<T> {
        let OwnedI8 { depth, columns, .. } = self.owned;
        (0..self.rows * columns)
            .map(|i| {
                let (row, n) = (i / columns, i % columns);
                let product =
                    |k: usize| i64::from(self.left[row * depth + k]) * i64::from(self.natural[k * columns + n]);
                end(row, n, self.before[i], (0..depth).map(product).sum())
            })
            .collect()
    }

    /// The outputs on every instruction set, which must be the formula's.
    fn assert_exact(&self, what: &str) -> Vec<i8> {
        let want = self.naive(|row, n, out, sum| self.owned.naive_end(row, n, out, sum));
        for isa in Isa::available() {
            assert_same(&self.all(isa), &want, &format!("{} {what}", isa.name()));
        }
        want
    }
}

#[test]
fn by_hand() {
    // Rows [1 2 3 4] and [-5 6 -7 8]; columns [1 1 1 1] and [10 -10 10 -10]; a quarter of the sums.
    let mut case = Case::constant(2, 2, &[1, 2, 3, 4], |k, n| [[1, 1, 1, 1], [10, -10, 10, -10]][n][k]);
    case.left[4..].copy_from_slice(&[-5, 6, -7, 8]);
    for isa in isas() {
        // Sums 10, -20, 2, -260: 2.5 and 0.5 go upwards.
        assert_eq!(case.wide::<Raw>(isa), [10, -20, 2, -260]);
        assert_eq!(case.wide::<Wide>(isa), [3, -5, 1, -65]);
        assert_eq!(case.all(isa), [3, -5, 1, -65]);
        case.owned.bias[..2].copy_from_slice(&[1, -400]);
        // Sums 11, -420, 3, -660.
        assert_eq!(case.wide::<Wide>(isa), [3, -105, 1, -165]);
        assert_eq!(case.all(isa), [3, -105, 1, -127]);
        case.owned.relu = true;
        assert_eq!(case.all(isa), [3, 0, 1, 0]);
        // Residuals of -1, 2, -3, 100 times 8 and 7: sums 3, -406, -21, 40 and, after ReLU, 3, 14, -21, 700.
        case.owned.joining[..2].copy_from_slice(&[8, 7]);
        case.before = vec![-1, 2, -3, 100];
        case.owned.joins = Some([false, false]);
        assert_eq!(case.all(isa), [1, 0, 0, 10]);
        case.owned.joins = Some([false, true]);
        assert_eq!(case.all(isa), [1, 4, -5, 127]);
        (case.owned.added, case.owned.added_stride) = (vec![-1, 2, 99, -3, 100], 3);
        case.before.fill(55);
        case.owned.joins = Some([true, false]);
        assert_eq!(case.all(isa), [1, 0, 0, 10]);
        case.owned.joins = Some([true, true]);
        assert_eq!(case.all(isa), [1, 4, -5, 127]);
        (case.owned.joins, case.owned.relu) = (None, false);
        case.owned.bias.fill(0);
    }
}

/// Numbers of rows, columns and k around a tile, a panel and a block of every instruction set, each with another way through
/// the code.
fn table() -> impl Iterator<Item = ([usize; 3], bool, WayI8)> {
    let rows = [1, 2, 3, 5, 6, 7, 9, 13, 96, 97, 197];
    let columns = [1, 15, 16, 17, 32, 33, 50];
    let depths = [4, 8, 12, 64, 284, 768, 772, 1536, 1540, 2308];
    let shapes = rows.into_iter().flat_map(move |r| columns.map(|c| depths.map(|d| [r, c, d]))).flatten();
    let ways = ways();
    // The largest shapes once, the others in two ways.
    shapes.enumerate().flat_map(move |(i, shape)| {
        let ways = [ways[i * 7 % 40], ways[(i * 7 + 13) % 40]];
        let count = if shape.iter().product::<usize>() > 2_000_000 { 1 } else { 2 };
        ways.into_iter().take(count).enumerate().map(move |(j, way)| (shape, (i + j).is_multiple_of(2), way))
    })
}

#[test]
fn every_isa_is_exact() {
    let mut whole = Vec::new();
    for (shape, stored, way) in table() {
        whole.extend(Case::new(shape, stored, way, 5).assert_exact(&format!("{shape:?} {way:?}")));
    }
    assert_telling(&whole, "all");
}

#[test]
fn wide_outputs_and_sums_are_exact_too() {
    for (shape, stored, way) in table().filter(|(shape, ..)| shape[0] < 10 && shape[2] != 768) {
        let case = Case::new(shape, stored, way, 6);
        let wide = case.naive(|row, n, out, sum| case.owned.naive_wide(row, n, out.into(), sum) as i32);
        let sums = case.naive(|row, n, out, sum| case.owned.naive_sum(row, n, out.into(), sum) as i32);
        for isa in Isa::available() {
            assert_same(&case.wide::<Wide>(isa), &wide, &format!("{} {shape:?} {way:?}", isa.name()));
            assert_same(&case.wide::<Raw>(isa), &sums, &format!("{} {shape:?} {way:?}", isa.name()));
        }
    }
}

#[test]
fn the_largest_sums_are_exact() {
    // 4608 products of 127 * 127, of every combination of signs, and the largest that pair.
    const MOST: i32 = 4608 * 127 * 127;
    for (x, signed) in [(127, false), (127, true), (-127, true)] {
        for calm in [false, true] {
            let magnitude = |k: usize| if calm { [127, 2][k % 2] } else { 127i8 };
            let w = |k: usize, n: usize| if n.is_multiple_of(2) { magnitude(k) } else { -magnitude(k) };
            let mut case = Case::constant(7, 18, &[x; 4608], w);
            case.owned.signed = signed;
            assert_eq!(case.owned.pairs, [u8::from(calm); 2]);
            let most = if calm { MOST / 254 * 129 } else { MOST } * i32::from(x.signum());
            for isa in isas() {
                let want: Vec<i32> = (0..7 * 18).map(|i| if i % 18 % 2 == 0 { most } else { -most }).collect();
                assert_same(&case.wide::<Raw>(isa), &want, &format!("{} {x} {calm}", isa.name()));
            }
        }
    }
}

#[test]
fn sums_wrap_around_alike() {
    // Twice the largest bias, and residuals that leave 32 bits by themselves.
    let mut case = Case::constant(5, 17, &[127; 8], |_, _| 127);
    case.owned.bias = padded(vec![i32::MAX; 17]);
    case.owned.joining = padded(vec![i32::MIN + 1; 17]);
    case.owned.joins = Some([false, false]);
    case.before = (0..85).map(|i| i as i8).collect();
    let want: Vec<i32> =
        (0..85).map(|i: i32| i32::MAX.wrapping_add(8 * 127 * 127).wrapping_add(i.wrapping_mul(i32::MIN + 1))).collect();
    for isa in isas() {
        assert_same(&case.wide::<Raw>(isa), &want, isa.name());
    }
}

/// A wrong note about the weights costs values, and nothing else.
#[test]
fn wrong_notes_are_no_danger() {
    let mut case = Case::constant(13, 35, &[127; 1544], |_, _| 127);
    case.owned.pairs.fill(1);
    case.owned.sums.fill(i32::MIN);
    for isa in isas() {
        assert_eq!(case.all(isa).len(), 13 * 35);
    }
    assert_eq!(case.all(Isa::Scalar), [127; 13 * 35], "the specification reads no notes");
}

#[test]
fn any_shape_and_any_split_is_exact() {
    let shape = (0usize..220, 1usize..50, prop_oneof![1usize..12, 190usize..196, 380usize..390]);
    let run = |((rows, columns, groups), stored, way, seed, split): (_, bool, usize, u64, usize)| {
        let case = Case::new([rows, columns, 4 * groups], stored, ways()[way], seed);
        let want = case.assert_exact("whole");
        for isa in Isa::available() {
            let split = split % (rows + 1);
            let parts = [case.rows(isa, 0..split), case.rows(isa, split..rows)].concat();
            assert_same(&parts, &want, "in two parts");
        }
        Ok(())
    };
    let mut runner = TestRunner::new(Config { cases: 48, ..Config::default() });
    runner.run(&(shape, any::<bool>(), 0usize..40, any::<u64>(), any::<usize>()), run).unwrap();
}

/// A product of three rows, broken in one place.
fn broken(joins: bool, damage: impl FnOnce(&mut OwnedI8)) {
    let way = WayI8 { joins: joins.then_some([true, false]), ..PLAIN };
    let mut case = Case::new([3, 17, 8], true, way, 0);
    damage(&mut case.owned);
    case.all(Isa::Scalar);
}

#[test]
#[should_panic(expected = "the depth is no multiple of 4")]
fn a_depth_that_is_no_group() {
    broken(false, |owned| owned.depth = 6);
}

#[test]
#[should_panic(expected = "packed weights do not match the shape")]
fn short_weights() {
    broken(false, |owned| owned.weights.truncate(255));
}

#[test]
#[should_panic(expected = "what is known of the weights is too short")]
fn short_sums() {
    broken(false, |owned| owned.sums.truncate(17));
}

#[test]
#[should_panic(expected = "what is known of the weights is too short")]
fn short_pairs() {
    broken(false, |owned| owned.pairs.truncate(1));
}

#[test]
#[should_panic(expected = "the bias is shorter than the columns")]
fn unpadded_bias() {
    broken(false, |owned| owned.bias.truncate(17));
}

#[test]
#[should_panic(expected = "the multipliers are fewer than the columns")]
fn unpadded_multipliers() {
    broken(false, |owned| owned.multiplier.truncate(17));
}

#[test]
#[should_panic(expected = "the residual's multipliers are fewer than the columns")]
fn unpadded_multipliers_of_the_residual() {
    broken(true, |owned| owned.joining.truncate(17));
}

#[test]
#[should_panic(expected = "the residual is shorter than the rows")]
fn short_residual() {
    broken(true, |owned| owned.added.truncate(2 * 20 + 16));
}

#[test]
#[should_panic(expected = "the scratch is too small")]
fn short_scratch() {
    let case = Case::new([3, 17, 1600], true, PLAIN, 0);
    case.owned.product().to::<Narrow>().check(3, &vec![0; scratch_len(1600, 17) - 1]);
}

use super::*;
use crate::cases::isas;
use crate::matmul::int8::scratch_len;
use crate::ops::conv::tests::{ONE, geometry, naive_sums, natural_index, table};
use crate::testing::int8::{OwnedI8, PLAIN, WayI8, assert_same, assert_telling, ways};
use crate::testing::{Rng, write_rows};
use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};

struct Case {
    geometry: Geometry,
    input: Vec<i8>,
    owned: OwnedI8,
    before: Vec<i8>,
    /// `[columns, channels, kernel]`, as PyTorch has them.
    natural: Vec<i8>,
}

impl Case {
    fn new(geometry: Geometry, columns: usize, way: WayI8, seed: u64) -> Self {
        let mut rng = Rng::new(seed);
        let (rows, depth) = (geometry.rows(), geometry.depth());
        let natural = OwnedI8::natural(&mut rng, columns * depth, way);
        let weight = |k: usize, n: usize| if k < depth { natural[n * depth + natural_index(&geometry, k)] } else { 0 };
        let owned = OwnedI8::drawn(&mut rng, [rows, geometry.depth_i8(), columns], way, weight);
        let input = rng.left(geometry.input.iter().product::<usize>() * geometry.channels, way.signed);
        Self { geometry, input, owned, before: rng.left(rows * columns, true), natural }
    }

    fn rows(&self, isa: Isa, rows: Range<usize>) -> Vec<i8> {
        let columns = self.owned.columns;
        let args = ConvI8 { geometry: self.geometry, input: &self.input, product: self.owned.product() };
        let mut scratch = vec![i32::MIN; scratch_len(self.owned.depth, columns)];
        write_rows(rows.len(), columns + 2, &self.before[rows.start * columns..rows.end * columns], |out| {
            conv_i8(isa, &args, rows.clone(), columns + 2, out, &mut scratch);
        })
    }

    fn all(&self, isa: Isa) -> Vec<i8> {
        self.rows(isa, 0..self.geometry.rows())
    }

    fn wide(&self, isa: Isa) -> Vec<i32> {
        let columns = self.owned.columns;
        let before: Vec<i32> = self.before.iter().copied().map(i32::from).collect();
        let args = ConvI8 { geometry: self.geometry, input: &self.input, product: self.owned.product() };
        let mut scratch = vec![i32::MIN; scratch_len(self.owned.depth, columns)];
        write_rows(self.geometry.rows(), columns + 2, &before, |out| {
            conv_i8_wide(isa, &args, 0..self.geometry.rows(), columns + 2, out, &mut scratch);
        })
    }

    /// The formula. Its sums of products are exact in f64.
    fn naive(&self) -> (Vec<i8>, Vec<i32>) {
        let wide = |x: &[i8]| x.iter().copied().map(f64::from).collect::<Vec<_>>();
        let columns = self.owned.columns;
        let sums = naive_sums(&self.geometry, &wide(&self.input), &wide(&self.natural), columns);
        let each = sums.into_iter().enumerate().map(|(i, sum)| {
            let (row, n, before, sum) = (i / columns, i % columns, self.before[i], sum as i64);
            let wide = self.owned.naive_wide(row, n, before.into(), sum) as i32;
            (self.owned.naive_end(row, n, before, sum), wide)
        });
        each.unzip()
    }

    /// The outputs on every instruction set, which must be the formula's.
    fn assert_exact(&self, what: &str) -> Vec<i8> {
        let (want, wide) = self.naive();
        for isa in Isa::available() {
            assert_same(&self.all(isa), &want, &format!("{} {what}", isa.name()));
            assert_same(&self.wide(isa), &wide, &format!("{} {what}, wide", isa.name()));
        }
        want
    }
}

/// Whether bytes can be convolved so: their channels are whole groups, or those of a run are copied.
fn taken(g: &Geometry) -> bool {
    let taps = if g.dilation[2] == 1 { g.kernel[2] } else { 1 };
    g.channels.is_multiple_of(4) || taps * g.channels < 48
}

/// The table of the convolution in f32, with channels that are whole groups where they have to be.
fn groups() -> impl Iterator<Item = (&'static str, Geometry, usize)> {
    let round = |g: Geometry| if taken(&g) { g } else { Geometry { channels: g.channels.next_multiple_of(4), ..g } };
    table().into_iter().map(move |(name, g, columns)| (name, round(g), columns))
}

#[test]
fn by_hand() {
    // The image [1 2 3; 4 5 6] in one channel of four and the kernel [1 10; 20 -30], a zero on every side.
    let g = geometry([1, 2, 3], 4, [1, 2, 2], ONE, ONE, [0, 1, 1]);
    let mut case = Case::new(g, 1, PLAIN, 0);
    case.input = [1, 2, 3, 4, 5, 6].iter().flat_map(|x| [0, *x, 0, 0]).collect();
    case.owned = OwnedI8::new(16, &[2], |k, _| if k % 4 == 1 { [1, 10, 20, -30][k / 4] } else { 99 });
    for isa in isas() {
        // Two more than -30, -40, -50, 60; -110, -49, -48, 123; 40, 54, 65, 6, then a quarter, halves upwards.
        assert_eq!(case.wide(isa), [-7, -9, -12, 16, -27, -12, -11, 31, 11, 14, 17, 2]);
        assert_eq!(case.all(isa), [-7, -9, -12, 16, -27, -12, -11, 31, 11, 14, 17, 2]);
        case.owned.relu = true;
        assert_eq!(case.all(isa), [0, 0, 0, 16, 0, 0, 0, 31, 11, 14, 17, 2]);
        case.owned.relu = false;
    }
}

/// As [`by_hand`], of one channel.
#[test]
fn one_channel_by_hand() {
    let mut case = Case::new(geometry([1, 2, 3], 1, [1, 2, 2], ONE, ONE, [0, 1, 1]), 1, PLAIN, 0);
    case.input = vec![1, 2, 3, 4, 5, 6];
    case.owned = OwnedI8::new(4, &[2], |k, _| [1, 10, 20, -30][k]);
    for isa in isas() {
        assert_eq!(case.all(isa), [-7, -9, -12, 16, -27, -12, -11, 31, 11, 14, 17, 2]);
    }
}

/// The first layer of a network: runs of 7 taps of 3 channels, 147 products, and one of nothing.
#[test]
fn an_image_is_exact() {
    let mut g = geometry([1, 13, 22], 3, [1, 7, 7], [1, 2, 2], ONE, [0, 3, 3]);
    assert_eq!((g.depth(), g.depth_i8()), (147, 148));
    for (i, way) in ways().into_iter().enumerate() {
        Case::new(g, [16, 32, 35][i % 3], way, 9).assert_exact(&format!("{way:?}"));
    }
    // More products than a block of k has: it ends within a run.
    g = geometry([9, 11, 12], 5, [7, 7, 7], ONE, ONE, [3; 3]);
    assert_eq!(g.depth_i8(), 1716);
    for way in ways().into_iter().step_by(7) {
        Case::new(g, 19, way, 9).assert_exact(&format!("{way:?}"));
    }
}

#[test]
fn every_isa_is_exact() {
    let ways = ways();
    let mut whole = Vec::new();
    for (i, (name, g, columns)) in groups().enumerate() {
        for way in [PLAIN, ways[i % 40], ways[(i + 17) % 40]] {
            let out = Case::new(g, columns, way, 3).assert_exact(&format!("{name} {way:?}"));
            whole.extend(out);
        }
    }
    assert_telling(&whole, "all");
}

#[test]
fn any_shape_and_any_split_is_exact() {
    let three = |low: usize, high: usize| [low..=high, low..=high, low..=high];
    let walk = (three(1, 6), 1usize..70, three(1, 3), three(1, 3), three(1, 3), three(0, 3), three(1, 6));
    let run = |((input, channels, kernel, stride, dilation, padding, output), columns, way, seed, split): (
        ([usize; 3], usize, _, _, _, _, _),
        usize,
        usize,
        u64,
        usize,
    )| {
        let mut g = Geometry { input, channels, kernel, stride, dilation, padding, output };
        if !taken(&g) {
            g.channels = channels.next_multiple_of(4);
        }
        let case = Case::new(g, columns, ways()[way], seed);
        let want = case.assert_exact("whole");
        for isa in Isa::available() {
            let (rows, split) = (g.rows(), split % (g.rows() + 1));
            let parts = [case.rows(isa, 0..split), case.rows(isa, split..rows)].concat();
            assert_same(&parts, &want, "in two parts");
        }
        Ok(())
    };
    let mut runner = TestRunner::new(Config { cases: 64, ..Config::default() });
    runner.run(&(walk, 1usize..36, 0usize..40, any::<u64>(), any::<usize>()), run).unwrap();
}

/// A 3x3 convolution of a 4 x 5 image, broken in one place.
fn broken(damage: impl FnOnce(&mut Case)) {
    let mut case = Case::new(geometry([1, 4, 5], 4, [1, 3, 3], ONE, ONE, [0, 1, 1]), 3, PLAIN, 0);
    damage(&mut case);
    case.all(Isa::Scalar);
}

#[test]
#[should_panic(expected = "the input has another shape")]
fn short_input() {
    broken(|case| case.input.truncate(79));
}

#[test]
#[should_panic(expected = "the channels are no multiple of 4")]
fn channels_that_are_no_groups() {
    broken(|case| {
        case.geometry.channels = 17;
        case.input.resize(340, 0);
    });
}

#[test]
#[should_panic(expected = "the weights belong to another kernel")]
fn weights_of_another_kernel() {
    broken(|case| case.owned.depth = 40);
}

#[test]
#[should_panic(expected = "rows 0..21 of 20")]
fn rows_outside() {
    let case = Case::new(geometry([1, 4, 5], 4, ONE, ONE, ONE, [0; 3]), 3, PLAIN, 0);
    let args = ConvI8 { geometry: case.geometry, input: &case.input, product: case.owned.product() };
    conv_i8(Isa::Scalar, &args, 0..21, 3, &mut [0; 63], &mut vec![0; scratch_len(4, 3)]);
}

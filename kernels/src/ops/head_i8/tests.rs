use super::*;
use crate::cases::isas;
use crate::isa::Isa;
use crate::ops::head::confidence::tests::sure;
use crate::testing::Rng;
use crate::testing::int8::{OwnedI8, PLAIN, WayI8, assert_same};
use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};

struct Case {
    voxels: usize,
    channels: usize,
    classes: usize,
    signed: bool,
    input: Vec<i8>,
    layers: [OwnedI8; 3],
    /// `[outputs, inputs]` of each layer, as PyTorch has them.
    natural: [Vec<i8>; 3],
    scale: f32,
}

impl Case {
    fn new([voxels, channels, classes]: [usize; 3], way: WayI8, seed: u64) -> Self {
        let mut rng = Rng::new(seed);
        let columns = [channels, channels, classes];
        let natural = columns.map(|columns| OwnedI8::natural(&mut rng, columns * channels, way));
        let layers = [0, 1, 2].map(|i| {
            let way = WayI8 { relu: i < 2, signed: i == 0 && way.signed, joins: None, ..way };
            let shape = [voxels, channels, columns[i]];
            OwnedI8::drawn(&mut rng, shape, way, |k, n| natural[i][n * channels + k])
        });
        let input = rng.left(voxels * channels, way.signed);
        Self { voxels, channels, classes, signed: way.signed, input, layers, natural, scale: 0.0123 }
    }

    /// Classes and logits. Classes must not depend on what else was asked for, and the confidence is that of the logits.
    fn rows(&self, isa: Isa, rows: Range<usize>) -> (Vec<u8>, Vec<f32>) {
        let Self { channels, classes, signed, scale, .. } = *self;
        let layers = self.layers.each_ref().map(|layer| LayerI8 {
            weights: &layer.weights,
            sums: &layer.sums,
            pairs: &layer.pairs,
            bias: &layer.bias,
        });
        let multipliers = [0, 1].map(|i| &self.layers[i].multiplier[..]);
        let args = HeadI8 { input: &self.input, signed, channels, classes, layers, multipliers, scale };
        let mut scratch = vec![i32::MIN; scratch_len(channels, classes)];
        let mut alone = vec![255; rows.len()];
        let results = Results { classes: &mut alone, logits: None, confidence: None };
        head_i8(isa, &args, rows.clone(), results, &mut scratch);
        let (mut chosen, mut logits) = (vec![254; rows.len()], vec![f32::NAN; rows.len() * classes]);
        let [mut occupied, mut class] = [vec![253; rows.len()], vec![252; rows.len()]];
        let confidence = Confidence { scale: 0.7, occupied: &mut occupied, class: &mut class };
        let results = Results { classes: &mut chosen, logits: Some(&mut logits), confidence: Some(confidence) };
        head_i8(isa, &args, rows, results, &mut scratch);
        assert_eq!(chosen, alone, "logits change the classes");
        assert_eq!([occupied, class], sure(isa, &logits, &chosen, 0.7), "not the confidence of the logits");
        (chosen, logits)
    }

    fn all(&self, isa: Isa) -> (Vec<u8>, Vec<f32>) {
        self.rows(isa, 0..self.voxels)
    }

    /// The last layer's sums by the formula.
    fn naive(&self) -> Vec<i64> {
        let mut out = Vec::new();
        for row in 0..self.voxels {
            let input = &self.input[row * self.channels..][..self.channels];
            let mut x: Vec<i64> = input.iter().copied().map(i64::from).collect();
            for (i, layer) in self.layers.iter().enumerate() {
                let products = |n: usize| {
                    let weights = &self.natural[i][n * self.channels..][..self.channels];
                    weights.iter().zip(&x).map(|(w, x)| i64::from(*w) * x).sum()
                };
                let end = |n: usize| match i {
                    2 => layer.naive_sum(row, n, 0, products(n)),
                    _ => layer.naive_end(row, n, 0, products(n)).into(),
                };
                x = (0..layer.columns).map(end).collect();
            }
            out.extend(x);
        }
        out
    }

    /// The classes and logits on every instruction set, which must be the formula's.
    fn assert_exact(&self, what: &str) -> (Vec<u8>, Vec<f32>) {
        let sums = self.naive();
        let logits: Vec<f32> = sums.iter().map(|sum| *sum as f32 * self.scale).collect();
        let first = |sums: &[i64]| {
            let best = sums.iter().max().expect("a class");
            sums.iter().position(|sum| sum == best).expect("the best") as u8
        };
        let classes: Vec<u8> = sums.chunks_exact(self.classes).map(first).collect();
        for isa in Isa::available() {
            let got = self.all(isa);
            assert_same(&got.0, &classes, &format!("{} {what}", isa.name()));
            assert_same(&got.1, &logits, &format!("{} {what}", isa.name()));
        }
        (classes, logits)
    }
}

#[test]
fn by_hand() {
    // a = relu([1 1; 1 -1] x + [0, 2]) / 4, b = relu(8 a - [0, 4]) / 4, sums = [b0 + b1, b0 - b1, 5].
    let mut case = Case::new([2, 4, 3], PLAIN, 0);
    let pick = |w: [[i8; 2]; 2]| move |k: usize, n: usize| if k < 2 && n < 2 { w[n][k] } else { 0 };
    case.layers[0] = OwnedI8::new(4, &[0, 2, 0, 0], pick([[1, 1], [1, -1]]));
    case.layers[1] = OwnedI8::new(4, &[0, -4, 0, 0], pick([[8, 0], [0, 8]]));
    case.layers[2] = OwnedI8::new(4, &[0, 0, 5], pick([[1, 1], [1, -1]]));
    case.input = vec![4, 12, 99, -99, 12, -6, 0, 0];
    case.scale = 0.5;
    for isa in isas() {
        // Voxel 0: 16 and -6, so a = [4, 0], b = [8, 0] and the sums [8, 8, 5]: the first of the largest.
        // Voxel 1: 6 and 20, so a = [1.5, 5] rounded to [2, 5], b = [4, 9] and the sums [13, -5, 5].
        assert_eq!(case.all(isa), (vec![0, 0], vec![4.0, 4.0, 2.5, 6.5, -2.5, 2.5]));
        assert_eq!(case.rows(isa, 1..2), (vec![0], vec![6.5, -2.5, 2.5]));
    }
}

#[test]
fn every_isa_is_exact() {
    let (mut classes, mut logits) = (Vec::new(), Vec::new());
    let shapes = [
        [0, 4, 3],
        [1, 32, 17],
        [5, 4, 2],
        [6, 16, 20],
        [7, 20, 256],
        [95, 16, 1],
        [96, 36, 17],
        [97, 32, 16],
        [193, 28, 20],
        [2, 1600, 33],
    ];
    for shape in shapes {
        for (signed, calm) in [(false, false), (true, false), (false, true), (true, true)] {
            let way = WayI8 { signed, calm, ..PLAIN };
            let (some, more) = Case::new(shape, way, 3).assert_exact(&format!("{shape:?} {way:?}"));
            classes.extend(some);
            logits.extend(more.into_iter().map(f32::to_bits));
        }
    }
    let many = logits.len();
    for codes in [&mut logits, &mut classes.into_iter().map(u32::from).collect()] {
        codes.sort_unstable();
        codes.dedup();
    }
    assert!(2 * logits.len() > many, "only {} of {many} logits differ", logits.len());
}

#[test]
fn the_largest_sum_wins_where_floats_are_equal() {
    // 2^24 and 2^24 + 1 are the same f32.
    let mut case = Case::new([1, 4, 3], PLAIN, 0);
    case.layers[2] = OwnedI8::new(4, &[0, 1 << 24, (1 << 24) + 1], |_, _| 0);
    for isa in isas() {
        let (classes, logits) = case.all(isa);
        assert_eq!((classes[0], logits[1].to_bits()), (2, logits[2].to_bits()));
    }
}

#[test]
fn any_shape_and_any_split_is_exact() {
    let run = |(voxels, groups, classes, signed, calm, seed, split): (usize, usize, _, _, _, u64, usize)| {
        let case = Case::new([voxels, 4 * groups, classes], WayI8 { signed, calm, ..PLAIN }, seed);
        let want = case.assert_exact("whole");
        for isa in Isa::available() {
            let split = split % (voxels + 1);
            let (first, second) = (case.rows(isa, 0..split), case.rows(isa, split..voxels));
            assert_same(&[first.0, second.0].concat(), &want.0, "in two parts");
            assert_same(&[first.1, second.1].concat(), &want.1, "in two parts");
        }
        Ok(())
    };
    let shape = (0usize..200, 1usize..11, 1usize..40, any::<bool>(), any::<bool>(), any::<u64>(), any::<usize>());
    TestRunner::new(Config { cases: 48, ..Config::default() }).run(&shape, run).unwrap();
}

/// A head over three voxels, broken in one place.
fn broken(damage: impl FnOnce(&mut Case)) {
    let mut case = Case::new([3, 8, 4], PLAIN, 0);
    damage(&mut case);
    case.all(Isa::Scalar);
}

#[test]
#[should_panic(expected = "a class must fit a byte")]
fn no_class() {
    broken(|case| case.classes = 0);
}

#[test]
#[should_panic(expected = "the depth is no multiple of 4")]
fn channels_that_are_no_groups() {
    broken(|case| case.channels = 6);
}

#[test]
#[should_panic(expected = "packed weights do not match the shape")]
fn short_weights() {
    broken(|case| case.layers[1].weights.truncate(127));
}

#[test]
#[should_panic(expected = "the multipliers are fewer than the columns")]
fn short_multipliers() {
    broken(|case| case.layers[1].multiplier.truncate(8));
}

#[test]
#[should_panic(expected = "rows 0..3 are not in the input")]
fn short_input() {
    broken(|case| case.input.truncate(23));
}

use super::confidence::tests::sure;
use super::*;
use crate::testing::{
    Fill, Owned, Rng, Tally, assert_close, assert_lively, assert_order_shows, assert_same_bits, reverse_channels,
    reverse_columns, round_to,
};
use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};

struct Case {
    voxels: usize,
    channels: usize,
    classes: usize,
    input: Vec<f32>,
    layers: [Owned; 3],
    /// `[outputs, inputs]` of each layer, as PyTorch has them.
    natural: [Vec<f32>; 3],
}

impl Case {
    fn new([voxels, channels, classes]: [usize; 3], half: bool, seed: u64, fill: Fill) -> Self {
        let mut rng = Rng::new(seed);
        let columns = [channels, channels, classes];
        let natural = columns.map(|columns| round_to(half, fill(&mut rng, columns * channels)));
        let layers = [0, 1, 2].map(|i| {
            let bias = fill(&mut rng, columns[i]);
            Owned::new(channels, &bias, half, |k, n| natural[i][n * channels + k])
        });
        Self { voxels, channels, classes, input: fill(&mut rng, voxels * channels), layers, natural }
    }

    fn args(&self) -> Head<'_> {
        Head {
            input: &self.input,
            channels: self.channels,
            classes: self.classes,
            weights: [0, 1, 2].map(|i| self.layers[i].product().weights),
            biases: [0, 1, 2].map(|i| &self.layers[i].bias[..]),
        }
    }

    /// Classes and logits. Classes must not depend on what else was asked for, and the confidence is that of the logits.
    fn rows(&self, isa: Isa, rows: Range<usize>) -> (Vec<u8>, Vec<f32>) {
        let mut scratch = vec![f32::NAN; scratch_len(self.channels, self.classes)];
        let mut alone = vec![255; rows.len()];
        let results = Results { classes: &mut alone, logits: None, confidence: None };
        head(isa, &self.args(), rows.clone(), results, &mut scratch);
        let (mut classes, mut logits) = (vec![254; rows.len()], vec![f32::NAN; rows.len() * self.classes]);
        let [mut occupied, mut class] = [vec![253; rows.len()], vec![252; rows.len()]];
        let confidence = Confidence { scale: 0.7, occupied: &mut occupied, class: &mut class };
        let results = Results { classes: &mut classes, logits: Some(&mut logits), confidence: Some(confidence) };
        head(isa, &self.args(), rows, results, &mut scratch);
        assert_eq!(classes, alone, "logits change the classes");
        assert_eq!([occupied, class], sure(isa, &logits, &classes, 0.7), "not the confidence of the logits");
        (classes, logits)
    }

    fn all(&self, isa: Isa) -> (Vec<u8>, Vec<f32>) {
        self.rows(isa, 0..self.voxels)
    }

    fn assert_every_isa(&self, what: &str) -> Vec<f32> {
        let (classes, logits) = self.all(Isa::Scalar);
        for isa in Isa::available() {
            let got = self.all(isa);
            assert_same_bits(&got.1, &logits, &format!("{} {what}", isa.name()));
            assert_eq!(got.0, classes, "{} {what}", isa.name());
        }
        logits
    }

    /// The logits in f64.
    fn naive(&self) -> Vec<f64> {
        let mut out = Vec::new();
        for voxel in 0..self.voxels {
            let input = &self.input[voxel * self.channels..][..self.channels];
            let mut x: Vec<f64> = input.iter().map(|v| f64::from(*v)).collect();
            for layer in 0..3 {
                let row = |n: usize| {
                    let weights = &self.natural[layer][n * self.channels..][..self.channels];
                    let sum: f64 = weights.iter().zip(&x).map(|(w, x)| f64::from(*w) * x).sum();
                    sum + f64::from(self.layers[layer].bias[n])
                };
                let columns = if layer == 2 { self.classes } else { self.channels };
                let sums = (0..columns).map(row);
                x = if layer < 2 { sums.map(|v| v.max(0.0)).collect() } else { sums.collect() };
            }
            out.extend(x);
        }
        out
    }
}

/// A head over two channels that are never negative, whose logits are its last layer's alone.
fn last_layer(weights: &[[f32; 2]], bias: &[f32], voxels: &[[f32; 2]]) -> Case {
    let mut case = Case::new([voxels.len(), 2, weights.len()], false, 0, Rng::ordinary);
    let same = || Owned::new(2, &[0.0, 0.0], false, |k, n| if k == n { 1.0 } else { 0.0 });
    case.layers = [same(), same(), Owned::new(2, bias, false, |k, n| weights[n][k])];
    case.input = voxels.concat();
    case
}

#[test]
fn by_hand() {
    // a = relu([1 1; 1 -1] x + [0, 1]), b = relu(2 a - [0, 3]), logits = [b0 + b1, b0 - b1, 5].
    let mut case = last_layer(&[[1.0, 1.0], [1.0, -1.0], [0.0, 0.0]], &[0.0, 0.0, 5.0], &[[1.0, 3.0], [3.0, -2.0]]);
    case.layers[0] = Owned::new(2, &[0.0, 1.0], false, |k, n| [[1.0, 1.0], [1.0, -1.0]][n][k]);
    case.layers[1] = Owned::new(2, &[0.0, -3.0], false, |k, n| if k == n { 2.0 } else { 0.0 });
    for isa in Isa::available() {
        // a = [4, 0] and [1, 6], b = [8, 0] and [2, 9].
        assert_eq!(case.all(isa), (vec![0, 0], vec![8.0, 8.0, 5.0, 11.0, -7.0, 5.0]));
        assert_eq!(case.rows(isa, 1..2), (vec![0], vec![11.0, -7.0, 5.0]));
    }
}

#[test]
fn the_first_of_equal_logits_wins() {
    let case = last_layer(&[[0.0, 1.0], [1.0, 0.0], [1.0, 0.0], [0.0, 1.0]], &[0.0; 4], &[[2.0, 1.0], [1.0, 2.0]]);
    for isa in Isa::available() {
        assert_eq!(case.all(isa).0, [1, 0], "{}", isa.name());
    }
    let case = last_layer(&[[0.0; 2]; 256], &[-7.0; 256], &[[2.0, 1.0]]);
    for isa in Isa::available() {
        assert_eq!(case.all(isa).0, [0], "{}", isa.name());
    }
}

#[test]
fn zeros_of_both_signs_are_equal() {
    assert_eq!(largest(&[-0.0, 0.0]), 0);
    assert_eq!(largest(&[0.0, -0.0]), 0);
    assert_eq!(largest(&[-1.0, -0.0, 0.0]), 1);
}

#[test]
fn nan_wins_only_where_it_comes_first() {
    const NAN: f32 = f32::NAN;
    for (bias, class) in [
        (vec![1.0, NAN, 2.0], 2),
        (vec![1.0, NAN, 0.0], 0),
        (vec![NAN, 1.0, 2.0], 0),
        (vec![NAN; 17], 0),
        (vec![f32::NEG_INFINITY, NAN, f32::INFINITY], 2),
        (vec![f32::NEG_INFINITY; 3], 0),
    ] {
        let case = last_layer(&vec![[0.0; 2]; bias.len()], &bias, &[[1.0, 1.0]]);
        for isa in Isa::available() {
            assert_eq!(case.all(isa).0, [class], "{} {bias:?}", isa.name());
        }
    }
}

#[test]
fn the_last_of_256_classes_fits() {
    let mut bias = vec![0.0; 256];
    bias[255] = 1.0;
    let case = last_layer(&[[0.0; 2]; 256], &bias, &[[1.0, 1.0]]);
    for isa in Isa::available() {
        assert_eq!(case.all(isa).0, [255], "{}", isa.name());
    }
}

/// Voxels around a tile and a block, channels around a panel and odd, the classes of both data sets and the extremes.
fn table() -> Vec<[usize; 3]> {
    vec![
        [0, 4, 3],
        [1, 32, 17],
        [5, 1, 2],
        [6, 15, 20],
        [7, 17, 256],
        [95, 16, 1],
        [96, 33, 17],
        [97, 32, 16],
        [193, 27, 20],
        [2, 257, 33],
        [3, 0, 5],
    ]
}

#[test]
fn every_isa_gives_the_scalar_bits() {
    let tally = Tally::default();
    for shape in table() {
        for half in [false, true] {
            let logits = Case::new(shape, half, 3, Rng::wide).assert_every_isa(&format!("{shape:?} {half}"));
            if shape[1] > 1 {
                // One channel may be cut off by ReLU.
                tally.count(&logits);
            }
        }
    }
    tally.assert_half();
}

#[test]
fn infinities_and_nan_come_out_where_the_scalar_code_has_them() {
    for shape in table() {
        Case::new(shape, true, 4, Rng::special).assert_every_isa(&format!("{shape:?}"));
    }
    let mut case = Case::new([100, 3, 17], false, 4, Rng::ordinary);
    case.input = Rng::new(5).special(300);
    let logits = case.assert_every_isa("special voxels");
    assert_lively(&logits, "special voxels");
    assert!(logits.iter().any(|v| v.is_nan()), "nothing special came out");
}

#[test]
fn any_shape_and_any_split_gives_the_scalar_bits() {
    let tally = Tally::default();
    let run = |(voxels, channels, classes, half, seed, split): (usize, _, _, _, u64, usize)| {
        let case = Case::new([voxels, channels, classes], half, seed, Rng::fill_of(seed));
        tally.count_finite(seed, &case.assert_every_isa("whole"));
        let (classes, logits) = case.all(Isa::Scalar);
        for isa in Isa::available() {
            let split = split % (voxels + 1);
            let (first, second) = (case.rows(isa, 0..split), case.rows(isa, split..voxels));
            assert_same_bits(&[first.1, second.1].concat(), &logits, "in two parts");
            assert_eq!([first.0, second.0].concat(), classes, "in two parts");
        }
        Ok(())
    };
    let mut runner = TestRunner::new(Config { cases: 64, ..Config::default() });
    let shape = (0usize..200, 1usize..40, 1usize..40);
    runner.run(&(shape.0, shape.1, shape.2, any::<bool>(), any::<u64>(), any::<usize>()), run).unwrap();
    tally.assert_half();
}

#[test]
fn the_order_of_a_chain_shows() {
    for shape in table().into_iter().filter(|shape| shape[0] * shape[1] > 30) {
        let mut case = Case::new(shape, false, 7, Rng::ordinary);
        let want = case.all(Isa::Scalar).1;
        case.input = reverse_columns(&case.input, shape[1]);
        case.layers[0].single = reverse_channels(&case.layers[0].single, shape[1]);
        assert_order_shows(&case.all(Isa::Scalar).1, &want, &format!("{shape:?}"));
    }
}

#[test]
fn the_scalar_code_agrees_with_f64() {
    for shape in table() {
        for half in [false, true] {
            let case = Case::new(shape, half, 6, Rng::ordinary);
            let (classes, logits) = case.all(Isa::Scalar);
            let want = case.naive();
            // Three layers: rounded sums are factors of the next, which has terms up to 100 at 257 channels.
            assert_close(&logits, &want, 1e-4, &format!("{shape:?} {half}"));
            for (class, logits) in classes.iter().zip(want.chunks_exact(shape[2])) {
                let best = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
                let chosen = logits[usize::from(*class)];
                assert!(chosen >= best - 2e-4 * (1.0 + best.abs()), "{shape:?}: {chosen} was chosen over {best}");
            }
        }
    }
}

/// A head over three voxels, broken in one place.
fn broken(damage: impl FnOnce(&mut Case)) {
    let mut case = Case::new([3, 5, 4], false, 0, Rng::ordinary);
    damage(&mut case);
    case.all(Isa::best());
}

#[test]
#[should_panic(expected = "a class must fit a byte")]
fn no_class() {
    broken(|case| case.classes = 0);
}

#[test]
#[should_panic(expected = "a class must fit a byte")]
fn too_many_classes() {
    Case::new([1, 1, 257], false, 0, Rng::ordinary).all(Isa::best());
}

#[test]
#[should_panic(expected = "packed weights do not match the shape")]
fn short_weights() {
    broken(|case| case.layers[1].single.truncate(79));
}

#[test]
#[should_panic(expected = "the bias is shorter than the columns")]
fn unpadded_bias() {
    broken(|case| case.layers[2].bias.truncate(4));
}

#[test]
#[should_panic(expected = "rows 0..3 are not in the input")]
fn short_input() {
    broken(|case| case.input.truncate(14));
}

#[test]
#[should_panic(expected = "rows 2..1 are not in the input")]
fn rows_backwards() {
    let case = Case::new([3, 5, 4], false, 0, Rng::ordinary);
    case.rows(Isa::best(), Range { start: 2, end: 1 });
}

/// A call whose outputs and scratch have these sizes.
fn sized(classes: usize, logits: usize, [occupied, class]: [usize; 2], scratch: usize) {
    let case = Case::new([3, 5, 4], false, 0, Rng::ordinary);
    let (mut occupied, mut class) = (vec![0; occupied], vec![0; class]);
    let results = Results {
        classes: &mut vec![0; classes],
        logits: Some(&mut vec![0.0; logits]),
        confidence: Some(Confidence { scale: 1.0, occupied: &mut occupied, class: &mut class }),
    };
    head(Isa::best(), &case.args(), 0..3, results, &mut vec![0.0; scratch]);
}

#[test]
#[should_panic(expected = "the classes do not hold the rows")]
fn short_classes() {
    sized(2, 12, [3, 3], scratch_len(5, 4));
}

#[test]
#[should_panic(expected = "the logits do not hold the rows")]
fn short_logits() {
    sized(3, 11, [3, 3], scratch_len(5, 4));
}

#[test]
#[should_panic(expected = "the scratch is too small")]
fn short_scratch() {
    sized(3, 12, [3, 3], scratch_len(5, 4) - 1);
}

#[test]
#[should_panic(expected = "the confidence does not hold the rows")]
fn short_confidence() {
    sized(3, 12, [3, 2], scratch_len(5, 4));
}

#[test]
#[should_panic(expected = "the confidence's scale is NaN")]
fn a_scale_that_is_no_number() {
    let case = Case::new([1, 5, 4], false, 0, Rng::ordinary);
    let confidence = Confidence { scale: f32::NAN, occupied: &mut [0], class: &mut [0] };
    let results = Results { classes: &mut [0], logits: None, confidence: Some(confidence) };
    head(Isa::best(), &case.args(), 0..1, results, &mut vec![0.0; scratch_len(5, 4)]);
}

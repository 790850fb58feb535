//! Sums by hand, masks, order and rounding, and every rule that a call can break.

use super::*;
use crate::testing::{Fill, Rng, Tally, assert_lively, assert_order_shows, assert_same_bits};
use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};

struct Case {
    ptr: Vec<u32>,
    col: Vec<u32>,
    features: Vec<f32>,
    stride: usize,
    first_channel: usize,
    channels: usize,
    bias: Option<Vec<f32>>,
    relu: bool,
}

impl Case {
    /// Rows of these lengths over `pixels` pixels, of whose `stride` channels `channels` are gathered; the others are
    /// NaN, which must not show.
    fn new(lengths: &[usize], pixels: usize, channels: usize, end: [bool; 2], seed: u64, fill: Fill) -> Self {
        let mut rng = Rng::new(seed);
        let (first_channel, stride) = (3, channels + 5);
        let mut ptr = vec![0];
        ptr.extend(lengths.iter().scan(0, |sum, n| {
            *sum += *n as u32;
            Some(*sum)
        }));
        let col = (0..lengths.iter().sum()).map(|_| (rng.bits() % pixels as u64) as u32).collect();
        let mut features = vec![f32::NAN; pixels * stride];
        for pixel in features.chunks_exact_mut(stride) {
            pixel[first_channel..][..channels].copy_from_slice(&fill(&mut rng, channels));
        }
        let bias = end[0].then(|| fill(&mut rng, channels));
        Self { ptr, col, features, stride, first_channel, channels, bias, relu: end[1] }
    }

    fn args(&self) -> Gather<'_> {
        Gather {
            ptr: &self.ptr,
            col: &self.col,
            mask: None,
            features: &self.features,
            stride: self.stride,
            first_channel: self.first_channel,
            channels: self.channels,
            bias: self.bias.as_deref(),
            relu: self.relu,
        }
    }

    fn rows(&self, isa: Isa, rows: Range<usize>) -> Vec<f32> {
        let mut out = vec![f32::NAN; rows.len() * self.channels];
        gather(isa, &self.args(), rows, &mut out);
        out
    }

    fn all(&self, isa: Isa) -> Vec<f32> {
        self.rows(isa, 0..self.ptr.len() - 1)
    }
}

#[test]
fn by_hand() {
    // Three pixels of which channels 1 and 2 are read; rows of two, no, one and three entries.
    let features = [9.0, 1.0, 10.0, 9.0, 2.0, -20.0, 9.0, 6.0, 60.0];
    let mut args = Gather {
        ptr: &[0, 2, 2, 3, 6],
        col: &[0, 1, 2, 2, 1, 1],
        features: &features,
        mask: None,
        stride: 3,
        first_channel: 1,
        channels: 2,
        bias: None,
        relu: false,
    };
    for isa in Isa::available() {
        let mut out = [f32::NAN; 8];
        gather(isa, &args, 0..4, &mut out);
        assert_eq!(out, [1.5, -5.0, 0.0, 0.0, 6.0, 60.0, 10.0 / 3.0, 20.0 / 3.0]);
        (args.bias, args.relu) = (Some(&[-2.0, 1.0][..]), true);
        gather(isa, &args, 1..3, &mut out[..4]);
        assert_eq!(out[..4], [0.0, 1.0, 4.0, 61.0]);
        (args.bias, args.relu) = (None, false);
    }
}

/// The case without the entries that `mask` leaves out.
fn without(case: &Case, mask: Mask<'_>) -> Case {
    let (mut ptr, mut col) = (vec![0], vec![]);
    for row in case.ptr.windows(2) {
        let kept = |col: &&u32| !mask.masked[**col as usize / mask.pixels];
        col.extend(case.col[row[0] as usize..row[1] as usize].iter().filter(kept));
        ptr.push(col.len() as u32);
    }
    Case { ptr, col, features: case.features.clone(), bias: case.bias.clone(), ..*case }
}

#[test]
fn a_masked_camera_is_as_if_its_entries_were_not_there() {
    let tally = Tally::default();
    let run = |(lengths, channels, masked, seed): (Vec<usize>, usize, Vec<bool>, u64)| {
        let pixels = 7;
        let mut case = Case::new(&lengths, pixels * masked.len(), channels, [true, false], seed, Rng::wide);
        for row in case.ptr.windows(2) {
            case.col[row[0] as usize..row[1] as usize].sort_unstable();
        }
        let mask = Mask { pixels, masked: &masked };
        let fewer = without(&case, mask);
        let want = fewer.all(Isa::Scalar);
        tally.count(&want);
        for isa in Isa::available() {
            let mut out = vec![f32::NAN; lengths.len() * channels];
            gather(isa, &Gather { mask: Some(mask), ..case.args() }, 0..lengths.len(), &mut out);
            assert_same_bits(&out, &want, isa.name());
        }
        for row in 0..lengths.len() {
            let kept: Vec<u32> = mask.kept(case.args().row(row).next().unwrap_or(&[])).flatten().copied().collect();
            let expected = fewer.args().row(row).next().unwrap_or(&[]).to_vec();
            assert_eq!(
                (mask.kept(&case.col[case.ptr[row] as usize..case.ptr[row + 1] as usize]).columns(), kept),
                (expected.len(), expected)
            );
        }
        Ok(())
    };
    let lengths = prop::collection::vec(0usize..30, 0..12);
    let masked = prop::collection::vec(any::<bool>(), 1..9);
    let mut runner = TestRunner::new(Config::default());
    runner.run(&(lengths, 1usize..70, masked, any::<u64>()), run).unwrap();
    tally.assert_half();
}

#[test]
fn kept_by_hand() {
    let kept = |masked: &[bool], cols: &[u32]| -> Vec<Vec<u32>> {
        Mask { pixels: 10, masked }.kept(cols).map(<[u32]>::to_vec).collect()
    };
    let cols = [3, 9, 10, 25, 29, 30, 39];
    assert_eq!(kept(&[false; 4], &cols), [cols]);
    assert_eq!(kept(&[false, true, false, false], &cols), [&cols[..2], &cols[3..]]);
    assert_eq!(kept(&[true, false, true, false], &cols), [vec![10], vec![30, 39]]);
    assert!(kept(&[true; 4], &cols).is_empty() && kept(&[false; 4], &[]).is_empty());
    // Columns that do not ascend give some runs, and an end.
    assert!(kept(&[true, false], &[15, 3, 12, 1]).concat().len() <= 4);
}

#[test]
#[should_panic(expected = "out of range")]
fn a_pixel_of_no_camera_under_a_mask() {
    Mask { pixels: 10, masked: &[true] }.kept(&[20]).for_each(drop);
}

#[test]
fn sums_ascend_from_zero() {
    // 2^25 + 1 - 2^25 + 1 is 1 from the left; a lone -0 becomes 0 + -0 = 0.
    let features: Vec<f32> = [33_554_432.0, 1.0, -33_554_432.0, -0.0].iter().flat_map(|x| [*x; 17]).collect();
    let mut case = Case::new(&[4, 1], 4, 17, [false; 2], 0, Rng::ordinary);
    (case.features, case.stride, case.first_channel, case.col) = (features, 17, 0, vec![0, 1, 2, 1, 3]);
    for isa in Isa::available() {
        let out = case.all(isa);
        assert_same_bits(&out, &[[0.25; 17], [0.0; 17]].concat(), isa.name());
    }
}

/// (row lengths, channels): channels around a vector and around four.
fn table() -> Vec<(Vec<usize>, usize)> {
    let lengths = vec![3, 0, 1, 27, 0, 0, 128, 2, 5, 0];
    let mut table: Vec<_> =
        [1, 15, 16, 17, 27, 32, 33, 63, 64, 65, 80, 81, 128, 200].map(|c| (lengths.clone(), c)).into();
    table.extend([(vec![], 16), (vec![0], 17), (vec![0; 9], 64), (vec![1], 64), (vec![4], 0)]);
    table
}

#[test]
fn every_isa_gives_the_scalar_bits() {
    let tally = Tally::default();
    for (lengths, channels) in table() {
        for end in [[false, false], [true, false], [false, true], [true, true]] {
            let case = Case::new(&lengths, 40, channels, end, 3, Rng::wide);
            let want = case.all(Isa::Scalar);
            if end[0] && !end[1] && lengths.len() > 9 {
                // Four rows in ten are empty: all of those give the bias.
                tally.count(&want);
            }
            for isa in Isa::available() {
                assert_same_bits(&case.all(isa), &want, &format!("{} {lengths:?} {channels} {end:?}", isa.name()));
                let parts = [case.rows(isa, 0..lengths.len() / 2), case.rows(isa, lengths.len() / 2..lengths.len())];
                assert_same_bits(
                    &parts.concat(),
                    &want,
                    &format!("{} {lengths:?} {channels} in two parts", isa.name()),
                );
            }
        }
    }
    tally.assert_half();
}

#[test]
fn infinities_and_nan_come_out_where_the_scalar_code_has_them() {
    for (lengths, channels) in table() {
        let case = Case::new(&lengths, 40, channels, [true, true], 4, Rng::special);
        let want = case.all(Isa::Scalar);
        for isa in Isa::available() {
            assert_same_bits(&case.all(isa), &want, &format!("{} {lengths:?} {channels}", isa.name()));
        }
    }
    let want = Case::new(&[4; 30], 40, 40, [true, false], 4, Rng::special).all(Isa::Scalar);
    assert_lively(&want, "four entries");
    assert!(want.iter().any(|v| v.is_nan()) && want.iter().any(|v| v.is_infinite()), "nothing special came out");
}

#[test]
fn the_order_of_a_sum_shows() {
    let mut case = Case::new(&[3, 27, 128, 9, 50], 400, 81, [false; 2], 7, Rng::ordinary);
    let want = case.all(Isa::Scalar);
    case.col = case
        .ptr
        .windows(2)
        .flat_map(|ends| case.col[ends[0] as usize..ends[1] as usize].iter().rev())
        .copied()
        .collect();
    assert_order_shows(&case.all(Isa::Scalar), &want, "entries");
}

/// A gather of four channels, broken in one place.
fn broken(isa: Isa, damage: impl FnOnce(&mut Case)) {
    let mut case = Case::new(&[2, 0, 3], 10, 4, [true, false], 0, Rng::ordinary);
    damage(&mut case);
    case.all(isa);
}

#[test]
#[should_panic(expected = "channels out of range")]
fn channels_outside_the_pixel() {
    broken(Isa::best(), |case| case.first_channel = 6);
}

#[test]
#[should_panic(expected = "channels out of range")]
fn a_first_channel_that_wraps() {
    broken(Isa::best(), |case| case.first_channel = usize::MAX - 1);
}

#[test]
#[should_panic(expected = "the bias is shorter than the channels")]
fn short_bias() {
    broken(Isa::best(), |case| case.bias = Some(vec![0.0; 3]));
}

#[test]
#[should_panic(expected = "rows 1..4 of 3")]
fn rows_outside() {
    Case::new(&[2, 0, 3], 10, 4, [false; 2], 0, Rng::ordinary).rows(Isa::best(), 1..4);
}

#[test]
#[should_panic(expected = "rows 2..1 of 3")]
fn rows_backwards() {
    Case::new(&[2, 0, 3], 10, 4, [false; 2], 0, Rng::ordinary).rows(Isa::best(), Range { start: 2, end: 1 });
}

#[test]
#[should_panic(expected = "the output does not hold the rows")]
fn short_output() {
    let case = Case::new(&[2, 0, 3], 10, 4, [false; 2], 0, Rng::ordinary);
    gather(Isa::best(), &case.args(), 0..3, &mut [0.0; 11]);
}

#[test]
#[should_panic(expected = "out of range")]
fn a_pixel_that_is_not_there() {
    broken(Isa::best(), |case| case.col[4] = 10);
}

#[test]
#[should_panic(expected = "out of range")]
fn a_pixel_that_is_not_there_for_the_scalar_code() {
    broken(Isa::Scalar, |case| case.col[4] = u32::MAX);
}

#[test]
#[should_panic(expected = "out of range")]
fn a_pixel_whose_place_wraps() {
    // In 32 bits `col * stride` would be 0, a pixel that exists.
    let features = [1.0; 64];
    let mut out = [0.0; 64];
    let args = Gather {
        ptr: &[0, 1],
        col: &[1 << 26],
        mask: None,
        features: &features,
        stride: 64,
        first_channel: 0,
        channels: 64,
        bias: None,
        relu: false,
    };
    gather(Isa::best(), &args, 0..1, &mut out);
}

#[test]
#[should_panic(expected = "the stride is out of range")]
#[cfg(target_pointer_width = "64")]
fn a_stride_that_no_features_have() {
    broken(Isa::best(), |case| case.stride = 1 << 32);
}

#[test]
#[should_panic(expected = "slice index starts at 2 but ends at 1")]
fn offsets_that_descend() {
    broken(Isa::best(), |case| case.ptr[2] = 1);
}

#[test]
#[should_panic(expected = "out of range")]
fn offsets_beyond_the_entries() {
    broken(Isa::best(), |case| case.ptr[3] = 6);
}

//! What the kernels' tests share: values to compute with, and comparisons that name the place of a difference.

pub(crate) mod int8;

use crate::matmul::layout::{pack, packed_len};
use crate::matmul::{Panels, Product, Residual};
use half::f16;

/// A small generator (splitmix64), so that tests see the same values everywhere.
pub(crate) struct Rng(u64);

impl Rng {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed)
    }

    pub(crate) fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Uniform on [-1, 1).
    pub(crate) fn unit(&mut self) -> f32 {
        (self.bits() >> 40) as f32 / (1 << 23) as f32 - 1.0
    }

    /// `n` values of order one.
    pub(crate) fn ordinary(&mut self, n: usize) -> Vec<f32> {
        (0..n).map(|_| self.unit()).collect()
    }

    /// `n` finite values over 24 binary orders of magnitude, with zeros of both signs and subnormals among them.
    pub(crate) fn wide(&mut self, n: usize) -> Vec<f32> {
        let mut one = || {
            let x = self.unit();
            match self.bits() % 16 {
                0 => 0.0,
                1 => -0.0,
                2 => x * f32::MIN_POSITIVE,
                _ => x * f32::from_bits(((115 + self.bits() % 24) as u32) << 23),
            }
        };
        (0..n).map(|_| one()).collect()
    }

    /// Like [`Rng::wide`], but about one value in 80 is infinite or NaN, of either sign, quiet or signalling.
    pub(crate) fn special(&mut self, n: usize) -> Vec<f32> {
        let mut x = self.wide(n);
        for x in &mut x {
            match self.bits() % 240 {
                0 => *x = f32::INFINITY,
                1 => *x = f32::NEG_INFINITY,
                2 => {
                    let bits = self.bits() as u32;
                    *x = f32::from_bits(bits & 0x807f_ffff | 0x7f80_0001);
                }
                _ => {}
            }
        }
        x
    }

    /// [`Rng::special`] for one seed in four, else [`Rng::wide`].
    pub(crate) fn fill_of(seed: u64) -> Fill {
        if seed.is_multiple_of(4) { Rng::special } else { Rng::wide }
    }
}

/// A source of values: [`Rng::ordinary`], [`Rng::wide`] or [`Rng::special`].
pub(crate) type Fill = fn(&mut Rng, usize) -> Vec<f32>;

/// Asserts equal bits, except that any NaN equals any NaN.
#[track_caller]
pub(crate) fn assert_same_bits(got: &[f32], want: &[f32], what: &str) {
    assert_eq!(got.len(), want.len(), "{what}: lengths differ");
    for (i, (g, w)) in got.iter().zip(want).enumerate() {
        let same = g.to_bits() == w.to_bits() || (g.is_nan() && w.is_nan());
        assert!(same, "{what}: element {i} is {g:e} ({:08x}), not {w:e} ({:08x})", g.to_bits(), w.to_bits());
    }
}

/// Asserts that a comparison of these values means something: at least half are finite, and they are not all equal.
#[track_caller]
pub(crate) fn assert_lively(values: &[f32], what: &str) {
    let finite = values.iter().filter(|v| v.is_finite()).count();
    assert!(2 * finite >= values.len(), "{what}: only {finite} of {} values are finite", values.len());
    assert!(values.iter().any(|v| v.is_finite() && *v != values[0]), "{what}: all values are {}", values[0]);
}

/// Asserts that two orders of the same sums differ in bits somewhere, and nowhere by much: inputs for which they agreed
/// would hide a body that adds in another order.
#[track_caller]
pub(crate) fn assert_order_shows(one: &[f32], other: &[f32], what: &str) {
    let wide: Vec<f64> = other.iter().map(|v| f64::from(*v)).collect();
    assert_close(one, &wide, 1e-4, what);
    let differ = one.iter().zip(other).filter(|(a, b)| a.to_bits() != b.to_bits()).count();
    assert!(8 * differ >= one.len() && differ > 0, "{what}: only {differ} of {} depend on the order", one.len());
}

/// The rows of `columns` values in opposite order.
pub(crate) fn reverse_rows(x: &[f32], columns: usize) -> Vec<f32> {
    x.rchunks_exact(columns).flatten().copied().collect()
}

/// Each row's values in opposite order.
pub(crate) fn reverse_columns(x: &[f32], columns: usize) -> Vec<f32> {
    x.chunks_exact(columns).flat_map(|row| row.iter().rev()).copied().collect()
}

/// Packed weights of taps of `channels` channels each, with the channels in opposite order.
pub(crate) fn reverse_channels(packed: &[f32], channels: usize) -> Vec<f32> {
    packed.chunks_exact(channels * crate::LANES).flat_map(|tap| reverse_rows(tap, crate::LANES)).collect()
}

/// Asserts |got - want| <= tolerance * (1 + |want|).
#[track_caller]
pub(crate) fn assert_close(got: &[f32], want: &[f64], tolerance: f64, what: &str) {
    assert_eq!(got.len(), want.len(), "{what}: lengths differ");
    for (i, (g, w)) in got.iter().zip(want).enumerate() {
        let error = (f64::from(*g) - w).abs();
        assert!(error <= tolerance * (1.0 + w.abs()), "{what}: element {i} is {g:e}, not {w:e}");
    }
}

/// Pads every row of `channels` values to a multiple of 16 with `junk`, which a kernel must not let show.
pub(crate) fn pad_rows(x: &[f32], channels: usize, junk: f32) -> Vec<f32> {
    let padded = channels.next_multiple_of(crate::LANES);
    let mut out = vec![junk; x.len() / channels * padded];
    for (from, to) in x.chunks_exact(channels).zip(out.chunks_exact_mut(padded)) {
        to[..channels].copy_from_slice(from);
    }
    out
}

/// Counts what a comparison compared, over many cases, so that it cannot pass by comparing nothing.
#[derive(Default)]
pub(crate) struct Tally {
    outputs: std::cell::Cell<usize>,
    telling: std::cell::Cell<usize>,
}

impl Tally {
    /// Counts one case's outputs: those that are finite, each value once.
    pub(crate) fn count(&self, outputs: &[f32]) {
        let mut bits: Vec<u32> = outputs.iter().filter(|v| v.is_finite()).map(|v| v.to_bits()).collect();
        bits.sort_unstable();
        bits.dedup();
        self.outputs.set(self.outputs.get() + outputs.len());
        self.telling.set(self.telling.get() + bits.len());
    }

    /// As [`Tally::count`], if the case has finite values only: if [`Rng::fill_of`] its seed is [`Rng::wide`].
    pub(crate) fn count_finite(&self, seed: u64, outputs: &[f32]) {
        if !seed.is_multiple_of(4) {
            self.count(outputs);
        }
    }

    /// Asserts that there were outputs, and that at least half of them were finite and distinct.
    #[track_caller]
    pub(crate) fn assert_half(&self) {
        let (telling, outputs) = (self.telling.get(), self.outputs.get());
        assert!(outputs > 0 && 2 * telling >= outputs, "only {telling} of {outputs} outputs were finite and distinct");
    }
}

/// A [`Residual`] without its tensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Joins {
    Nowhere,
    InPlace,
    Before,
    After,
}

/// Every place where a residual can join.
pub(crate) const JOINS: [Joins; 4] = [Joins::Nowhere, Joins::InPlace, Joins::Before, Joins::After];

/// What happens besides the sum, and the precision of the weights.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Way {
    pub(crate) half: bool,
    pub(crate) joins: Joins,
    pub(crate) relu: bool,
}

/// Nothing.
pub(crate) const PLAIN: Way = Way { half: false, joins: Joins::Nowhere, relu: false };

/// All sixteen.
pub(crate) fn ways() -> Vec<Way> {
    let of = |half, relu| JOINS.map(|joins| Way { half, joins, relu });
    [of(false, false), of(true, true), of(true, false), of(false, true)].concat()
}

/// All of a [`Product`] but its left matrix, owned.
pub(crate) struct Owned {
    pub(crate) depth: usize,
    pub(crate) columns: usize,
    pub(crate) relu: bool,
    pub(crate) joins: Joins,
    pub(crate) single: Vec<f32>,
    pub(crate) half: Option<Vec<f16>>,
    /// Padded with NaN, which must not show.
    pub(crate) bias: Vec<f32>,
    /// The tensor of the residual and the distance between its rows.
    pub(crate) added: Vec<f32>,
    pub(crate) added_stride: usize,
}

impl Owned {
    /// Packs the weights w(k, n), which must be representable where `half` is asked for.
    pub(crate) fn new(depth: usize, bias: &[f32], half: bool, w: impl Fn(usize, usize) -> f32) -> Self {
        let columns = bias.len();
        let mut single = vec![f32::NAN; packed_len(depth, columns)];
        pack(depth, columns, w, &mut single);
        let half = half.then(|| single.iter().map(|w| f16::from_f32(*w)).collect());
        let bias = pad_rows(bias, columns.max(1), f32::NAN);
        Self {
            depth,
            columns,
            relu: false,
            joins: Joins::Nowhere,
            single,
            half,
            bias,
            added: Vec::new(),
            added_stride: 0,
        }
    }

    /// The same with a residual for `rows` rows, `gap` values wider apart than need be, and with ReLU or not.
    pub(crate) fn end(mut self, rng: &mut Rng, fill: Fill, rows: usize, joins: Joins, gap: usize, relu: bool) -> Self {
        self.joins = joins;
        self.relu = relu;
        self.added_stride = self.columns + gap;
        self.added = fill(rng, rows * self.added_stride);
        self
    }

    pub(crate) fn product(&self) -> Product<'_> {
        let (rows, stride) = (&self.added[..], self.added_stride);
        Product {
            weights: self.half.as_ref().map_or(Panels::F32(&self.single), |w| Panels::F16(w)),
            bias: &self.bias,
            depth: self.depth,
            columns: self.columns,
            relu: self.relu,
            residual: match self.joins {
                Joins::Nowhere => Residual::None,
                Joins::InPlace => Residual::InPlace,
                Joins::Before => Residual::Before { rows, stride },
                Joins::After => Residual::After { rows, stride },
            },
        }
    }

    /// What the formula makes of the exact sum of products of output (`row`, `n`), where `out` was before.
    pub(crate) fn naive_end(&self, row: usize, n: usize, out: f32, sum: f64) -> f64 {
        let added = |row: usize| f64::from(self.added[row * self.added_stride + n]);
        let mut value = sum + f64::from(self.bias[n]);
        match self.joins {
            Joins::InPlace => value += f64::from(out),
            Joins::Before => value += added(row),
            _ => {}
        }
        if self.relu {
            value = value.max(0.0);
        }
        if self.joins == Joins::After { value + added(row) } else { value }
    }
}

/// The nearest half-precision values where `half` is asked for.
pub(crate) fn round_to(half: bool, mut x: Vec<f32>) -> Vec<f32> {
    if half {
        x.iter_mut().for_each(|x| *x = f16::from_f32(*x).to_f32());
    }
    x
}

/// A value that a test finds again between the rows of an output.
pub(crate) trait Gap: Copy {
    const GAP: Self;
    fn is_gap(self) -> bool;
}

impl Gap for f32 {
    const GAP: Self = f32::from_bits(0x7fc0_0bad);
    fn is_gap(self) -> bool {
        self.to_bits() == Self::GAP.to_bits()
    }
}

impl Gap for i8 {
    const GAP: Self = i8::MIN;
    fn is_gap(self) -> bool {
        self == Self::GAP
    }
}

impl Gap for i32 {
    const GAP: Self = 0x0bad_0bad;
    fn is_gap(self) -> bool {
        self == Self::GAP
    }
}

/// Runs `write` on `rows` rows of values, `stride` apart, which hold `before`. Returns what they hold afterwards, densely;
/// the values in between must be left alone.
pub(crate) fn write_rows<T: Gap>(rows: usize, stride: usize, before: &[T], write: impl FnOnce(&mut [T])) -> Vec<T> {
    let columns = before.len().checked_div(rows).unwrap_or(0);
    let mut out = vec![T::GAP; rows * stride];
    for row in 0..rows {
        out[row * stride..][..columns].copy_from_slice(&before[row * columns..][..columns]);
    }
    let end = out.len().saturating_sub(stride - columns);
    write(&mut out[..end]);
    for (i, v) in out.iter().enumerate() {
        assert!(i % stride < columns || v.is_gap(), "value {i}, between rows, was written");
    }
    out.chunks(stride.max(1)).flat_map(|row| &row[..columns]).copied().collect()
}

#[test]
fn special_numbers_are_of_every_kind() {
    for seed in 0..12 {
        let x = Rng::new(seed).special(2000);
        let kinds: [fn(&f32) -> bool; 9] = [
            |v| v.is_nan() && v.is_sign_positive() && v.to_bits() & 0x0040_0000 != 0,
            |v| v.is_nan() && v.is_sign_negative(),
            |v| v.is_nan() && v.to_bits() & 0x0040_0000 == 0,
            |v| *v == f32::INFINITY,
            |v| *v == f32::NEG_INFINITY,
            |v| v.to_bits() == 0.0f32.to_bits(),
            |v| v.to_bits() == (-0.0f32).to_bits(),
            |v| v.is_subnormal(),
            |v| v.is_normal(),
        ];
        for (i, kind) in kinds.into_iter().enumerate() {
            assert!(x.iter().any(kind), "seed {seed}: nothing of kind {i}");
        }
        assert!(Rng::new(seed).wide(2000).iter().all(|v| v.is_finite()));
    }
}

/// The comparison that all kernels' tests rest on: it sees the last bit, the sign of zero, subnormals and NaN, in the first
/// and the last place.
#[test]
fn one_changed_bit_is_noticed() {
    let want: Vec<f32> = [vec![1.0; 16], vec![f32::NAN, 0.0, f32::MIN_POSITIVE / 2.0, f32::INFINITY, -2.0]].concat();
    let noticed = |got: Vec<f32>| std::panic::catch_unwind(|| assert_same_bits(&got, &want, "")).is_err();
    assert!(!noticed(want.clone()));
    for place in 0..want.len() {
        for bit in 0..32 {
            let mut got = want.clone();
            got[place] = f32::from_bits(got[place].to_bits() ^ 1 << bit);
            assert_eq!(noticed(got.clone()), !(got[place].is_nan() && want[place].is_nan()), "{place} {bit}");
        }
    }
    assert!(noticed(want[1..].to_vec()));
}

//! What the kernels' tests share: numbers to compute with, and comparisons that name the place of a difference.

use crate::panels::{Panels, pack, packed_len};
use crate::product::{Product, Residual};
use half::f16;

/// A small generator (splitmix64), so that tests see the same numbers everywhere.
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

    /// `n` numbers of order one.
    pub(crate) fn ordinary(&mut self, n: usize) -> Vec<f32> {
        (0..n).map(|_| self.unit()).collect()
    }

    /// `n` finite numbers over 24 binary orders of magnitude, with zeros of both signs and subnormals among them.
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

    /// Like [`Rng::wide`], but about one number in 80 is infinite or NaN.
    pub(crate) fn special(&mut self, n: usize) -> Vec<f32> {
        let mut x = self.wide(n);
        for x in &mut x {
            match self.bits() % 240 {
                0 => *x = f32::INFINITY,
                1 => *x = f32::NEG_INFINITY,
                2 => *x = f32::NAN,
                _ => {}
            }
        }
        x
    }
}

/// A source of numbers: [`Rng::ordinary`], [`Rng::wide`] or [`Rng::special`].
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

/// Asserts |got - want| <= tolerance * (1 + |want|).
#[track_caller]
pub(crate) fn assert_close(got: &[f32], want: &[f64], tolerance: f64, what: &str) {
    assert_eq!(got.len(), want.len(), "{what}: lengths differ");
    for (i, (g, w)) in got.iter().zip(want).enumerate() {
        let error = (f64::from(*g) - w).abs();
        assert!(error <= tolerance * (1.0 + w.abs()), "{what}: element {i} is {g:e}, not {w:e}");
    }
}

/// Pads every row of `channels` numbers to a multiple of 16 with `junk`, which a kernel must not let show.
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

    /// The same with a residual for `rows` rows, `gap` numbers wider apart than need be, and with a rectifier or not.
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

/// The nearest half-precision numbers where `half` is asked for.
pub(crate) fn round_to(half: bool, mut x: Vec<f32>) -> Vec<f32> {
    if half {
        x.iter_mut().for_each(|x| *x = f16::from_f32(*x).to_f32());
    }
    x
}

/// Runs `write` on `rows` rows of numbers, `stride` apart, which hold `before`. Returns what they hold afterwards, densely;
/// the numbers in between must be left alone.
pub(crate) fn write_rows(rows: usize, stride: usize, before: &[f32], write: impl FnOnce(&mut [f32])) -> Vec<f32> {
    let gap = f32::from_bits(0x7fc0_0bad);
    let columns = before.len().checked_div(rows).unwrap_or(0);
    let mut out = vec![gap; rows * stride];
    for row in 0..rows {
        out[row * stride..][..columns].copy_from_slice(&before[row * columns..][..columns]);
    }
    let end = out.len().saturating_sub(stride - columns);
    write(&mut out[..end]);
    for (i, v) in out.iter().enumerate() {
        assert!(i % stride < columns || v.to_bits() == gap.to_bits(), "number {i}, between rows, was written");
    }
    out.chunks(stride.max(1)).flat_map(|row| &row[..columns]).copied().collect()
}

//! What tests of products of bytes share.

use super::Rng;
use crate::matmul::int8::layout::{pack, pairs, sums};
use crate::matmul::layout::packed_len;
use crate::matmul::{ProductI8, ResidualI8};

impl Rng {
    /// `n` bytes from `low` to `high`, both included.
    pub(crate) fn bytes(&mut self, n: usize, low: i8, high: i8) -> Vec<i8> {
        let span = (i32::from(high) - i32::from(low) + 1) as u64;
        (0..n).map(|_| (i32::from(low) + (self.bits() >> 32).wrapping_rem(span) as i32) as i8).collect()
    }

    /// `n` elements of a left matrix.
    pub(crate) fn left(&mut self, n: usize, signed: bool) -> Vec<i8> {
        self.bytes(n, if signed { -127 } else { 0 }, 127)
    }

    /// An integer between -`most` and `most`.
    pub(crate) fn within(&mut self, most: i32) -> i32 {
        (f64::from(self.unit()) * f64::from(most)) as i32
    }
}

/// How a residual joins: whether it is read from a tensor apart, and whether after ReLU.
pub(crate) type JoinsI8 = Option<[bool; 2]>;

/// Every way.
pub(crate) const JOINS: [JoinsI8; 5] =
    [None, Some([false, false]), Some([false, true]), Some([true, false]), Some([true, true])];

/// Signed left elements, weights that pair, ReLU, residual.
#[derive(Clone, Copy, Debug)]
pub(crate) struct WayI8 {
    pub(crate) signed: bool,
    pub(crate) calm: bool,
    pub(crate) relu: bool,
    pub(crate) joins: JoinsI8,
}

/// Nothing.
pub(crate) const PLAIN: WayI8 = WayI8 { signed: true, calm: false, relu: false, joins: None };

/// All forty, so that neighbours differ in most.
pub(crate) fn ways() -> Vec<WayI8> {
    (0..40)
        .map(|i| [i / 20 % 2 == 1, i % 2 == 1, i / 2 % 2 == 1].map(|flag| flag ^ (i % 3 == 0)))
        .enumerate()
        .map(|(i, [signed, calm, relu])| WayI8 { signed, calm, relu, joins: JOINS[i % 5] })
        .collect()
}

/// All of a [`ProductI8`] but its left matrix, owned.
pub(crate) struct OwnedI8 {
    pub(crate) depth: usize,
    pub(crate) columns: usize,
    pub(crate) signed: bool,
    pub(crate) relu: bool,
    pub(crate) joins: JoinsI8,
    pub(crate) weights: Vec<i8>,
    pub(crate) sums: Vec<i32>,
    pub(crate) pairs: Vec<u8>,
    /// Padded with junk, which must not show.
    pub(crate) bias: Vec<i32>,
    pub(crate) multiplier: Vec<i32>,
    /// Of the residual.
    pub(crate) joining: Vec<i32>,
    /// The tensor of the residual and the distance between its rows.
    pub(crate) added: Vec<i8>,
    pub(crate) added_stride: usize,
}

/// What is behind the columns.
const JUNK: i32 = i32::MIN + 77;

/// Pads with junk to a multiple of 16.
pub(crate) fn padded(mut x: Vec<i32>) -> Vec<i32> {
    x.resize(x.len().next_multiple_of(16), JUNK);
    x
}

impl OwnedI8 {
    /// Packs the weights w(k, n). Sums go to the output unchanged but for a factor of 1/4.
    pub(crate) fn new(depth: usize, bias: &[i32], w: impl Fn(usize, usize) -> i8) -> Self {
        let columns = bias.len();
        let mut weights = vec![99; packed_len(depth, columns)];
        pack(depth, columns, w, &mut weights);
        Self {
            depth,
            columns,
            signed: true,
            relu: false,
            joins: None,
            sums: sums(&weights, depth).collect(),
            pairs: pairs(&weights, depth).collect(),
            weights,
            bias: padded(bias.to_vec()),
            multiplier: padded(vec![1 << 30; columns]),
            joining: padded(vec![0; columns]),
            added: vec![],
            added_stride: 0,
        }
    }

    /// `natural` bytes for `columns` x `depth` weights.
    pub(crate) fn natural(rng: &mut Rng, n: usize, way: WayI8) -> Vec<i8> {
        // Four of 64 are 256.
        if way.calm { rng.bytes(n, -64, 64) } else { rng.bytes(n, -127, 127) }
    }

    /// Weights w(k, n), a bias about as large as the sums, multipliers that bring them into 8 bits, now and then a step
    /// beyond, and a residual for `rows` rows.
    pub(crate) fn drawn(
        rng: &mut Rng,
        [rows, depth, columns]: [usize; 3],
        way: WayI8,
        w: impl Fn(usize, usize) -> i8,
    ) -> Self {
        let size = 5000.0 * (depth as f64).sqrt().max(1.0);
        let bias: Vec<i32> = (0..columns).map(|_| rng.within(size as i32)).collect();
        let mut owned = Self::new(depth, &bias, w);
        let mut factor = || (f64::from(rng.within(40) + 60) / size * 2f64.powi(32)) as i32;
        owned.multiplier = padded((0..columns).map(|_| factor()).collect());
        owned.joining = padded((0..columns).map(|_| rng.within(size as i32 / 100)).collect());
        owned.added_stride = columns + 3;
        owned.added = rng.left(rows * owned.added_stride, true);
        WayI8 { signed: owned.signed, relu: owned.relu, joins: owned.joins, .. } = way;
        owned
    }

    pub(crate) fn product(&self) -> ProductI8<'_> {
        let multiplier = &self.joining[..];
        ProductI8 {
            weights: &self.weights,
            sums: &self.sums,
            pairs: &self.pairs,
            bias: &self.bias,
            depth: self.depth,
            columns: self.columns,
            signed: self.signed,
            relu: self.relu,
            residual: match self.joins {
                None => ResidualI8::None,
                Some([false, after]) => ResidualI8::InPlace { multiplier, after },
                Some([true, after]) => {
                    ResidualI8::Apart { rows: &self.added, stride: self.added_stride, multiplier, after }
                }
            },
            multiplier: &self.multiplier,
        }
    }

    /// What the formula makes of the sum of products of output (`row`, `n`), where `out` was before: the sum at its end.
    pub(crate) fn naive_sum(&self, row: usize, n: usize, out: i64, products: i64) -> i64 {
        let relu = |x: i64| if self.relu { x.max(0) } else { x };
        let sum = products + i64::from(self.bias[n]);
        let Some([apart, after]) = self.joins else { return relu(sum) };
        let added = if apart { i64::from(self.added[row * self.added_stride + n]) } else { out };
        let added = added * i64::from(self.joining[n]);
        if after { relu(sum) + added } else { relu(sum + added) }
    }

    /// [`OwnedI8::naive_sum`] in the output's scale, not clamped.
    pub(crate) fn naive_wide(&self, row: usize, n: usize, out: i64, products: i64) -> i64 {
        let exact = i128::from(self.naive_sum(row, n, out, products)) * i128::from(self.multiplier[n]);
        // The nearest integer, halves upwards.
        ((2 * exact + (1 << 32)).div_euclid(1 << 33)) as i64
    }

    /// The output.
    pub(crate) fn naive_end(&self, row: usize, n: usize, out: i8, products: i64) -> i8 {
        self.naive_wide(row, n, out.into(), products).clamp(-127, 127) as i8
    }
}

/// Asserts that outputs are equal, and that there are some different ones.
#[track_caller]
pub(crate) fn assert_same<T: PartialEq + std::fmt::Debug>(got: &[T], want: &[T], what: &str) {
    assert_eq!(got.len(), want.len(), "{what}: lengths differ");
    if let Some(i) = got.iter().zip(want).position(|(a, b)| a != b) {
        panic!("{what}: element {i} is {:?}, not {:?}", got[i], want[i]);
    }
}

/// Asserts that outputs tell: a third are neither zero nor at an end of their range.
#[track_caller]
pub(crate) fn assert_telling(out: &[i8], what: &str) {
    let telling = out.iter().filter(|x| **x != 0 && x.abs() != 127).count();
    assert!(3 * telling >= out.len(), "{what}: only {telling} of {} outputs tell", out.len());
}

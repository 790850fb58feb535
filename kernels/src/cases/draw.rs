//! Shapes and values out of bytes. Bytes that run out read as zero.

use crate::matmul::layout::packed_len;
use crate::matmul::{Panels, Product, Residual};
use half::f16;
use std::ops::Range;
use std::vec;
use std::vec::Vec;

use super::memory::{Held, Memory};

/// Multiply-adds that one case may take: a fraction of a millisecond of the specification.
pub const MAX_WORK: usize = 1 << 16;

/// Values that a sum treats in ways of their own.
const SPECIAL: [f32; 10] = [
    0.0,
    -0.0,
    f32::INFINITY,
    f32::NEG_INFINITY,
    f32::NAN,
    f32::MIN_POSITIVE,
    f32::from_bits(1),
    f32::MAX,
    f32::MIN,
    -1.0,
];

/// The mode of values of order one.
const ORDINARY: u8 = 4;

/// Bytes that are read as shapes and values.
pub struct Draw {
    bytes: vec::IntoIter<u8>,
    state: u64,
    mode: u8,
}

impl Draw {
    /// The first two bytes say which values are drawn.
    pub fn new(bytes: &[u8]) -> Self {
        let mut draw = Self { bytes: Vec::from(bytes).into_iter(), state: 0, mode: 0 };
        draw.state = u64::from(draw.byte());
        draw.mode = draw.byte() % 4;
        draw
    }

    /// From bytes that `seed` determines.
    pub fn seeded(seed: u64) -> Self {
        let mut draw = Self { bytes: vec![].into_iter(), state: seed, mode: 0 };
        let bytes: Vec<u8> = (0..64).map(|_| draw.bits() as u8).collect();
        Self { mode: draw.bits() as u8 % 4, bytes: bytes.into_iter(), ..draw }
    }

    /// As [`Draw::seeded`], but all values are between -1 and 1, so that sums can be compared with a tolerance.
    pub fn ordinary(seed: u64) -> Self {
        Self { mode: ORDINARY, ..Self::seeded(seed) }
    }

    /// splitmix64.
    fn bits(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.state ^ (self.state >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// The next byte.
    pub fn byte(&mut self) -> u8 {
        self.bytes.next().unwrap_or(0)
    }

    /// Yes or no.
    pub fn flag(&mut self) -> bool {
        self.byte() % 2 == 1
    }

    /// `low` to `high`, both included.
    pub fn extent(&mut self, low: usize, high: usize) -> usize {
        low + usize::from(self.byte()) % (high - low + 1)
    }

    /// Columns of a product, as many as there may be where each takes `work` multiply-adds.
    pub fn columns(&mut self, work: usize) -> Option<usize> {
        let most = MAX_WORK / work.max(1);
        (most > 0).then(|| self.extent(1, most.min(70)))
    }

    /// Some of `n` rows.
    pub fn rows(&mut self, n: usize) -> Range<usize> {
        let start = self.extent(0, n.min(255));
        start..self.extent(start, n.min(255).max(start))
    }

    /// A value: one in four is taken from the bytes as it is, as long as there are any.
    pub fn value(&mut self) -> f32 {
        let bits = self.bits();
        if self.mode != ORDINARY && bits.is_multiple_of(4) && self.bytes.len() >= 4 {
            return f32::from_le_bytes([self.byte(), self.byte(), self.byte(), self.byte()]);
        }
        let unit = (bits >> 40) as f32 / (1 << 23) as f32 - 1.0;
        match self.mode {
            0 | ORDINARY => unit,
            1 if (bits >> 8).is_multiple_of(16) => SPECIAL[(bits >> 16) as usize % SPECIAL.len()],
            1 => unit,
            2 => (unit * 4.0).round(),
            _ => f32::from_bits((bits >> 32) as u32),
        }
    }

    /// `n` values.
    pub fn values(&mut self, n: usize) -> Vec<f32> {
        (0..n).map(|_| self.value()).collect()
    }

    /// A byte: one in four is taken from the bytes as it is, as long as there are any.
    pub fn int8(&mut self) -> i8 {
        let bits = self.bits();
        if bits.is_multiple_of(4) && self.bytes.len() > 0 {
            return self.byte().cast_signed();
        }
        match self.mode {
            0 => (bits >> 32) as i8,
            1 => [-128, -127, 127, 0][(bits >> 32) as usize % 4],
            2 => (bits >> 32) as i8 % 8,
            _ => ((bits >> 32) as i8).max(0),
        }
    }

    /// `n` bytes.
    pub fn int8s(&mut self, n: usize) -> Vec<i8> {
        (0..n).map(|_| self.int8()).collect()
    }

    /// An integer of any size: one in four is taken from the bytes as it is, as long as there are any.
    pub fn int32(&mut self) -> i32 {
        let bits = self.bits();
        if bits.is_multiple_of(4) && self.bytes.len() >= 4 {
            return i32::from_le_bytes([self.byte(), self.byte(), self.byte(), self.byte()]);
        }
        match (self.mode, bits >> 8 & 7) {
            (1, 0) => i32::MAX,
            (1, 1) => i32::MIN,
            // Any number of leading zeros or ones.
            _ => (bits >> 32) as i32 >> (bits >> 16 & 31),
        }
    }

    /// An integer from `low` to `high`, both included.
    pub fn int_within(&mut self, low: i32, high: i32) -> i32 {
        let x = self.int32();
        if (low..=high).contains(&x) {
            return x;
        }
        match x & 7 {
            0 => low,
            1 => high,
            _ => (i64::from(low) + i64::from(x).rem_euclid(i64::from(high) - i64::from(low) + 1)) as i32,
        }
    }

    /// `n` integers from `low` to `high`, both included.
    pub fn ints_within(&mut self, n: usize, low: i32, high: i32) -> Vec<i32> {
        (0..n).map(|_| self.int_within(low, high)).collect()
    }

    /// `n` values, if the flag that comes first says so.
    pub fn maybe(&mut self, n: usize) -> Option<Vec<f32>> {
        self.flag().then(|| self.values(n))
    }
}

/// Packed weights in either precision.
pub struct Weights {
    single: Vec<f32>,
    half: Option<Vec<f16>>,
}

impl Weights {
    /// `n` of them, the zero columns included.
    pub fn draw(draw: &mut Draw, n: usize) -> Self {
        let half = draw.flag();
        let single = draw.values(n);
        let half = half.then(|| single.iter().map(|w| f16::from_f32(*w)).collect());
        Self { single, half }
    }

    /// The same in `memory`.
    pub fn hold(&self, memory: Memory) -> HeldWeights {
        match &self.half {
            Some(half) => HeldWeights::Half(memory.hold(half)),
            None => HeldWeights::Single(memory.hold(&self.single)),
        }
    }
}

/// [`Weights`] in some memory.
pub enum HeldWeights {
    /// Single precision.
    Single(Held<f32>),
    /// Half precision.
    Half(Held<f16>),
}

impl HeldWeights {
    /// As kernels take them.
    pub fn panels(&self) -> Panels<'_> {
        match self {
            HeldWeights::Single(w) => Panels::F32(w),
            HeldWeights::Half(w) => Panels::F16(w),
        }
    }
}

/// All of a product but its left matrix.
pub(crate) struct Right {
    depth: usize,
    columns: usize,
    weights: Weights,
    bias: Vec<f32>,
    relu: bool,
    joins: u8,
    added: Vec<f32>,
    stride: usize,
}

/// [`Right`] in some memory.
pub(crate) struct HeldRight<'a> {
    right: &'a Right,
    weights: HeldWeights,
    bias: Held<f32>,
    added: Held<f32>,
}

impl Right {
    /// A product of `rows` rows.
    pub(crate) fn draw(draw: &mut Draw, rows: usize, depth: usize, columns: usize) -> Self {
        let (joins, stride) = (draw.byte() % 4, columns + draw.extent(0, 3));
        Self {
            depth,
            columns,
            weights: Weights::draw(draw, packed_len(depth, columns)),
            bias: draw.values(columns.next_multiple_of(16)),
            relu: draw.flag(),
            joins,
            added: if joins > 1 { draw.values(span(rows, stride, columns)) } else { vec![] },
            stride,
        }
    }

    pub(crate) fn hold(&self, memory: Memory) -> HeldRight<'_> {
        let (weights, bias) = (self.weights.hold(memory), memory.hold(&self.bias));
        HeldRight { right: self, weights, bias, added: memory.hold(&self.added) }
    }
}

impl HeldRight<'_> {
    pub(crate) fn product(&self) -> Product<'_> {
        let (rows, stride) = (&self.added[..], self.right.stride);
        Product {
            weights: self.weights.panels(),
            bias: &self.bias,
            depth: self.right.depth,
            columns: self.right.columns,
            relu: self.right.relu,
            residual: match self.right.joins {
                0 => Residual::None,
                1 => Residual::InPlace,
                2 => Residual::Before { rows, stride },
                _ => Residual::After { rows, stride },
            },
        }
    }
}

/// Values from the first of `rows` rows, `stride` apart, to the last one's end.
pub(crate) fn span(rows: usize, stride: usize, columns: usize) -> usize {
    rows.checked_sub(1).map_or(0, |before| before * stride + columns)
}

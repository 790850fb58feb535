//! What the kernels' targets share: shapes and numbers out of bytes, and the comparison of every instruction set with the
//! scalar one.
//!
//! Bytes that run out read as zero. Tensors are exactly as long as a kernel asks for, so that the sanitizer sees a step
//! beyond either end.

use half::f16;
use std::ops::Range;
use voxcast::random::Random;
use voxcast_kernels::panels::packed_len;
use voxcast_kernels::product::{Product, Residual};
use voxcast_kernels::{Isa, Panels};

/// Multiply-adds that one input may take: a fraction of a millisecond of the scalar code.
pub const MAX_WORK: usize = 1 << 16;

/// Numbers that a sum treats in ways of their own.
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

/// Bytes that are read as shapes and numbers.
pub struct Input<'a> {
    bytes: &'a [u8],
    random: Random,
    mode: u8,
}

impl<'a> Input<'a> {
    /// The first two bytes say which numbers are drawn.
    pub fn new(bytes: &'a [u8]) -> Self {
        let mut input = Self { bytes, random: Random::new(0), mode: 0 };
        input.random = Random::new(u64::from(input.byte()));
        input.mode = input.byte() % 4;
        input
    }

    /// The next byte.
    pub fn byte(&mut self) -> u8 {
        let Some((&first, rest)) = self.bytes.split_first() else { return 0 };
        self.bytes = rest;
        first
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

    /// A number: one in four is taken from the bytes as it is, as long as there are any.
    pub fn number(&mut self) -> f32 {
        let bits = self.random.next_u64();
        if bits.is_multiple_of(4)
            && let Some((raw, rest)) = self.bytes.split_first_chunk()
        {
            self.bytes = rest;
            return f32::from_le_bytes(*raw);
        }
        let unit = (bits >> 40) as f32 / (1 << 23) as f32 - 1.0;
        match self.mode {
            0 => unit,
            1 if (bits >> 8).is_multiple_of(16) => SPECIAL[(bits >> 16) as usize % SPECIAL.len()],
            1 => unit,
            2 => (unit * 4.0).round(),
            _ => f32::from_bits((bits >> 32) as u32),
        }
    }

    /// `n` numbers.
    pub fn numbers(&mut self, n: usize) -> Vec<f32> {
        (0..n).map(|_| self.number()).collect()
    }

    /// `n` numbers, if the flag that comes first says so.
    pub fn maybe(&mut self, n: usize) -> Option<Vec<f32>> {
        self.flag().then(|| self.numbers(n))
    }
}

/// Packed weights in either precision.
pub struct Weights {
    single: Vec<f32>,
    half: Option<Vec<f16>>,
}

impl Weights {
    /// `n` of them, the zero columns included.
    pub fn new(input: &mut Input<'_>, n: usize) -> Self {
        let half = input.flag();
        let single = input.numbers(n);
        let half = half.then(|| single.iter().map(|w| f16::from_f32(*w)).collect());
        Self { single, half }
    }

    /// As kernels take them.
    pub fn panels(&self) -> Panels<'_> {
        self.half.as_ref().map_or(Panels::F32(&self.single), |w| Panels::F16(w))
    }
}

/// All of a product but its left matrix.
pub struct Right {
    depth: usize,
    columns: usize,
    weights: Weights,
    bias: Vec<f32>,
    relu: bool,
    joins: u8,
    added: Vec<f32>,
    stride: usize,
}

impl Right {
    /// A product of `rows` rows.
    pub fn new(input: &mut Input<'_>, rows: usize, depth: usize, columns: usize) -> Self {
        let (joins, stride) = (input.byte() % 4, columns + input.extent(0, 3));
        Self {
            depth,
            columns,
            weights: Weights::new(input, packed_len(depth, columns)),
            bias: input.numbers(columns.next_multiple_of(16)),
            relu: input.flag(),
            joins,
            added: if joins > 1 { input.numbers(span(rows, stride, columns)) } else { vec![] },
            stride,
        }
    }

    /// As kernels take it.
    pub fn product(&self) -> Product<'_> {
        let (rows, stride) = (&self.added[..], self.stride);
        Product {
            weights: self.weights.panels(),
            bias: &self.bias,
            depth: self.depth,
            columns: self.columns,
            relu: self.relu,
            residual: match self.joins {
                0 => Residual::None,
                1 => Residual::InPlace,
                2 => Residual::Before { rows, stride },
                _ => Residual::After { rows, stride },
            },
        }
    }
}

/// Numbers from the first of `rows` rows, `stride` apart, to the last one's end.
pub fn span(rows: usize, stride: usize, columns: usize) -> usize {
    rows.checked_sub(1).map_or(0, |before| before * stride + columns)
}

/// Asserts that `kernel`, which writes over `before`, gives the bits of the scalar code on every instruction set. NaN may
/// have any payload.
pub fn every_isa(before: &[f32], kernel: impl Fn(Isa, &mut [f32])) {
    let run = |isa: Isa| {
        let mut out = before.to_vec();
        kernel(isa, &mut out);
        out
    };
    let want = run(Isa::Scalar);
    for isa in Isa::available().filter(|isa| *isa != Isa::Scalar) {
        same(&run(isa), &want, isa.name());
    }
}

/// Asserts equal bits, but for the payload of NaN.
pub fn same(got: &[f32], want: &[f32], what: &str) {
    assert_eq!(got.len(), want.len(), "{what}: lengths");
    for (i, (got, want)) in got.iter().zip(want).enumerate() {
        let same = got.to_bits() == want.to_bits() || (got.is_nan() && want.is_nan());
        assert!(same, "{what}: number {i} is {got:e}, not {want:e}");
    }
}

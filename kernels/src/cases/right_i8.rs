//! The right side of a product of bytes, drawn or for a bench.

use super::bench::bytes;
use super::draw::{Draw, span};
use super::memory::{Held, Memory};
use crate::matmul::int8::layout::{pairs, sums};
use crate::matmul::layout::packed_len;
use crate::matmul::{ProductI8, ResidualI8};
use std::vec;
use std::vec::Vec;

/// Packed weights and what is stored beside them.
pub(crate) struct WeightsI8 {
    depth: usize,
    pub(crate) packed: Vec<i8>,
    pub(crate) sums: Vec<i32>,
    pub(crate) pairs: Vec<u8>,
}

impl WeightsI8 {
    pub(crate) fn new(depth: usize, packed: Vec<i8>) -> Self {
        Self { depth, sums: sums(&packed, depth).collect(), pairs: pairs(&packed, depth).collect(), packed }
    }

    /// `matrices` of `depth` x `columns`, one after the other. Zero columns hold anything.
    pub(crate) fn draw(draw: &mut Draw, depth: usize, columns: usize, matrices: usize) -> Self {
        let n = matrices * packed_len(depth, columns);
        // Half as large, more of them pair.
        let by = if draw.flag() { 2 } else { 1 };
        Self::new(depth, draw.int8s(n).into_iter().map(|w| w.max(-127) / by).collect())
    }

    /// A bench's weights: they pair, as trained ones mostly do.
    pub(crate) fn bench(depth: usize, columns: usize, matrices: usize) -> Self {
        Self::new(depth, bytes(matrices * packed_len(depth, columns)).into_iter().map(|w| w / 2).collect())
    }

    /// The same in `memory`.
    pub(crate) fn hold(&self, memory: Memory) -> HeldWeightsI8 {
        let Self { packed, sums, pairs, .. } = self;
        HeldWeightsI8 { packed: memory.hold(packed), sums: memory.hold(sums), pairs: memory.hold(pairs) }
    }
}

/// [`WeightsI8`] in some memory.
pub(crate) struct HeldWeightsI8 {
    pub(crate) packed: Held<i8>,
    pub(crate) sums: Held<i32>,
    pub(crate) pairs: Held<u8>,
}

/// `n` elements of a left matrix.
pub(crate) fn left(draw: &mut Draw, n: usize, signed: bool) -> Vec<i8> {
    let low = if signed { -127 } else { 0 };
    draw.int8s(n).into_iter().map(|x| x.max(low)).collect()
}

/// One number per column and of the zero columns, from `low` on.
pub(crate) fn padded(draw: &mut Draw, columns: usize, low: i32) -> Vec<i32> {
    (0..columns.next_multiple_of(16)).map(|_| draw.int32()).map(|x| if x < low { !x } else { x }).collect()
}

/// All of a product but its left matrix.
pub(crate) struct RightI8 {
    weights: WeightsI8,
    columns: usize,
    pub(crate) signed: bool,
    relu: bool,
    bias: Vec<i32>,
    multiplier: Vec<i32>,
    joins: u8,
    after: bool,
    joining: Vec<i32>,
    added: Vec<i8>,
    stride: usize,
}

/// [`RightI8`] in some memory.
pub(crate) struct HeldRightI8<'a> {
    right: &'a RightI8,
    weights: HeldWeightsI8,
    bias: Held<i32>,
    multiplier: Held<i32>,
    joining: Held<i32>,
    added: Held<i8>,
}

impl RightI8 {
    /// A product of `rows` rows.
    pub(crate) fn draw(draw: &mut Draw, rows: usize, depth: usize, columns: usize) -> Self {
        let (joins, stride) = (draw.byte() % 3, columns + draw.extent(0, 3));
        Self {
            columns,
            signed: draw.flag(),
            relu: draw.flag(),
            after: draw.flag(),
            weights: WeightsI8::draw(draw, depth, columns, 1),
            bias: padded(draw, columns, i32::MIN),
            multiplier: padded(draw, columns, 0),
            joining: padded(draw, columns, i32::MIN),
            added: if joins > 1 { left(draw, span(rows, stride, columns), true) } else { vec![] },
            joins,
            stride,
        }
    }

    /// A bench's product of `depth` x `columns`: ReLU and no residual.
    pub(crate) fn bench(depth: usize, columns: usize, signed: bool) -> Self {
        let padded = columns.next_multiple_of(16);
        Self {
            weights: WeightsI8::bench(depth, columns, 1),
            columns,
            signed,
            relu: true,
            bias: vec![1000; padded],
            multiplier: vec![1 << 20; padded],
            joins: 0,
            after: false,
            joining: vec![],
            added: vec![],
            stride: columns,
        }
    }

    /// Bytes of the weights.
    pub(crate) fn bytes(&self) -> usize {
        self.weights.packed.len()
    }

    pub(crate) fn hold(&self, memory: Memory) -> HeldRightI8<'_> {
        HeldRightI8 {
            right: self,
            weights: self.weights.hold(memory),
            bias: memory.hold(&self.bias),
            multiplier: memory.hold(&self.multiplier),
            joining: memory.hold(&self.joining),
            added: memory.hold(&self.added),
        }
    }

    /// Where it lies.
    pub(crate) fn product(&self) -> ProductI8<'_> {
        let Self { columns, signed, relu, ref bias, ref multiplier, .. } = *self;
        let WeightsI8 { depth, ref packed, ref sums, ref pairs } = self.weights;
        ProductI8 {
            weights: packed,
            sums,
            pairs,
            bias,
            depth,
            columns,
            signed,
            relu,
            residual: self.residual(&self.joining, &self.added),
            multiplier,
        }
    }

    fn residual<'a>(&self, multiplier: &'a [i32], rows: &'a [i8]) -> ResidualI8<'a> {
        let Self { after, stride, .. } = *self;
        match self.joins {
            0 => ResidualI8::None,
            1 => ResidualI8::InPlace { multiplier, after },
            _ => ResidualI8::Apart { rows, stride, multiplier, after },
        }
    }
}

impl HeldRightI8<'_> {
    pub(crate) fn product(&self) -> ProductI8<'_> {
        ProductI8 {
            weights: &self.weights.packed,
            sums: &self.weights.sums,
            pairs: &self.weights.pairs,
            bias: &self.bias,
            multiplier: &self.multiplier,
            residual: self.right.residual(&self.joining, &self.added),
            ..self.right.product()
        }
    }
}

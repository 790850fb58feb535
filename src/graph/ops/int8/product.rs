//! What integer products have in common: stored parts, how they follow from the weights, and what is proved of them.

use super::columns::{Column, Steps};
use super::integers;
use crate::base::error::Result;
use crate::graph::call::{Added, Call};
use crate::graph::element::{Element, Elements};
use crate::graph::parts::Part;
use crate::graph::weights::{Span, Values};
use voxcast_kernels::LANES;
use voxcast_kernels::matmul::int8::layout::{self, GROUP, packed_index};
use voxcast_kernels::matmul::int8::scratch_len;
use voxcast_kernels::matmul::layout::packed_len;
use voxcast_kernels::matmul::{ProductI8, ResidualI8};

/// The order of a product's parts.
pub(super) const WEIGHTS: usize = 0;
pub(super) const SUMS: usize = 1;
pub(super) const PAIRS: usize = 2;
pub(super) const BIAS: usize = 3;
pub(super) const MULTIPLIER: usize = 4;
/// The residual's multipliers, where there is one.
pub(super) const RESIDUAL: usize = 5;
/// Parts of a product without residual.
pub(super) const PARTS: usize = RESIDUAL;

/// Weights, what is known of them, bias and multipliers of products of `depth` x `columns`, `panels` of them with weights of
/// their own; the residual's multipliers if it has one. The panels' weights, sums and pairs follow each other.
pub(super) fn parts(panels: usize, depth: usize, columns: usize, residual: bool) -> Vec<Part> {
    let padded = columns.next_multiple_of(LANES);
    let mut parts = vec![
        Part::of(Element::I8, "weight", panels * packed_len(depth, columns)),
        integers("sums", panels * padded),
        Part::of(Element::U8, "pairs", panels * padded / LANES),
        integers("bias", padded),
        integers("multiplier", padded),
    ];
    if residual {
        parts.push(integers("residual", padded));
    }
    parts
}

/// Bytes of scratch of a product.
pub(super) fn scratch(depth: usize, columns: usize) -> usize {
    scratch_len(depth, columns) * size_of::<i32>()
}

/// The values of [`parts`]. The weights of a column are those of its first panel, then of the next.
pub(super) fn values(panels: usize, columns: &[Column], residual: bool) -> Vec<Values> {
    let depth = columns[0].weights.len() / panels;
    let len = packed_len(depth, columns.len());
    let mut packed = vec![0i8; panels * len];
    for (n, column) in columns.iter().enumerate() {
        for (k, &weight) in column.weights.iter().enumerate() {
            packed[k / depth * len + packed_index(depth, k % depth, n)] = weight as i8;
        }
    }
    let each = |f: fn(&Column) -> f64| {
        let mut values: Values = columns.iter().map(f).collect();
        values.resize(columns.len().next_multiple_of(LANES), 0.0);
        values
    };
    let sums = packed.chunks_exact(len).flat_map(|packed| layout::sums(packed, depth)).map(f64::from).collect();
    let pairs = packed.chunks_exact(len).flat_map(|packed| layout::pairs(packed, depth)).map(f64::from).collect();
    let weights = packed.iter().copied().map(f64::from).collect();
    let mut values = vec![weights, sums, pairs, each(|c| c.bias), each(|c| c.multiplier)];
    if residual {
        values.push(each(|c| c.residual));
    }
    values
}

/// The columns of `dense` weights, `[outputs, inputs, taps]` in the checkpoint's order, with zeros to a multiple
/// of [`GROUP`].
pub(super) fn columns(
    weight: &[f64],
    bias: &[f64],
    inputs: usize,
    column: impl Fn(usize, &[f64], f64) -> Result<Column>,
) -> Result<Vec<Column>> {
    let depth = weight.len() / bias.len();
    let taps = depth / inputs;
    let mut ordered = vec![0.0; depth.next_multiple_of(GROUP)];
    let columns = weight.chunks_exact(depth).zip(bias).enumerate().map(|(n, (weight, &bias))| {
        for (i, &w) in weight.iter().enumerate() {
            ordered[i % taps * inputs + i / taps] = w;
        }
        column(n, &ordered, bias)
    });
    columns.collect()
}

/// The finest step of an output to which sums of columns of these spans can be brought.
pub(super) fn finest(steps: Steps, spans: &[Span]) -> f64 {
    spans.iter().map(|&span| steps.finest(span)).fold(0.0, f64::max)
}

/// Checks what kernels take for granted of [`values`].
pub(super) fn verify(depth: usize, columns: usize, parts: &[Elements<'_>]) -> std::result::Result<(), String> {
    verify_multipliers(&parts[MULTIPLIER])?;
    verify_weights(depth, columns, parts)
}

/// Checks multipliers.
pub(super) fn verify_multipliers(part: &Elements<'_>) -> std::result::Result<(), String> {
    super::within(part, "multiplier", 0..=i32::MAX)
}

/// Checks weights, what is declared of them, and that no sum can leave i32.
pub(super) fn verify_weights(depth: usize, columns: usize, parts: &[Elements<'_>]) -> std::result::Result<(), String> {
    let len = packed_len(depth, columns);
    let weights: &[i8] = parts[WEIGHTS].of();
    if let Some(at) = weights.iter().position(|w| *w == i8::MIN) {
        return Err(format!("weight [{at}] is -128, expected -127 to 127"));
    }
    let sums = weights.chunks_exact(len).flat_map(|weights| layout::sums(weights, depth));
    check_equal("sums", sums, parts[SUMS].of())?;
    let pairs = weights.chunks_exact(len).flat_map(|weights| layout::pairs(weights, depth));
    check_equal("pairs", pairs, parts[PAIRS].of())?;
    let residual = parts.get(RESIDUAL).map(|part| part.of::<i32>());
    for weights in weights.chunks_exact(len) {
        layout::fits(weights, depth, columns, parts[BIAS].of(), residual).map_err(|overflow| {
            format!("column {}: its sum may reach {}, expected at most {}", overflow.column, overflow.bound, i32::MAX)
        })?;
    }
    Ok(())
}

/// Checks that what is declared of weights is what follows from them.
fn check_equal<T: PartialEq + std::fmt::Display>(
    what: &str,
    expected: impl Iterator<Item = T>,
    declared: &[T],
) -> std::result::Result<(), String> {
    let differs = expected.zip(declared).enumerate().find(|(_, (expected, declared))| expected != *declared);
    differs.map_or(Ok(()), |(at, (expected, declared))| {
        Err(format!("{what} [{at}]: found {declared}, the weights give {expected}"))
    })
}

/// The right matrix, with the residual as the kernel takes it.
pub(super) fn product<'a>(call: &Call<'a>, depth: usize, signed: bool) -> ProductI8<'a> {
    ProductI8 {
        weights: call.part(WEIGHTS),
        sums: call.part(SUMS),
        pairs: call.part(PAIRS),
        bias: call.part(BIAS),
        depth,
        columns: call.site.channels,
        signed,
        relu: call.site.relu,
        residual: residual(call),
        multiplier: call.part(MULTIPLIER),
    }
}

fn residual<'a>(call: &Call<'a>) -> ResidualI8<'a> {
    match call.added {
        Added::Nothing => ResidualI8::None,
        Added::InPlace => ResidualI8::InPlace { multiplier: call.part(RESIDUAL), after: false },
        Added::Apart { elements, after } => {
            // A residual has the shape of the output.
            let stride = call.site.output().channels;
            ResidualI8::Apart { rows: elements.of(), stride, multiplier: call.part(RESIDUAL), after }
        }
    }
}

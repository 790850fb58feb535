//! The operations that read and write 8-bit integers, and the conversions where floating point begins and ends.
//!
//! Sums are exact; [`voxcast_kernels::quantised`] has the rules that all share. What a description stores are the integers
//! that its kernel reads. They follow from the weights and from the scales of the tensors that the operation reads and
//! writes, in f64, once, at import.

mod broadcast;
mod columns;
mod conv;
mod convert;
mod deconv;
mod deform_conv;
mod depthwise;
mod gate;
mod gather;
mod global_mean;
mod head;
mod max_pool;
mod normalise;
mod product;
mod upsample_add;

pub use broadcast::BroadcastI8;
pub use conv::ConvI8;
pub use convert::{Dequantise, Quantise};
pub use deconv::DeconvI8;
pub use deform_conv::DeformConvI8;
pub use depthwise::DepthwiseI8;
pub use gate::GateI8;
pub use gather::GatherI8;
pub use global_mean::GlobalMeanI8;
pub use head::HeadI8;
pub use max_pool::MaxPoolI8;
pub use normalise::NormaliseI8;
pub use upsample_add::UpsampleAddI8;

use crate::graph::element::{Element, Elements};
use crate::graph::parts::Part;
use crate::graph::tensor::Tensor;

/// What one step of a tensor's elements is.
///
/// # Panics
/// If it has no scale: the rewrite gives one to every `i8` tensor.
fn step(tensor: &Tensor) -> f64 {
    tensor.scale.expect("the rewrite scales i8 tensors").wide()
}

/// `2^bits * step / of step`, rounded: a factor in fixed point from one tensor's scale to another's.
fn factor(from: &Tensor, to: &Tensor, bits: u32) -> f64 {
    (power(bits) * (step(from) / step(to))).round()
}

/// `2^bits`.
fn power(bits: u32) -> f64 {
    (1u64 << bits) as f64
}

/// One part of a few integers.
fn integers(suffix: &'static str, len: usize) -> Part {
    Part::of(Element::I32, suffix, len)
}

/// Checks that every element of a stored part lies in `range`.
fn within(part: &Elements<'_>, what: &str, range: std::ops::RangeInclusive<i32>) -> Result<(), String> {
    let bad = part.of::<i32>().iter().find(|value| !range.contains(value));
    bad.map_or(Ok(()), |value| Err(format!("{what}: found {value}, expected {} to {}", range.start(), range.end())))
}

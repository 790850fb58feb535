//! Fusion of an 8-bit volume with its bird's-eye view.

use super::columns::Steps;
use super::{factor, integers, step};
use crate::base::error::Result;
use crate::graph::call::{Call, Tile};
use crate::graph::element::{Element, Elements};
use crate::graph::ops::description::{Description, Machine, ROWS, wide};
use crate::graph::parts::Part;
use crate::graph::recipe::Recipe;
use crate::graph::site::Site;
use crate::graph::weights::{Values, Weights, padded};
use voxcast_kernels::LANES;
use voxcast_kernels::gate_i8::{FRACTION, GateI8 as Kernel, MAX_FACTORS, gate_i8};

/// Step of the gate's logit.
const LOGIT: f64 = 1.0 / 64.0;
/// Bits behind the point that the gate itself brings to the bird's-eye view's factor.
const GATE_BITS: u32 = 10;

/// [`voxcast_kernels::gate_i8`]: volume (in place), bird's-eye view.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GateI8;

impl GateI8 {
    /// By how much the step of what is read may exceed that of the output.
    pub const MOST_RATIO: f64 = 4.0;
}

impl Description for GateI8 {
    fn kind(&self) -> &'static str {
        "gate i8"
    }

    fn in_place(&self) -> Option<usize> {
        Some(0)
    }

    fn parts(&self, site: &Site<'_>) -> Vec<Part> {
        let weight = Part::of(Element::I8, "weight", site.channels.next_multiple_of(LANES));
        vec![weight, integers("logit", 2), integers("factors", 2)]
    }

    fn evaluate(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Values>> {
        let Recipe::Conv(names) = site.recipe else { unreachable!("one convolution, not {:?}", site.recipe) };
        let dense = weights.dense(names, &[1, site.channels, 1, 1, 1], 1)?;
        let steps = Steps { input: step(site.input(0)), output: LOGIT, residual: None };
        let column = steps.column(&dense.weight, dense.bias[0])?;
        let factors = [(0, FRACTION), (1, FRACTION - GATE_BITS)];
        let factors = factors.map(|(input, bits)| factor(site.input(input), site.output(), bits));
        Ok(vec![padded(column.weights), vec![column.bias, column.multiplier], factors.into()])
    }

    fn verify(&self, _: &Site<'_>, parts: &[Elements<'_>]) -> std::result::Result<(), String> {
        let (weights, logit): (&[i8], &[i32]) = (parts[0].of(), parts[1].of());
        if let Some(at) = weights.iter().position(|w| *w == i8::MIN) {
            return Err(format!("weight [{at}] is -128, expected -127 to 127"));
        }
        let magnitudes: i64 = weights.iter().map(|w| i64::from(w.unsigned_abs())).sum();
        let bound = i64::from(logit[0].unsigned_abs()) + 127 * magnitudes;
        if bound > i64::from(i32::MAX) {
            return Err(format!("the logit's sum may reach {bound}, expected at most {}", i32::MAX));
        }
        if logit[1] < 0 {
            return Err(format!("multiplier: found {}, expected 0 to {}", logit[1], i32::MAX));
        }
        let factors: &[i32] = parts[2].of();
        let bad = factors.iter().zip(MAX_FACTORS).find(|(factor, most)| !(0..=*most).contains(*factor));
        bad.map_or(Ok(()), |(factor, most)| Err(format!("factor: found {factor}, expected 0 to {most}")))
    }

    fn multiply_adds(&self, site: &Site<'_>) -> u128 {
        wide(site.rows()) * wide(site.channels)
    }

    /// Whole columns.
    fn tile(&self, site: &Site<'_>, _: Machine) -> usize {
        let depth = site.output().extent[2];
        ROWS.div_ceil(depth) * depth
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let (depth, channels) = (call.site.output().extent[2], call.site.channels);
        let [start, end] = [tile.positions.start, tile.positions.end].map(|p| p / depth * channels);
        let (logit, factors) = (call.part::<i32>(1), call.part::<i32>(2));
        let args = Kernel {
            bev: &call.input(1)[start..end],
            depth,
            channels,
            weights: call.part(0),
            bias: logit[0],
            multiplier: logit[1],
            factors: [factors[0], factors[1]],
        };
        gate_i8(call.isa, &args, tile.output(0));
    }
}

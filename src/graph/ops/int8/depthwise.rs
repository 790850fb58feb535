//! Depthwise convolution of an 8-bit plane.

use super::columns::{Column, Steps};
use super::{integers, product, within};
use crate::base::error::Result;
use crate::graph::call::{Call, Tile};
use crate::graph::element::{Element, Elements};
use crate::graph::ops::description::{Description, Machine, whole_lines, wide};
use crate::graph::parts::Part;
use crate::graph::recipe::Recipe;
use crate::graph::site::Site;
use crate::graph::weights::{Dense, Span, Values, Weights, packed_taps, padded};
use voxcast_kernels::LANES;
use voxcast_kernels::depthwise::Depthwise;
use voxcast_kernels::depthwise_i8::{DepthwiseI8 as Kernel, depthwise_i8};

/// [`voxcast_kernels::depthwise_i8`]: x, which is also the residual where there is one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DepthwiseI8 {
    /// Taps along height and width.
    pub side: usize,
}

impl DepthwiseI8 {
    fn dense(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Dense> {
        let Recipe::Conv(names) = site.recipe else { unreachable!("one convolution, not {:?}", site.recipe) };
        weights.dense(names, &[site.channels, 1, self.side, self.side], site.channels)
    }
}

impl Description for DepthwiseI8 {
    fn kind(&self) -> &'static str {
        "depthwise i8"
    }

    fn parts(&self, site: &Site<'_>) -> Vec<Part> {
        let padded = site.channels.next_multiple_of(LANES);
        let mut parts = vec![
            Part::of(Element::I8, "weight", self.side * self.side * padded),
            integers("bias", padded),
            integers("multiplier", padded),
        ];
        if site.residual.is_some() {
            parts.push(integers("residual", padded));
        }
        parts
    }

    fn evaluate(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Values>> {
        let (taps, channels) = (self.side * self.side, site.channels);
        let dense = self.dense(site, weights)?;
        let steps = Steps::of(site);
        let columns =
            dense.weight.chunks_exact(taps).zip(&dense.bias).map(|(weight, &bias)| steps.column(weight, bias));
        let columns: Vec<Column> = columns.collect::<Result<_>>()?;
        let each = |f: fn(&Column) -> f64| padded(columns.iter().map(f).collect());
        let weight: Values = columns.iter().flat_map(|c| c.weights.iter().copied()).collect();
        let mut values = vec![packed_taps(&weight, taps, channels), each(|c| c.bias), each(|c| c.multiplier)];
        if site.residual.is_some() {
            values.push(each(|c| c.residual));
        }
        Ok(values)
    }

    fn spans(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Span>> {
        Ok(self.dense(site, weights)?.spans())
    }

    fn finest(&self, site: &Site<'_>, spans: &[Span]) -> f64 {
        product::finest(Steps::of(site), spans)
    }

    fn verify(&self, site: &Site<'_>, parts: &[Elements<'_>]) -> std::result::Result<(), String> {
        let padded = site.channels.next_multiple_of(LANES);
        let weights: &[i8] = parts[0].of();
        if let Some(at) = weights.iter().position(|w| *w == i8::MIN) {
            return Err(format!("weight [{at}] is -128, expected -127 to 127"));
        }
        within(&parts[2], "multiplier", 0..=i32::MAX)?;
        for channel in 0..site.channels {
            let taps = weights.iter().skip(channel).step_by(padded).map(|w| i64::from(w.unsigned_abs()));
            let joins = parts.get(3).map_or(0, |part| i64::from(part.of::<i32>()[channel].unsigned_abs()));
            let bound = i64::from(parts[1].of::<i32>()[channel].unsigned_abs()) + 127 * (taps.sum::<i64>() + joins);
            if bound > i64::from(i32::MAX) {
                return Err(format!("channel {channel}: its sum may reach {bound}, expected at most {}", i32::MAX));
            }
        }
        Ok(())
    }

    fn multiply_adds(&self, site: &Site<'_>) -> u128 {
        wide(site.rows()) * wide(self.side * self.side) * wide(site.channels)
    }

    fn tile(&self, site: &Site<'_>, machine: Machine) -> usize {
        whole_lines(site, site.output().extent[1], machine)
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let [_, height, width] = call.site.output().extent;
        let convolution = Depthwise {
            input: call.input(0),
            height,
            width,
            channels: call.site.channels,
            kernel: self.side,
            weights: call.part(0),
            bias: call.part(1),
            residual: call.site.residual.is_some(),
        };
        let residual = if convolution.residual { call.part(3) } else { &[] };
        let args = Kernel { convolution, residual, multiplier: call.part(2) };
        let rows = tile.positions.start / width..tile.positions.end / width;
        depthwise_i8(call.isa, &args, rows, tile.output(0));
    }
}

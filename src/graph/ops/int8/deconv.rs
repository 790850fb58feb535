//! Transposed convolution that doubles an 8-bit volume.

use super::columns::{Column, Steps};
use super::product::{self, BIAS, MULTIPLIER, PAIRS, RESIDUAL, SUMS, WEIGHTS};
use crate::base::error::Result;
use crate::graph::call::{Added, Call, Tile};
use crate::graph::element::Elements;
use crate::graph::ops::deconv::{TAPS, folded};
use crate::graph::ops::description::{Description, Machine, whole_lines, wide};
use crate::graph::parts::Part;
use crate::graph::site::Site;
use crate::graph::weights::{Span, Values, Weights};
use voxcast_kernels::deconv3d_i8::{Deconv3dI8 as Kernel, deconv3d_i8};

/// [`voxcast_kernels::deconv3d_i8`]: x. A residual is added after the ReLU.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeconvI8 {
    /// Whether x may be negative.
    pub signed: bool,
}

/// Products of one output.
fn depth(site: &Site<'_>) -> usize {
    TAPS * site.input(0).channels
}

/// The weights of output channel `n`. All eight parities have one scale, so that they can have one bias.
fn column(site: &Site<'_>, weight: &impl Fn(usize, usize, usize) -> f64, n: usize) -> Values {
    let column = (0..TAPS).flat_map(|parity| (0..depth(site)).map(move |k| (parity, k)));
    column.map(|(parity, k)| weight(parity, k, n)).collect()
}

impl Description for DeconvI8 {
    fn kind(&self) -> &'static str {
        "deconv3d i8"
    }

    fn parts(&self, site: &Site<'_>) -> Vec<Part> {
        product::parts(TAPS, depth(site), site.channels, site.residual.is_some())
    }

    fn evaluate(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Values>> {
        let (weight, bias) = folded(site, weights)?;
        let steps = Steps::of(site);
        let columns = (0..site.channels).map(|n| steps.column(&column(site, &weight, n), bias[n]));
        let columns: Vec<Column> = columns.collect::<Result<_>>()?;
        Ok(product::values(TAPS, &columns, site.residual.is_some()))
    }

    fn spans(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Span>> {
        let (weight, bias) = folded(site, weights)?;
        Ok((0..site.channels).map(|n| Span::of(&column(site, &weight, n), bias[n])).collect())
    }

    fn finest(&self, site: &Site<'_>, spans: &[Span]) -> f64 {
        product::finest(Steps::of(site), spans)
    }

    fn verify(&self, site: &Site<'_>, parts: &[Elements<'_>]) -> std::result::Result<(), String> {
        product::verify(depth(site), site.channels, parts)
    }

    fn scratch(&self, site: &Site<'_>) -> usize {
        product::scratch(depth(site), site.channels)
    }

    fn multiply_adds(&self, site: &Site<'_>) -> u128 {
        wide(site.rows()) * wide(depth(site)) * wide(site.channels)
    }

    fn tile(&self, site: &Site<'_>, machine: Machine) -> usize {
        whole_lines(site, site.output().extent[0], machine)
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let x = call.site.input(0);
        let args = Kernel {
            extent: x.extent,
            channels: x.channels,
            columns: call.site.channels,
            input: call.input(0),
            signed: self.signed,
            weights: call.part(WEIGHTS),
            sums: call.part(SUMS),
            pairs: call.part(PAIRS),
            bias: call.part(BIAS),
            relu: call.site.relu,
            add: match call.added {
                Added::Nothing => None,
                Added::Apart { elements, after: true } => Some((elements.of(), call.part(RESIDUAL))),
                other => unreachable!("a residual after the ReLU, not {other:?}"),
            },
            multiplier: call.part(MULTIPLIER),
        };
        let [_, y, z] = call.site.output().extent;
        let planes = tile.positions.start / (y * z)..tile.positions.end / (y * z);
        deconv3d_i8(call.isa, &args, planes, tile.output(0), tile.scratch());
    }
}

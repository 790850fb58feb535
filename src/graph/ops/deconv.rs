//! Transposed convolution that doubles a volume.

use super::description::{Description, Machine, Shader, whole_lines, wide};
use super::product::SCRATCH_BYTES;
use crate::base::error::Result;
use crate::graph::call::{Added, Call, Tile};
use crate::graph::parts::Part;
use crate::graph::recipe::Recipe;
use crate::graph::site::Site;
use crate::graph::weights::{Values, Weights, packed_by, padded};
use voxcast_kernels::LANES;
use voxcast_kernels::deconv3d::{Deconv3d, deconv3d, kernel_tap};
use voxcast_kernels::panels::packed_len;

/// Taps per axis of the kernel.
const SIDE: usize = 4;
/// Taps that an output of one parity meets, of two per axis; there are as many parities.
pub(super) const TAPS: usize = 8;

/// [`voxcast_kernels::deconv3d`]: x. A residual is added after the ReLU.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Deconv;

/// Element (k, n) of the matrix of a parity, k running over (tap, input), by parity, k and n; and the bias.
pub(super) fn folded(
    site: &Site<'_>,
    weights: &Weights<'_>,
) -> Result<(impl Fn(usize, usize, usize) -> f64 + use<>, Values)> {
    let Recipe::Conv(names) = site.recipe else { unreachable!("one convolution, not {:?}", site.recipe) };
    let (inputs, outputs) = (site.input(0).channels, site.channels);
    let raw = weights.tensor(&format!("{}.weight", names.prefix), &[inputs, outputs, SIDE, SIDE, SIDE])?;
    let mut bias = weights.tensor(&format!("{}.bias", names.prefix), &[outputs])?;
    let scale = weights.fold(names, &mut bias)?;
    let weight = move |parity: usize, k: usize, n: usize| {
        let (tap, c) = (k / inputs, k % inputs);
        let at = (0..3).fold(c * outputs + n, |at, axis| {
            let bit = 2 - axis;
            at * SIDE + kernel_tap(parity >> bit & 1, tap >> bit & 1)
        });
        raw[at] * scale[n]
    };
    Ok((weight, bias))
}

impl Description for Deconv {
    fn kind(&self) -> &'static str {
        "deconv3d"
    }

    fn parts(&self, site: &Site<'_>) -> Vec<Part> {
        let (inputs, outputs) = (site.input(0).channels, site.channels);
        let weight = TAPS * packed_len(TAPS * inputs, outputs);
        vec![Part::panels("weight", weight), Part::plain("bias", outputs.next_multiple_of(LANES))]
    }

    fn evaluate(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Values>> {
        let (inputs, outputs) = (site.input(0).channels, site.channels);
        let (folded, bias) = folded(site, weights)?;
        let weight = (0..TAPS).flat_map(|parity| packed_by(TAPS * inputs, outputs, |k, n| folded(parity, k, n)));
        Ok(vec![weight.collect(), padded(bias)])
    }

    fn scratch(&self, _: &Site<'_>) -> usize {
        SCRATCH_BYTES
    }

    fn multiply_adds(&self, site: &Site<'_>) -> u128 {
        wide(site.rows()) * wide(TAPS * site.input(0).channels) * wide(site.channels)
    }

    fn tile(&self, site: &Site<'_>, machine: Machine) -> usize {
        whole_lines(site, site.output().extent[0], machine)
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let x = call.site.input(0);
        let args = Deconv3d {
            extent: x.extent,
            channels: x.channels,
            columns: call.site.channels,
            input: call.input(0),
            weights: call.parts[0].panels(),
            bias: call.part(1),
            relu: call.site.relu,
            add: match call.added {
                Added::Nothing => None,
                Added::Apart { elements, after: true } => Some(elements.of()),
                other => unreachable!("a residual after the ReLU, not {other:?}"),
            },
        };
        let [_, y, z] = call.site.output().extent;
        let planes = tile.positions.start / (y * z)..tile.positions.end / (y * z);
        deconv3d(call.isa, &args, planes, tile.output(0), tile.scratch());
    }

    fn shader(&self, site: &Site<'_>) -> Option<Shader> {
        let Recipe::Conv(names) = site.recipe else { return None };
        let (x, outputs) = (site.input(0), site.channels);
        let [a, b, c] = x.extent;
        let weight = (Some(format!("{}.weight", names.prefix)), vec![x.channels, outputs, SIDE, SIDE, SIDE]);
        let bias = (Some(format!("{}.bias", names.prefix)), vec![outputs]);
        Some(Shader { name: "deconv", shape: vec![x.channels, outputs, 0, 0, a, b, c, 0], weights: vec![weight, bias] })
    }
}

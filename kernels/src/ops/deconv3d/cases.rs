//! [`super::deconv3d()`] with any arguments, and at the network's shapes.

use super::{Deconv3d, deconv3d};
use crate::cases::{Bench, Case, Draw, Memory, Output, Weights, values};
use crate::isa::Isa;
use crate::matmul::layout::packed_len;
use crate::matmul::{Panels, SCRATCH};
use std::ops::Range;
use std::vec;
use std::vec::Vec;

struct Call {
    extent: [usize; 3],
    channels: usize,
    columns: usize,
    planes: Range<usize>,
    input: Vec<f32>,
    weights: Weights,
    bias: Vec<f32>,
    relu: bool,
    add: Option<Vec<f32>>,
}

impl Call {
    fn plane(&self) -> usize {
        4 * self.extent[1] * self.extent[2] * self.columns
    }
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let extent: [usize; 3] = core::array::from_fn(|_| draw.extent(1, 6));
    let channels = draw.extent(1, 40);
    let voxels = extent.iter().product::<usize>();
    let columns = draw.columns(voxels * channels * 64)?;
    Some(Call {
        extent,
        channels,
        columns,
        planes: draw.rows(2 * extent[0]),
        weights: Weights::draw(draw, 8 * packed_len(8 * channels, columns)),
        input: draw.values(voxels * channels),
        bias: draw.values(columns.next_multiple_of(16)),
        relu: draw.flag(),
        add: draw.maybe(8 * voxels * columns),
    })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let (input, weights, bias) = (memory.hold(&self.input), self.weights.hold(memory), memory.hold(&self.bias));
        let add = self.add.as_ref().map(|add| memory.hold(add));
        let mut out = memory.filled(self.planes.len() * self.plane(), f32::NAN);
        let mut scratch = memory.filled(SCRATCH, f32::NAN);
        let args = Deconv3d {
            extent: self.extent,
            channels: self.channels,
            columns: self.columns,
            input: &input,
            weights: weights.panels(),
            bias: &bias,
            relu: self.relu,
            add: add.as_deref(),
        };
        deconv3d(isa, &args, self.planes.clone(), &mut out, &mut scratch);
        Output::from(&out[..])
    }
}

/// The last transposed convolution of `nuscenes-200`.
pub(crate) fn benches() -> Vec<Bench> {
    let (extent, channels, columns): (_, usize, usize) = ([100, 100, 8], 64, 32);
    let [d, h, w] = extent;
    let (input, bias) = (values(d * h * w * channels, 1.0), values(columns.next_multiple_of(16), 1.0));
    let weights = values(8 * packed_len(8 * channels, columns), 1.0 / channels as f32);
    let mut scratch = values(SCRATCH, 0.0);
    let (plane, read) = (4 * h * w * columns, 4 * (input.len() + weights.len()));
    vec![Bench::new("up1 64-32", [2 * d, plane], plane * 8 * channels, read, move |isa, planes, out| {
        let args = Deconv3d {
            extent,
            channels,
            columns,
            input: &input,
            weights: Panels::F32(&weights),
            bias: &bias,
            relu: true,
            add: None,
        };
        deconv3d(isa, &args, planes, out, &mut scratch);
    })]
}

//! [`super::gather()`] with any arguments, and at the network's shapes.

use super::{Gather, Mask, gather};
use crate::cases::{Bench, Case, Draw, Exact, Memory, Output, values};
use crate::isa::Isa;
use std::ops::Range;
use std::vec;
use std::vec::Vec;

struct Call {
    per_camera: usize,
    masked: Option<Vec<bool>>,
    ptr: Vec<u32>,
    col: Vec<u32>,
    stride: usize,
    first_channel: usize,
    channels: usize,
    rows: Range<usize>,
    relu: bool,
    features: Vec<f32>,
    bias: Option<Vec<f32>>,
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let (cameras, per_camera) = (draw.extent(1, 5), draw.extent(1, 8));
    let (pixels, channels, first_channel) = (cameras * per_camera, draw.extent(0, 150), draw.extent(0, 5));
    let stride = first_channel + channels + draw.extent(0, 3);
    let mut ptr = vec![0];
    for _ in 0..draw.extent(0, 12) {
        ptr.push(ptr[ptr.len() - 1] + u32::from(draw.byte()) % 20);
    }
    let mut col: Vec<u32> = (0..ptr[ptr.len() - 1]).map(|_| draw.extent(0, pixels - 1) as u32).collect();
    let masked: Vec<bool> = (0..cameras).map(|_| draw.flag()).collect();
    let masked = draw.flag().then_some(masked);
    if masked.is_some() {
        ptr.windows(2).for_each(|row| col[row[0] as usize..row[1] as usize].sort_unstable());
    }
    Some(Call {
        per_camera,
        masked,
        stride,
        first_channel,
        channels,
        rows: draw.rows(ptr.len() - 1),
        relu: draw.flag(),
        features: draw.values(pixels * stride),
        bias: draw.maybe(channels),
        ptr,
        col,
    })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let [ptr, col] = [&self.ptr, &self.col].map(|x| memory.hold(x));
        let masked = self.masked.as_ref().map(|masked| memory.hold(masked));
        let features = memory.hold(&self.features);
        let bias = self.bias.as_ref().map(|bias| memory.hold(bias));
        let mut out = memory.filled(self.rows.len() * self.channels, f32::NAN);
        let args = Gather {
            ptr: &ptr,
            col: &col,
            mask: masked.as_ref().map(|masked| Mask { pixels: self.per_camera, masked }),
            features: &features,
            stride: self.stride,
            first_channel: self.first_channel,
            channels: self.channels,
            bias: bias.as_deref(),
            relu: self.relu,
        };
        gather(isa, &args, self.rows.clone(), &mut out);
        Output::from(&out[..])
    }

    fn exact(&self) -> Option<Exact> {
        let kept = |col: &&u32| self.masked.as_ref().is_none_or(|m| !m[**col as usize / self.per_camera]);
        let mut values = Vec::new();
        for row in self.rows.clone() {
            let cols = &self.col[self.ptr[row] as usize..self.ptr[row + 1] as usize];
            let pixels: Vec<usize> = cols.iter().filter(kept).map(|&col| col as usize).collect();
            for c in 0..self.channels {
                let feature = |pixel: &usize| f64::from(self.features[pixel * self.stride + self.first_channel + c]);
                let mean = pixels.iter().map(feature).sum::<f64>() / pixels.len().max(1) as f64;
                let value = mean + self.bias.as_ref().map_or(0.0, |bias| f64::from(bias[c]));
                values.push(if self.relu { value.max(0.0) } else { value });
            }
        }
        Some(Exact { values, tolerance: 1e-6 })
    }
}

/// The volume gather of level 1 of `nuscenes-200`, six cameras: 27 entries a row. As two thirds of a real rig's entries
/// follow their predecessor, rows are made of runs of three neighbours.
pub(crate) fn benches() -> Vec<Bench> {
    let (pixels, stride, rows, channels, entries) = (6 * 116 * 200, 128, 100 * 100 * 8, 64, 27);
    // Rows along a ray see almost the same pixels: starts move slowly with the row, and by a line of the image within it.
    let entry = |row: usize, i: usize| ((row * 7 / 4 + i / 3 * 200 + i % 3) % pixels) as u32;
    let ptr: Vec<u32> = (0..=rows).map(|row| (row * entries) as u32).collect();
    let col: Vec<u32> = (0..rows).flat_map(|row| (0..entries).map(move |i| entry(row, i))).collect();
    let (features, bias) = (values(pixels * stride, 1.0), values(channels, 1.0));
    let read = 4 * (col.len() + pixels * channels);
    vec![Bench::new("level1 volume", [rows, channels], entries * channels, read, move |isa, rows, out| {
        let args = Gather {
            ptr: &ptr,
            col: &col,
            mask: None,
            features: &features,
            stride,
            first_channel: 0,
            channels,
            bias: Some(&bias),
            relu: true,
        };
        gather(isa, &args, rows, out);
    })]
}

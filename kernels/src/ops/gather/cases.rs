//! [`super::gather()`] with any arguments, and at the network's shapes.

use super::{Gather, Mask, gather};
use crate::cases::{Bench, Case, Draw, Exact, Memory, Output, values};
use crate::isa::Isa;
use std::ops::Range;
use std::vec;
use std::vec::Vec;

/// All but the features and the bias, whatever their type.
pub(crate) struct Entries {
    pub(crate) per_camera: usize,
    pub(crate) masked: Option<Vec<bool>>,
    pub(crate) ptr: Vec<u32>,
    pub(crate) col: Vec<u32>,
    pub(crate) pixels: usize,
    pub(crate) stride: usize,
    pub(crate) first_channel: usize,
    pub(crate) channels: usize,
    pub(crate) rows: Range<usize>,
    pub(crate) relu: bool,
}

impl Entries {
    pub(crate) fn draw(draw: &mut Draw) -> Self {
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
        let (rows, relu) = (draw.rows(ptr.len() - 1), draw.flag());
        Self { per_camera, masked, ptr, col, pixels, stride, first_channel, channels, rows, relu }
    }
}

struct Call {
    entries: Entries,
    features: Vec<f32>,
    bias: Option<Vec<f32>>,
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let entries = Entries::draw(draw);
    let features = draw.values(entries.pixels * entries.stride);
    Some(Call { features, bias: draw.maybe(entries.channels), entries })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let entries = &self.entries;
        let [ptr, col] = [&entries.ptr, &entries.col].map(|x| memory.hold(x));
        let masked = entries.masked.as_ref().map(|masked| memory.hold(masked));
        let features = memory.hold(&self.features);
        let bias = self.bias.as_ref().map(|bias| memory.hold(bias));
        let mut out = memory.filled(entries.rows.len() * entries.channels, f32::NAN);
        let args = Gather {
            ptr: &ptr,
            col: &col,
            mask: masked.as_ref().map(|masked| Mask { pixels: entries.per_camera, masked }),
            features: &features[..],
            stride: entries.stride,
            first_channel: entries.first_channel,
            channels: entries.channels,
            bias: bias.as_deref(),
            relu: entries.relu,
        };
        gather(isa, &args, entries.rows.clone(), &mut out);
        Output::from(&out[..])
    }

    fn exact(&self) -> Option<Exact> {
        let e = &self.entries;
        let kept = |col: &&u32| e.masked.as_ref().is_none_or(|m| !m[**col as usize / e.per_camera]);
        let mut values = Vec::new();
        for row in e.rows.clone() {
            let cols = &e.col[e.ptr[row] as usize..e.ptr[row + 1] as usize];
            let pixels: Vec<usize> = cols.iter().filter(kept).map(|&col| col as usize).collect();
            for c in 0..e.channels {
                let feature = |pixel: &usize| f64::from(self.features[pixel * e.stride + e.first_channel + c]);
                let mean = pixels.iter().map(feature).sum::<f64>() / pixels.len().max(1) as f64;
                let value = mean + self.bias.as_ref().map_or(0.0, |bias| f64::from(bias[c]));
                values.push(if e.relu { value.max(0.0) } else { value });
            }
        }
        Some(Exact { values, tolerance: 1e-6 })
    }
}

/// Level 1 of `nuscenes-200`, six cameras: 27 entries a row. As two thirds of a real rig's entries follow their predecessor,
/// rows are made of runs of three neighbours.
pub(crate) fn level1() -> Entries {
    let (per_camera, stride, rows, channels, entries) = (116 * 200, 128, 100 * 100 * 8, 64, 27);
    let pixels = 6 * per_camera;
    // Rows along a ray see almost the same pixels: starts move slowly with the row, and by a line of the image within it.
    let entry = |row: usize, i: usize| ((row * 7 / 4 + i / 3 * 200 + i % 3) % pixels) as u32;
    Entries {
        per_camera,
        masked: None,
        ptr: (0..=rows).map(|row| (row * entries) as u32).collect(),
        col: (0..rows).flat_map(|row| (0..entries).map(move |i| entry(row, i))).collect(),
        pixels,
        stride,
        first_channel: 0,
        channels,
        rows: 0..rows,
        relu: true,
    }
}

/// Its volume gather.
pub(crate) fn benches() -> Vec<Bench> {
    let rig = level1();
    let (features, bias) = (values(rig.pixels * rig.stride, 1.0), values(rig.channels, 1.0));
    let read = 4 * (rig.col.len() + rig.pixels * rig.channels);
    let (units, work) = ([rig.rows.len(), rig.channels], rig.col.len() / rig.rows.len() * rig.channels);
    vec![Bench::new("level1 volume", units, work, read, move |isa, rows, out| {
        let args = Gather {
            ptr: &rig.ptr,
            col: &rig.col,
            mask: None,
            features: &features[..],
            stride: rig.stride,
            first_channel: 0,
            channels: rig.channels,
            bias: Some(&bias[..]),
            relu: true,
        };
        gather(isa, &args, rows, out);
    })]
}

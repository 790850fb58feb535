//! [`super::head()`] with any arguments, and at the network's shapes.

use super::{Head, head, scratch_len};
use crate::cases::{Bench, Case, Draw, MAX_WORK, Memory, Output, Weights, values};
use crate::isa::Isa;
use crate::matmul::Panels;
use crate::matmul::layout::packed_len;
use std::ops::Range;
use std::vec;
use std::vec::Vec;

struct Call {
    channels: usize,
    classes: usize,
    rows: Range<usize>,
    logits: bool,
    input: Vec<f32>,
    weights: [Weights; 3],
    biases: [Vec<f32>; 3],
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let (voxels, channels) = (draw.extent(0, 110), draw.extent(0, 40));
    let classes = draw.columns(voxels * channels)?;
    if voxels * channels * channels > MAX_WORK {
        return None;
    }
    let columns = [channels, channels, classes];
    Some(Call {
        channels,
        classes,
        rows: draw.rows(voxels),
        weights: columns.map(|columns| Weights::draw(draw, packed_len(channels, columns))),
        biases: columns.map(|columns| draw.values(columns.next_multiple_of(16))),
        input: draw.values(voxels * channels),
        logits: draw.flag(),
    })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let input = memory.hold(&self.input);
        let (weights, biases) =
            (self.weights.each_ref().map(|w| w.hold(memory)), self.biases.each_ref().map(|bias| memory.hold(bias)));
        let mut classes = memory.filled(self.rows.len(), 255u8);
        let mut logits = memory.filled(if self.logits { self.rows.len() * self.classes } else { 0 }, f32::NAN);
        let mut scratch = memory.filled(scratch_len(self.channels, self.classes), f32::NAN);
        let args = Head {
            input: &input,
            channels: self.channels,
            classes: self.classes,
            weights: weights.each_ref().map(|w| w.panels()),
            biases: biases.each_ref().map(|bias| &bias[..]),
        };
        let kept = self.logits.then_some(&mut logits[..]);
        head(isa, &args, self.rows.clone(), &mut classes, kept, &mut scratch);
        Output { values: logits.to_vec(), codes: classes.iter().map(|class| i64::from(*class)).collect() }
    }
}

/// Level 0 of `nuscenes-200`, with its logits.
pub(crate) fn benches() -> Vec<Bench> {
    let (voxels, channels, classes) = (200 * 200 * 16, 32, 17);
    let columns: [usize; 3] = [channels, channels, classes];
    let weights = columns.map(|columns| values(packed_len(channels, columns), 0.1));
    let biases = columns.map(|columns| values(columns.next_multiple_of(16), 1.0));
    let (input, mut scratch) = (values(voxels * channels, 1.0), values(scratch_len(channels, classes), 0.0));
    let mut chosen = vec![0; voxels];
    let (work, read) = (channels * (2 * channels + classes), 4 * input.len() + voxels);
    vec![Bench::new("level0 32-17", [voxels, classes], work, read, move |isa, rows, logits| {
        let args = Head {
            input: &input,
            channels,
            classes,
            weights: weights.each_ref().map(|w| Panels::F32(w)),
            biases: biases.each_ref().map(|bias| &bias[..]),
        };
        let chosen = &mut chosen[..rows.len()];
        head(isa, &args, rows, chosen, Some(logits), &mut scratch);
    })]
}

//! [`super::head()`] with any arguments, and at the network's shapes.

use super::{Confidence, Head, Results, head, scratch_len};
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
    /// That of the confidence.
    softmax_scale: Option<f32>,
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
        softmax_scale: draw.flag().then(|| 0.1 + draw.extent(0, 40) as f32 / 10.0),
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
        let sure = if self.softmax_scale.is_some() { self.rows.len() } else { 0 };
        let (mut occupied, mut class) = (memory.filled(sure, 255u8), memory.filled(sure, 255u8));
        let confidence =
            self.softmax_scale.map(|scale| Confidence { scale, occupied: &mut occupied, class: &mut class });
        let logits_kept = self.logits.then_some(&mut logits[..]);
        let results = Results { classes: &mut classes, logits: logits_kept, confidence };
        head(isa, &args, self.rows.clone(), results, &mut scratch);
        let codes = classes.iter().chain(&*occupied).chain(&*class);
        Output { values: logits.to_vec(), codes: codes.copied().map(i64::from).collect() }
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
        let results = Results { classes: &mut chosen[..rows.len()], logits: Some(logits), confidence: None };
        head(isa, &args, rows, results, &mut scratch);
    })]
}

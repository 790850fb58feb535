//! [`super::head_i8()`] with any arguments, and at the network's shapes.

use super::{HeadI8, LayerI8, head_i8, scratch_len};
use crate::cases::right_i8::{WeightsI8, left, padded};
use crate::cases::{Bench, Case, Draw, MAX_WORK, Memory, Output, bytes};
use crate::isa::Isa;
use crate::ops::head::{Confidence, Results};
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
    signed: bool,
    input: Vec<i8>,
    weights: [WeightsI8; 3],
    biases: [Vec<i32>; 3],
    multipliers: [Vec<i32>; 2],
    scale: f32,
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let (voxels, channels) = (draw.extent(0, 110), 4 * draw.extent(1, 5));
    let classes = draw.columns(voxels * channels)?;
    if voxels * channels * channels > MAX_WORK {
        return None;
    }
    let (columns, signed) = ([channels, channels, classes], draw.flag());
    // Beside biases of any size products would not tell.
    let shift = if draw.flag() { 20 } else { 0 };
    Some(Call {
        channels,
        classes,
        rows: draw.rows(voxels),
        weights: columns.map(|columns| WeightsI8::draw(draw, channels, columns, 1)),
        biases: columns.map(|columns| padded(draw, columns, i32::MIN).into_iter().map(|bias| bias >> shift).collect()),
        multipliers: [channels; 2].map(|columns| padded(draw, columns, 0)),
        input: left(draw, voxels * channels, signed),
        signed,
        scale: draw.value(),
        logits: draw.flag(),
        softmax_scale: draw.flag().then(|| 0.1 + draw.extent(0, 40) as f32 / 10.0),
    })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let Self { channels, classes, signed, scale, .. } = *self;
        let input = memory.hold(&self.input);
        let weights = self.weights.each_ref().map(|w| w.hold(memory));
        let biases = self.biases.each_ref().map(|bias| memory.hold(bias));
        let multipliers = self.multipliers.each_ref().map(|multiplier| memory.hold(multiplier));
        let layers = core::array::from_fn(|i| LayerI8 {
            weights: &weights[i].packed,
            sums: &weights[i].sums,
            pairs: &weights[i].pairs,
            bias: &biases[i],
        });
        let multipliers = multipliers.each_ref().map(|multiplier| &multiplier[..]);
        let args = HeadI8 { input: &input, signed, channels, classes, layers, multipliers, scale };
        let mut chosen = memory.filled(self.rows.len(), 255u8);
        let mut logits = memory.filled(if self.logits { self.rows.len() * classes } else { 0 }, f32::NAN);
        let mut scratch = memory.filled(scratch_len(channels, classes), i32::MIN);
        let sure = if self.softmax_scale.is_some() { self.rows.len() } else { 0 };
        let (mut occupied, mut class) = (memory.filled(sure, 255u8), memory.filled(sure, 255u8));
        let confidence =
            self.softmax_scale.map(|scale| Confidence { scale, occupied: &mut occupied, class: &mut class });
        let kept = self.logits.then_some(&mut logits[..]);
        let results = Results { classes: &mut chosen, logits: kept, confidence };
        head_i8(isa, &args, self.rows.clone(), results, &mut scratch);
        let codes = chosen.iter().chain(&*occupied).chain(&*class);
        Output { values: logits.to_vec(), codes: codes.copied().map(i64::from).collect() }
    }
}

/// Level 0 of `nuscenes-200`, with its logits.
pub(crate) fn benches() -> Vec<Bench> {
    let (voxels, channels, classes) = (200 * 200 * 16, 32, 17);
    let weights = [channels, channels, classes].map(|columns| WeightsI8::bench(channels, columns, 1));
    let (bias, multiplier) = (vec![1000; 32], vec![1 << 23; 32]);
    let input: Vec<i8> = bytes(voxels * channels).into_iter().map(|x| x.max(0)).collect();
    let (mut scratch, mut chosen) = (vec![0; scratch_len(channels, classes)], vec![0; voxels]);
    let (work, read) = (channels * (2 * channels + classes), input.len() + voxels);
    vec![Bench::new("level0 32-17", [voxels, classes], work, read, move |isa, rows, logits| {
        let layers =
            weights.each_ref().map(|w| LayerI8 { weights: &w.packed, sums: &w.sums, pairs: &w.pairs, bias: &bias });
        let multipliers = [&multiplier[..]; 2];
        let args = HeadI8 { input: &input, signed: false, channels, classes, layers, multipliers, scale: 0.01 };
        let results = Results { classes: &mut chosen[..rows.len()], logits: Some(logits), confidence: None };
        head_i8(isa, &args, rows, results, &mut scratch);
    })]
}

//! [`super::gather_i8()`] with any arguments, and at the network's shapes.

use super::super::gather::{Mask, cases as floating};
use super::{FRACTION, Gather, MAX_BIAS, MAX_FACTOR, gather_i8};
use crate::cases::{Bench, Case, Draw, Memory, Output, bytes};
use crate::isa::Isa;
use std::vec;
use std::vec::Vec;

struct Call {
    entries: floating::Entries,
    factor: i32,
    features: Vec<i8>,
    bias: Option<Vec<i32>>,
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let entries = floating::Entries::draw(draw);
    Some(Call {
        factor: draw.int_within(0, MAX_FACTOR),
        features: draw.int8s(entries.pixels * entries.stride),
        bias: draw.flag().then(|| draw.ints_within(entries.channels, -MAX_BIAS, MAX_BIAS)),
        entries,
    })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let entries = &self.entries;
        let [ptr, col] = [&entries.ptr, &entries.col].map(|x| memory.hold(x));
        let masked = entries.masked.as_ref().map(|masked| memory.hold(masked));
        let features = memory.hold(&self.features);
        let bias = self.bias.as_ref().map(|bias| memory.hold(bias));
        let mut out = memory.filled(entries.rows.len() * entries.channels, 55i8);
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
        gather_i8(isa, &args, self.factor, entries.rows.clone(), &mut out);
        Output::from(&out[..])
    }
}

/// The volume gather of level 1 of `nuscenes-200`, six cameras.
pub(crate) fn benches() -> Vec<Bench> {
    let rig = floating::level1();
    let (features, bias) = (bytes(rig.pixels * rig.stride), vec![3 << FRACTION; rig.channels]);
    let read = 4 * rig.col.len() + rig.pixels * rig.channels;
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
        gather_i8(isa, &args, 1_234_567, rows, out);
    })]
}

//! [`super::normalise_i8()`] with any arguments, and at the network's shapes.

use super::{FRACTION, MAX_FACTOR, MAX_OFFSET, NormaliseI8, normalise_i8};
use crate::cases::{Bench, Case, Draw, Memory, Output};
use crate::isa::Isa;
use std::ops::Range;
use std::vec;
use std::vec::Vec;

struct Call {
    height: usize,
    width: usize,
    padded_width: usize,
    rows: Range<usize>,
    args: NormaliseI8,
    image: Vec<u8>,
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let (height, width) = (draw.extent(0, 12), draw.extent(0, 40));
    let padded_height = height + draw.extent(0, 4);
    let padded_width = (width + draw.extent(0, 9)).max(1);
    // Anything, or what keeps most bytes apart.
    let [factor, offset] = if draw.flag() { [MAX_FACTOR, MAX_OFFSET] } else { [1 << FRACTION, 127 << FRACTION] };
    let args = NormaliseI8 {
        factors: core::array::from_fn(|_| draw.int_within(factor / 4, factor)),
        offsets: core::array::from_fn(|_| draw.int_within(-offset, offset / 2)),
    };
    let image = draw.int8s(height * width * 3).into_iter().map(i8::cast_unsigned).collect();
    Some(Call { height, width, padded_width, rows: draw.rows(padded_height), args, image })
}

impl Case for Call {
    /// There is one body for all instruction sets.
    fn run(&self, _: Isa, memory: Memory) -> Output {
        let image = memory.hold(&self.image);
        let mut out = memory.filled(self.rows.len() * self.padded_width * 3, 55i8);
        normalise_i8(&self.args, &image, [self.height, self.width], self.padded_width, self.rows.start, &mut out);
        Output::from(&out[..])
    }
}

/// An image of nuScenes.
pub(crate) fn benches() -> Vec<Bench> {
    let (height, width) = (900, 1600);
    let image: Vec<u8> = (0..height * width * 3).map(|i| (i * 7 % 256) as u8).collect();
    let args = NormaliseI8 { factors: [900_000; 3], offsets: [-90_000_000; 3] };
    vec![Bench::new("900 x 1600", [928, width * 3], 0, image.len(), move |_, rows, out| {
        normalise_i8(&args, &image, [height, width], width, rows.start, out);
    })]
}

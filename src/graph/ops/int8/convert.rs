//! Where floating point begins and ends.

use crate::graph::call::{Call, Tile};
use crate::graph::ops::description::{Description, Machine, ROWS};
use crate::graph::site::Site;
use voxcast_kernels::dequantise::dequantise;
use voxcast_kernels::quantise::quantise;

/// [`voxcast_kernels::quantise`]: x, to integers of the output's scale.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Quantise;

/// [`voxcast_kernels::dequantise`]: x, to the numbers that its integers stand for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Dequantise;

impl Description for Quantise {
    fn kind(&self) -> &'static str {
        "quantise"
    }

    fn tile(&self, _: &Site<'_>, _: Machine) -> usize {
        ROWS
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let output = call.site.output();
        let scale = output.scale.expect("the rewrite scales i8 tensors");
        let [start, end] = [tile.positions.start, tile.positions.end].map(|p| p * output.channels);
        quantise(call.isa, &call.input(0)[start..end], 1.0 / scale.step(), tile.output(0));
    }
}

impl Description for Dequantise {
    fn kind(&self) -> &'static str {
        "dequantise"
    }

    fn tile(&self, _: &Site<'_>, _: Machine) -> usize {
        ROWS
    }

    fn execute(&self, call: &Call<'_>, mut tile: Tile<'_>) {
        let x = call.site.input(0);
        let scale = x.scale.expect("the rewrite scales i8 tensors");
        let [start, end] = [tile.positions.start, tile.positions.end].map(|p| p * x.channels);
        dequantise(call.isa, &call.input(0)[start..end], scale.step(), tile.output(0));
    }
}

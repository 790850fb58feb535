//! The specification, tile by tile.

use super::transform::SIDE;
use super::{Part, Run};
#[cfg(not(feature = "std"))]
use crate::math::Float as _;
use crate::matmul::layout::packed_index;
use crate::simd::LANES;

/// Transforms the columns of a square, then its rows.
#[inline(always)]
fn both_axes(mut square: [[f32; SIDE]; SIDE], line: impl Fn([f32; SIDE]) -> [f32; SIDE]) -> [[f32; SIDE]; SIDE] {
    for j in 0..SIDE {
        let column = line(core::array::from_fn(|i| square[i][j]));
        for i in 0..SIDE {
            square[i][j] = column[i];
        }
    }
    square.map(line)
}

impl Run<'_> {
    #[inline(always)]
    pub(super) fn specification(mut self) {
        for part in 0..self.args.shape.parts() {
            self.part(Part::new(&self.args.shape, part));
        }
    }

    #[inline(always)]
    fn part(&mut self, part: Part) {
        let shape = self.args.shape;
        let (scheme, depth) = (shape.scheme, shape.depth());
        let [_, across] = shape.tiles();
        let weights = &self.args.weights[part.index * shape.part_len()..][..shape.part_len()];
        // The first layer under the taps.
        let under = if shape.layer_taps == 1 { 0 } else { part.before(2) };
        let (end, first) = (self.args.end(), shape.positions(&self.tile_rows).start);
        for tile in self.tile_rows.start * across..self.tile_rows.end * across {
            let at = [tile / across, tile % across].map(|v| v * scheme.outputs());
            for z in 0..shape.layers {
                // V of all k, point by point.
                for k in 0..depth {
                    let (layer, c) = ((z + k / shape.channels).wrapping_sub(under), k % shape.channels);
                    let v = both_axes(
                        self.square(&part, at, layer, c),
                        #[inline(always)]
                        |d| scheme.input(d),
                    );
                    for i in 0..scheme.inputs() {
                        for j in 0..scheme.inputs() {
                            self.scratch[(i * scheme.inputs() + j) * depth + k] = v[i][j];
                        }
                    }
                }
                let v = &self.scratch[..scheme.points() * depth];
                for n in (0..shape.columns).step_by(LANES) {
                    let mut sums = [[0.0; LANES]; SIDE * SIDE];
                    for point in 0..scheme.points() {
                        let weights = &weights[point * shape.point_len()..][..shape.point_len()];
                        for group_at in (0..depth).step_by(shape.group()) {
                            let mut group = [0.0f32; LANES];
                            for k in group_at..depth.min(group_at + shape.group()) {
                                let weights = &weights[packed_index(depth, k, n)..][..LANES];
                                for (sum, weight) in group.iter_mut().zip(weights) {
                                    *sum = v[point * depth + k].mul_add(*weight, *sum);
                                }
                            }
                            for (sum, group) in sums[point].iter_mut().zip(group) {
                                *sum = if group_at == 0 { group } else { *sum + group };
                            }
                        }
                    }
                    for column in n..shape.columns.min(n + LANES) {
                        let square: [[f32; SIDE]; SIDE] = core::array::from_fn(|i| {
                            core::array::from_fn(|j| match i.max(j) < scheme.inputs() {
                                true => sums[i * scheme.inputs() + j][column - n],
                                false => 0.0,
                            })
                        });
                        let tile = both_axes(
                            square,
                            #[inline(always)]
                            |m| scheme.output(m),
                        );
                        for i in 0..scheme.outputs().min(shape.plane[0] - at[0]) {
                            for j in 0..scheme.outputs().min(shape.plane[1] - at[1]) {
                                let position = part.position(&shape, [at[0] + i, at[1] + j, z]);
                                let out = &mut self.out[(position - first) * self.stride + column];
                                let sum = end.start(position, column, *out) + tile[i][j];
                                *out = end.finish(position, column, sum);
                            }
                        }
                    }
                }
            }
        }
    }

    /// The inputs of a tile in one layer and channel, zero outside. `at` is its first output.
    #[inline(always)]
    fn square(&self, part: &Part, at: [usize; 2], layer: usize, channel: usize) -> [[f32; SIDE]; SIDE] {
        let shape = self.args.shape;
        core::array::from_fn(|i| {
            core::array::from_fn(|j| {
                let [y, x] = [(at[0] + i).wrapping_sub(part.before(0)), (at[1] + j).wrapping_sub(part.before(1))];
                let inside = y < shape.plane[0] && x < shape.plane[1] && layer < shape.layers;
                let wanted = i.max(j) < shape.scheme.inputs();
                match inside && wanted {
                    true => {
                        self.args.input[((y * shape.plane[1] + x) * shape.layers + layer) * shape.channels + channel]
                    }
                    false => 0.0,
                }
            })
        })
    }
}

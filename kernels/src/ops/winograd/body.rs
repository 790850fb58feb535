//! The vector body: block by block, so that what is transformed is used while it is close.

use super::transform::{Four, SIDE, Three, Transform, Two};
use super::{Layout, Part, ROWS, Run, Scheme, Shape};
use crate::matmul::driver::{DEPTH, Linear, Target};
use crate::matmul::epilogue::{End, Epilogue, Place};
use crate::matmul::tile::{Arithmetic, Single};
use crate::simd::{Kernel, LANES, Simd, TileRows};
use core::ops::Range;

impl Kernel for Run<'_> {
    type Output = ();

    #[inline(always)]
    fn reference(self) {
        self.specification();
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        match self.args.shape.scheme {
            Scheme::Two => self.blocks::<S, Two>(s),
            Scheme::Three => self.blocks::<S, Three>(s),
            Scheme::Four => self.blocks::<S, Four>(s),
        }
    }
}

/// Which tiles and layers are computed together.
struct Block {
    tiles: Range<usize>,
    layers: Range<usize>,
}

/// Some rows of `P` panels at one point: a sum per row and column.
struct Sums<'a, const P: usize> {
    /// The point's transformed inputs. A row is the layers under the taps, which lie one after the other.
    inputs: &'a [f32],
    /// Where each row of the block starts.
    starts: &'a [usize],
    /// The first of these rows.
    row: usize,
    /// A block of k of the panels.
    panels: [&'a [f32]; P],
    /// The block's first k, a multiple of the group.
    k: usize,
    /// Products of a group.
    group: usize,
    /// The sums of each panel and row.
    out: &'a mut [[f32; LANES]],
}

impl<S: Simd, const P: usize> TileRows<S> for Sums<'_, P> {
    #[inline(always)]
    fn run<const N: usize>(self, s: S) {
        let Self { inputs, starts, row, panels, mut k, group, out } = self;
        let rows = starts.len();
        let starts: &[usize; N] = starts[row..].first_chunk().expect("the block has these rows");
        let depth = panels[0].len() / LANES;
        let end = k + depth;
        let mut left = [inputs.as_ptr(); N];
        for r in 0..N {
            left[r] = inputs[starts[r] + k..starts[r] + end].as_ptr();
        }
        let mut weights = panels;
        let mut first = k == 0;
        while k < end {
            let len = group.min(end - k);
            let mut here = weights;
            for j in 0..P {
                (here[j], weights[j]) = weights[j].split_at(len * LANES);
            }
            // SAFETY: each pointer was good for what is left of the block, of which this is the next part.
            let sums = unsafe { Single.multiply(s, 0, left, here, len, [[s.splat(0.0); P]; N]) };
            for j in 0..P {
                let out: &mut [_; N] = out[j * rows + row..].first_chunk_mut().expect("the block has these rows");
                for r in 0..N {
                    // Through memory: there are not enough registers for the sums of groups beside those of products.
                    let sum = if first { sums[r][j] } else { s.add(s.load(&out[r]), sums[r][j]) };
                    s.store(&mut out[r], sum);
                }
            }
            for left in &mut left {
                *left = left.wrapping_add(len);
            }
            first = false;
            k += len;
        }
    }
}

/// The rows of a block at one point.
struct Point<'a> {
    shape: Shape,
    /// The weights of this point, and what lies behind them.
    weights: &'a [f32],
    inputs: &'a [f32],
    starts: &'a [usize],
}

impl Point<'_> {
    /// All rows of `P` panels from `panel` on, in one block of k.
    #[inline(always)]
    fn panels<S: Simd, const P: usize>(&self, s: S, panel: usize, k: Range<usize>, out: &mut [[f32; LANES]]) {
        let depth = self.shape.depth();
        let mut panels = [self.weights; P];
        for j in 0..P {
            panels[j] = &self.weights[((panel + j) * depth + k.start) * LANES..][..k.len() * LANES];
        }
        // What is needed next mostly lies behind this, here or at the next point: it is fetched, a share per tile.
        let share = (P * k.len()).div_ceil(self.starts.len().div_ceil(S::TILE.rows));
        let mut ahead = panels[P - 1].as_ptr().wrapping_add(k.len() * LANES);
        let mut i = 0;
        while i < self.starts.len() {
            for _ in 0..share {
                s.prefetch(ahead);
                ahead = ahead.wrapping_add(LANES);
            }
            i += s.rows(
                self.starts.len() - i,
                Sums {
                    inputs: self.inputs,
                    starts: self.starts,
                    row: i,
                    panels,
                    k: k.start,
                    group: self.shape.group(),
                    out: &mut *out,
                },
            );
        }
    }
}

impl Run<'_> {
    #[inline(always)]
    fn blocks<S: Simd, T: Transform>(mut self, s: S) {
        let shape = self.args.shape;
        let layout = shape.layout();
        let [_, across] = shape.tiles();
        let tiles = self.tile_rows.start * across..self.tile_rows.end * across;
        for first in tiles.clone().step_by(layout.tiles) {
            for layer in (0..shape.layers).step_by(layout.layers) {
                let block = Block {
                    tiles: first..tiles.end.min(first + layout.tiles),
                    layers: layer..shape.layers.min(layer + layout.layers),
                };
                // Parts that differ along the layers alone read the same transformed inputs.
                for parts in (0..shape.parts()).step_by(shape.step()) {
                    self.inputs::<S, T>(s, &layout, &block, &Part::new(&shape, parts));
                    for part in parts..parts + shape.step() {
                        let part = Part::new(&shape, part);
                        for column in (0..shape.columns).step_by(layout.columns) {
                            let columns = column..shape.columns.min(column + layout.columns);
                            self.products(s, &layout, &block, &part, &columns);
                            self.outputs::<S, T>(s, &layout, &block, &part, &columns);
                        }
                    }
                }
            }
        }
    }

    /// The first output of a tile.
    #[inline(always)]
    fn corner(&self, tile: usize) -> [usize; 2] {
        let [_, across] = self.args.shape.tiles();
        let outputs = self.args.shape.scheme.outputs();
        [tile / across * outputs, tile % across * outputs]
    }

    /// Transforms the inputs: `[point][tile][layer][channel]`.
    #[inline(always)]
    fn inputs<S: Simd, T: Transform>(&mut self, s: S, layout: &Layout, block: &Block, part: &Part) {
        let shape = self.args.shape;
        let halo = shape.halo();
        for (i, tile) in block.tiles.clone().enumerate() {
            let corner = self.corner(tile);
            // The inputs of the tile that exist.
            let inside: [Range<usize>; 2] = [0, 1].map(
                #[inline(always)]
                |a| {
                    let before = part.before(a);
                    before.saturating_sub(corner[a])..T::INPUTS.min(shape.plane[a] + before - corner[a])
                },
            );
            let from = [0, 1].map(
                #[inline(always)]
                |a| corner[a].wrapping_sub(part.before(a)),
            );
            let whole = inside.iter().all(|inside| *inside == (0..T::INPUTS));
            for stored in 0..block.layers.len() + 2 * halo {
                let to = (i * layout.stored + stored) * shape.channels;
                let layer = (block.layers.start + stored).wrapping_sub(halo);
                if layer >= shape.layers {
                    for point in 0..shape.scheme.points() {
                        self.scratch[point * layout.input + to..][..shape.channels].fill(0.0);
                    }
                } else if whole {
                    self.transform::<S, T, true>(s, layout.input, from, layer, &inside, to);
                } else {
                    self.transform::<S, T, false>(s, layout.input, from, layer, &inside, to);
                }
            }
        }
    }

    /// Transforms all channels of one tile in one layer to `to` of every point. `from` is the first input of the tile, which may
    /// lie outside the plane. `WHOLE` says that all inputs exist.
    #[inline(always)]
    fn transform<S: Simd, T: Transform, const WHOLE: bool>(
        &mut self,
        s: S,
        distance: usize,
        from: [usize; 2],
        layer: usize,
        inside: &[Range<usize>; 2],
        to: usize,
    ) {
        let shape = self.args.shape;
        let step = shape.layers * shape.channels;
        let line = shape.plane[1] * step;
        // Of the input at (row, column): may lie outside where that does not exist.
        let start = |i: usize, j: usize| {
            let row = from[0].wrapping_add(i).wrapping_mul(line);
            row.wrapping_add(from[1].wrapping_add(j).wrapping_mul(step)).wrapping_add(layer * shape.channels)
        };
        let [rows, columns] = inside;
        let last = start(rows.end - 1, columns.end - 1) + shape.channels;
        assert!(last <= self.args.input.len() && start(rows.start, columns.start) < last, "inputs outside the tensor");
        assert!((T::INPUTS * T::INPUTS - 1) * distance + to + shape.channels <= self.scratch.len(), "no room");
        let (input, out) = (self.args.input.as_ptr(), self.scratch.as_mut_ptr());
        for c in (0..shape.channels).step_by(LANES) {
            let mut half = [[s.splat(0.0); SIDE]; SIDE];
            for j in 0..T::INPUTS {
                let mut column = [s.splat(0.0); SIDE];
                for i in 0..T::INPUTS {
                    if WHOLE || (rows.contains(&i) && columns.contains(&j)) {
                        // SAFETY: this input exists, so its 16 channels lie between those of the first and the last one
                        // that exist, which are in the tensor.
                        column[i] = unsafe { s.load_ptr(input.add(start(i, j) + c)) };
                    }
                }
                column = T::input(s, column);
                for i in 0..T::INPUTS {
                    half[i][j] = column[i];
                }
            }
            for i in 0..T::INPUTS {
                let row = T::input(s, half[i]);
                for j in 0..T::INPUTS {
                    // SAFETY: the last point's channels end in the scratch, and this is no later one.
                    unsafe { s.store_ptr(out.add((i * T::INPUTS + j) * distance + to + c), row[j]) };
                }
            }
        }
    }

    /// Multiplies and sums at every point: `[point][panel][tile][layer][16]`.
    #[inline(always)]
    fn products<S: Simd>(&mut self, s: S, layout: &Layout, block: &Block, part: &Part, columns: &Range<usize>) {
        let shape = self.args.shape;
        let mut starts = [0; ROWS];
        let mut rows = 0;
        for tile in 0..block.tiles.len() {
            for layer in 0..block.layers.len() {
                starts[rows] = (tile * layout.stored + layer + part.first[2]) * shape.channels;
                rows += 1;
            }
        }
        let starts = &starts[..rows];
        let weights = &self.args.weights[part.index * shape.part_len()..];
        let panels = columns.start / LANES..columns.end.div_ceil(LANES);
        let (inputs, sums) = self.scratch.split_at_mut(shape.scheme.points() * layout.input);
        let points = inputs.chunks_exact(layout.input).zip(sums.chunks_exact_mut(layout.sums));
        for (point, (inputs, sums)) in points.enumerate() {
            let point = Point { shape, weights: &weights[point * shape.point_len()..], inputs, starts };
            let (sums, _) = sums.as_chunks_mut();
            let most = DEPTH / S::TILE.panels.min(panels.len());
            for k in (0..shape.depth()).step_by(most) {
                let k = k..shape.depth().min(k + most);
                let mut panel = panels.start;
                while panel < panels.end {
                    let sums = &mut sums[(panel - panels.start) * rows..];
                    if S::TILE.panels == 2 && panels.end - panel >= 2 {
                        point.panels::<S, 2>(s, panel, k.clone(), sums);
                        panel += 2;
                    } else {
                        point.panels::<S, 1>(s, panel, k.clone(), sums);
                        panel += 1;
                    }
                }
            }
        }
    }

    /// Transforms the sums back and writes the outputs.
    #[inline(always)]
    fn outputs<S: Simd, T: Transform>(
        &mut self,
        s: S,
        layout: &Layout,
        block: &Block,
        part: &Part,
        columns: &Range<usize>,
    ) {
        let shape = self.args.shape;
        let mut end = self.args.end();
        let target = Linear { first: shape.positions(&self.tile_rows).start, stride: self.stride };
        let sums = &self.scratch[shape.scheme.points() * layout.input..];
        let rows = block.tiles.len() * block.layers.len();
        let mut row = 0;
        for tile in block.tiles.clone() {
            let corner = self.corner(tile);
            let inside = [T::OUTPUTS.min(shape.plane[0] - corner[0]), T::OUTPUTS.min(shape.plane[1] - corner[1])];
            for layer in block.layers.clone() {
                for column in (0..columns.len()).step_by(LANES) {
                    let from = column * rows + row * LANES;
                    assert!((shape.scheme.points() - 1) * layout.sums + from + LANES <= sums.len(), "no such sums");
                    let mut half = [[s.splat(0.0); SIDE]; SIDE];
                    for j in 0..T::INPUTS {
                        let mut line = [s.splat(0.0); SIDE];
                        for i in 0..T::INPUTS {
                            // SAFETY: the last point's sums end in the slice, and this is no later one.
                            line[i] =
                                unsafe { s.load_ptr(sums.as_ptr().add((i * T::INPUTS + j) * layout.sums + from)) };
                        }
                        line = T::output(s, line);
                        for i in 0..T::OUTPUTS {
                            half[i][j] = line[i];
                        }
                    }
                    let column = columns.start + column;
                    for i in 0..inside[0] {
                        let line = T::output(s, half[i]);
                        for j in 0..inside[1] {
                            let position = part.position(&shape, [corner[0] + i, corner[1] + j, layer]);
                            let offsets = &[target.offset(position)];
                            let (row, target) = (position, &target);
                            let place = Place { column, columns: shape.columns, row, target, offsets };
                            if column + LANES <= shape.columns {
                                write::<S, true>(s, &mut end, &place, line[j], self.out);
                            } else {
                                write::<S, false>(s, &mut end, &place, line[j], self.out);
                            }
                        }
                    }
                }
                row += 1;
            }
        }
    }
}

/// Adds `sums` to where the outputs start, and writes them.
#[inline(always)]
fn write<S: Simd, const WHOLE: bool>(
    s: S,
    end: &mut End<'_>,
    place: &Place<'_, Linear, 1>,
    sums: S::V,
    out: &mut [f32],
) {
    let [[start]] = Epilogue::<S, Single>::start::<Linear, 1, 1, WHOLE>(end, s, place, out);
    Epilogue::<S, Single>::finish::<Linear, 1, 1, WHOLE>(end, s, place, [[s.add(start, sums)]], out);
}

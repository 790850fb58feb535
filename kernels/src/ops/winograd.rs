//! Convolution by Winograd's minimal filtering: 3x3 in a plane, alone or with three taps across layers, and the transposed
//! convolution of [`crate::deconv3d`].
//!
//! The plane is cut into tiles of m x m outputs, m = 2, 3 or 4 ([`Scheme`]). A tile's (m + 2) x (m + 2) inputs, or 4 x 4 for
//! m = 3, are transformed, multiplied point by point with transformed weights, summed over channels, and the sums transformed
//! back:
//!
//! ```text
//! V[c]   = B^T d[c] B                                  d[c]: the inputs of a tile in one layer and channel, zero outside
//! M[n]   = sum over (kz, c) of V[z + kz - 1][c] * U[kz, c][n]     point by point
//! out[n] = end(start(n) + (A^T M[n] A))                the part of the tile that lies in the plane
//! ```
//!
//! An image is a plane (height, width) with one layer; a volume is a plane (x, y) with layers along z, whose taps are summed
//! before the transform back, so that each layer is transformed once. F(4,3) in the plane needs a quarter of the
//! multiplications; F(2,3) along all three axes would need 8/27.
//!
//! A transposed convolution with kernel 4 and stride 2 is eight *parts*, one per parity p of the output's indices, each a
//! convolution with two taps per axis that starts p - 1 positions from where its outputs lie: F(3,2), with 4/9 of the multiplications.
//! Output (x, y, z) of part p is output 2 (x, y, z) + p of the whole, and V is the same for both parities along z.
//!
//! The order of the sums: B^T first down each column of the tile, then along each row, as written in
//! `transform.rs`; M in groups of [`Shape::group`] products, k over (kz, c) ascending, each group one fma chain from 0, the
//! groups' sums added in order to the first one's; A^T first down each column, then along each row; then one addition to `start`, the bias
//! (plus the residual that comes before ReLU). The groups keep the error low: with them it stays under twice that
//! of a direct sum ([`Shape::accurate`]).
//!
//! A number that is not finite spoils its whole tile, and which tile that is follows from the shape alone.

mod body;
mod choice;
mod reference;
mod transform;

pub use choice::Reads;
pub use transform::Scheme;

use crate::conv::Geometry;
use crate::isa::Isa;
use crate::matmul::Residual;
use crate::matmul::epilogue::End;
use crate::simd::{LANES, dispatch};
use core::ops::Range;

/// What is convolved, and how.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Extent of the two axes that tiles are cut from: height and width, or x and y.
    pub plane: [usize; 2],
    /// Positions along the third axis: 1 for an image.
    pub layers: usize,
    /// Taps along the third axis: 1, or 3 with a zero on either side; 2 of a transposed convolution.
    pub layer_taps: usize,
    /// Input channels, a multiple of 16.
    pub channels: usize,
    /// Output channels.
    pub columns: usize,
    /// Size of the tiles.
    pub scheme: Scheme,
}

/// A convolution's arguments.
#[derive(Clone, Copy, Debug)]
pub struct Winograd<'a> {
    /// What is convolved.
    pub shape: Shape,
    /// `[plane, layers, channels]`.
    pub input: &'a [f32],
    /// What [`Shape::pack`] made.
    pub weights: &'a [f32],
    /// One number per column, padded with anything to a multiple of 16.
    pub bias: &'a [f32],
    /// Whether negative results become 0.
    pub relu: bool,
    /// What is added.
    pub residual: Residual<'a>,
}

/// Output columns that are computed at a time.
const COLUMNS: usize = 128;
/// Rows (a tile in one layer each) of a block, at most.
const ROWS: usize = 96;
/// Rows of a block, at least, if there are as many.
const FEWEST: usize = 24;
/// Numbers of a part's transformed weights from which on a block has as many rows as it can: all are read for every block, and
/// from here on that takes longer than what a larger block does not find in the second-level cache.
const MANY_WEIGHTS: usize = 1 << 20;
/// f32 that the transformed inputs and the sums of a block may take beyond [`FEWEST`] rows: a second-level cache.
const BUDGET: usize = (512 << 10) / size_of::<f32>();
/// Layers of a block, at most.
const LAYERS: usize = 32;

/// A block of tiles and layers, and how it lies in scratch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Layout {
    /// Tiles, at most.
    tiles: usize,
    /// Layers, at most.
    layers: usize,
    /// Transformed layers of a tile: with a neighbour on either side unless there is one tap.
    stored: usize,
    /// Output columns, at most.
    columns: usize,
    /// Distance between points of the transformed inputs.
    input: usize,
    /// Distance between points of the sums.
    sums: usize,
}

impl Shape {
    /// The shape of a convolution that the kernel can compute: 3x3 on an image or 3x3x3 on a volume, stride and dilation 1,
    /// of the size of its input, from a multiple of 16 channels.
    pub fn of(geometry: &Geometry, columns: usize, scheme: Scheme) -> Option<Self> {
        let Geometry { input, channels, kernel, stride, dilation, padding, output } = *geometry;
        let (plane, layers, layer_taps) = match (kernel, padding) {
            ([1, 3, 3], [0, 1, 1]) if input[0] == 1 => ([input[1], input[2]], 1, 1),
            ([3, 3, 3], [1, 1, 1]) => ([input[0], input[1]], input[2], 3),
            _ => return None,
        };
        let same = stride == [1; 3] && dilation == [1; 3] && output == input;
        (same && channels > 0 && channels.is_multiple_of(LANES)).then_some(Self {
            plane,
            layers,
            layer_taps,
            channels,
            columns,
            scheme,
        })
    }

    /// The shape of the transposed convolution of [`crate::deconv3d`], from a multiple of 16 channels.
    pub fn of_deconv3d(extent: [usize; 3], channels: usize, columns: usize) -> Option<Self> {
        let [x, y, layers] = extent;
        (channels > 0 && channels.is_multiple_of(LANES)).then_some(Self {
            plane: [x, y],
            layers,
            layer_taps: 2,
            channels,
            columns,
            scheme: Scheme::Three,
        })
    }

    /// Distance between outputs of a part along every axis: 2 for a transposed convolution, otherwise 1.
    fn step(&self) -> usize {
        if self.scheme == Scheme::Three { 2 } else { 1 }
    }

    /// Convolutions that are computed of the same input: 8 parities of a transposed one, otherwise 1.
    pub fn parts(&self) -> usize {
        self.step().pow(3)
    }

    /// Layers on either side of those that are computed, of which taps read.
    fn halo(&self) -> usize {
        usize::from(self.layer_taps > 1)
    }

    /// Products of a group, whose sum is one chain.
    pub fn group(&self) -> usize {
        if self.depth() < 64 { 16 } else { 32 }
    }

    /// Tiles along both axes of the plane.
    pub fn tiles(&self) -> [usize; 2] {
        self.plane.map(|v| v.div_ceil(self.scheme.outputs()))
    }

    /// Input positions.
    pub fn inputs(&self) -> usize {
        self.plane[0] * self.plane[1] * self.layers
    }

    /// Output positions.
    pub fn rows(&self) -> usize {
        self.parts() * self.inputs()
    }

    /// The output positions of a range of rows of tiles.
    pub fn positions(&self, tile_rows: &Range<usize>) -> Range<usize> {
        let plane = self.parts() * self.plane[1] * self.layers;
        let position = |row: usize| (row * self.scheme.outputs()).min(self.plane[0]) * plane;
        position(tile_rows.start)..position(tile_rows.end)
    }

    /// Multiply-adds of the sums over channels, which are all but the transforms: the executed ones, where
    /// [`Geometry::depth`] counts those of the formula. [`u64::MAX`] stands for more than that.
    pub fn multiply_adds(&self) -> u64 {
        let [down, across] = self.tiles().map(|v| v as u128);
        let per_tile = [self.parts(), self.layers, self.scheme.points(), self.depth(), self.columns];
        let count = per_tile.iter().try_fold(down * across, |a, &b| a.checked_mul(b as u128));
        count.and_then(|v| u64::try_from(v).ok()).unwrap_or(u64::MAX)
    }

    /// f32 of scratch that one call needs.
    pub fn scratch_len(&self) -> usize {
        let layout = self.layout();
        self.scheme.points() * (layout.input + layout.sums)
    }

    fn layout(&self) -> Layout {
        let points = self.scheme.points();
        let layers = self.layers.min(LAYERS);
        let stored = layers + 2 * self.halo();
        let columns = self.columns.next_multiple_of(LANES).min(COLUMNS);
        // Whole register tiles of every instruction set.
        let step = 12 / gcd(12, layers);
        let fewest = if self.part_len() < MANY_WEIGHTS { FEWEST } else { ROWS };
        let fit = BUDGET / (points * (stored * self.channels + layers * columns));
        let most = (ROWS / layers).min(self.tiles().iter().product());
        let tiles = fit.max(fewest.div_ceil(layers)).min(most);
        let tiles = if tiles < step { tiles } else { tiles / step * step };
        // An odd number of cache lines from point to point, so that points do not share cache sets.
        let odd = |len: usize| ((len / LANES) | 1) * LANES;
        Layout {
            tiles,
            layers,
            stored,
            columns,
            input: odd(tiles * stored * self.channels),
            sums: odd(tiles * layers * columns),
        }
    }

    fn check(&self) {
        assert!(self.plane[0] > 0 && self.plane[1] > 0 && self.layers > 0, "an extent is zero");
        assert!(self.columns > 0, "no output channels");
        let known = match self.scheme {
            Scheme::Two | Scheme::Four => self.layer_taps == 1 || self.layer_taps == 3,
            Scheme::Three => self.layer_taps == 2,
        };
        assert!(known, "{} taps across layers", self.layer_taps);
        assert!(self.channels > 0 && self.channels.is_multiple_of(LANES), "channels come in sixteens");
        assert!(self.fits(isize::MAX as usize), "the shape overflows");
    }

    /// Whether each of input, outputs, transformed weights and scratch takes at most `bytes`.
    fn fits(&self, bytes: usize) -> bool {
        let within = |numbers: &[usize]| {
            let size = numbers.iter().try_fold(size_of::<f32>(), |a, &b| a.checked_mul(b));
            size.is_some_and(|size| size <= bytes)
        };
        let columns = self.columns.saturating_add(LANES);
        // Points, taps across layers and parts of the weights make at most 256. At each of at most 64 points scratch has at most
        // ROWS rows of sums and three times as many of inputs, both padded.
        within(&[
            self.plane[0],
            self.plane[1],
            self.layers,
            self.channels.max(self.columns.saturating_mul(self.parts())),
        ]) && within(&[256, self.channels, columns])
            && within(&[64, 5, ROWS, self.channels.max(COLUMNS)])
    }
}

const fn gcd(a: usize, b: usize) -> usize {
    if b == 0 { a } else { gcd(b, a % b) }
}

impl<'a> Winograd<'a> {
    fn check(&self, tile_rows: &Range<usize>, stride: usize, out: &[f32], scratch: &[f32]) {
        let shape = &self.shape;
        shape.check();
        assert_eq!(self.input.len(), shape.inputs() * shape.channels, "the input has another shape");
        assert_eq!(self.weights.len(), shape.weights_len(), "transformed weights do not match the shape");
        assert!(self.bias.len() >= shape.columns.next_multiple_of(LANES), "the bias is shorter than the columns");
        let total = shape.tiles()[0];
        assert!(tile_rows.start <= tile_rows.end && tile_rows.end <= total, "rows of tiles {tile_rows:?} of {total}");
        assert!(stride >= shape.columns, "output rows overlap");
        let positions = shape.positions(tile_rows);
        let span = |rows: usize, stride: usize| match rows.checked_sub(1) {
            None => 0,
            Some(before) => before.saturating_mul(stride).saturating_add(shape.columns),
        };
        if let Residual::Before { rows, stride } | Residual::After { rows, stride } = self.residual {
            assert!(rows.len() >= span(positions.end, stride), "the residual is shorter than the rows");
        }
        assert!(out.len() >= span(positions.len(), stride), "the output is shorter than its rows");
        assert!(scratch.len() >= shape.scratch_len(), "the scratch is too small");
    }

    fn end(&self) -> End<'a> {
        End { bias: Some(self.bias), relu: self.relu, residual: self.residual }
    }
}

/// Convolves the rows of tiles `tile_rows` into `out`, which holds their output positions ([`Shape::positions`]), `stride`
/// numbers apart. `scratch` holds [`Shape::scratch_len`] numbers of any value.
///
/// # Panics
/// If a slice does not have the size that the shape asks for.
///
/// # Determinism
/// The same bits on every instruction set and for every division into rows of tiles. Other bits than [`crate::conv`] and
/// [`crate::deconv3d`].
pub fn winograd(
    isa: Isa,
    args: &Winograd<'_>,
    tile_rows: Range<usize>,
    stride: usize,
    out: &mut [f32],
    scratch: &mut [f32],
) {
    args.check(&tile_rows, stride, out, scratch);
    dispatch(isa, Run { args, tile_rows, stride, out, scratch });
}

/// One of the convolutions that the arguments stand for ([`Shape::parts`]).
#[derive(Clone, Copy)]
struct Part {
    /// Its place among them: parity `(p_x * 2 + p_y) * 2 + p_z`.
    index: usize,
    /// Distance between its outputs along every axis.
    step: usize,
    /// The first of its outputs along each axis.
    first: [usize; 3],
}

impl Part {
    fn new(shape: &Shape, index: usize) -> Self {
        let step = shape.step();
        Self { index, step, first: [index / 4, index / 2 % 2, index % 2] }
    }

    /// By how many positions the inputs under the taps begin before the output.
    #[inline(always)]
    fn before(&self, axis: usize) -> usize {
        1 - self.first[axis]
    }

    /// The output position of this part's output (x, y, z).
    #[inline(always)]
    fn position(&self, shape: &Shape, at: [usize; 3]) -> usize {
        let [x, y, z] = [0, 1, 2].map(|a| at[a] * self.step + self.first[a]);
        (x * shape.plane[1] * self.step + y) * shape.layers * self.step + z
    }
}

struct Run<'a> {
    args: &'a Winograd<'a>,
    tile_rows: Range<usize>,
    stride: usize,
    out: &'a mut [f32],
    scratch: &'a mut [f32],
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests;

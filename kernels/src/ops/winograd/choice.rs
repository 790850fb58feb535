//! Which convolutions are worth it.

use super::{Scheme, Shape};
use crate::conv::Geometry;
use crate::simd::LANES;

/// What reading one number of transformed weights costs, in multiply-adds.
const WEIGHT: u128 = 8;
/// What one point of one channel costs in either transform, in multiply-adds.
const TRANSFORM: u128 = 14;

/// How often a frame reads the weights of a convolution.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reads {
    /// For each camera, so that time saved is saved as often.
    PerCamera,
    /// Once.
    PerFrame,
}

impl Shape {
    /// The shape by which a convolution to `columns` channels is computed fastest within the error of [`Shape::accurate`], or
    /// none if a direct sum is. Its weights are [`Shape::modest`].
    ///
    /// Costs are counted in multiply-adds, from the shape alone: the sums, which take a quarter longer in groups and an eighth
    /// longer in a direct sum than the multiply-adds alone; both transforms, 14 per number; the weights, which are
    /// read from far away, 8 per number. Winograd must save an eighth.
    pub fn best(geometry: &Geometry, columns: usize, reads: Reads) -> Option<Self> {
        let schemes = [Scheme::Two, Scheme::Four].into_iter();
        let shapes = schemes.filter_map(|scheme| Self::of(geometry, columns, scheme));
        Self::cheapest(shapes, reads, geometry.rows() as u128, geometry.depth() as u128)
    }

    /// As [`Shape::best`], for the transposed convolution of [`crate::deconv3d`].
    pub fn best_deconv3d(extent: [usize; 3], channels: usize, columns: usize, reads: Reads) -> Option<Self> {
        let shape = Self::of_deconv3d(extent, channels, columns)?;
        Self::cheapest([shape].into_iter(), reads, shape.inputs() as u128, 8 * channels as u128)
    }

    /// The cheapest of the shapes, unless direct sums are cheaper, of `rows` outputs of each part, each a sum of `depth` products.
    fn cheapest(shapes: impl Iterator<Item = Self>, reads: Reads, rows: u128, depth: u128) -> Option<Self> {
        let direct = |shape: &Self| {
            let products = shape.parts() as u128 * depth * shape.padded();
            rows * products * 9 / 8 + WEIGHT * products
        };
        shapes
            .filter(|shape| shape.accurate() && shape.modest(reads))
            .map(|shape| (shape.cost(), shape))
            .min_by_key(|(cost, _)| *cost)
            .filter(|(cost, shape)| *cost <= direct(shape) / 8 * 7)
            .map(|(_, shape)| shape)
    }

    /// Columns that are computed.
    fn padded(&self) -> u128 {
        self.columns.next_multiple_of(LANES) as u128
    }

    fn cost(&self) -> u128 {
        let [down, across] = self.tiles().map(|v| v as u128);
        let numbers = down * across * (self.layers * self.scheme.points()) as u128;
        let (parts, transforms) = (self.parts() as u128, (self.parts() / self.step()) as u128);
        let sums = parts * self.depth() as u128 * self.padded();
        numbers * (sums * 5 / 4 + TRANSFORM * (transforms * self.channels as u128 + parts * self.padded()))
            + WEIGHT * self.scheme.points() as u128 * sums
    }

    /// Whether the error is at most twice that of a direct sum. F(4,3) amplifies the rounding of its transforms, beside which
    /// a direct sum of few products has little.
    pub fn accurate(&self) -> bool {
        self.scheme != Scheme::Four || self.depth() >= 32
    }

    /// Whether the transformed weights take little memory beside the maps that the convolution reads and writes: at most three
    /// times as much where every camera reads them, and half as much where they are read once in a frame. A network's memory
    /// follows its maps, and deep layers of small maps would add much to it: F(4,3) and F(3,2) have four times the weights
    /// of a direct sum. F(2,3) has 16/9 times as many, which every camera's pass may read in any case.
    pub fn modest(&self, reads: Reads) -> bool {
        let [most, per] = match reads {
            Reads::PerCamera if self.scheme == Scheme::Two => return true,
            Reads::PerCamera => [3, 1],
            Reads::PerFrame => [1, 2],
        };
        let maps = self.inputs() as u128 * self.channels as u128 + self.rows() as u128 * self.columns as u128;
        let per_point = self.parts() as u128 * self.depth() as u128 * self.padded();
        self.scheme.points() as u128 * per_point * per <= maps * most
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn best(input: [usize; 3], kernel: [usize; 3], channels: usize, columns: usize) -> Option<Scheme> {
        let padding = kernel.map(|k| k / 2);
        let geometry = Geometry { input, channels, kernel, stride: [1; 3], dilation: [1; 3], padding, output: input };
        let reads = if kernel[0] == 1 { Reads::PerCamera } else { Reads::PerFrame };
        Shape::best(&geometry, columns, reads).map(|shape| shape.scheme)
    }

    #[test]
    fn the_choice_follows_from_the_shape() {
        let (plane, cube) = ([1, 3, 3], [3; 3]);
        for (input, kernel, channels, columns, want) in [
            ([1, 232, 400], plane, 64, 64, Some(Scheme::Four)),
            ([1, 58, 100], plane, 256, 27, Some(Scheme::Four)),
            ([1, 58, 176], plane, 128, 128, Some(Scheme::Four)),
            ([1, 32, 88], plane, 32, 32, Some(Scheme::Four)),
            ([200, 200, 16], cube, 32, 32, Some(Scheme::Four)),
            ([104, 104, 8], cube, 16, 16, Some(Scheme::Four)),
            ([50, 50, 4], cube, 128, 128, Some(Scheme::Two)),
            ([26, 26, 2], cube, 48, 48, None),
            // Weights decide: those of F(4,3) would take more than they may beside the maps.
            ([1, 16, 44], plane, 256, 27, Some(Scheme::Four)),
            ([1, 29, 50], plane, 512, 512, Some(Scheme::Two)),
            ([1, 6, 17], plane, 256, 256, Some(Scheme::Two)),
            // So few tiles that reading the weights takes longer than is saved.
            ([1, 1, 1], plane, 256, 256, None),
            // Few channels: the transforms cost more than they save.
            ([1, 232, 400], plane, 16, 16, None),
            // Not a convolution that the kernel computes.
            ([1, 232, 400], [1; 3], 64, 64, None),
            ([1, 928, 1600], plane, 3, 64, None),
            ([1, 58, 100], plane, 40, 64, None),
        ] {
            assert_eq!(best(input, kernel, channels, columns), want, "{input:?} {kernel:?} {channels}-{columns}");
        }
    }

    #[test]
    fn weights_that_are_read_once_leave_smaller_tiles() {
        let (kernel, padding) = ([3; 3], [1; 3]);
        for (input, want) in
            [([50, 50, 4], [Some(Scheme::Four), Some(Scheme::Two)]), ([13, 13, 1], [Some(Scheme::Two), None])]
        {
            let geometry =
                Geometry { input, channels: 128, kernel, stride: [1; 3], dilation: [1; 3], padding, output: input };
            let reads = [Reads::PerCamera, Reads::PerFrame];
            let chosen = reads.map(|reads| Shape::best(&geometry, 128, reads).map(|shape| shape.scheme));
            assert_eq!(chosen, want, "{input:?}");
        }
    }

    #[test]
    fn volumes_are_doubled_by_it_where_their_weights_are_few() {
        for (extent, channels, columns, want) in [
            ([100, 100, 8], 64, 32, true),
            ([50, 50, 4], 128, 64, true),
            ([52, 52, 4], 32, 16, true),
            ([25, 25, 2], 256, 128, false),
            ([100, 100, 8], 40, 32, false),
        ] {
            let shape = Shape::best_deconv3d(extent, channels, columns, Reads::PerFrame);
            assert_eq!(
                shape.map(|shape| shape.scheme),
                want.then_some(Scheme::Three),
                "{extent:?} {channels}-{columns}"
            );
        }
    }

    #[test]
    fn strides_and_dilations_are_left_alone() {
        let sound = Geometry {
            input: [1, 58, 100],
            channels: 64,
            kernel: [1, 3, 3],
            stride: [1; 3],
            dilation: [1; 3],
            padding: [0, 1, 1],
            output: [1, 58, 100],
        };
        assert!(Shape::best(&sound, 64, Reads::PerFrame).is_some());
        for geometry in [
            Geometry { stride: [1, 2, 2], output: [1, 29, 50], ..sound },
            Geometry { dilation: [1, 2, 2], padding: [0, 2, 2], ..sound },
            Geometry { padding: [0; 3], output: [1, 56, 98], ..sound },
            Geometry { input: [2, 58, 100], output: [2, 58, 100], ..sound },
        ] {
            assert_eq!(Shape::best(&geometry, 64, Reads::PerCamera), None, "{geometry:?}");
        }
    }
}

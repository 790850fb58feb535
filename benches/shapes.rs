//! The shapes of the `nuscenes-200` network's layers, each named after what runs it.
//!
//! A camera image is 928 x 1600 pixels after padding; backbone layers are those of one camera.

use voxcast_kernels::conv::Geometry;

/// One convolution: how it walks its input, and its output channels.
pub(crate) struct Layer {
    pub(crate) name: &'static str,
    pub(crate) geometry: Geometry,
    pub(crate) columns: usize,
}

impl Layer {
    /// Multiply-adds of one run.
    pub(crate) fn multiply_adds(&self) -> u64 {
        (self.geometry.rows() * self.geometry.depth() * self.columns) as u64
    }
}

/// A square kernel on an image, padded so that the output is the input over the stride.
fn image(name: &'static str, [h, w]: [usize; 2], widths: [usize; 2], kernel: usize, stride: usize) -> Layer {
    let geometry = Geometry {
        input: [1, h, w],
        channels: widths[0],
        kernel: [1, kernel, kernel],
        stride: [1, stride, stride],
        dilation: [1; 3],
        padding: [0, kernel / 2, kernel / 2],
        output: [1, h.div_ceil(stride), w.div_ceil(stride)],
    };
    Layer { name, geometry, columns: widths[1] }
}

/// A 3x3x3 kernel on a volume.
fn volume(name: &'static str, extent: [usize; 3], width: usize) -> Layer {
    let geometry = Geometry {
        input: extent,
        channels: width,
        kernel: [3; 3],
        stride: [1; 3],
        dilation: [1; 3],
        padding: [1; 3],
        output: extent,
    };
    Layer { name, geometry, columns: width }
}

/// The backbone's 1x1 convolutions: a third of the frame. A stage's first block halves the image.
pub(crate) fn pointwise() -> Vec<Layer> {
    vec![
        image("layer1 64-64", [232, 400], [64, 64], 1, 1),
        image("layer1 64-256", [232, 400], [64, 256], 1, 1),
        image("layer1 256-64", [232, 400], [256, 64], 1, 1),
        image("layer2 256-128 stride 2", [232, 400], [256, 128], 1, 2),
        image("layer2 256-512 stride 2", [232, 400], [256, 512], 1, 2),
        image("layer2 128-512", [116, 200], [128, 512], 1, 1),
        image("layer2 512-128", [116, 200], [512, 128], 1, 1),
        image("layer3 256-1024", [58, 100], [256, 1024], 1, 1),
        image("layer3 1024-256", [58, 100], [1024, 256], 1, 1),
        image("layer4 512-2048", [29, 50], [512, 2048], 1, 1),
        image("layer4 2048-512", [29, 50], [2048, 512], 1, 1),
    ]
}

/// Convolutions of more taps, in two dimensions and in three.
pub(crate) fn spatial() -> Vec<Layer> {
    vec![
        image("stem 7x7 3-64 stride 2", [928, 1600], [3, 64], 7, 2),
        image("layer1 3x3 64", [232, 400], [64, 64], 3, 1),
        image("layer2 3x3 128", [116, 200], [128, 128], 3, 1),
        image("layer3 offsets 3x3 256-27", [58, 100], [256, 27], 3, 1),
        image("layer4 offsets 3x3 512-27", [29, 50], [512, 27], 3, 1),
        image("folded fpn level1 3x3 512-128", [116, 200], [512, 128], 3, 1),
        volume("level1 3x3x3 64", [100, 100, 8], 64),
        volume("level3 3x3x3 256", [25, 25, 2], 256),
        volume("refine0 3x3x3 32", [200, 200, 16], 32),
    ]
}

/// The backbone's deformable convolutions: a quarter of the frame.
pub(crate) fn deformable() -> Vec<Layer> {
    vec![image("layer3 3x3 256", [58, 100], [256, 256], 3, 1), image("layer4 3x3 512", [29, 50], [512, 512], 3, 1)]
}

/// The last transposed convolution, `up1`: extent, input channels, output channels.
pub(crate) const UP1: ([usize; 3], usize, usize) = ([100, 100, 8], 64, 32);

/// The occupancy head of level 0: voxels, channels, classes.
pub(crate) const HEAD: (usize, usize, usize) = (200 * 200 * 16, 32, 17);

/// The volume gather of level 1 after folding: feature pixels of six cameras, and how many channels they have, the
/// volume's and the plane's; rows; channels gathered.
pub(crate) const GATHER: (usize, usize, usize, usize) = (6 * 116 * 200, 128, 100 * 100 * 8, 64);

/// Entries a row has in the mean.
pub(crate) const ENTRIES: usize = 27;

/// Feature pixel of every entry of [`GATHER`]: rows of equal length, each made of runs of three neighbours, as two thirds
/// of a real rig's entries follow their predecessor.
pub(crate) fn columns() -> Vec<u32> {
    let (pixels, _, rows, _) = GATHER;
    // Rows along a ray see almost the same pixels: starts move slowly with the row, and by a line of the image within it.
    let start = |row: usize, run: usize| row * 7 / 4 + run * 200;
    let entry = |row: usize, i: usize| (start(row, i / 3) + i % 3) % pixels;
    (0..rows).flat_map(|row| (0..ENTRIES).map(move |i| entry(row, i) as u32)).collect()
}

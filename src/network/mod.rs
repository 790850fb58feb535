//! The network as a user names it: the architecture's parameters, read from JSON or built in.
//!
//! The keys are those of a `network.json`. [`crate::graph`] turns these numbers into operations.

mod grid;

pub use grid::{Axes, Grid, forward_of};

use crate::base::error::{Error, Result};
use serde::{Deserialize, Serialize};

/// Which residual block the backbone is made of (He et al., arXiv 1512.03385).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Block {
    /// 1x1, 3x3, 1x1 with four times the width at the end: ResNet-50, 101. The stride sits on the first 1x1 ("caffe").
    #[default]
    Bottleneck,
    /// 3x3, 3x3: ResNet-18, 34. Has no deformable form.
    Basic,
}

impl Block {
    /// Output channels of a block over the stage's width.
    pub fn expansion(self) -> usize {
        match self {
            Block::Bottleneck => 4,
            Block::Basic => 1,
        }
    }
}

/// Where a voxel is sampled when the projection matrices are built.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Sampling {
    /// End-inclusive linspace over the whole range, as in the published code and so in its checkpoints.
    #[default]
    Linspace,
    /// The centres of equal sub-cells, as in the paper's text.
    Centres,
}

/// The architecture: every number that the operations and their shapes follow from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Network {
    /// Residual blocks in each of the four backbone stages.
    pub depths: [usize; 4],
    /// Channels of the stem; stage i is `width << i` wide inside its blocks.
    pub width: usize,
    /// Which backbone stages use modulated deformable 3x3 convolution (DCNv2, arXiv 1811.11168).
    pub dcn: [bool; 4],
    /// The residual block.
    #[serde(default)]
    pub block: Block,
    /// Channels of the feature pyramid (FPN, arXiv 1612.03144).
    pub fpn: usize,
    /// Channels of level 0 (the output) and of levels 1 to 3.
    pub channels: [usize; 4],
    /// Query, key and value channels of one attention head, levels 1 to 3.
    pub key_dims: [usize; 3],
    /// Pixels of the padded image per feature pixel, levels 1 to 3. The backbone makes these 8, 16, 32.
    #[serde(default = "default_strides")]
    pub strides: [usize; 3],
    /// Metres, in the lidar frame: [min, max] of x, of y, of z.
    pub bounds: [[f32; 2]; 3],
    /// Classes, the empty class 0 among them.
    pub classes: usize,
    /// Height and width of the image after zero-padding to multiples of 32.
    pub image: [usize; 2],
    /// Voxels along x, y, z at levels 1 to 3. Each level halves the one before; the output doubles level 1.
    pub grids: [[usize; 3]; 3],
    /// Sample points per voxel and axis at levels 1 to 3.
    pub samples: [usize; 3],
    /// Where the sample points lie.
    #[serde(default)]
    pub sampling: Sampling,
    /// Cameras that the network was trained for. The weights do not depend on it; sizes that are told before a scene is
    /// seen do.
    #[serde(default = "default_cameras")]
    pub cameras: usize,
}

fn default_strides() -> [usize; 3] {
    [8, 16, 32]
}

fn default_cameras() -> usize {
    6
}

/// Names that [`Network::built_in`] knows.
pub const BUILT_IN: [&str; 4] = ["nuscenes-200", "nuscenes-256", "semantickitti-256", "edge"];

/// No dimension of a network may exceed this: with [`MAX_VOXELS`] it keeps every size that is computed from them within
/// a `usize`. The largest are the weights of a 3x3 convolution of the last stage: 9 times the square of 8 widths.
const MAX_DIM: usize = if usize::BITS < 64 { 1 << 10 } else { 1 << 16 };

/// Blocks that a backbone stage may have; the deepest ResNet published has 48 in one. A graph has some ten operations per
/// block, and planning looks at pairs of them.
const MAX_DEPTH: usize = 256;

/// Pixels that a side of an image may have, padded or not.
pub const MAX_SIDE: usize = 16_384;

/// Voxels that the output may have. `nuscenes-256` has 2^21.
const MAX_VOXELS: u64 = if usize::BITS < 64 { 1 << 27 } else { 1 << 32 };

/// Attention heads of the EfficientViT block; fixed by the published architecture.
pub const HEADS: usize = 8;

impl Network {
    /// The network of a published configuration, or `None` for a name that is not in [`BUILT_IN`].
    pub fn built_in(name: &str) -> Option<Self> {
        let nuscenes_200 = Network {
            depths: [3, 4, 23, 3],
            width: 64,
            dcn: [false, false, true, true],
            block: Block::Bottleneck,
            fpn: 512,
            channels: [32, 64, 128, 256],
            key_dims: [8, 16, 32],
            strides: default_strides(),
            bounds: [[-50.0, 50.0], [-50.0, 50.0], [-5.0, 3.0]],
            classes: 17,
            image: [928, 1600],
            grids: [[100, 100, 8], [50, 50, 4], [25, 25, 2]],
            samples: [4, 5, 6],
            sampling: Sampling::Linspace,
            cameras: 6,
        };
        let nuscenes_256 =
            Network { grids: [[128, 128, 16], [64, 64, 8], [32, 32, 4]], samples: [3, 4, 5], ..nuscenes_200.clone() };
        match name {
            "nuscenes-200" => Some(nuscenes_200),
            "nuscenes-256" => Some(nuscenes_256),
            "semantickitti-256" => Some(Network {
                bounds: [[0.0, 51.2], [-25.6, 25.6], [-2.0, 4.4]],
                classes: 20,
                image: [384, 1248],
                cameras: 1,
                ..nuscenes_256
            }),
            "edge" => Some(Network {
                depths: [2, 2, 3, 2],
                width: 32,
                dcn: [false; 4],
                block: Block::Basic,
                fpn: 64,
                channels: [16, 32, 48, 64],
                key_dims: [4, 6, 8],
                // The ground, 1.84 m below the lidar, passes through the middle of its voxels.
                bounds: [[-50.0, 50.0], [-50.0, 50.0], [-5.3, 2.7]],
                image: [192, 544],
                grids: [[52, 52, 4], [26, 26, 2], [13, 13, 1]],
                ..nuscenes_200
            }),
            _ => None,
        }
    }

    /// Reads and checks a `network.json`.
    ///
    /// # Errors
    /// [`ErrorKind::Format`](crate::ErrorKind::Format) with the key that is missing, unknown, of another type or out of range.
    pub fn from_json(text: &str) -> Result<Self> {
        let network: Network = serde_json::from_str(text).map_err(|e| Error::format(format!("network JSON: {e}")))?;
        network.check()?;
        Ok(network)
    }

    /// The network as JSON, readable by [`Network::from_json`].
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).unwrap_or_default()
    }

    /// Checks every rule that the operations rely on.
    ///
    /// # Errors
    /// [`ErrorKind::Format`](crate::ErrorKind::Format) naming the first key that breaks one.
    pub fn check(&self) -> Result<()> {
        let bad = |key: &str, found: String, expected: &str| {
            Err(Error::format(format!("network key \"{key}\": found {found}, expected {expected}")))
        };
        let ranged = |v: usize| (1..=MAX_DIM).contains(&v);
        for (key, values) in [
            ("depths", &self.depths[..]),
            ("width", &[self.width]),
            ("fpn", &[self.fpn]),
            ("channels", &self.channels),
            ("key_dims", &self.key_dims),
            ("samples", &self.samples),
            ("cameras", &[self.cameras]),
            ("grids", self.grids.as_flattened()),
        ] {
            if !values.iter().all(|&v| ranged(v)) {
                return bad(key, format!("{values:?}"), &format!("values from 1 to {MAX_DIM}"));
            }
        }
        if !(2..=256).contains(&self.classes) {
            return bad("classes", self.classes.to_string(), "2 to 256, so that a class fits a byte");
        }
        if self.strides != default_strides() {
            return bad(
                "strides",
                format!("{:?}", self.strides),
                "[8, 16, 32], the strides of the backbone's last three stages",
            );
        }
        if self.depths.iter().any(|&v| v > MAX_DEPTH) {
            return bad("depths", format!("{:?}", self.depths), "values from 1 to 256");
        }
        if self.image.iter().any(|&v| v == 0 || v % 32 != 0 || v > MAX_SIDE) {
            return bad(
                "image",
                format!("{:?}", self.image),
                "height and width padded to multiples of 32, up to 16384",
            );
        }
        if self.block == Block::Basic && self.dcn.contains(&true) {
            return bad("dcn", format!("{:?}", self.dcn), "no deformable stage with basic blocks");
        }
        if let Some(c) = self.channels[1..].iter().find(|&&c| c % HEADS != 0) {
            return bad("channels", c.to_string(), "multiples of 8 at levels 1 to 3, one share per attention head");
        }
        if let Some(l) = (0..3).find(|&l| self.key_dims[l] * HEADS != self.channels[l + 1]) {
            let expected = format!(
                "{} at level {}: a head's output is added to the next one's input, so both have an eighth of the channels",
                self.channels[l + 1] / HEADS,
                l + 1
            );
            return bad("key_dims", self.key_dims[l].to_string(), &expected);
        }
        for l in 0..2 {
            if (0..3).any(|a| self.grids[l][a] != 2 * self.grids[l + 1][a]) {
                return bad(
                    "grids",
                    format!("{:?}", self.grids),
                    "each level exactly half of the one before, on every axis",
                );
            }
        }
        // Dimensions are below 2^16, so this product and the eightfold of it need at most 51 bits.
        let voxels = 8 * self.grids[0].iter().map(|&v| v as u64).product::<u64>();
        if voxels > MAX_VOXELS {
            let expected = format!("at most {MAX_VOXELS} voxels in the output, which has {voxels}");
            return bad("grids", format!("{:?}", self.grids), &expected);
        }
        for (axis, [lo, hi]) in ["x", "y", "z"].iter().zip(self.bounds) {
            if !(lo.is_finite() && hi.is_finite() && lo < hi) {
                return bad("bounds", format!("[{lo}, {hi}] on {axis}"), "finite, ascending [min, max]");
            }
        }
        Ok(())
    }

    /// Voxels of the output along x, y, z: twice level 1.
    pub fn output_grid(&self) -> [usize; 3] {
        self.grids[0].map(|v| 2 * v)
    }

    /// Height and width of the feature maps at level index 0..3 (levels 1 to 3).
    pub fn feature_size(&self, level: usize) -> [usize; 2] {
        self.image.map(|v| v / self.strides[level])
    }

    /// Feature pixels of one camera at level index 0..3.
    pub fn feature_pixels(&self, level: usize) -> usize {
        self.feature_size(level).iter().product()
    }

    /// Edge lengths of an output voxel in metres.
    pub fn voxel_size(&self) -> [f32; 3] {
        let grid = self.output_grid();
        std::array::from_fn(|a| (self.bounds[a][1] - self.bounds[a][0]) / grid[a] as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::{Value, json};

    fn sound() -> Value {
        serde_json::to_value(Network::built_in("nuscenes-200")).expect("plain numbers")
    }

    #[test]
    fn built_in_networks_are_sound_and_survive_json() {
        for name in BUILT_IN {
            let network = Network::built_in(name).expect("built in");
            network.check().expect("sound");
            assert_eq!(Network::from_json(&network.to_json()).expect("its own JSON"), network);
        }
        assert_eq!(Network::built_in("nuscenes"), None);
    }

    #[test]
    fn sizes_of_the_published_network() {
        let network = Network::built_in("nuscenes-200").expect("built in");
        assert_eq!(network.output_grid(), [200, 200, 16]);
        assert_eq!([0, 1, 2].map(|l| network.feature_size(l)), [[116, 200], [58, 100], [29, 50]]);
        assert_eq!(network.feature_pixels(2), 1450);
        assert_eq!(network.voxel_size(), [0.5; 3]);
        assert_eq!((Block::Bottleneck.expansion(), Block::Basic.expansion()), (4, 1));
    }

    #[test]
    fn keys_with_a_default_may_be_missing() {
        let mut network = sound();
        for key in ["block", "strides", "sampling", "cameras"] {
            network.as_object_mut().expect("an object").remove(key);
        }
        assert_eq!(Network::from_json(&network.to_string()).ok(), Network::built_in("nuscenes-200"));
        for key in
            ["depths", "width", "dcn", "fpn", "channels", "key_dims", "bounds", "classes", "image", "grids", "samples"]
        {
            let mut network = sound();
            network.as_object_mut().expect("an object").remove(key);
            let error = Network::from_json(&network.to_string()).expect_err("a key is missing");
            assert!(error.message().contains(&format!("missing field `{key}`")), "{error}");
        }
    }

    #[test]
    fn each_rule_names_its_key() {
        let side = |v: usize| json!([[4 * v, 4, 4], [2 * v, 2, 2], [v, 1, 1]]);
        let cases = [
            ("/depths/2", json!(0), "\"depths\": found [3, 4, 0, 3]"),
            ("/depths/2", json!(257), "1 to 256"),
            ("/width", json!(65537), "\"width\": found [65537], expected values from 1 to 65536"),
            ("/fpn", json!(0), "\"fpn\""),
            ("/samples/0", json!(0), "\"samples\""),
            ("/cameras", json!(0), "\"cameras\""),
            ("/classes", json!(1), "\"classes\": found 1, expected 2 to 256"),
            ("/classes", json!(257), "\"classes\""),
            ("/strides/0", json!(4), "\"strides\""),
            ("/image/0", json!(900), "\"image\": found [900, 1600]"),
            ("/image/1", json!(16_416), "up to 16384"),
            ("/block", json!("basic"), "\"dcn\""),
            ("/channels/1", json!(60), "\"channels\": found 60, expected multiples of 8"),
            ("/key_dims/1", json!(8), "\"key_dims\": found 8, expected 16 at level 2"),
            ("/grids/1/0", json!(51), "each level exactly half"),
            ("/grids/0/2", json!(0), "\"grids\""),
            ("/grids", json!([[2048, 2048, 512], [1024, 1024, 256], [512, 512, 128]]), "17179869184"),
            ("/bounds/2", json!([3, -5]), "[3, -5] on z"),
            ("/bounds/0", json!([1, 1]), "ascending"),
            ("/bounds/0/0", json!(1e39), "finite"),
        ];
        for (pointer, value, expected) in cases {
            let mut network = sound();
            *network.pointer_mut(pointer).expect("a key") = value;
            let error = Network::from_json(&network.to_string()).expect_err(pointer);
            assert_eq!(error.kind(), crate::ErrorKind::Format);
            assert!(error.message().contains(expected), "{pointer}: {error} (expected {expected})");
        }
        let mut network = sound();
        network["grids"] = side(1);
        Network::from_json(&network.to_string()).expect("the smallest grid");
    }
}

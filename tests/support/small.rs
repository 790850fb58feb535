//! Small networks with drawn weights, rigs and images: whole sessions in milliseconds.

use std::sync::Arc;
use voxcast::graph::Rewrites;
use voxcast::import::{Source, import};
use voxcast::model::Options;
use voxcast::network::{Block, Sampling};
use voxcast::random::Random;
use voxcast::rig::RigBuilder;
use voxcast::weights::Precision;
use voxcast::{ImageView, Isa, Model, Network, Rig};

#[path = "weights.rs"]
mod weights;
pub(crate) use weights::{Tempered, Weights};

/// A network with odd sizes wherever sizes are free: channels that fill no vector, X != Y, windows that need padding.
pub(crate) fn network() -> Network {
    Network {
        depths: [1, 1, 2, 1],
        width: 3,
        dcn: [false, false, true, true],
        block: Block::Bottleneck,
        fpn: 17,
        channels: [9, 16, 24, 32],
        key_dims: [2, 3, 4],
        strides: [8, 16, 32],
        bounds: [[-50.0, 50.0], [-40.0, 40.0], [-5.0, 3.0]],
        classes: 19,
        image: [64, 96],
        grids: [[12, 20, 4], [6, 10, 2], [3, 5, 1]],
        samples: [3, 2, 2],
        sampling: Sampling::Linspace,
        cameras: 2,
    }
}

/// A model file in memory.
pub(crate) fn model_bytes(network: &Network, precision: Precision, rewrites: Rewrites, seed: u64) -> Vec<u8> {
    bytes_of(&Weights(seed), network, Options { precision, rewrites })
}

pub(crate) fn model(network: &Network, precision: Precision, rewrites: Rewrites, seed: u64) -> Arc<Model> {
    Arc::new(Model::from_bytes(model_bytes(network, precision, rewrites, seed)).unwrap())
}

/// A model in f32 whose softmaxes weigh tokens rather than choose one, so that rounding stays as small as it is.
pub(crate) fn tempered(network: &Network, rewrites: Rewrites, seed: u64) -> Arc<Model> {
    let options = Options { precision: Precision::F32, rewrites };
    Arc::new(Model::from_bytes(bytes_of(&Tempered(seed), network, options)).unwrap())
}

fn bytes_of(weights: &impl Source, network: &Network, options: Options) -> Vec<u8> {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("model");
    import(weights, network, options, &path, &mut |_, _| ()).unwrap();
    std::fs::read(&path).unwrap()
}

/// Pinhole cameras that look outwards, turned by `turn` radians.
pub(crate) fn lidar2img(network: &Network, turn: f32) -> Vec<[f32; 16]> {
    let [height, width] = network.image.map(|v| v as f32);
    let (centre_u, centre_v, focal) = (width / 2.0, height / 2.0, width * 0.7);
    (0..network.cameras)
        .map(|i| {
            let (s, c) = (std::f32::consts::TAU * i as f32 / network.cameras as f32 + turn).sin_cos();
            let (right, down, ahead) = ([s, -c, 0.0, 0.1], [0.0, 0.0, -1.0, 0.3], [c, s, 0.0, -0.5]);
            let row = |a: [f32; 4], f: f32, centre: f32| std::array::from_fn(|k| f * a[k] + centre * ahead[k]);
            let rows: [[f32; 4]; 4] =
                [row(right, focal, centre_u), row(down, focal, centre_v), ahead, [0., 0., 0., 1.]];
            rows.concat().try_into().unwrap()
        })
        .collect()
}

pub(crate) fn rig(network: &Network, turn: f32) -> Arc<Rig> {
    let mut builder = RigBuilder::new(network, network.cameras, Isa::best()).unwrap();
    Arc::new(builder.build(&lidar2img(network, turn)).unwrap())
}

/// One image per camera, a little smaller than the network's so that it is padded.
pub(crate) struct Images {
    height: usize,
    width: usize,
    bytes: Vec<Vec<u8>>,
}

impl Images {
    pub(crate) fn new(network: &Network, seed: u64) -> Self {
        let [height, width] = [network.image[0] - 3, network.image[1] - 6];
        let mut random = Random::new(seed);
        let mut image = || (0..height * width * 3).map(|_| random.next_u64() as u8).collect();
        Self { height, width, bytes: (0..network.cameras).map(|_| image()).collect() }
    }

    pub(crate) fn views(&self) -> Vec<ImageView<'_>> {
        self.bytes.iter().map(|bgr| ImageView::bgr(self.height, self.width, bgr)).collect()
    }
}

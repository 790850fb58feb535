//! Small networks with drawn weights, rigs and images: whole sessions in milliseconds.

use std::sync::Arc;
use voxcast::calibrate::Calibrator;
use voxcast::graph::Rewrites;
use voxcast::import::{Integers, Source, import, import_int8_to_bytes};
use voxcast::model::Options;
use voxcast::model::ranges::Ranges;
use voxcast::network::{Block, Sampling};
use voxcast::random::Random;
use voxcast::rig::RigBuilder;
use voxcast::weights::Precision;
use voxcast::{ImageView, Isa, Model, Network, Rig, Threads};

#[path = "scene.rs"]
mod scene;
#[path = "weights.rs"]
mod weights;
#[allow(unused_imports, reason = "other tests use the rest")]
pub(crate) use scene::{lidar2img, scene};
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

/// As small as a network that runs everything can be.
pub(crate) fn tiny() -> Network {
    Network {
        depths: [1; 4],
        width: 2,
        fpn: 5,
        channels: [3, 8, 16, 8],
        key_dims: [1, 2, 1],
        classes: 5,
        image: [32, 64],
        grids: [[8, 4, 4], [4, 2, 2], [2, 1, 1]],
        samples: [1; 3],
        ..network()
    }
}

/// The network with channels that models of this precision compute as it says: for int8 in multiples of four.
pub(crate) fn suited(network: Network, precision: Precision) -> Network {
    match precision {
        Precision::F32 | Precision::F16 => network,
        Precision::I8 => Network { width: 4, fpn: 20, channels: [12, 16, 24, 32], key_dims: [2, 3, 4], ..network },
    }
}

/// A model file in memory; of int8 with ranges measured on two drawn scenes.
pub(crate) fn model_bytes(network: &Network, precision: Precision, rewrites: Rewrites, seed: u64) -> Vec<u8> {
    match precision {
        Precision::F32 | Precision::F16 => bytes_of(&Weights(seed), network, Options { precision, rewrites }),
        Precision::I8 => int8_bytes(network, rewrites, seed, &[]),
    }
}

/// An int8 model file in memory, with these operations kept in f32.
pub(crate) fn int8_bytes(network: &Network, rewrites: Rewrites, seed: u64, keep_f32: &[String]) -> Vec<u8> {
    let ranges = ranges(network, rewrites, seed);
    let integers = Integers { rewrites, ranges: &ranges, keep_f32 };
    import_int8_to_bytes(&Near(Weights(seed)), network, &integers, &mut |_, _| ()).unwrap()
}

/// Weights whose deformable convolutions sample within some pixels and whose gates are half open, as those of trained networks
/// are: integers cannot hold offsets of hundreds.
pub(crate) struct Near(pub(crate) Weights);

impl Source for Near {
    fn tensor(&self, name: &str, shape: &[usize]) -> voxcast::Result<Vec<f64>> {
        let mut values = self.0.tensor(name, shape)?;
        if name.contains("conv_offset") || name.contains("combine_coeff") {
            values.iter_mut().for_each(|value| *value /= 100.0);
        }
        Ok(values)
    }
}

/// The model in f32 that an int8 one of this seed is made of.
pub(crate) fn near(network: &Network, rewrites: Rewrites, seed: u64) -> Arc<Model> {
    let options = Options { precision: Precision::F32, rewrites };
    Arc::new(Model::from_bytes(bytes_of(&Near(Weights(seed)), network, options)).unwrap())
}

/// Ranges of the network's tensors on two drawn scenes.
pub(crate) fn ranges(network: &Network, rewrites: Rewrites, seed: u64) -> Ranges {
    let model = near(network, rewrites, seed);
    let mut calibrator = Calibrator::new(model, Isa::best(), &Threads::calling()).unwrap();
    for seed in [3, 4] {
        calibrator.see(&scene(network, seed)).unwrap();
    }
    calibrator.ranges().unwrap()
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

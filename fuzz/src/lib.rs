//! What the targets share: the smallest network, its model, and containers around fuzzed contents.

use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};
use voxcast::import::import;
use voxcast::model::Options;
use voxcast::network::{Block, Sampling};
use voxcast::random::Random;
use voxcast::seeded::SeededWeights;
use voxcast::{ImageView, Model, Network};

/// Every kind of operation, as small as it gets.
pub fn network() -> Network {
    Network {
        depths: [1; 4],
        width: 1,
        dcn: [false, false, true, true],
        block: Block::Bottleneck,
        fpn: 2,
        channels: [3, 8, 8, 8],
        key_dims: [1, 1, 1],
        strides: [8, 16, 32],
        bounds: [[-8.0, 8.0], [-8.0, 8.0], [-2.0, 2.0]],
        classes: 3,
        image: [32, 64],
        grids: [[8, 4, 4], [4, 2, 2], [2, 1, 1]],
        samples: [2, 1, 1],
        sampling: Sampling::Linspace,
        cameras: 2,
    }
}

/// A path that this process alone writes to; in memory where the system has such a place, for files are made again and again.
pub fn scratch_file(name: &str) -> PathBuf {
    let memory = Path::new("/dev/shm");
    let directory = if memory.is_dir() { memory.to_owned() } else { std::env::temp_dir() };
    directory.join(format!("voxcast-fuzz-{}-{name}", std::process::id()))
}

/// A model file of [`network()`].
pub fn model_bytes(options: Options) -> Vec<u8> {
    let path = scratch_file("model");
    import(&SeededWeights { seed: 1 }, &network(), options, &path, &mut |_, _| ()).expect("a model");
    let bytes = std::fs::read(&path).expect("what was just written");
    std::fs::remove_file(&path).expect("what was just read");
    bytes
}

/// One model of [`network()`], made once.
pub fn model() -> Arc<Model> {
    static MODEL: OnceLock<Arc<Model>> = OnceLock::new();
    let make = || Arc::new(Model::from_bytes(model_bytes(Options::default())).expect("a sound model"));
    MODEL.get_or_init(make).clone()
}

/// The file of this header and `data`, with the checksum made right if there is a place for one.
pub fn sealed(header: &[u8], data: &[u8]) -> Vec<u8> {
    const KEY: &[u8] = b"\"checksum\":\"xxh3-64:";
    let mut header = header.to_vec();
    header.resize((header.len() + 8).next_multiple_of(64) - 8, b' ');
    let mut bytes = [&(header.len() as u64).to_le_bytes()[..], &header, data].concat();
    let digits = bytes[..8 + header.len()].windows(KEY.len()).position(|w| w == KEY).map(|at| at + KEY.len());
    if let Some(digits) = digits.map(|at| at..at + 16).filter(|d| d.end <= 8 + header.len()) {
        bytes[digits.clone()].fill(b'0');
        let sum = xxhash_rust::xxh3::xxh3_64(&bytes);
        bytes[digits].copy_from_slice(format!("{sum:016x}").as_bytes());
    }
    bytes
}

/// Header and data of a file.
pub fn split(file: &[u8]) -> (&[u8], &[u8]) {
    let length = u64::from_le_bytes(file[..8].try_into().expect("eight bytes")) as usize;
    (&file[8..8 + length], &file[8 + length..])
}

/// Bytes of data that the header ends with, as far as they can be guessed.
pub fn data_len(header: &[u8]) -> usize {
    const KEY: &[u8] = b"\"data_offsets\":[";
    let Some(at) = header.windows(KEY.len()).rposition(|w| w == KEY) else { return 0 };
    let pair = &header[at + KEY.len()..];
    let number = pair.split(|&b| b == b',').nth(1).unwrap_or_default();
    let digits: String = number.iter().take_while(|b| b.is_ascii_digit()).map(|&b| char::from(b)).collect();
    digits.parse().unwrap_or(0)
}

/// Camera images of drawn bytes.
pub fn images(network: &Network, cameras: usize) -> Vec<Vec<u8>> {
    let mut random = Random::new(9);
    let mut image = || (0..network.image[0] * network.image[1] * 3).map(|_| random.next_u64() as u8).collect();
    (0..cameras).map(|_| image()).collect()
}

/// As a session takes them.
pub fn views<'a>(network: &Network, images: &'a [Vec<u8>]) -> Vec<ImageView<'a>> {
    let [height, width] = network.image;
    images.iter().map(|bgr| ImageView::bgr(height, width, bgr)).collect()
}

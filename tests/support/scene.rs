//! Drawn scenes.

use voxcast::random::Random;
use voxcast::scene::Image;
use voxcast::{Network, Scene};

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

/// Cameras `CAM_0`, `CAM_1`, ... in a ring, with images of exactly the network's size: blocks of one colour with some
/// grain, neither flat nor mere noise.
#[allow(dead_code, reason = "not every test that has cameras needs their images")]
pub(crate) fn scene(network: &Network, seed: u64) -> Scene {
    let [height, width] = network.image;
    let mut random = Random::new(seed);
    let mut image = || {
        let across = width.div_ceil(8);
        let blocks: Vec<u8> = (0..height.div_ceil(8) * across * 3).map(|_| random.next_u64() as u8).collect();
        let pixel = |i: usize| blocks[(i / (3 * width) / 8 * across + i / 3 % width / 8) * 3 + i % 3] / 4 * 3;
        let bgr = (0..height * width * 3).map(|i| pixel(i) + (random.next_u64() >> 58) as u8).collect();
        Image { height, width, bgr }
    };
    Scene {
        names: (0..network.cameras).map(|i| format!("CAM_{i}")).collect(),
        images: (0..network.cameras).map(|_| image()).collect(),
        lidar2img: lidar2img(network, 0.0),
    }
}

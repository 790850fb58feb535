//! A synthetic world: seeded streets, seen by a ring of cameras, with the class of every voxel.
//!
//! A seed gives a road with lanes, crossings and sidewalks, what is built and grows beside it, and the vehicles, people and
//! things of the 16 classes of nuScenes in places where they belong. Colours, textures, light and weather vary, so that
//! a colour tells no class. It is made to train and to test networks where no recorded data may be shipped.
//!
//! Determinism: only additions, multiplications, divisions and square roots take part, in a fixed order per pixel and
//! voxel, so that a seed gives the same bytes on every machine. Frames are independent of each other.

mod camera;
mod culling;
mod labels;
mod objects;
mod render;
mod solid;
mod street;
mod texture;
mod world;
#[cfg(all(feature = "images", feature = "npz"))]
mod write;

pub use render::{CameraView, SKY};
#[cfg(all(feature = "images", feature = "npz"))]
pub use write::{SET_FORMAT, set_file};

use crate::base::error::{Error, Result};
use crate::base::random::Random;
use crate::network::Network;
use crate::scene::{Scene, forward_of};
use camera::Pinhole;
use labels::VehicleGrid;
use render::Light;
use world::World;

/// Names of the classes, in order; 0 is empty.
pub const CLASSES: [&str; 17] = [
    "empty",
    "barrier",
    "bicycle",
    "bus",
    "car",
    "construction vehicle",
    "motorcycle",
    "pedestrian",
    "traffic cone",
    "trailer",
    "truck",
    "driveable surface",
    "other flat",
    "sidewalk",
    "terrain",
    "manmade",
    "vegetation",
];

/// Metres that the ego vehicle drives from one frame of a sequence to the next: 28.8 km/h at two frames a second.
pub const METRES_PER_FRAME: f32 = 4.0;

/// Nanoseconds from one frame of a sequence to the next.
pub const NANOSECONDS_PER_FRAME: u64 = 500_000_000;

/// A ring of cameras and a grid, for which frames are made.
#[derive(Clone, Debug)]
pub struct Synthesiser {
    cameras: Vec<Pinhole>,
    network: Network,
    forward: [f32; 2],
}

/// One frame: images, and the truth about them.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Images and calibration.
    pub scene: Scene,
    /// When the images are taken: nanoseconds since the sequence began.
    pub stamp: u64,
    /// Class of every voxel of the network's output grid, `[x, y, z]`, z fastest: of what fills at least a sixth of it
    /// (for people, cones and other small things: of an upright through it), else of the ground's surface in it, else 0.
    pub labels: Vec<u8>,
    /// Per voxel 1 where the ray of some camera's pixel passes through it or ends on it, else 0.
    pub visible: Vec<u8>,
    /// Per camera and pixel, the class (255: sky).
    pub pixel_classes: Vec<Vec<u8>>,
    /// Per camera and pixel, the metres along the optical axis (infinite: sky).
    pub pixel_depths: Vec<Vec<f32>>,
}

impl Synthesiser {
    /// For `network`'s image size, number of cameras, bounds and output grid. Six cameras are mounted and named as in
    /// nuScenes, any other number looks around evenly, the first one ahead.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) for a network with fewer classes than there are.
    pub fn new(network: &Network) -> Result<Self> {
        if network.classes < CLASSES.len() {
            let (found, expected) = (network.classes, CLASSES.len());
            return Err(Error::mismatch(format!("a network of {found} classes, expected the {expected} of nuScenes")));
        }
        let forward = forward_of(&network.bounds);
        let cameras = (0..network.cameras).map(|n| Pinhole::of_ring(n, network, forward)).collect();
        Ok(Self { cameras, network: network.clone(), forward })
    }

    /// The same world and grid, seen by other cameras: a name and a row-major 4x4 matrix from lidar-frame metres to
    /// pixels of the network's images for each.
    ///
    /// # Errors
    /// [`ErrorKind::Format`](crate::ErrorKind::Format) for a matrix that no camera can have, or without cameras.
    pub fn with_cameras(self, cameras: &[(String, [f32; 16])]) -> Result<Self> {
        if cameras.is_empty() {
            return Err(Error::format("no cameras, expected at least one"));
        }
        let pinhole = |(name, matrix): &(String, [f32; 16])| {
            let camera = Pinhole::of_matrix(name.clone(), matrix, self.network.image, self.forward);
            camera.ok_or_else(|| Error::format(format!("camera {name}: lidar2img has no inverse, expected a camera's")))
        };
        let cameras = cameras.iter().map(pinhole).collect::<Result<_>>()?;
        Ok(Self { cameras, ..self })
    }

    /// The network whose images and grid are made.
    pub fn network(&self) -> &Network {
        &self.network
    }

    /// The frame of a seed.
    pub fn frame(&self, seed: u64) -> Frame {
        self.frame_of(seed, 0, 1)
    }

    /// Frame `index` of a sequence of `count` in the world of `seed`: from frame to frame the ego vehicle drives
    /// [`METRES_PER_FRAME`] along the road, and others drive too.
    pub fn frame_of(&self, seed: u64, index: usize, count: usize) -> Frame {
        let metres = |frames: usize| METRES_PER_FRAME * frames as f32;
        let world = World::new(seed, metres(count.saturating_sub(1)), metres(index));
        let light = Light::new(&mut Random::new(seed ^ 0x11f4_7e57_ab1e_0001));
        let noise = |camera: usize| seed.wrapping_mul(0x9e37_79b9) ^ (index as u64) << 32 ^ camera as u64;
        let shadows = world.shadows(&light);
        let view = |(n, camera)| world.view(&light, shadows.as_ref(), camera, noise(n));
        let views: Vec<CameraView> = self.cameras.iter().enumerate().map(view).collect();
        let grid = VehicleGrid::new(&self.network, self.forward);
        let labels = labels::voxels(&world, &grid);
        let visible = labels::visible(&grid, &self.cameras, &views);
        let mut frame = Frame {
            scene: Scene { names: Vec::new(), images: Vec::new(), lidar2img: Vec::new() },
            stamp: index as u64 * NANOSECONDS_PER_FRAME,
            labels,
            visible,
            pixel_classes: Vec::new(),
            pixel_depths: Vec::new(),
        };
        for (camera, view) in self.cameras.iter().zip(views) {
            frame.scene.names.push(camera.name.clone());
            frame.scene.lidar2img.push(camera.lidar2img);
            frame.scene.images.push(view.image);
            frame.pixel_classes.push(view.classes);
            frame.pixel_depths.push(view.depths);
        }
        frame
    }
}

#[cfg(test)]
mod tests;

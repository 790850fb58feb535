//! A scene: one set of camera images with their calibration.

use crate::error::{Error, Result};
use crate::network::Network;

/// One camera image: 8-bit, three channels, rows top to bottom, **BGR** as the published networks were trained.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    /// Rows of pixels.
    pub height: usize,
    /// Pixels of a row.
    pub width: usize,
    /// `height * width * 3` bytes, blue first.
    pub bgr: Vec<u8>,
}

/// Images of all cameras at one moment, and where each lidar-frame point lands in them.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// Name of each camera, for people.
    pub names: Vec<String>,
    /// One image per camera, in the camera order of the network's training.
    pub images: Vec<Image>,
    /// Row-major 4x4 per camera: lidar-frame metres (x, y, z, 1) to (u*d, v*d, d, 1) with u, v in image pixels.
    pub lidar2img: Vec<[f32; 16]>,
}

impl Scene {
    /// Number of cameras.
    pub fn cameras(&self) -> usize {
        self.images.len()
    }

    /// Checks that every image, padded to multiples of 32, has the size that `network` takes.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) naming the camera, its size and the expected one.
    pub fn check(&self, network: &Network) -> Result<()> {
        for (name, image) in self.names.iter().zip(&self.images) {
            let padded = [image.height.next_multiple_of(32), image.width.next_multiple_of(32)];
            if padded != network.image {
                return Err(Error::mismatch(format!(
                    "camera {name}: image of {}x{} pads to {}x{}, the network expects {}x{} (height x width)",
                    image.height, image.width, padded[0], padded[1], network.image[0], network.image[1]
                )));
            }
        }
        Ok(())
    }
}

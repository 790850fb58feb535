//! What a session holds of each camera: the latest image, and how old the features are.

use crate::image::ImageView;
use crate::runtime::executor::Image;

/// A camera's part in a result.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CameraStatus {
    /// Which of the camera's images its features come from: the first that it was given is 1. 0 if there was none yet.
    pub image: u64,
    /// Completed frames since then: 0 if the image was new in this frame.
    pub age: u64,
    /// Whether the camera was left out.
    pub masked: bool,
}

/// One camera.
#[derive(Debug)]
pub(super) struct Camera {
    /// Room for an image of the network's size.
    pixels: Vec<u8>,
    size: [usize; 2],
    /// Images received.
    received: u64,
    /// The image in the features, 0 if they are not complete.
    pub(super) features: u64,
    /// Frames completed since the features were.
    pub(super) age: u64,
    /// Whether the frame under way has run this camera's pass; it runs none twice.
    pub(super) passed: bool,
}

impl Camera {
    /// Without an image; `pixels` is the room for one.
    pub(super) fn new(pixels: Vec<u8>) -> Self {
        Self { pixels, size: [0; 2], received: 0, features: 0, age: 0, passed: false }
    }

    /// Takes the next image, which was checked.
    pub(super) fn receive(&mut self, image: &ImageView<'_>) {
        self.size = [image.height, image.width];
        image.copy_to(&mut self.pixels[..image.height * image.width * 3]);
        self.received += 1;
    }

    /// Whether there is an image that the features do not show.
    pub(super) fn is_new(&self) -> bool {
        self.received != self.features
    }

    /// Images received.
    pub(super) fn received(&self) -> u64 {
        self.received
    }

    /// The latest image.
    pub(super) fn image(&self) -> Image<'_> {
        let [height, width] = self.size;
        Image { height, width, bgr: &self.pixels[..height * width * 3] }
    }

    /// Bytes held.
    pub(super) fn bytes(&self) -> usize {
        self.pixels.capacity()
    }
}

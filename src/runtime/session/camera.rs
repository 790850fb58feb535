//! What a session holds of each camera: the size of the latest image, and how old the features are.

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
#[derive(Clone, Debug, Default)]
pub(super) struct CameraState {
    /// Height and width of the latest image.
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

impl CameraState {
    /// The next image has come, of this height and width.
    pub(super) fn receive(&mut self, size: [usize; 2]) {
        self.size = size;
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

    /// Height and width of the latest image.
    pub(super) fn size(&self) -> [usize; 2] {
        self.size
    }
}

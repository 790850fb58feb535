//! voxcast's networks once more, on a Vulkan adapter: one plain WGSL shader per operation, f32, the checkpoint's weights as
//! they are. Nothing is folded, packed or fused, and no arithmetic is shared with the runtime, which is tested against the
//! golden files that this writes.

pub mod cases;
pub mod gpu;
pub mod network;
pub mod network_i8;
pub mod operations;
pub mod operations_i8;
pub mod ops;
pub mod ops_i8;
pub mod projection;

use std::fmt;

/// Why something could not be done, in one line.
#[derive(Debug)]
pub struct Failure(pub String);

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for Failure {}

impl From<voxcast::Error> for Failure {
    fn from(error: voxcast::Error) -> Self {
        Self(error.to_string())
    }
}

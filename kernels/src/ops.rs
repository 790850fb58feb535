//! One file per operation: its formula and the order of its sums, its specification, its vector body, its tests.

pub mod conv;
pub mod deconv3d;
pub mod deform_conv2d;
pub mod depthwise;
pub mod gate;
pub mod gather;
pub mod head;
pub mod max_pool;
pub mod normalise;
pub mod pool;
pub mod project;
pub mod scale_shift;
pub mod upsample_add;
pub mod window_attention;
pub mod winograd;

//! One file per operation: its formula and the order of its sums, its specification, its vector body, its tests.

pub mod conv;
pub mod conv_i8;
pub mod deconv3d;
pub mod deconv3d_i8;
pub mod deform_conv2d;
pub mod deform_conv2d_i8;
pub mod depthwise;
pub mod depthwise_i8;
pub mod dequantise;
pub mod gate;
pub mod gate_i8;
pub mod gather;
pub mod gather_i8;
pub mod head;
pub mod head_i8;
pub mod max_pool;
pub mod max_pool_i8;
pub mod mean_i8;
pub mod normalise;
pub mod normalise_i8;
pub mod pool;
pub mod project;
pub mod quantise;
pub mod scale_shift;
pub mod upsample_add;
pub mod upsample_add_i8;
pub mod window_attention;
pub mod winograd;

/// Makes the registry of a list of kernels.
#[cfg(feature = "cases")]
macro_rules! registry {
    ($($kernel:ident)*) => {
        /// Every kernel.
        pub const REGISTRY: &[crate::cases::Entry] = &[$(crate::cases::Entry {
            name: stringify!($kernel),
            draw: |draw| Some(std::boxed::Box::new($kernel::cases::draw(draw)?)),
            benches: $kernel::cases::benches,
        }),*];
    };
}

#[cfg(feature = "cases")]
registry! {
    conv
    conv_i8
    deconv3d
    deconv3d_i8
    deform_conv2d
    deform_conv2d_i8
    depthwise
    depthwise_i8
    dequantise
    gate
    gate_i8
    gather
    gather_i8
    head
    head_i8
    max_pool
    max_pool_i8
    mean_i8
    normalise
    normalise_i8
    pool
    project
    quantise
    scale_shift
    upsample_add
    upsample_add_i8
    window_attention
    winograd
}

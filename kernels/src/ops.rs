//! One file per operation: its formula and the order of its sums, its specification, its vector body, its tests.

pub mod conv;
pub mod conv_i8;
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
    deform_conv2d
    depthwise
    gate
    gather
    head
    max_pool
    normalise
    pool
    project
    scale_shift
    upsample_add
    window_attention
    winograd
}

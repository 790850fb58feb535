//! Numbers and structs that C programs share with the library: the Rust side of the constants and structs of
//! `include/voxcast.h`, which explains them. Uses nothing of the crate, so that the test of the header can include it.

use std::ffi::c_char;

/// `VOXCAST_ABI`: changes when a program that was compiled for another number would no longer work.
pub(crate) const ABI: u32 = 1;

/// What a function returns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(i32)]
pub(crate) enum Status {
    Ok = 0,
    InvalidArgument = 1,
    BufferTooSmall = 2,
    Io = 3,
    Format = 4,
    Mismatch = 5,
    Unsupported = 6,
    TooLarge = 7,
    NoResult = 8,
    Busy = 9,
    Poisoned = 10,
    Internal = 11,
    SelftestFailed = 12,
}

impl Status {
    /// Every status with its name in the header.
    pub(crate) const NAMES: [(Self, &'static std::ffi::CStr); 13] = [
        (Self::Ok, c"VOXCAST_OK"),
        (Self::InvalidArgument, c"VOXCAST_INVALID_ARGUMENT"),
        (Self::BufferTooSmall, c"VOXCAST_BUFFER_TOO_SMALL"),
        (Self::Io, c"VOXCAST_IO"),
        (Self::Format, c"VOXCAST_FORMAT"),
        (Self::Mismatch, c"VOXCAST_MISMATCH"),
        (Self::Unsupported, c"VOXCAST_UNSUPPORTED"),
        (Self::TooLarge, c"VOXCAST_TOO_LARGE"),
        (Self::NoResult, c"VOXCAST_NO_RESULT"),
        (Self::Busy, c"VOXCAST_BUSY"),
        (Self::Poisoned, c"VOXCAST_POISONED"),
        (Self::Internal, c"VOXCAST_INTERNAL"),
        (Self::SelftestFailed, c"VOXCAST_SELFTEST_FAILED"),
    ];
}

/// `VOXCAST_BGR` and `VOXCAST_RGB`.
pub(crate) const ORDERS: [i32; 2] = [0, 1];

/// `VOXCAST_UNLIMITED`, `VOXCAST_NANOSECONDS` and `VOXCAST_SLICES`.
pub(crate) const BUDGETS: [i32; 3] = [0, 1, 2];

/// `VOXCAST_IDLE`, `VOXCAST_RUNNING` and `VOXCAST_COMPLETE`.
pub(crate) const STEPS: [i32; 3] = [0, 1, 2];

/// Most threads that options may ask for.
pub(crate) const MAX_THREADS: u32 = 1024;

/// `voxcast_network`: numbers of a model's network.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub(crate) struct Network {
    pub(crate) size: usize,
    pub(crate) cameras: usize,
    pub(crate) classes: usize,
    pub(crate) height: usize,
    pub(crate) width: usize,
    pub(crate) grid: [usize; 3],
    pub(crate) voxels: usize,
    pub(crate) bounds: [[f32; 2]; 3],
    pub(crate) checksum: u64,
}

/// `voxcast_options`: how a session or a rig builder runs.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub(crate) struct Options {
    pub(crate) size: usize,
    pub(crate) isa: *const c_char,
    pub(crate) threads: u32,
    pub(crate) logits: u32,
    pub(crate) slice_cost: u64,
    pub(crate) confidence: u32,
    pub(crate) reserved: u32,
}

/// `voxcast_image`: a camera's image where the caller has it.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub(crate) struct Image {
    pub(crate) pixels: *const u8,
    pub(crate) length: usize,
    pub(crate) height: usize,
    pub(crate) width: usize,
    pub(crate) stride: usize,
    pub(crate) order: i32,
    pub(crate) reserved: i32,
}

/// `voxcast_camera`: a camera's part in a result.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub(crate) struct Camera {
    pub(crate) image: u64,
    pub(crate) age: u64,
    pub(crate) masked: u32,
    pub(crate) reserved: u32,
}

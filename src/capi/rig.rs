//! Rigs, and how they are built.

use super::model::ModelHandle;
use super::options;
use super::pointers::{array, path};
use super::status::{Failure, Outcome, call, free, given, invalid, make, own};
use super::types::{Options, Status};
use crate::rig::{Rig, RigBuilder};
use std::ffi::c_char;
use std::mem::MaybeUninit;
use std::sync::{Arc, Mutex};

/// `voxcast_rig`: matrices that sessions may share.
pub(super) struct RigHandle(pub(super) Mutex<Arc<Rig>>);

impl RigHandle {
    fn new(rig: Rig) -> Self {
        Self(Mutex::new(Arc::new(rig)))
    }
}

/// `voxcast_rig_builder`.
pub(super) struct BuilderHandle {
    builder: Mutex<RigBuilder>,
    steps: usize,
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_rig_open(
    model: Option<&ModelHandle>,
    file: *const c_char,
    cameras: usize,
    rig: Option<&mut MaybeUninit<Option<Box<RigHandle>>>>,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let body = || {
        let network = given(model, "model")?.0.network();
        // SAFETY: `file` is null or a string, as the header asks of the caller.
        let file = unsafe { path(file) }?;
        Ok(RigHandle::new(Rig::open(file, network, cameras)?))
    };
    // SAFETY: `message` is null or has room, as the header asks of the caller.
    unsafe { make(rig, message, capacity, body) }
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_rig_check(
    rig: Option<&RigHandle>,
    lidar2img: *const f32,
    cameras: usize,
    known: Option<&mut MaybeUninit<u32>>,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let body = || {
        let known = given(known, "known")?.write(0);
        let rig = own(&given(rig, "rig")?.0, "rig")?;
        // SAFETY: `lidar2img` is null or has 16 numbers per camera, as the header asks of the caller.
        let matrices = unsafe { matrices(lidar2img, cameras) }?;
        *known = u32::from(rig.check_calibration(matrices)?);
        Ok(())
    };
    // SAFETY: `message` is null or has room, as the header asks of the caller.
    unsafe { call(message, capacity, body) }
}

#[unsafe(no_mangle)]
extern "C" fn voxcast_rig_free(rig: Option<Box<RigHandle>>) {
    free(rig);
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_rig_builder_new(
    model: Option<&ModelHandle>,
    cameras: usize,
    options: *const Options,
    builder: Option<&mut MaybeUninit<Option<Box<BuilderHandle>>>>,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let body = || {
        let network = given(model, "model")?.0.network();
        // SAFETY: `options` is null or a struct of the size that it says, as the header asks of the caller.
        let options = unsafe { options::read(options) }?;
        let builder = RigBuilder::new(network, cameras, options.isa)?.with_threads(options.threads);
        Ok(BuilderHandle { steps: builder.steps(), builder: Mutex::new(builder) })
    };
    // SAFETY: `message` is null or has room, as the header asks of the caller.
    unsafe { make(builder, message, capacity, body) }
}

#[unsafe(no_mangle)]
extern "C" fn voxcast_rig_builder_free(builder: Option<Box<BuilderHandle>>) {
    free(builder);
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_rig_builder_build(
    builder: Option<&BuilderHandle>,
    lidar2img: *const f32,
    cameras: usize,
    rig: Option<&mut MaybeUninit<Option<Box<RigHandle>>>>,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let body = || {
        let mut builder = own(&given(builder, "builder")?.builder, "rig builder")?;
        // SAFETY: `lidar2img` is null or has 16 numbers per camera, as the header asks of the caller.
        let matrices = unsafe { matrices(lidar2img, cameras) }?;
        Ok(RigHandle::new(builder.build(matrices)?))
    };
    // SAFETY: `message` is null or has room, as the header asks of the caller.
    unsafe { make(rig, message, capacity, body) }
}

#[unsafe(no_mangle)]
extern "C" fn voxcast_rig_builder_steps(builder: Option<&BuilderHandle>) -> usize {
    builder.map_or(0, |builder| builder.steps)
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_rig_builder_begin(
    builder: Option<&BuilderHandle>,
    lidar2img: *const f32,
    cameras: usize,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let body = || {
        let mut builder = own(&given(builder, "builder")?.builder, "rig builder")?;
        // SAFETY: `lidar2img` is null or has 16 numbers per camera, as the header asks of the caller.
        let matrices = unsafe { matrices(lidar2img, cameras) }?;
        Ok(builder.begin(matrices)?)
    };
    // SAFETY: `message` is null or has room, as the header asks of the caller.
    unsafe { call(message, capacity, body) }
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_rig_builder_advance(
    builder: Option<&BuilderHandle>,
    steps: usize,
    rig: Option<&RigHandle>,
    complete: Option<&mut MaybeUninit<u32>>,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let body = || {
        let complete = given(complete, "complete")?.write(0);
        let mut builder = own(&given(builder, "builder")?.builder, "rig builder")?;
        let mut rig = own(&given(rig, "rig")?.0, "rig")?;
        let rig = Arc::get_mut(&mut rig).ok_or_else(|| {
            Failure::new(Status::Busy, "a session is using the rig, expected one that no session uses")
        })?;
        *complete = u32::from(builder.advance(steps, rig)?);
        Ok(())
    };
    // SAFETY: `message` is null or has room, as the header asks of the caller.
    unsafe { call(message, capacity, body) }
}

/// One matrix per camera.
///
/// # Safety
/// As [`array`], of 16 numbers per camera.
unsafe fn matrices<'a>(lidar2img: *const f32, cameras: usize) -> Outcome<&'a [[f32; 16]]> {
    if lidar2img.is_null() {
        return Err(invalid("lidar2img is NULL"));
    }
    // SAFETY: this function's own condition.
    unsafe { array(lidar2img.cast(), cameras, "lidar2img") }
}

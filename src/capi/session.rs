//! Sessions: made, given images, run.

use super::model::ModelHandle;
use super::options;
use super::pointers::array;
use super::rig::RigHandle;
use super::status::{Outcome, call, free, given, invalid, make, own};
use super::types::{BUDGETS, Image, ORDERS, Options, STEPS};
use crate::image::{ChannelOrder, ImageView};
use crate::runtime::session::{Budget, Session, Step};
use std::ffi::c_char;
use std::mem::MaybeUninit;
use std::sync::Mutex;
use std::time::Duration;

/// `voxcast_session`.
pub(super) struct SessionHandle(pub(super) Mutex<Session>);

// What the header says of it.
const _: () = assert!(size_of::<SessionHandle>() < 4096);

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_session_memory(
    model: Option<&ModelHandle>,
    cameras: usize,
    options: *const Options,
    bytes: Option<&mut MaybeUninit<u64>>,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let body = || {
        let model = &given(model, "model")?.0;
        // SAFETY: `options` is null or a struct of the size that it says, as the header asks of the caller.
        let options = unsafe { options::read(options) }?;
        given(bytes, "bytes")?.write(Session::memory(model, cameras, &options)?.total() as u64);
        Ok(())
    };
    // SAFETY: `message` is null or has room, as the header asks of the caller.
    unsafe { call(message, capacity, body) }
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_session_new(
    model: Option<&ModelHandle>,
    rig: Option<&RigHandle>,
    options: *const Options,
    session: Option<&mut MaybeUninit<Option<Box<SessionHandle>>>>,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let body = || {
        let model = given(model, "model")?.0.clone();
        let rig = own(&given(rig, "rig")?.0, "rig")?.clone();
        // SAFETY: `options` is null or a struct of the size that it says, as the header asks of the caller.
        let options = unsafe { options::read(options) }?;
        Ok(SessionHandle(Mutex::new(Session::new(model, rig, &options)?)))
    };
    // SAFETY: `message` is null or has room, as the header asks of the caller.
    unsafe { make(session, message, capacity, body) }
}

#[unsafe(no_mangle)]
pub(super) extern "C" fn voxcast_session_free(session: Option<Box<SessionHandle>>) {
    free(session);
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_session_set_camera(
    session: Option<&SessionHandle>,
    camera: usize,
    image: Option<&Image>,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let body = || {
        let mut session = own(&given(session, "session")?.0, "session")?;
        // SAFETY: the image is as the header asks of the caller.
        let image = unsafe { view(given(image, "image")?) }?;
        Ok(session.set_camera(camera, image)?)
    };
    // SAFETY: `message` is null or has room, as the header asks of the caller.
    unsafe { call(message, capacity, body) }
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_session_run(
    session: Option<&SessionHandle>,
    images: *const Image,
    count: usize,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let body = || {
        let mut session = own(&given(session, "session")?.0, "session")?;
        // SAFETY: `images` is null or has `count` images, as the header asks of the caller. Any bits are an `Image`.
        let images = unsafe { array(images, count, "images") }?;
        // SAFETY: each image is as the header asks of the caller.
        let view = |image| unsafe { view(image) };
        images.iter().try_for_each(|image| view(image).map(drop))?;
        // Looked at twice, so that no list of views is allocated. None is empty, unless another thread makes it so.
        let empty = ImageView::bgr(0, 0, &[]);
        session.run_each(images.iter().map(|image| view(image).unwrap_or(empty)), &mut |_| ())?;
        Ok(())
    };
    // SAFETY: `message` is null or has room, as the header asks of the caller.
    unsafe { call(message, capacity, body) }
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
pub(super) unsafe extern "C" fn voxcast_session_step(
    session: Option<&SessionHandle>,
    budget: i32,
    amount: u64,
    step: Option<&mut MaybeUninit<i32>>,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let body = || {
        let mut session = own(&given(session, "session")?.0, "session")?;
        let [unlimited, nanoseconds, slices] = BUDGETS;
        let budget = match budget {
            b if b == unlimited => Budget::Unlimited,
            b if b == nanoseconds => Budget::Time(Duration::from_nanos(amount)),
            b if b == slices => Budget::Slices(u32::try_from(amount).unwrap_or(u32::MAX)),
            other => return Err(invalid(format!("budget {other}, expected VOXCAST_UNLIMITED or its neighbours"))),
        };
        let step = given(step, "step")?;
        let [idle, running, complete] = STEPS;
        step.write(match session.step(budget) {
            Step::Idle => idle,
            Step::Running => running,
            Step::Complete => complete,
        });
        Ok(())
    };
    // SAFETY: `message` is null or has room, as the header asks of the caller.
    unsafe { call(message, capacity, body) }
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_session_set_masked(
    session: Option<&SessionHandle>,
    camera: usize,
    masked: u32,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let body = || Ok(own(&given(session, "session")?.0, "session")?.set_masked(camera, masked != 0)?);
    // SAFETY: `message` is null or has room, as the header asks of the caller.
    unsafe { call(message, capacity, body) }
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_session_swap_rig(
    session: Option<&SessionHandle>,
    rig: Option<&RigHandle>,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let body = || {
        let mut session = own(&given(session, "session")?.0, "session")?;
        let mut rig = own(&given(rig, "rig")?.0, "rig")?;
        *rig = session.set_rig(rig.clone())?;
        Ok(())
    };
    // SAFETY: `message` is null or has room, as the header asks of the caller.
    unsafe { call(message, capacity, body) }
}

/// An image as a session takes it.
///
/// # Safety
/// Its pixels are null or as many bytes as it says, which stay as they are for `'a`.
unsafe fn view<'a>(image: &Image) -> Outcome<ImageView<'a>> {
    let Image { pixels, length, height, width, stride, order, reserved } = *image;
    let [bgr, rgb] = ORDERS;
    let order = match order {
        o if o == bgr => ChannelOrder::Bgr,
        o if o == rgb => ChannelOrder::Rgb,
        other => return Err(invalid(format!("order {other}, expected VOXCAST_BGR or VOXCAST_RGB"))),
    };
    if reserved != 0 {
        return Err(invalid(format!("reserved is {reserved}, expected 0")));
    }
    if pixels.is_null() {
        return Err(invalid("pixels is NULL"));
    }
    let stride = if stride == 0 { width.saturating_mul(3) } else { stride };
    // SAFETY: this function's own condition.
    let pixels = unsafe { array(pixels, length, "pixels") }?;
    Ok(ImageView { height, width, stride, order, pixels })
}

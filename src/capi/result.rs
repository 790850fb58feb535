//! What a session found out, copied to where the caller wants it.

use super::pointers::Room;
use super::session::SessionHandle;
use super::status::{Failure, Outcome, call, given, own};
use super::text::Text;
use super::types::{Camera, Status};
use crate::runtime::session::{CameraStatus, Confidence, Occupancy, Session};
use std::ffi::c_char;
use std::mem::MaybeUninit;

/// Tells how long a part of the result is, and copies it if there is one.
///
/// # Safety
/// `message` is null, or `capacity` bytes from it may be written.
unsafe fn copy<T>(
    session: Option<&SessionHandle>,
    room: Room<'_, T>,
    length: impl FnOnce(&Session) -> Outcome<usize>,
    write: impl FnOnce(Occupancy<'_>, &mut [MaybeUninit<T>]),
    (message, capacity): (*mut c_char, usize),
) -> i32 {
    let body = || {
        let session = own(&given(session, "session")?.0, "session")?;
        room.fill(length(&session)?, |out| {
            write(result(&session)?, out);
            Ok(())
        })
    };
    // SAFETY: this function's own condition.
    unsafe { call(message, capacity, body) }
}

/// The last complete result.
fn result(session: &Session) -> Outcome<Occupancy<'_>> {
    session.occupancy().ok_or_else(|| Failure::new(Status::NoResult, "no frame is complete yet"))
}

fn no_logits() -> Failure {
    Failure::new(Status::Unsupported, "the session keeps no logits: its options did not ask for them")
}

fn no_confidence() -> Failure {
    let message = "the session does not say how sure it is: its options did not ask for the confidence";
    Failure::new(Status::Unsupported, message)
}

fn voxels(session: &Session) -> usize {
    session.model().network().output_grid().iter().product()
}

/// [`copy`] of codes of how sure the network is.
///
/// # Safety
/// That of [`copy`].
unsafe fn copy_codes(
    session: Option<&SessionHandle>,
    room: Room<'_, u8>,
    codes: for<'a> fn(Confidence<'a>) -> &'a [u8],
    message: (*mut c_char, usize),
) -> i32 {
    let length = |session: &Session| session.keeps_confidence().then(|| voxels(session)).ok_or_else(no_confidence);
    let write = |o: Occupancy<'_>, out: &mut [MaybeUninit<u8>]| {
        put(out, o.confidence.into_iter().flat_map(codes).copied());
    };
    // SAFETY: this function's own condition.
    unsafe { copy(session, room, length, write, message) }
}

fn put<T>(out: &mut [MaybeUninit<T>], values: impl Iterator<Item = T>) {
    for (out, value) in out.iter_mut().zip(values) {
        out.write(value);
    }
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_session_classes(
    session: Option<&SessionHandle>,
    classes: *mut u8,
    room: usize,
    length: Option<&mut MaybeUninit<usize>>,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let write = |o: Occupancy<'_>, out: &mut [MaybeUninit<u8>]| put(out, o.classes.iter().copied());
    // SAFETY: `classes` and `message` are null or have room, as the header asks of the caller.
    unsafe { copy(session, Room::new(classes, room, length), |s| Ok(voxels(s)), write, (message, capacity)) }
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_session_logits(
    session: Option<&SessionHandle>,
    logits: *mut f32,
    room: usize,
    length: Option<&mut MaybeUninit<usize>>,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let elements = |session: &Session| {
        let elements = voxels(session) * session.model().network().classes;
        session.keeps_logits().then_some(elements).ok_or_else(no_logits)
    };
    let write = |o: Occupancy<'_>, out: &mut [MaybeUninit<f32>]| put(out, o.logits.unwrap_or_default().iter().copied());
    // SAFETY: `logits` and `message` are null or have room, as the header asks of the caller.
    unsafe { copy(session, Room::new(logits, room, length), elements, write, (message, capacity)) }
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_session_confidence_occupied(
    session: Option<&SessionHandle>,
    codes: *mut u8,
    room: usize,
    length: Option<&mut MaybeUninit<usize>>,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    // SAFETY: `codes` and `message` are null or have room, as the header asks of the caller.
    unsafe { copy_codes(session, Room::new(codes, room, length), |sure| sure.occupied, (message, capacity)) }
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_session_confidence_class(
    session: Option<&SessionHandle>,
    codes: *mut u8,
    room: usize,
    length: Option<&mut MaybeUninit<usize>>,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    // SAFETY: `codes` and `message` are null or have room, as the header asks of the caller.
    unsafe { copy_codes(session, Room::new(codes, room, length), |sure| sure.class, (message, capacity)) }
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_session_support(
    session: Option<&SessionHandle>,
    support: *mut u16,
    room: usize,
    length: Option<&mut MaybeUninit<usize>>,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let write = |o: Occupancy<'_>, out: &mut [MaybeUninit<u16>]| put(out, o.support.iter().copied());
    // SAFETY: `support` and `message` are null or have room, as the header asks of the caller.
    unsafe { copy(session, Room::new(support, room, length), |s| Ok(voxels(s)), write, (message, capacity)) }
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_session_bits(
    session: Option<&SessionHandle>,
    bits: *mut u8,
    room: usize,
    length: Option<&mut MaybeUninit<usize>>,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let write = |o: Occupancy<'_>, out: &mut [MaybeUninit<u8>]| put(out, o.bits());
    // SAFETY: `bits` and `message` are null or have room, as the header asks of the caller.
    unsafe { copy(session, Room::new(bits, room, length), |s| Ok(voxels(s).div_ceil(8)), write, (message, capacity)) }
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_session_cameras(
    session: Option<&SessionHandle>,
    cameras: *mut Camera,
    room: usize,
    length: Option<&mut MaybeUninit<usize>>,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let camera = |&CameraStatus { image, age, masked }: &CameraStatus| Camera {
        image,
        age,
        masked: u32::from(masked),
        reserved: 0,
    };
    let write = |o: Occupancy<'_>, out: &mut [MaybeUninit<Camera>]| put(out, o.cameras.iter().map(camera));
    // SAFETY: `cameras` and `message` are null or have room, as the header asks of the caller.
    unsafe { copy(session, Room::new(cameras, room, length), |s| Ok(s.cameras()), write, (message, capacity)) }
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_session_digest(
    session: Option<&SessionHandle>,
    digest: Option<&mut MaybeUninit<u64>>,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let body = || {
        let session = own(&given(session, "session")?.0, "session")?;
        given(digest, "digest")?.write(result(&session)?.digest());
        Ok(())
    };
    // SAFETY: `message` is null or has room, as the header asks of the caller.
    unsafe { call(message, capacity, body) }
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_session_logits_digest(
    session: Option<&SessionHandle>,
    digest: Option<&mut MaybeUninit<u64>>,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let body = || {
        let session = own(&given(session, "session")?.0, "session")?;
        given(digest, "digest")?.write(result(&session)?.logits_digest().ok_or_else(no_logits)?);
        Ok(())
    };
    // SAFETY: `message` is null or has room, as the header asks of the caller.
    unsafe { call(message, capacity, body) }
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_session_longest_slice(
    session: Option<&SessionHandle>,
    nanoseconds: Option<&mut MaybeUninit<u64>>,
    operation: *mut c_char,
    room: usize,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let body = || {
        let session = own(&given(session, "session")?.0, "session")?;
        let (time, longest) =
            session.longest_slice().ok_or_else(|| Failure::new(Status::NoResult, "no step was cut into slices yet"))?;
        given(nanoseconds, "nanoseconds")?.write(u64::try_from(time.as_nanos()).unwrap_or(u64::MAX));
        // SAFETY: `operation` is null or has room, as the header asks of the caller.
        unsafe { Text::new(operation, room) }.write(&longest.name);
        Ok(())
    };
    // SAFETY: `message` is null or has room, as the header asks of the caller.
    unsafe { call(message, capacity, body) }
}

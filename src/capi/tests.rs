//! What a C program cannot bring about: panics, and another call inside of a handle at a known moment. The rest is in
//! `tests/capi`.

use super::session::{SessionHandle, voxcast_session_free, voxcast_session_step};
use super::status::{Outcome, call, make, own};
use super::text::Text;
use super::types::{STEPS, Status};
use crate::graph::Rewrites;
use crate::graph::parts::Precision;
use crate::network::Network;
use crate::rig::RigBuilder;
use crate::runtime::session::{Session, SessionOptions};
use crate::small;
use std::ffi::{CStr, c_char};
use std::mem::MaybeUninit;
use std::sync::{Arc, Mutex};
use voxcast_kernels::Isa;

fn session() -> Session {
    let network = Network { cameras: 1, ..small::tiny() };
    let model = small::model(&network, Precision::F32, Rewrites::ALL, 1);
    let rig = RigBuilder::new(&network, 1, Isa::best()).and_then(|mut b| b.build(&[[0.0; 16]])).expect("a rig");
    Session::new(model, Arc::new(rig), &SessionOptions::default()).expect("a session")
}

/// A status and its message.
fn said(body: impl FnOnce() -> Outcome) -> (i32, String) {
    let mut message: [c_char; 200] = [1; 200];
    // SAFETY: there is room for 200 bytes.
    let status = unsafe { call(message.as_mut_ptr(), message.len(), body) };
    // SAFETY: `call` ends what it writes with NUL.
    let text = unsafe { CStr::from_ptr(message.as_ptr()) };
    (status, text.to_str().expect("UTF-8").to_owned())
}

/// The status of a step of everything there is to do.
fn step(handle: &SessionHandle) -> i32 {
    let mut step = MaybeUninit::new(-1);
    // SAFETY: no message is asked for.
    let status = unsafe { voxcast_session_step(Some(handle), 0, 0, Some(&mut step), std::ptr::null_mut(), 0) };
    // SAFETY: it was written here, and perhaps again.
    let step = unsafe { step.assume_init() };
    assert_eq!(step == STEPS[0], status == Status::Ok as i32, "nothing to do, or nothing done");
    status
}

#[test]
fn a_panic_becomes_a_status_and_poisons_what_it_may_have_harmed() {
    let handle = Box::new(SessionHandle(Mutex::new(session())));
    assert_eq!(step(&handle), Status::Ok as i32);
    let found = said(|| {
        let _session = own(&handle.0, "session")?;
        panic!("number {}", 7)
    });
    assert_eq!(found, (Status::Internal as i32, "a bug in voxcast: number 7".to_owned()));
    assert_eq!(step(&handle), Status::Poisoned as i32);
    let (_, text) = said(|| own(&handle.0, "session").map(drop));
    assert_eq!(text, "an earlier call failed inside the session; it can only be freed");
    voxcast_session_free(Some(handle));
}

#[test]
fn a_call_inside_of_another_is_refused() {
    let state = Mutex::new(5);
    let outer = own(&state, "rig").unwrap_or_else(|_| panic!("nobody has it"));
    let (status, text) = said(|| own(&state, "rig").map(drop));
    assert_eq!((status, &text[..]), (Status::Busy as i32, "another call is using the rig: one at a time, please"));
    drop(outer);
    assert_eq!(said(|| own(&state, "rig").map(drop)), (Status::Ok as i32, String::new()));
}

#[test]
fn a_handle_that_is_not_made_is_null() {
    let mut place = MaybeUninit::<Option<Box<i32>>>::uninit();
    // SAFETY: nothing is assumed of the bytes. To drop them as a box would be a wild pointer freed.
    unsafe { std::ptr::write_bytes(place.as_mut_ptr(), 0xff, 1) };
    // SAFETY: there is no room for a message.
    let status = unsafe { make(Some(&mut place), std::ptr::null_mut(), 0, || panic!("at once")) };
    assert_eq!(status, Status::Internal as i32);
    // SAFETY: `make` has written it.
    assert_eq!(unsafe { place.assume_init() }, None);
}

#[test]
fn text_is_cut_between_characters() {
    for (capacity, expected) in [(1, ""), (2, "a"), (3, "a"), (4, "aä"), (6, "aä"), (7, "aä€"), (9, "aä€")] {
        let mut room = [1u8; 9];
        // SAFETY: there is room for 9 bytes.
        unsafe { Text::new(room.as_mut_ptr().cast(), capacity) }.write("aä€");
        let (text, rest) = room.split_at(expected.len());
        assert_eq!((text, rest[0]), (expected.as_bytes(), 0), "{capacity}");
        assert!(rest[1..].iter().all(|&byte| byte == 1), "{capacity}");
    }
    // SAFETY: there is no room, and none is used.
    unsafe { Text::new(std::ptr::dangling_mut(), 0) }.write("aä€");
}

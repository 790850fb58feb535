//! Any bytes as a checkpoint without a zip: an error, or tensors that can all be converted.
//!
//! The first three pickles of such a file are always alike. The input is tried as a whole file, as what follows them, and as
//! the pickle of the tensors, with keys and storages behind it for it to refer to.

#![no_main]

#[path = "../../tests/support/pth.rs"]
#[allow(dead_code, reason = "the library's tests use the rest")]
mod pth;

use libfuzzer_sys::fuzz_target;
use voxcast::checkpoint::Checkpoint;
use voxcast_fuzz::read_all;

fn try_file(bytes: Vec<u8>) {
    if let Ok(checkpoint) = Checkpoint::from_bytes(bytes) {
        assert!(checkpoint.notes().iter().all(|note| !note.message().contains('\n')));
        read_all(&checkpoint);
    }
}

fuzz_target!(|bytes: &[u8]| {
    try_file(bytes.to_vec());
    try_file([&pth::legacy_head(), bytes].concat());
    let storages = [("0", 4, vec![0; 64]), ("1", 2, vec![0; 64])];
    try_file(pth::legacy_of(bytes.to_vec(), &storages));
});

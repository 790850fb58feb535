//! Any bytes as a checkpoint: an error, or tensors that can all be converted.
//!
//! A checksum stands in front of the pickle in a `.pth`, which mutation never gets past. Bytes that begin as a pickle do
//! are therefore also put into a sound archive, with storages for them to refer to.

#![no_main]

#[path = "../../tests/support/pth.rs"]
#[allow(dead_code, reason = "the library's tests use the rest")]
mod pth;

use libfuzzer_sys::fuzz_target;
use voxcast::checkpoint::Checkpoint;
use voxcast_fuzz::read_all;

fn try_file(bytes: Vec<u8>) {
    if let Ok(checkpoint) = Checkpoint::from_bytes(bytes) {
        read_all(&checkpoint);
    }
}

fuzz_target!(|bytes: &[u8]| {
    if bytes.starts_with(&[0x80]) {
        try_file(pth::pth_of(bytes.to_vec(), &["0", "1"]));
    }
    try_file(bytes.to_vec());
});

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

/// Elements to convert for one input; an expanded view with many names would take minutes.
const MAX_ELEMENTS: usize = 1 << 20;

fn read_all(bytes: Vec<u8>) {
    let Ok(checkpoint) = Checkpoint::from_bytes(bytes) else { return };
    let mut read = 0;
    for name in checkpoint.names() {
        let tensor = checkpoint.get(name).expect("a listed name");
        read += tensor.len();
        if read > MAX_ELEMENTS {
            break;
        }
        if let Ok(values) = tensor.to_f32() {
            assert_eq!(values.len(), tensor.shape().iter().product::<usize>());
            assert!(values.iter().all(|v| v.is_finite()));
        }
        if let Ok(values) = tensor.to_f64() {
            assert_eq!(values.len(), tensor.len());
        }
    }
}

fuzz_target!(|bytes: &[u8]| {
    if bytes.starts_with(&[0x80]) {
        read_all(pth::pth_of(bytes.to_vec(), &["0", "1"]));
    }
    read_all(bytes.to_vec());
});

//! Any bytes as an `.npz` and as an `.npy` of integers: an error, or arrays as long as their shapes say.
//!
//! The input is tried as a whole archive, and as the one entry of a sound one: a checksum cannot be found by mutation.

#![no_main]

use libfuzzer_sys::fuzz_target;
use std::io::{Cursor, Write};
use voxcast::npz::{OwnedElements, read_npy_integers, read_npz};
use voxcast_fuzz::scratch_file;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

/// Arrays that the bytes hold, written to a file and read.
fn read(bytes: &[u8]) {
    let file = scratch_file("npz");
    std::fs::write(&file, bytes).expect("room for a small file");
    let product = |shape: &[usize]| shape.iter().try_fold(1usize, |n, &axis| n.checked_mul(axis));
    if let Ok((shape, integers)) = read_npy_integers(&file) {
        assert_eq!(Some(integers.len()), product(&shape), "{shape:?}");
    }
    let Ok(arrays) = read_npz(&file) else { return };
    for array in arrays {
        let len = match &array.elements {
            OwnedElements::U8(v) => v.len(),
            OwnedElements::U16(v) => v.len(),
            OwnedElements::F32(v) => v.len(),
            OwnedElements::Unread(_) => continue,
        };
        assert_eq!(Some(len), product(&array.shape), "{:?}", array.shape);
    }
}

/// An archive whose one entry is `bytes`.
fn archive(bytes: &[u8], method: CompressionMethod) -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(vec![]));
    let options = SimpleFileOptions::default().compression_method(method);
    zip.start_file("a.npy", options).expect("an entry");
    zip.write_all(bytes).expect("memory to write to");
    zip.finish().expect("memory to write to").into_inner()
}

fuzz_target!(|bytes: &[u8]| {
    read(bytes);
    let Some((&method, entry)) = bytes.split_first() else { return };
    read(&archive(entry, [CompressionMethod::Stored, CompressionMethod::Deflated][usize::from(method % 2)]));
});

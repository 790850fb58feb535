//! Normalisation has one body: rows that are computed apart give what the whole image gives, which is one subtraction.

#![no_main]

use libfuzzer_sys::fuzz_target;
use voxcast_fuzz::differential::Input;
use voxcast_kernels::normalise::{BGR_MEAN, normalise};

fuzz_target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let (height, width) = (input.extent(0, 12), input.extent(0, 40));
    let (padded_height, padded_width) = (height + input.extent(0, 4), (width + input.extent(0, 9)).max(1));
    let image: Vec<u8> = (0..height * width * 3).map(|_| input.byte()).collect();
    let rows = input.rows(padded_height);
    let mut whole = vec![f32::NAN; padded_height * padded_width * 3];
    normalise(&image, height, width, padded_width, 0, &mut whole);
    for (i, got) in whole.iter().enumerate() {
        let (y, x, c) = (i / 3 / padded_width, i / 3 % padded_width, i % 3);
        let inside = y < height && x < width;
        let want = if inside { f32::from(image[(y * width + x) * 3 + c]) - BGR_MEAN[c] } else { 0.0 };
        assert_eq!(got.to_bits(), want.to_bits(), "number {i}");
    }
    let mut part = vec![f32::NAN; rows.len() * padded_width * 3];
    normalise(&image, height, width, padded_width, rows.start, &mut part);
    assert_eq!(part, whole[rows.start * padded_width * 3..rows.end * padded_width * 3]);
});

use super::*;
use png::chunk::ChunkType;
use std::path::PathBuf;

fn decoded(bytes: &[u8]) -> Result<(Image, Vec<String>)> {
    let mut notes = Vec::new();
    decode(bytes, None, &mut notes).map(|image| (image, notes))
}

fn place() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/images"))
}

fn jpeg(name: &str) -> Vec<u8> {
    std::fs::read(place().join(format!("{name}.jpg"))).expect("an image")
}

/// What Pillow and OpenCV decoded `tests/images/*.jpg` to: names, sizes and digests.
fn expected() -> Vec<(String, [usize; 2], String)> {
    let text = std::fs::read_to_string(place().join("expected.json")).expect("a file");
    let root: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    let images = root["images"].as_object().expect("images");
    let number = |v: &serde_json::Value| v.as_u64().expect("a number") as usize;
    let entry = |(name, v): (&String, &serde_json::Value)| {
        (name.clone(), [number(&v["height"]), number(&v["width"])], v["bgr"].as_str().expect("a digest").to_owned())
    };
    images.iter().map(entry).collect()
}

#[test]
fn jpegs_have_the_bytes_of_libjpeg_turbo() {
    let expected = expected();
    assert_eq!(expected.len(), 22);
    for (name, [height, width], digest) in expected {
        let (image, notes) = decoded(&jpeg(&name)).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!([image.height, image.width], [height, width], "{name}");
        assert_eq!(format!("{:016x}", crate::base::digest::bytes(&image.bgr)), digest, "{name}");
        assert_eq!(notes.len(), usize::from(name == "profile"), "{name}: {notes:?}");
    }
}

#[test]
fn no_jpeg_that_is_cut_short_is_decoded() {
    let mut refused = 0;
    for (name, ..) in expected() {
        let bytes = jpeg(&name);
        for length in 0..bytes.len() {
            assert!(decoded(&bytes[..length]).is_err(), "{name}: {length} of {} bytes", bytes.len());
            refused += 1;
        }
        // As some copies end: what is missing replaced by an end.
        let scan = bytes.windows(2).rposition(|m| m == [0xff, 0xda]).expect("a scan");
        let data = scan + 2 + usize::from(u16::from_be_bytes([bytes[scan + 2], bytes[scan + 3]]));
        for length in (data..bytes.len() - 2).step_by(7) {
            let ended = [&bytes[..length], &[0xff, 0xd9]].concat();
            if let Ok((image, _)) = decoded(&ended) {
                // Padding bits of the last byte may be all that is missing.
                assert_eq!(image, decoded(&bytes).unwrap().0, "{name}: {length} of {} bytes and an end", bytes.len());
            }
            refused += 1;
        }
        // What follows the end, such as a second picture, is no part of the image.
        assert_eq!(decoded(&[&bytes[..], b"more"].concat()).unwrap().0, decoded(&bytes).unwrap().0, "{name}");
    }
    assert!(refused > 20_000, "{refused}");
}

#[test]
fn an_end_elsewhere_is_no_end() {
    let bytes = jpeg("444");
    let comment = [&bytes[..2], &[0xff, 0xfe, 0, 4, 0xff, 0xd9], &bytes[2..]].concat();
    assert_eq!(decoded(&comment).unwrap().0, decoded(&bytes).unwrap().0);
    let error = decoded(&comment[..comment.len() - 2]).unwrap_err();
    assert!(error.message().contains("no end of image"), "{error}");
}

#[test]
fn jpegs_that_programs_read_differently_are_refused() {
    use libjpeg_turbo_rs::{PixelFormat, Subsampling, compress_arithmetic, compress_lossless};
    let rgb: Vec<u8> = (0..8 * 8 * 3).map(|i| (i * 7) as u8).collect();
    let grey = &rgb[..64];
    let arithmetic = compress_arithmetic(&rgb, 8, 8, PixelFormat::Rgb, 80, Subsampling::S444).unwrap();
    let lossless = compress_lossless(grey, 8, 8, PixelFormat::Grayscale).unwrap();
    let mut wide = jpeg("444");
    let frame = wide.windows(2).position(|m| m == [0xff, 0xc0]).unwrap();
    (wide[frame + 1], wide[frame + 4]) = (0xc1, 12);
    for (bytes, expected) in [
        (jpeg("turned"), "EXIF orientation 6, expected 1"),
        (jpeg("cmyk"), "of 4 components, expected grey, YCbCr or RGB"),
        (arithmetic, "arithmetic"),
        (lossless, "lossless"),
        (wide, "12 bits a sample, expected 8"),
    ] {
        let error = decoded(&bytes).expect_err(expected);
        assert!(error.kind() == ErrorKind::Unsupported && error.message().contains(expected), "{error}");
    }
}

#[test]
fn damaged_jpegs_are_refused_or_decoded_whole() {
    for name in ["420", "progressive", "restart"] {
        let bytes = jpeg(name);
        let mut refused = 0;
        for at in 0..bytes.len() {
            for bit in [0, 3, 7] {
                let mut damaged = bytes.clone();
                damaged[at] ^= 1 << bit;
                match decoded(&damaged) {
                    Err(_) => refused += 1,
                    Ok((image, _)) => assert_eq!(image.bgr.len(), image.height * image.width * 3),
                }
            }
        }
        assert!(refused > bytes.len() / 4, "{name}: {refused} of {} refused", 3 * bytes.len());
    }
}

#[test]
fn sizes_are_checked_before_memory_is_taken() {
    let size = |bytes: &[u8], size| decode(bytes, Some(size), &mut Vec::new());
    for bytes in [jpeg("420"), png(png::ColorType::Rgb, png::BitDepth::Eight, &[])] {
        let (image, _) = decoded(&bytes).unwrap();
        size(&bytes, [image.height, image.width]).unwrap();
        let error = size(&bytes, [image.height, image.width + 1]).unwrap_err();
        assert!(error.kind() == ErrorKind::Mismatch && error.message().contains("the calibration expects"), "{error}");
    }
    let mut large = jpeg("420");
    let frame = large.windows(2).position(|m| m == [0xff, 0xc0]).unwrap();
    for (side, kind, expected) in [
        (16_384u16, ErrorKind::Format, "expected more bytes for its size"),
        (16_385, ErrorKind::TooLarge, "expected sides up to 16384"),
        (0, ErrorKind::Format, ""),
    ] {
        large[frame + 5..frame + 7].copy_from_slice(&side.to_be_bytes());
        large[frame + 7..frame + 9].copy_from_slice(&side.to_be_bytes());
        let error = decoded(&large).unwrap_err();
        assert!(error.kind() == kind && error.message().contains(expected), "{error}");
    }
}

#[test]
fn orientations_of_exif_blocks() {
    let block = |order: &[u8; 4], words: &[u16]| {
        let word = |v: &u16| if order == b"II*\0" { v.to_le_bytes() } else { v.to_be_bytes() };
        [&order[..], &words.iter().flat_map(word).collect::<Vec<_>>()].concat()
    };
    for value in 1..=8u16 {
        // Offset of the directory 8, two entries: width 0x0100, then orientation 0x0112, each a short.
        let little = block(b"II*\0", &[8, 0, 2, 0x0100, 3, 1, 0, 9, 0, 0x0112, 3, 1, 0, value, 0]);
        let big = block(b"MM\0*", &[0, 8, 2, 0x0100, 3, 0, 1, 9, 0, 0x0112, 3, 0, 1, value, 0]);
        let long = block(b"MM\0*", &[0, 8, 1, 0x0112, 4, 0, 1, 0, value]);
        for tiff in [&little, &big, &long] {
            assert_eq!(orientation(tiff), Some(u32::from(value)));
            assert_eq!(check_orientation(Some(tiff)).is_ok(), value == 1);
            for length in 0..tiff.len() {
                // A cut block states nothing, or the same.
                assert!(orientation(&tiff[..length]).is_none_or(|o| o == u32::from(value)));
            }
        }
    }
    for tiff in [&b"XX*\0\0\0\0\x08"[..], b"II*\0\xff\xff\xff\xff", b"", b"MM\0*\0\0\0\x08\xff\xff"] {
        assert_eq!(orientation(tiff), None);
    }
}

/// A PNG of 3 x 2 pixels whose channels count up, with more chunks in front of its data.
fn png(color: png::ColorType, depth: png::BitDepth, chunks: &[(&[u8; 4], &[u8])]) -> Vec<u8> {
    let mut out = Vec::new();
    let mut encoder = png::Encoder::new(&mut out, 3, 2);
    encoder.set_color(color);
    encoder.set_depth(depth);
    if color == png::ColorType::Indexed {
        encoder.set_palette((0..16u8).flat_map(|i| [i, 2 * i, 255 - i]).collect::<Vec<_>>());
    }
    let mut writer = encoder.write_header().unwrap();
    for (name, data) in chunks {
        writer.write_chunk(ChunkType(**name), data).unwrap();
    }
    let line = (3 * color.samples() * depth as usize).div_ceil(8);
    let opaque = |i: usize| match color {
        png::ColorType::Rgba if i % 4 == 3 => 255,
        png::ColorType::GrayscaleAlpha if i % 2 == 1 => 255,
        _ => (i * 5) as u8,
    };
    let data: Vec<u8> = match color {
        png::ColorType::Indexed => (0..2 * line).map(|i| i as u8 % 16).collect(),
        _ => (0..2 * line).map(opaque).collect(),
    };
    writer.write_image_data(&data).unwrap();
    writer.finish().unwrap();
    out
}

#[test]
fn pngs_of_every_kind_that_is_8_bits_a_channel() {
    use png::{BitDepth, ColorType};
    let grey = |values: [u8; 6]| values.iter().flat_map(|&v| [v; 3]).collect::<Vec<_>>();
    let palette = |i: u8| [255 - i, 2 * i, i];
    let flat = |pixels: [[u8; 3]; 6]| pixels.as_flattened().to_vec();
    for (color, depth, expected) in [
        (ColorType::Rgb, BitDepth::Eight, flat(std::array::from_fn(|i| [2, 1, 0].map(|c| ((3 * i + c) * 5) as u8)))),
        (ColorType::Rgba, BitDepth::Eight, flat(std::array::from_fn(|i| [2, 1, 0].map(|c| ((4 * i + c) * 5) as u8)))),
        (ColorType::Grayscale, BitDepth::Eight, grey([0, 5, 10, 15, 20, 25])),
        (ColorType::GrayscaleAlpha, BitDepth::Eight, grey([0, 10, 20, 30, 40, 50])),
        // Lines of one byte: 0 and 5.
        (ColorType::Grayscale, BitDepth::One, grey([0, 0, 0, 0, 0, 0])),
        (ColorType::Grayscale, BitDepth::Two, grey([0, 0, 0, 0, 0, 85])),
        // Lines of two bytes: 0, 5 and 10, 15.
        (ColorType::Grayscale, BitDepth::Four, grey([0, 0, 0, 0, 170, 0])),
        (ColorType::Indexed, BitDepth::Eight, flat([0, 1, 2, 3, 4, 5].map(palette))),
        (ColorType::Indexed, BitDepth::Four, flat([0, 0, 0, 0, 2, 0].map(palette))),
    ] {
        let (image, notes) = decoded(&png(color, depth, &[])).unwrap_or_else(|e| panic!("{color:?} {depth:?}: {e}"));
        assert_eq!((image.height, image.width, image.bgr), (2, 3, expected), "{color:?} {depth:?}");
        assert!(notes.is_empty());
    }
}

#[test]
fn pngs_that_programs_read_differently_are_refused_or_noted() {
    use png::{BitDepth, ColorType};
    let turned = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x03\0\0";
    let upright = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x01\0\0";
    let animation = [0, 0, 0, 2, 0, 0, 0, 0];
    let rgb = (ColorType::Rgb, BitDepth::Eight);
    for ((color, depth), chunk, expected) in [
        ((ColorType::Rgb, BitDepth::Sixteen), None, "16 bits a channel"),
        ((ColorType::Grayscale, BitDepth::Sixteen), None, "16 bits a channel"),
        // The first grey value, and red, green, blue of the first pixel, are transparent.
        ((ColorType::Grayscale, BitDepth::Eight), Some((b"tRNS", &[0, 0][..])), "pixel (0, 0) is transparent"),
        (rgb, Some((b"tRNS", &[0, 15, 0, 20, 0, 25])), "pixel (1, 0) is transparent"),
        ((ColorType::Indexed, BitDepth::Eight), Some((b"tRNS", &[255, 255, 9])), "pixel (2, 0) is transparent"),
        (rgb, Some((b"eXIf", turned)), "EXIF orientation 3"),
        (rgb, Some((b"acTL", &animation)), "an animation"),
    ] {
        let bytes = png(color, depth, &Vec::from_iter(chunk));
        let error = decoded(&bytes).expect_err(expected);
        assert!(error.kind() == ErrorKind::Unsupported && error.message().contains(expected), "{error}");
    }
    let gamma = |g: u32| g.to_be_bytes();
    let plain = decoded(&png(rgb.0, rgb.1, &[])).unwrap().0;
    for (chunk, data, noted) in [
        (b"gAMA", &gamma(45_455)[..], false),
        (b"gAMA", &gamma(100_000), true),
        (b"sRGB", &[0], false),
        (b"cICP", &[9, 16, 0, 1], true),
        (b"eXIf", upright, false),
        (b"tEXt", b"Comment\0drawn", false),
    ] {
        let (image, notes) = decoded(&png(rgb.0, rgb.1, &[(chunk, data)])).unwrap();
        assert_eq!((image == plain, notes.len()), (true, usize::from(noted)), "{}", String::from_utf8_lossy(chunk));
    }
}

#[test]
fn no_png_that_is_cut_short_or_damaged_is_decoded() {
    let bytes = png(png::ColorType::Rgb, png::BitDepth::Eight, &[(b"gAMA", &45_455u32.to_be_bytes())]);
    let whole = decoded(&bytes).unwrap().0;
    for length in 0..bytes.len() {
        assert!(decoded(&bytes[..length]).is_err(), "{length} of {} bytes", bytes.len());
    }
    for at in 0..bytes.len() {
        let mut damaged = bytes.clone();
        damaged[at] ^= 0x10;
        // Nothing is unseen: every byte is in a chunk with a checksum, or says what chunk it is.
        if let Ok((image, _)) = decoded(&damaged) {
            assert_eq!(image, whole, "byte {at}");
        }
    }
}

#[test]
fn what_is_no_image_is_refused() {
    for bytes in [&b""[..], b"GIF89a", b"BM", b"RIFF....WEBP", &[0xff], &[0xff, 0xd8], b"\x89PN"] {
        assert!(decoded(bytes).unwrap_err().message().contains("expected a JPEG or a PNG"));
    }
    for bytes in [&[0xff, 0xd8, 0xff][..], b"\x89PNG\r\n\x1a\n"] {
        assert_eq!(decoded(bytes).unwrap_err().kind(), ErrorKind::Format);
    }
}

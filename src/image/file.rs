//! Image files as pixels: JPEG and PNG, decoded to the bytes that OpenCV, Pillow and torchvision make of them.
//!
//! Training reads images with one of those, so a result from files is that of the training's pipeline only if the bytes
//! are the same. For PNG they follow from the format. For JPEG they follow from libjpeg-turbo, which all three use: its
//! accurate integer transform, its triangle filter for subsampled colour, its fixed-point colours.
//!
//! A file is decoded whole or refused: one that is cut short or damaged gives no pixels. What would change the pixels if it
//! were obeyed is refused (an orientation, transparency, 16 bits a channel) or noted (a colour profile).

use crate::base::error::{Error, ErrorKind, Result};
use crate::base::note::Note;
use crate::file::bounded::read_bounded;
use crate::image::{Image, check_side};
use crate::network::MAX_SIDE;
use std::path::Path;

/// Pixels that a byte of a PNG can stand for at most: deflate's 1032 bytes of eight one-bit pixels. An image that claims
/// more lies, and is refused before memory is taken for it.
const PNG_PIXELS_PER_BYTE: usize = 8 * 1032;

/// The same of a JPEG, which spends at least one bit on the mean of each block of 8x8 pixels.
const JPEG_PIXELS_PER_BYTE: usize = 8 * 64;

/// Longest image file in bytes: three bytes a pixel of the largest image.
const MAX_FILE: u64 = 3 * (MAX_SIDE * MAX_SIDE) as u64;

/// Scans that a progressive JPEG may have. Encoders write about ten; each is a pass over the whole image.
const MAX_SCANS: usize = 64;

/// Reads the image file of camera `name` as BGR. `size` is the height and width that the calibration says, where it does.
///
/// # Errors
/// Naming file and camera: [`ErrorKind::Io`] when it cannot be read; [`ErrorKind::Format`] when it is no JPEG or PNG, is
/// not whole or claims more pixels than its bytes could hold; [`ErrorKind::Mismatch`] for another size than `size`;
/// [`ErrorKind::TooLarge`] for a side beyond [`MAX_SIDE`]; [`ErrorKind::Unsupported`] for what is read nowhere, or read
/// differently by different programs.
pub(crate) fn read_image(path: &Path, name: &str, size: Option<[usize; 2]>, notes: &mut Vec<Note>) -> Result<Image> {
    let bytes = read_bounded(path, MAX_FILE).map_err(|e| of_camera(name, &e).in_file(path))?;
    let mut found = Vec::new();
    let image = decode_image(&bytes, name, size, &mut found).map_err(|e| e.in_file(path))?;
    notes.extend(found.into_iter().map(|note| note.in_file(path)));
    Ok(image)
}

/// Decodes the image file of camera `name` that is in memory, as [`read_image`] does.
///
/// # Errors
/// Those of [`read_image`] but for [`ErrorKind::Io`], naming the camera alone.
pub(crate) fn decode_image(bytes: &[u8], name: &str, size: Option<[usize; 2]>, notes: &mut Vec<Note>) -> Result<Image> {
    let mut found = Vec::new();
    let image = decode(bytes, size, &mut found).map_err(|e| of_camera(name, &e))?;
    notes.extend(found.into_iter().map(|what| Note::new(format!("image of camera {name}: {what}"))));
    Ok(image)
}

/// The error, said of a camera's image.
fn of_camera(name: &str, e: &Error) -> Error {
    Error::new(e.kind(), format!("image of camera {name}: {}", e.message()))
}

/// Decodes a file that is in memory; what it says and is not obeyed goes to `notes`.
fn decode(bytes: &[u8], size: Option<[usize; 2]>, notes: &mut Vec<String>) -> Result<Image> {
    let decode = match bytes {
        [0xff, 0xd8, 0xff, ..] => decode_jpeg,
        [0x89, b'P', b'N', b'G', ..] => decode_png,
        _ => {
            if bytes.is_empty() {
                return Err(Error::format("the file is empty, expected a JPEG or a PNG"));
            }
            let head = &bytes[..bytes.len().min(8)];
            return Err(Error::format(format!("begins with bytes {head:02x?}, expected a JPEG or a PNG")));
        }
    };
    let image = decode(bytes, size, notes)?;
    debug_assert_eq!(image.bgr.len(), image.height * image.width * 3);
    Ok(image)
}

/// Refuses sizes before memory is taken for them: no side, too long, not `expected`, or more than the file can hold.
fn check_size(found: [usize; 2], expected: Option<[usize; 2]>, bytes: usize, pixels_per_byte: usize) -> Result<()> {
    let [height, width] = found;
    check_side(height, width)?;
    if let Some([h, w]) = expected.filter(|&expected| expected != found) {
        let message = format!("{height}x{width}, the calibration expects {h}x{w} (height x width)");
        return Err(Error::mismatch(message));
    }
    if (height * width).div_ceil(pixels_per_byte) > bytes {
        return Err(Error::format(format!("{height}x{width} in {bytes} bytes, expected more bytes for its size")));
    }
    Ok(())
}

/// Refuses what turns or mirrors the image: OpenCV obeys it, Pillow does not, and the calibration was made for one of both.
fn check_orientation(exif: Option<&[u8]>) -> Result<()> {
    match exif.and_then(orientation) {
        None | Some(1) => Ok(()),
        Some(other) => {
            let message = format!(
                "EXIF orientation {other}, expected 1 or none; turn the pixels as the calibration has them, and drop the tag"
            );
            Err(Error::new(ErrorKind::Unsupported, message))
        }
    }
}

/// The orientation that an EXIF block states: tag 0x0112 of its first directory, as a 16-bit or 32-bit number.
fn orientation(tiff: &[u8]) -> Option<u32> {
    let little = match tiff.first_chunk()? {
        b"II*\0" => true,
        b"MM\0*" => false,
        _ => return None,
    };
    let half = |at: usize| {
        let bytes = *tiff.get(at..)?.first_chunk()?;
        Some(if little { u16::from_le_bytes(bytes) } else { u16::from_be_bytes(bytes) })
    };
    let word = |at: usize| {
        let bytes = *tiff.get(at..)?.first_chunk()?;
        Some(if little { u32::from_le_bytes(bytes) } else { u32::from_be_bytes(bytes) })
    };
    let directory = usize::try_from(word(4)?).ok()?;
    let entries = usize::from(half(directory)?);
    let entry = |i: usize| directory.checked_add(2 + 12 * i);
    let at = (0..entries).map_while(entry).take_while(|&at| half(at).is_some()).find(|&at| half(at) == Some(0x0112))?;
    match half(at.checked_add(2)?)? {
        3 => half(at.checked_add(8)?).map(u32::from),
        4 => word(at.checked_add(8)?),
        _ => None,
    }
}

const PROFILE: &str =
    "its colour profile is not applied, as OpenCV and Pillow do not either: pixels are as they are stored";

fn decode_jpeg(bytes: &[u8], size: Option<[usize; 2]>, notes: &mut Vec<String>) -> Result<Image> {
    use libjpeg_turbo_rs::{ColorSpace, DecodeLimits, Decoder, JpegError, PixelFormat};

    let broken = |e: JpegError| {
        let kind = match e {
            JpegError::Unsupported(_) => ErrorKind::Unsupported,
            JpegError::LimitExceeded { .. } | JpegError::AllocationFailed { .. } => ErrorKind::TooLarge,
            _ => ErrorKind::Format,
        };
        Error::new(kind, format!("JPEG: {e}"))
    };
    let unsupported = |what: String| Err(Error::new(ErrorKind::Unsupported, format!("JPEG: {what}")));
    let limits = DecodeLimits {
        max_width: MAX_SIDE,
        max_height: MAX_SIDE,
        max_pixels: (MAX_SIDE * MAX_SIDE) as u64,
        max_scans: MAX_SCANS,
        max_memory: None,
    };
    let mut decoder = Decoder::new_with_limits(bytes, limits).map_err(broken)?;
    let header = decoder.header();
    let (width, height) = header.dimensions();
    check_size([height, width], size, bytes.len(), JPEG_PIXELS_PER_BYTE)?;
    if header.is_lossless || decoder.is_arithmetic() {
        return unsupported("lossless or arithmetic coding, expected Huffman coding, baseline or progressive".into());
    }
    if header.precision != 8 {
        return unsupported(format!("{} bits a sample, expected 8", header.precision));
    }
    let space = decoder.jpeg_color_space();
    if !matches!(space, ColorSpace::Grayscale | ColorSpace::YCbCr | ColorSpace::Rgb) {
        let components = header.components.len();
        return unsupported(format!("colours {space:?} of {components} components, expected grey, YCbCr or RGB"));
    }
    check_orientation(decoder.exif_data())?;
    if decoder.icc_profile().map_err(broken)?.is_some() {
        notes.push(PROFILE.into());
    }
    // Where only the marker of the end is cut off, the decoder does not miss it.
    if !has_end(bytes) {
        return Err(Error::format("JPEG: no end of image, expected a whole file"));
    }
    decoder.set_output_format(PixelFormat::Bgr);
    decoder.set_stop_on_warning(true);
    // As libjpeg does by default; it shows only where a progressive file leaves coefficients out.
    decoder.set_block_smoothing(true);
    let image = decoder.decode_image().map_err(broken)?;
    Ok(Image { height, width, bgr: image.data })
}

/// Whether a JPEG's segments and scans lead to its end. An `FF D9` elsewhere, such as in a thumbnail, is none.
fn has_end(bytes: &[u8]) -> bool {
    let mut rest = bytes.get(2..).unwrap_or_default();
    while let Some(at) = rest.windows(2).position(|pair| pair[0] == 0xff && !matches!(pair[1], 0 | 0xd0..=0xd7 | 0xff))
    {
        if rest[at + 1] == 0xd9 {
            return true;
        }
        // The length counts itself. What follows a scan's header has no length: the next marker ends it.
        let Some(&length) = rest.get(at + 2..).and_then(<[u8]>::first_chunk) else { return false };
        let Some(next) = rest.get(at + 2 + usize::from(u16::from_be_bytes(length))..) else { return false };
        rest = next;
    }
    false
}

fn decode_png(bytes: &[u8], size: Option<[usize; 2]>, notes: &mut Vec<String>) -> Result<Image> {
    use png::{BitDepth, ColorType, DecodeOptions, Decoder, Limits, Transformations};

    let broken = |e: png::DecodingError| Error::format(format!("PNG: {e}"));
    let unsupported = |what: &str| Err(Error::new(ErrorKind::Unsupported, format!("PNG: {what}")));
    let mut options = DecodeOptions::default();
    options.set_ignore_checksums(false);
    options.set_skip_ancillary_crc_failures(false);
    options.set_ignore_text_chunk(true);
    let mut decoder = Decoder::new_with_options(std::io::Cursor::new(bytes), options);
    // Of rows, and of the chunks beside the image.
    decoder.set_limits(Limits { bytes: bytes.len() + 16 * MAX_SIDE });
    decoder.set_transformations(Transformations::EXPAND);
    let mut reader = decoder.read_info().map_err(broken)?;
    let info = reader.info();
    let [height, width] = [info.height, info.width].map(|side| side as usize);
    check_size([height, width], size, bytes.len(), PNG_PIXELS_PER_BYTE)?;
    if info.bit_depth == BitDepth::Sixteen {
        return unsupported("16 bits a channel, expected 8: programs disagree on how to halve them");
    }
    if info.animation_control().is_some_and(|control| control.num_frames > 1) {
        return unsupported("an animation, expected one image");
    }
    let mut pixels = vec![0; height * width * reader.output_color_type().0.samples()];
    let output = reader.next_frame(&mut pixels).map_err(broken)?;
    // Chunks may come behind the image, and the end must.
    reader.finish().map_err(broken)?;
    let info = reader.info();
    check_orientation(info.exif_metadata.as_deref().map(|exif| exif.strip_prefix(b"Exif\0\0").unwrap_or(exif)))?;
    let gamma = info.gama_chunk.is_some_and(|g| g.into_scaled() != SRGB_GAMMA);
    if info.icc_profile.is_some() || info.coding_independent_code_points.is_some() || gamma {
        notes.push(PROFILE.into());
    }
    let bgr: Vec<u8> = match output.color_type {
        ColorType::Grayscale => pixels.iter().flat_map(|&v| [v; 3]).collect(),
        ColorType::Rgb => {
            pixels.as_chunks_mut::<3>().0.iter_mut().for_each(|p| p.swap(0, 2));
            pixels
        }
        ColorType::GrayscaleAlpha => {
            let pixels = pixels.as_chunks::<2>().0;
            check_opaque(pixels.iter().map(|p| p[1]), width)?;
            pixels.iter().flat_map(|p| [p[0]; 3]).collect()
        }
        ColorType::Rgba => {
            let pixels = pixels.as_chunks::<4>().0;
            check_opaque(pixels.iter().map(|p| p[3]), width)?;
            pixels.iter().flat_map(|p| [p[2], p[1], p[0]]).collect()
        }
        ColorType::Indexed => return Err(Error::format("PNG: a palette was not expanded, expected colours")),
    };
    Ok(Image { height, width, bgr })
}

/// The `gAMA` that goes with sRGB, in 1/100000.
const SRGB_GAMMA: u32 = 45_455;

/// Refuses transparency, which would have to be laid over something.
fn check_opaque(mut alpha: impl Iterator<Item = u8>, width: usize) -> Result<()> {
    match alpha.position(|a| a != 255) {
        None => Ok(()),
        Some(at) => {
            let message = format!("PNG: pixel ({}, {}) is transparent, expected opaque ones", at % width, at / width);
            Err(Error::new(ErrorKind::Unsupported, message))
        }
    }
}

#[cfg(test)]
mod tests;

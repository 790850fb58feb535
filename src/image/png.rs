//! Writing PNG.

use crate::base::error::{Error, ErrorKind, Result};
use crate::file::replace::replace_file;
use image::codecs::png::{CompressionType, FilterType as PngFilter, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use std::path::Path;

/// Writes `height` rows of `width` RGB pixels as PNG.
pub(crate) fn write_rgb_png(path: &Path, width: usize, height: usize, rgb: &[u8]) -> Result<()> {
    let side = |v: usize| u32::try_from(v).map_err(|_| Error::new(ErrorKind::TooLarge, format!("picture side of {v}")));
    let (width, height) = (side(width)?, side(height)?);
    replace_file(path, |out| {
        PngEncoder::new_with_quality(out, CompressionType::Default, PngFilter::Adaptive)
            .write_image(rgb, width, height, ExtendedColorType::Rgb8)
            .map_err(std::io::Error::other)
    })
}

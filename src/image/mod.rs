//! A camera's image: as the caller holds it, and as it lies in a file.

#[cfg(feature = "images")]
pub(crate) mod file;

#[cfg(feature = "images")]
pub(crate) mod png;

use crate::base::error::{Error, ErrorKind, Result};
use crate::network::MAX_SIDE;

/// One camera image: 8-bit, three channels, rows top to bottom, **BGR** as the published networks were trained.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    /// Rows of pixels.
    pub height: usize,
    /// Pixels of a row.
    pub width: usize,
    /// `height * width * 3` bytes, blue first.
    pub bgr: Vec<u8>,
}

/// Refuses an image without pixels or with a side beyond [`MAX_SIDE`].
pub(crate) fn check_side(height: usize, width: usize) -> Result<()> {
    if height == 0 || width == 0 {
        return Err(Error::format(format!("{height}x{width} (height x width), expected at least one pixel")));
    }
    if height > MAX_SIDE || width > MAX_SIDE {
        let message = format!("{height}x{width} (height x width), expected sides up to {MAX_SIDE}");
        return Err(Error::new(ErrorKind::TooLarge, message));
    }
    Ok(())
}

/// The order of a pixel's three bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ChannelOrder {
    /// Blue first, as OpenCV holds images and as the network's normalisation takes them.
    #[default]
    Bgr,
    /// Red first.
    Rgb,
}

/// One camera's image: rows of 3-byte pixels, top to bottom.
#[derive(Clone, Copy, Debug)]
pub struct ImageView<'a> {
    /// Rows.
    pub height: usize,
    /// Pixels of a row.
    pub width: usize,
    /// Bytes from the start of one row to the start of the next, at least `3 * width`.
    pub stride: usize,
    /// Order of a pixel's bytes.
    pub order: ChannelOrder,
    /// The bytes, of which the last row needs only its own: at least `(height - 1) * stride + 3 * width`.
    pub pixels: &'a [u8],
}

impl<'a> ImageView<'a> {
    /// A dense image, blue first.
    pub const fn bgr(height: usize, width: usize, pixels: &'a [u8]) -> Self {
        Self { height, width, stride: 3 * width, order: ChannelOrder::Bgr, pixels }
    }

    /// A dense image, red first.
    pub const fn rgb(height: usize, width: usize, pixels: &'a [u8]) -> Self {
        Self { order: ChannelOrder::Rgb, ..Self::bgr(height, width, pixels) }
    }

    /// The same with `stride` bytes from row to row.
    #[must_use]
    pub const fn with_stride(self, stride: usize) -> Self {
        Self { stride, ..self }
    }

    /// Refuses an image that does not pad to `padded`, height and width, or has not the bytes that it claims.
    pub(crate) fn check(&self, camera: usize, padded: [usize; 2]) -> Result<()> {
        let Self { height, width, stride, pixels, .. } = *self;
        let size = [height, width].map(|v| v.checked_next_multiple_of(32).unwrap_or(0));
        if size != padded {
            return Err(Error::mismatch(format!(
                "image {camera}: {height}x{width} (height x width), the network expects a size that pads to {}x{}",
                padded[0], padded[1]
            )));
        }
        // A size that pads to the network's is small, and has at least one row.
        let needed = stride.checked_mul(height - 1).and_then(|rows| rows.checked_add(3 * width));
        if stride < 3 * width || needed.is_none_or(|needed| pixels.len() < needed) {
            return Err(Error::mismatch(format!(
                "image {camera}: {} bytes with rows {stride} bytes apart, {height}x{width} (height x width) needs rows \
                 at least {} bytes apart and all of the last one",
                pixels.len(),
                3 * width
            )));
        }
        Ok(())
    }

    /// Copies the pixels to `out`, densely and blue first. `check` passed, and `out` holds them exactly.
    pub(crate) fn copy_to(&self, out: &mut [u8]) {
        let row = 3 * self.width;
        for (y, out) in out.chunks_exact_mut(row).enumerate() {
            let pixels = &self.pixels[y * self.stride..][..row];
            match self.order {
                ChannelOrder::Bgr => out.copy_from_slice(pixels),
                ChannelOrder::Rgb => {
                    for (out, pixel) in out.as_chunks_mut::<3>().0.iter_mut().zip(pixels.as_chunks::<3>().0) {
                        *out = [pixel[2], pixel[1], pixel[0]];
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn strides_and_orders_give_the_same_pixels() {
        let dense: Vec<u8> = (0..36).collect();
        let copy = |image: ImageView<'_>| {
            image.check(0, [32, 32]).expect("sound");
            let mut out = vec![0; 36];
            image.copy_to(&mut out);
            out
        };
        assert_eq!(copy(ImageView::bgr(3, 4, &dense)), dense);
        let red: Vec<u8> = dense.chunks_exact(3).flat_map(|p| [p[2], p[1], p[0]]).collect();
        assert_eq!(copy(ImageView::rgb(3, 4, &red)), dense);
        let mut wide = vec![99u8; 2 * 17 + 12];
        for y in 0..3 {
            wide[y * 17..][..12].copy_from_slice(&red[y * 12..][..12]);
        }
        assert_eq!(copy(ImageView::rgb(3, 4, &wide).with_stride(17)), dense, "the last row without its rest");
    }

    #[test]
    fn sizes_that_do_not_fit_are_refused() {
        let bytes = vec![0u8; 64 * 96 * 3];
        let image = |height, width, len| ImageView::bgr(height, width, &bytes[..len]);
        let wrapping = ImageView { stride: 0, ..image(33, 96, 33 * 96 * 3) };
        for (image, expected) in [
            (image(0, 96, 0), "pads to 64x96"),
            (image(65, 96, 64 * 96 * 3), "pads to 64x96"),
            (ImageView { height: usize::MAX, ..wrapping }, "pads to 64x96"),
            (image(64, 96, 64 * 96 * 3 - 1), "18431 bytes with rows 288 bytes apart"),
            (wrapping, "rows 0 bytes apart"),
            (image(33, 96, 33 * 96 * 3).with_stride(287), "rows 287 bytes apart"),
            (image(33, 96, 33 * 96 * 3).with_stride(289), "needs rows at least 288"),
            (image(33, 96, 33 * 96 * 3).with_stride(usize::MAX), "18446744073709551615"),
        ] {
            let error = image.check(7, [64, 96]).expect_err(expected);
            assert!(error.message().starts_with("image 7: ") && error.message().contains(expected), "{error}");
        }
    }
}

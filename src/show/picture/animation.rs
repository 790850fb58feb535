//! Pictures one after the other, as an animated PNG.

use super::{Picture, RgbPixel};
use crate::base::error::{Error, ErrorKind, Result};
use crate::file::replace::Replacement;
use image::ImageBuffer;
use image::imageops::{self, FilterType};
use png::{BitDepth, ColorType, Compression, Encoder, Filter, Writer};
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

/// An animated PNG in the making. The file appears when [`Animation::finish`] succeeds, and not otherwise.
///
/// Browsers and most viewers play the format; others show the first picture. It is without loss, so equal pictures give
/// equal bytes.
pub struct Animation {
    path: PathBuf,
    replacement: Replacement,
    writer: Writer<BufWriter<File>>,
    width: usize,
    height: usize,
    left: usize,
}

impl Animation {
    /// Begins an animation of `frames` pictures of `width` x `height` pixels, `rate` of them per second, over and over.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if the file cannot be made; [`ErrorKind::Format`] without pictures, pixels or rate;
    /// [`ErrorKind::TooLarge`] beyond what the format can count.
    pub fn create(path: &Path, [width, height]: [usize; 2], frames: usize, rate: u16) -> Result<Self> {
        if frames == 0 || width == 0 || height == 0 || rate == 0 {
            return Err(Error::format("an animation without pictures, pixels or rate").in_file(path));
        }
        let counted = |n: usize| {
            u32::try_from(n).map_err(|_| Error::new(ErrorKind::TooLarge, format!("an animation of {n}")).in_file(path))
        };
        let replacement = Replacement::create(path)?;
        let failed = |e: png::EncodingError| Error::io(path, "write", &std::io::Error::other(e));
        let file = replacement.file.try_clone().map_err(|e| Error::io(path, "write", &e))?;
        let mut encoder = Encoder::new(BufWriter::new(file), counted(width)?, counted(height)?);
        encoder.set_color(ColorType::Rgb);
        encoder.set_depth(BitDepth::Eight);
        encoder.set_compression(Compression::Balanced);
        encoder.set_filter(Filter::Adaptive);
        if frames > 1 {
            encoder.set_animated(counted(frames)?, 0).map_err(failed)?;
            encoder.set_frame_delay(1, rate).map_err(failed)?;
        }
        let writer = encoder.write_header().map_err(failed)?;
        Ok(Self { path: path.to_owned(), replacement, writer, width, height, left: frames })
    }

    /// Width and height of its pictures.
    pub fn size(&self) -> [usize; 2] {
        [self.width, self.height]
    }

    /// Appends a picture.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if it cannot be written; [`ErrorKind::Mismatch`] if it has another size, or there have been as many
    /// as were announced.
    pub fn push(&mut self, picture: &Picture) -> Result<()> {
        if [picture.width, picture.height] != [self.width, self.height] || self.left == 0 {
            let message = format!(
                "a picture of {} x {} pixels, expected {} more of {} x {}",
                picture.width, picture.height, self.left, self.width, self.height
            );
            return Err(Error::mismatch(message).in_file(&self.path));
        }
        self.left -= 1;
        self.writer.write_image_data(&picture.rgb).map_err(|e| self.failed(e))
    }

    /// Ends the file and gives it its name.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`] if pictures are missing; [`ErrorKind::Io`] if it cannot be written.
    pub fn finish(self) -> Result<()> {
        let Self { path, replacement, writer, left, .. } = self;
        if left > 0 {
            return Err(Error::mismatch(format!("{left} pictures of the animation are missing")).in_file(&path));
        }
        // This flushes what is buffered.
        writer.finish().map_err(|e| Error::io(&path, "write", &std::io::Error::other(e)))?;
        replacement.commit(&path)
    }

    fn failed(&self, error: png::EncodingError) -> Error {
        Error::io(&self.path, "write", &std::io::Error::other(error))
    }
}

impl Picture {
    /// The same, `width` pixels wide and as high as its proportions make it.
    pub fn scaled(&self, width: usize) -> Picture {
        let width = width.clamp(1, 16_384);
        let height = (self.height * width).div_ceil(self.width.max(1)).max(1);
        let size = u32::try_from(self.width).ok().zip(u32::try_from(self.height).ok());
        let pixels = size.and_then(|(w, h)| ImageBuffer::<RgbPixel<u8>, &[u8]>::from_raw(w, h, &self.rgb[..]));
        let rgb = match pixels {
            Some(pixels) if self.width > 0 && self.height > 0 => {
                imageops::resize(&pixels, width as u32, height as u32, FilterType::CatmullRom).into_raw()
            }
            _ => vec![255; width * height * 3],
        };
        Picture { width, height, rgb }
    }
}

impl Picture {
    /// The same in a page of another size: cut, or white at the right and at the bottom.
    #[must_use]
    pub fn fitted(self, [width, height]: [usize; 2]) -> Picture {
        if [self.width, self.height] == [width, height] {
            return self;
        }
        let mut rgb = vec![255; width * height * 3];
        let kept = 3 * width.min(self.width);
        let rows = rgb.chunks_exact_mut(3 * width.max(1)).zip(self.rgb.chunks_exact(3 * self.width.max(1)));
        rows.for_each(|(to, from)| to[..kept].copy_from_slice(&from[..kept]));
        Picture { width, height, rgb }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::AnimationDecoder;
    use image::codecs::png::PngDecoder;

    fn picture(shade: u8) -> Picture {
        let rgb = (0..7 * 5 * 3).map(|i| shade.wrapping_add(i as u8)).collect();
        Picture { width: 7, height: 5, rgb }
    }

    #[test]
    fn pictures_come_back_in_order() {
        let dir = tempfile::tempdir().unwrap();
        for count in [1, 2, 5] {
            let path = dir.path().join(format!("{count}.png"));
            let mut animation = Animation::create(&path, [7, 5], count, 4).unwrap();
            let pictures: Vec<_> = (0..count).map(|i| picture(40 * i as u8)).collect();
            pictures.iter().for_each(|picture| animation.push(picture).unwrap());
            assert!(!path.exists());
            assert!(animation.push(&pictures[0]).is_err(), "one more than announced");
            animation.finish().unwrap();
            let file = std::io::BufReader::new(File::open(&path).unwrap());
            let decoder = PngDecoder::new(file).unwrap();
            assert_eq!(decoder.is_apng().unwrap(), count > 1);
            if count == 1 {
                assert_eq!(image::open(&path).unwrap().into_rgb8().into_raw(), pictures[0].rgb);
                continue;
            }
            let frames = decoder.apng().unwrap().into_frames().collect_frames().unwrap();
            assert_eq!(frames.len(), count);
            for (frame, picture) in frames.iter().zip(&pictures) {
                assert_eq!(std::time::Duration::from(frame.delay()).as_millis(), 250);
                let rgb: Vec<u8> = frame.buffer().pixels().flat_map(|p| [p[0], p[1], p[2]]).collect();
                assert_eq!(rgb, picture.rgb);
            }
        }
    }

    #[test]
    fn unfinished_and_unfitting_ones_leave_no_file() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        let mut animation = Animation::create(&path, [7, 5], 2, 4).unwrap();
        assert!(animation.push(&picture(0).scaled(6)).unwrap_err().message().contains("6 x 5"));
        animation.push(&picture(0)).unwrap();
        assert!(animation.finish().unwrap_err().message().contains("1 pictures"));
        assert!(Animation::create(&path, [7, 5], 0, 4).is_err());
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
    }

    #[test]
    fn fitting_cuts_or_leaves_white() {
        let wide = picture(0).fitted([9, 4]);
        assert_eq!((wide.width, wide.height, wide.rgb.len()), (9, 4, 108));
        assert_eq!((&wide.rgb[..21], &wide.rgb[21..27]), (&picture(0).rgb[..21], &[255; 6][..]));
        let high = picture(0).fitted([2, 6]);
        assert_eq!((&high.rgb[24..30], &high.rgb[30..]), (&picture(0).rgb[84..90], &[255; 6][..]));
        assert_eq!(picture(3).fitted([7, 5]), picture(3));
    }

    #[test]
    fn scaling_keeps_proportions_and_flat_colours() {
        let flat = Picture { width: 240, height: 90, rgb: vec![77; 240 * 90 * 3] };
        let small = flat.scaled(80);
        assert_eq!((small.width, small.height), (80, 30));
        assert!(small.rgb.iter().all(|&v| v == 77));
    }
}

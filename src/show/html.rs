//! A result as one HTML page that needs nothing else: voxels to turn, truth beside prediction, camera images.
//!
//! The page opens from a disk, without a network: it holds the grids, the images and its own program, and its content
//! security policy lets nothing be loaded and no form be sent. `src/html/` is that program: `viewer.html` with `viewer.css`; `mesh.js`, which
//! makes triangles of voxels; `cameras.js`, which reads cameras' matrices; `viewer.js`, which answers the reader. three.js
//! (`assets/viewer/`) draws.
//!
//! Grids travel as base64 of zlib streams, images as JPEG. Everything that comes from a file, names above all, travels as
//! JSON in which `<` is escaped, and reaches the page as text, never as markup. Equal input gives equal bytes.

use crate::base::digest;
use crate::base::error::{Error, Result};
use crate::file::labels::UNLABELLED;
use crate::file::replace::replace_file;
use crate::scene::{Image, Scene};
use crate::show::picture::{Occupancy, Palette};
use flate2::Compression;
use flate2::write::ZlibEncoder;
use image::codecs::jpeg::JpegEncoder;
use image::imageops::{self, FilterType};
use image::{ExtendedColorType, ImageBuffer, ImageEncoder, Rgb};
use serde::Serialize;
use std::io::Write;
use std::path::Path;

/// Pixels of an image row in the page; wider images are made smaller.
const IMAGE_WIDTH: usize = 640;

/// Of 100, enough that blocks do not show at that size.
const JPEG_QUALITY: u8 = 82;

const TEMPLATE: &str = include_str!("html/viewer.html");
const STYLE: &str = include_str!("html/viewer.css");
const PROGRAM: [&str; 3] =
    [include_str!("html/mesh.js"), include_str!("html/cameras.js"), include_str!("html/viewer.js")];

/// The script that defines `THREE`, as gzip.
static THREE: &[u8] = include_bytes!("../../assets/viewer/three.js.gz");

/// The terms under which three.js may be passed on, which every page repeats.
pub const THREE_LICENSE: &str = include_str!("../../assets/viewer/three-LICENSE.txt");

/// What a page shows.
#[derive(Clone, Copy, Debug)]
pub struct Page<'a> {
    /// First line, and the title of the browser's window.
    pub title: &'a str,
    /// Second line, such as the model's name; may be empty.
    pub subtitle: &'a str,
    /// What was predicted; its support tells "free" and "unknown" apart, and its confidence gives a
    /// slider that hides what is less likely to be there. Its caption names it, "prediction" if empty.
    pub prediction: Occupancy<'a>,
    /// The class of every voxel in truth, z fastest, on the grid of the prediction; 255 marks voxels without a label.
    pub truth: Option<&'a [u8]>,
    /// The images that the prediction was made of.
    pub scene: Option<&'a Scene>,
    /// Names and colours of the classes.
    pub palette: &'a Palette,
}

/// The page's data, as `viewer.js` reads it.
#[derive(Serialize)]
struct Data<'a> {
    title: &'a str,
    subtitle: &'a str,
    version: &'a str,
    digest: String,
    grid: [usize; 3],
    bounds: [[f32; 2]; 3],
    forward: [f32; 2],
    classes: Vec<Class<'a>>,
    prediction: Layer<'a>,
    truth: Option<Layer<'a>>,
    /// u16 per voxel.
    support: Option<String>,
    /// u8 per voxel: the probability that it is occupied.
    confidence: Option<String>,
    cameras: Vec<PageCamera<'a>>,
}

#[derive(Serialize)]
struct Class<'a> {
    name: &'a str,
    rgb: [u8; 3],
}

#[derive(Serialize)]
struct Layer<'a> {
    caption: &'a str,
    /// u8 per voxel.
    classes: String,
}

#[derive(Serialize)]
struct PageCamera<'a> {
    name: &'a str,
    /// Pixels of the original, for which the matrix is.
    width: usize,
    height: usize,
    lidar2img: &'a [f32],
    /// A data URI.
    image: String,
}

impl Page<'_> {
    /// Writes the page. The file appears whole or not at all.
    ///
    /// # Errors
    /// Those of [`Page::to_html`]; [`ErrorKind::Io`](crate::ErrorKind::Io) when the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<()> {
        let html = self.to_html()?;
        replace_file(path, |out| out.write_all(html.as_bytes()))
    }

    /// The page: some 250 kB, and what grids and images take when they are compressed.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) when the truth has not as many voxels as the prediction, when
    /// either has a class that the palette has not, and for a palette of more than 255 classes;
    /// [`ErrorKind::Format`](crate::ErrorKind::Format), naming the camera, for a scene whose names, images and matrices are
    /// not as many, for an image whose bytes do not fit its size, and for a matrix that is not finite.
    pub fn to_html(&self) -> Result<String> {
        let voxels = self.prediction.classes.len();
        if let Some(truth) = self.truth.filter(|t| t.len() != voxels) {
            return Err(Error::mismatch(format!("truth of {} voxels, expected {voxels}", truth.len())));
        }
        let known = self.palette.classes().len();
        if known > usize::from(UNLABELLED) {
            return Err(Error::mismatch(format!("{known} classes, expected at most {UNLABELLED}")));
        }
        check_classes("prediction", self.prediction.classes, known, false)?;
        check_classes("truth", self.truth.unwrap_or_default(), known, true)?;
        let caption = match self.prediction.caption {
            "" => "prediction",
            caption => caption,
        };
        let (support, confidence) = (self.prediction.support, self.prediction.confidence);
        let data = Data {
            title: self.title,
            subtitle: self.subtitle,
            version: env!("CARGO_PKG_VERSION"),
            digest: format!("{:016x}", digest::bytes(self.prediction.classes)),
            grid: self.prediction.grid.size,
            bounds: self.prediction.grid.bounds,
            forward: self.prediction.forward,
            classes: self.palette.classes().iter().map(|c| Class { name: &c.name, rgb: c.rgb }).collect(),
            prediction: Layer { caption, classes: packed(self.prediction.classes) },
            truth: self.truth.map(|classes| Layer { caption: "truth", classes: packed(classes) }),
            support: (!support.is_empty()).then(|| {
                let bytes: Vec<u8> = support.iter().flat_map(|n| n.to_le_bytes()).collect();
                packed(&bytes)
            }),
            confidence: (!confidence.is_empty()).then(|| packed(confidence)),
            cameras: self.scene.map_or(Ok(Vec::new()), cameras)?,
        };
        let json = serde_json::to_string(&data).unwrap_or_default();
        Ok(fill(TEMPLATE, |name| match name {
            "TITLE" => escaped(self.title),
            "THREE_LICENSE" => THREE_LICENSE.trim().to_owned(),
            "STYLE" => STYLE.to_owned(),
            "DATA" => script_safe(&json),
            "THREE" => base64(THREE),
            _ => PROGRAM.concat(),
        }))
    }
}

/// Refuses classes that have no name and no colour.
fn check_classes(what: &str, classes: &[u8], known: usize, unlabelled: bool) -> Result<()> {
    let fits = |class: u8| usize::from(class) < known || (unlabelled && class == UNLABELLED);
    let Some(first) = classes.iter().position(|&class| !fits(class)) else { return Ok(()) };
    let found = classes[first];
    let count = classes.iter().filter(|&&class| class == found).count();
    let message = format!("{what}: {count} voxels of class {found}, the first at {first}, expected 0 to {}", known - 1);
    Err(Error::mismatch(message))
}

/// The template with a text for each `{{NAME}}`. What is put in is not searched again.
fn fill(template: &str, text: impl Fn(&str) -> String) -> String {
    let mut parts = template.split("{{");
    let mut filled = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        let (name, rest) = part.split_once("}}").unwrap_or(("", part));
        filled += &text(name);
        filled += rest;
    }
    filled
}

/// JSON that cannot end the script element it stands in: only strings can hold a `<`, and there an escape means the same.
fn script_safe(json: &str) -> String {
    json.replace('<', "\\u003c")
}

/// Text between tags.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

/// Base64 of the bytes' zlib stream.
fn packed(bytes: &[u8]) -> String {
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::default());
    // Writing to memory does not fail.
    let stream = encoder.write_all(bytes).and_then(|()| encoder.finish()).unwrap_or_default();
    base64(&stream)
}

/// Base64 with the usual alphabet and padding (RFC 4648).
fn base64(bytes: &[u8]) -> String {
    const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for three in bytes.chunks(3) {
        let byte = |i: usize| u32::from(three.get(i).copied().unwrap_or(0));
        let bits = byte(0) << 16 | byte(1) << 8 | byte(2);
        for i in 0..4 {
            let digit = ALPHABET[(bits >> (18 - 6 * i) & 63) as usize];
            text.push(if i <= three.len() { char::from(digit) } else { '=' });
        }
    }
    text
}

fn cameras(scene: &Scene) -> Result<Vec<PageCamera<'_>>> {
    let (names, images, matrices) = (scene.names.len(), scene.images.len(), scene.lidar2img.len());
    if names != images || matrices != images {
        let message = format!("scene of {names} names, {images} images, {matrices} matrices, expected as many of each");
        return Err(Error::format(message));
    }
    let parts = scene.names.iter().zip(&scene.images).zip(&scene.lidar2img);
    parts
        .map(|((name, image), lidar2img)| {
            if lidar2img.iter().any(|v| !v.is_finite()) {
                return Err(Error::format(format!("camera {name}: lidar2img is not finite, expected finite numbers")));
            }
            let Image { width, height, .. } = *image;
            Ok(PageCamera { name, width, height, lidar2img, image: jpeg(name, image)? })
        })
        .collect()
}

/// The image as a data URI, at most [`IMAGE_WIDTH`] pixels wide.
fn jpeg(name: &str, image: &Image) -> Result<String> {
    let Image { height, width, ref bgr } = *image;
    let refused = || {
        let message = format!("camera {name}: {} bytes of pixels, expected {height} x {width} x 3", bgr.len());
        Error::format(message)
    };
    let size = u32::try_from(width).ok().zip(u32::try_from(height).ok()).filter(|&(w, h)| w > 0 && h > 0);
    let (w, h) = size.ok_or_else(refused)?;
    let pixels = ImageBuffer::<Rgb<u8>, &[u8]>::from_raw(w, h, &bgr[..]).ok_or_else(refused)?;
    let (to_w, to_h) = if width > IMAGE_WIDTH {
        let scaled = (height * IMAGE_WIDTH).div_ceil(width).max(1);
        (IMAGE_WIDTH as u32, scaled as u32)
    } else {
        (w, h)
    };
    // The channels are swapped afterwards: scaling treats them alike.
    let mut rgb = imageops::resize(&pixels, to_w, to_h, FilterType::Triangle).into_raw();
    rgb.chunks_exact_mut(3).for_each(|p| p.swap(0, 2));
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY)
        .write_image(&rgb, to_w, to_h, ExtendedColorType::Rgb8)
        .map_err(|e| Error::format(format!("camera {name}: image of {height}x{width}: {e}")))?;
    Ok(format!("data:image/jpeg;base64,{}", base64(&bytes)))
}

#[cfg(test)]
mod tests;

//! A scene: one set of camera images with their calibration.

pub mod camera;
mod stamps;

pub use stamps::read_stamps;

use crate::base::error::{Error, ErrorKind, Result};
use crate::network::Network;
use crate::scene::camera::read_calibration;
use safetensors::{Dtype, SafeTensors};
use std::fs::File;
use std::io::Read;
use std::path::{Component, Path};

/// Cameras that a scene may have.
pub const MAX_CAMERAS: usize = 64;

/// Longest side of an image in pixels.
pub const MAX_SIDE: usize = 16_384;

/// Largest `calibration.json` in bytes; one with 64 cameras needs a hundredth of it.
const MAX_CALIBRATION: u64 = 8 << 20;

/// Pixels that a byte of a compressed image can stand for at most: deflate's 1032 bytes of eight one-bit pixels. An image
/// that claims more lies, and is refused before memory is taken for it.
#[cfg(feature = "images")]
const MAX_PIXELS_PER_BYTE: u64 = 8 * 1032;

/// Name of the threads on which images are decoded.
///
/// A panic there is reported as an error of the file, but the process's panic hook has been called by then. A program
/// that wants to say one thing only gives its hook an exception for this name.
#[cfg(feature = "images")]
pub const DECODER_THREAD: &str = "voxcast image decoder";

/// The ego vehicle's forward direction in the lidar frame, as (x, y), judged by the bounds of the grid.
///
/// A grid that starts at x = 0 and is symmetric in y lies ahead of a vehicle that drives along +x (SemanticKITTI). Any other
/// is taken to lie around a vehicle that drives along +y, as nuScenes mounts its lidar. `bounds` are [min, max] metres of
/// x, y and z.
pub fn forward_of(bounds: &[[f32; 2]; 3]) -> [f32; 2] {
    let [x, y] = [bounds[0], bounds[1]];
    let slack = 1e-3 * (y[1] - y[0]).abs();
    if x[0].abs() <= slack && x[1] > slack && (y[0] + y[1]).abs() <= slack { [1.0, 0.0] } else { [0.0, 1.0] }
}

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

/// Images of all cameras at one moment, and where each lidar-frame point lands in them.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// Name of each camera, for people.
    pub names: Vec<String>,
    /// One image per camera, in the camera order of the network's training.
    pub images: Vec<Image>,
    /// Row-major 4x4 per camera: lidar-frame metres (x, y, z, 1) to (u*d, v*d, d, 1) with u, v in image pixels.
    pub lidar2img: Vec<[f32; 16]>,
}

impl Scene {
    /// Number of cameras.
    pub fn cameras(&self) -> usize {
        self.images.len()
    }

    /// Reads a scene: a directory with `calibration.json` and the JPEG or PNG images that it names, or a `.safetensors`
    /// file with `images` (u8 [N, H, W, 3], BGR) and `lidar2img` (f32 [N, 4, 4]).
    ///
    /// Cameras keep the order of the file. Colours are 8 bits a channel; transparency is dropped, grey becomes three
    /// equal channels and an orientation tag is ignored. JPEG decoders differ in the last bit: scenes that must give the
    /// same bits everywhere hold PNGs or tensors.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when a file is missing or unreadable, naming the camera; [`ErrorKind::Format`] when it is
    /// malformed, holds no camera or more than [`MAX_CAMERAS`], a matrix that is not finite, or a file name that leaves the
    /// directory; [`ErrorKind::Mismatch`] when an image has another size than the calibration says;
    /// [`ErrorKind::TooLarge`] when a side exceeds [`MAX_SIDE`]; [`ErrorKind::Unsupported`] for a directory when the
    /// feature `images` is off.
    pub fn open(path: &Path) -> Result<Self> {
        if path.is_dir() {
            return Self::open_directory(path);
        }
        let bytes = read_bounded(path, u64::MAX)?;
        Self::from_safetensors(&bytes).map_err(|e| e.in_file(path))
    }

    /// Reads the scene of `images` and `lidar2img` from the bytes of a safetensors file, as [`Scene::open`] does.
    ///
    /// # Errors
    /// Those of [`Scene::open`], without a file name.
    pub fn from_safetensors(bytes: &[u8]) -> Result<Self> {
        let file =
            SafeTensors::deserialize(bytes).map_err(|e| Error::format(format!("not a safetensors file: {e}")))?;
        let tensor = |name: &str, dtype: Dtype, expected: &str| {
            let tensor =
                file.tensor(name).map_err(|_| Error::format(format!("no tensor \"{name}\", expected {expected}")))?;
            if tensor.dtype() != dtype {
                let message = format!("tensor \"{name}\" is {:?}, expected {expected}", tensor.dtype());
                return Err(Error::format(message));
            }
            Ok(tensor)
        };
        let shape = |name: &str, found: &[usize], expected: &str| {
            Error::format(format!("tensor \"{name}\" has shape {found:?}, expected {expected}"))
        };
        let images = tensor("images", Dtype::U8, "u8 [N, H, W, 3]")?;
        let &[cameras, height, width, 3] = images.shape() else {
            return Err(shape("images", images.shape(), "[N, H, W, 3]"));
        };
        check_count(cameras)?;
        check_side("images", height, width)?;
        let matrices = tensor("lidar2img", Dtype::F32, "f32 [N, 4, 4]")?;
        if matrices.shape() != [cameras, 4, 4] {
            return Err(shape("lidar2img", matrices.shape(), &format!("[{cameras}, 4, 4]")));
        }
        let mut scene = Scene { names: Vec::new(), images: Vec::new(), lidar2img: Vec::new() };
        let pixels = images.data().chunks_exact(height * width * 3);
        for (camera, (bgr, matrix)) in pixels.zip(matrices.data().chunks_exact(64)).enumerate() {
            let name = format!("camera {camera}");
            let entry = |i: usize| f32::from_le_bytes(std::array::from_fn(|b| matrix[4 * i + b]));
            let matrix: [f32; 16] = std::array::from_fn(entry);
            check_finite(&name, &matrix)?;
            scene.names.push(name);
            scene.images.push(Image { height, width, bgr: bgr.to_vec() });
            scene.lidar2img.push(matrix);
        }
        Ok(scene)
    }

    fn open_directory(directory: &Path) -> Result<Self> {
        let path = directory.join("calibration.json");
        let text = String::from_utf8(read_bounded(&path, MAX_CALIBRATION)?)
            .map_err(|_| Error::format("calibration is not UTF-8 text").in_file(&path))?;
        let cameras = read_calibration(&text).map_err(|e| e.in_file(&path))?;
        check_count(cameras.len()).map_err(|e| e.in_file(&path))?;
        let mut scene = Scene { names: Vec::new(), images: Vec::new(), lidar2img: Vec::new() };
        for camera in cameras {
            check_finite(&camera.name, &camera.lidar2img).map_err(|e| e.in_file(&path))?;
            let file = Path::new(&camera.file);
            if camera.file.is_empty() || file.components().any(|c| !matches!(c, Component::Normal(_))) {
                let message =
                    format!("camera {}: file {:?}, expected a path inside the scene", camera.name, camera.file);
                return Err(Error::format(message).in_file(&path));
            }
            let size = Some([camera.height, camera.width]);
            scene.images.push(read_image(&directory.join(file), &camera.name, size)?);
            scene.names.push(camera.name);
            scene.lidar2img.push(camera.lidar2img);
        }
        Ok(scene)
    }

    /// Writes the scene as a directory that [`Scene::open`] reads back bit for bit: `calibration.json` and one PNG per
    /// camera, named after it. The directory is made if it is missing; each file appears whole or not at all.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when the directory or a file cannot be written; [`ErrorKind::Format`] when the numbers of names,
    /// images and matrices differ or an image has not the bytes that its size says.
    #[cfg(feature = "images")]
    pub fn save(&self, directory: &Path) -> Result<()> {
        self.save_stamped(directory, None)
    }

    /// [`Scene::save`] of images that were all taken at `stamp`, in nanoseconds; [`read_stamps`] finds it again.
    ///
    /// # Errors
    /// As [`Scene::save`].
    #[cfg(feature = "images")]
    pub fn save_stamped(&self, directory: &Path, stamp: Option<u64>) -> Result<()> {
        if self.names.len() != self.images.len() || self.lidar2img.len() != self.images.len() {
            let (names, images, matrices) = (self.names.len(), self.images.len(), self.lidar2img.len());
            let message =
                format!("scene of {names} names, {images} images, {matrices} matrices, expected as many of each");
            return Err(Error::format(message));
        }
        check_count(self.images.len())?;
        std::fs::create_dir_all(directory).map_err(|e| Error::io(directory, "create", &e))?;
        let mut cameras = Vec::new();
        let mut taken = std::collections::BTreeSet::new();
        for (index, (name, image)) in self.names.iter().zip(&self.images).enumerate() {
            check_side(name, image.height, image.width)?;
            if image.bgr.len() != image.height * image.width * 3 {
                let (found, size) = (image.bgr.len(), [image.height, image.width]);
                return Err(Error::format(format!("camera {name}: {found} bytes of pixels, expected {size:?} x 3")));
            }
            let mut stem: String =
                name.chars().take(64).map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
            // Some file systems do not tell cases apart.
            while stem.is_empty() || !taken.insert(stem.to_ascii_lowercase()) {
                stem = format!("{index:02}_{stem}");
            }
            let file = format!("{stem}.png");
            let path = directory.join(&file);
            let mut rgb = image.bgr.clone();
            rgb.chunks_exact_mut(3).for_each(|p| p.swap(0, 2));
            crate::show::picture::write_rgb_png(&path, image.width, image.height, &rgb)?;
            let matrix: Vec<&[f32]> = self.lidar2img[index].chunks(4).collect();
            let mut camera = serde_json::json!({
                "name": name, "file": file, "width": image.width, "height": image.height, "lidar2img": matrix,
            });
            if let Some(stamp) = stamp {
                camera["stamp"] = stamp.into();
            }
            cameras.push(camera);
        }
        let mut text = serde_json::json!({ "cameras": cameras }).to_string();
        text.push('\n');
        crate::file::replace::replace_file(&directory.join("calibration.json"), |out| {
            std::io::Write::write_all(out, text.as_bytes())
        })
    }

    /// Checks that every image, padded to multiples of 32, has the size that `network` takes.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`] naming the camera, its size and the expected one.
    pub fn check(&self, network: &Network) -> Result<()> {
        for (name, image) in self.names.iter().zip(&self.images) {
            let padded = [image.height.next_multiple_of(32), image.width.next_multiple_of(32)];
            if padded != network.image {
                return Err(Error::mismatch(format!(
                    "camera {name}: image of {}x{} pads to {}x{}, the network expects {}x{} (height x width)",
                    image.height, image.width, padded[0], padded[1], network.image[0], network.image[1]
                )));
            }
        }
        Ok(())
    }
}

/// The whole file, if it is not longer than `limit` bytes.
fn read_bounded(path: &Path, limit: u64) -> Result<Vec<u8>> {
    let file = File::open(path).map_err(|e| Error::io(path, "open", &e))?;
    let length = file.metadata().map_err(|e| Error::io(path, "read", &e))?.len();
    if length > limit {
        let message = format!("file of {length} bytes, expected at most {limit}");
        return Err(Error::new(ErrorKind::TooLarge, message).in_file(path));
    }
    let mut bytes = Vec::new();
    // A file that grows meanwhile is not followed.
    file.take(length).read_to_end(&mut bytes).map_err(|e| Error::io(path, "read", &e))?;
    Ok(bytes)
}

fn check_count(cameras: usize) -> Result<()> {
    if (1..=MAX_CAMERAS).contains(&cameras) {
        return Ok(());
    }
    Err(Error::format(format!("{cameras} cameras, expected 1 to {MAX_CAMERAS}")))
}

fn check_side(camera: &str, height: usize, width: usize) -> Result<()> {
    if height == 0 || width == 0 {
        let message =
            format!("camera {camera}: image of {height}x{width} (height x width), expected at least one pixel");
        return Err(Error::format(message));
    }
    if height > MAX_SIDE || width > MAX_SIDE {
        let message =
            format!("camera {camera}: image of {height}x{width} (height x width), expected sides up to {MAX_SIDE}");
        return Err(Error::new(ErrorKind::TooLarge, message));
    }
    Ok(())
}

pub(crate) fn check_finite(camera: &str, matrix: &[f32; 16]) -> Result<()> {
    match matrix.iter().position(|v| !v.is_finite()) {
        None => Ok(()),
        Some(i) => {
            let message =
                format!("camera {camera}: lidar2img[{}][{}] is {}, expected a finite number", i / 4, i % 4, matrix[i]);
            Err(Error::format(message))
        }
    }
}

#[cfg(not(feature = "images"))]
fn read_image(path: &Path, _camera: &str, _size: Option<[usize; 2]>) -> Result<Image> {
    let message = "this build reads no image files (feature \"images\"), expected a .safetensors scene";
    Err(Error::new(ErrorKind::Unsupported, message).in_file(path))
}

/// Reads the image file of camera `name` as BGR. `size` is the height and width that the calibration says, where it does.
///
/// Decoders of image formats are large, and some files make them panic rather than fail. A thread of its own keeps that
/// from the caller, and its name, [`DECODER_THREAD`], tells a panic hook whose panic it is.
#[cfg(feature = "images")]
pub(crate) fn read_image(path: &Path, name: &str, size: Option<[usize; 2]>) -> Result<Image> {
    on_decoder_thread(name, || decode_image(path, name, size)).map_err(|e| e.in_file(path))
}

/// Decodes the image file of camera `name` that is in memory, as [`read_image`] does.
#[cfg(feature = "mcap")]
pub(crate) fn decode_image_bytes(bytes: &[u8], name: &str, size: Option<[usize; 2]>) -> Result<Image> {
    on_decoder_thread(name, || decode(std::io::Cursor::new(bytes), bytes.len() as u64, name, size))
}

#[cfg(feature = "images")]
fn on_decoder_thread(name: &str, decode: impl FnOnce() -> Result<Image> + Send) -> Result<Image> {
    std::thread::scope(|scope| {
        let builder = std::thread::Builder::new().name(DECODER_THREAD.into());
        let thread = builder.spawn_scoped(scope, decode);
        let thread = thread.map_err(|e| Error::new(ErrorKind::Io, format!("cannot start a thread to decode: {e}")))?;
        thread.join().map_err(|_| Error::format(format!("image of camera {name}: its decoder gave up")))?
    })
}

/// Opens and decodes an image.
#[cfg(feature = "images")]
fn decode_image(path: &Path, name: &str, size: Option<[usize; 2]>) -> Result<Image> {
    let missing = |doing: &str, e: &std::io::Error| {
        let e = std::io::Error::new(e.kind(), format!("{e} (image of camera {name})"));
        Error::io(path, doing, &e)
    };
    let file = File::open(path).map_err(|e| missing("open", &e))?;
    let length = file.metadata().map_err(|e| missing("read", &e))?.len();
    decode(std::io::BufReader::new(file), length, name, size).map_err(|e| e.in_file(path))
}

/// Decodes an image of `length` bytes, after its header has passed every check on size.
#[cfg(feature = "images")]
fn decode(
    bytes: impl std::io::BufRead + std::io::Seek,
    length: u64,
    name: &str,
    size: Option<[usize; 2]>,
) -> Result<Image> {
    use image::{DynamicImage, ImageDecoder, ImageReader, Limits};

    let broken = |e: image::ImageError| Error::format(format!("image of camera {name}: {e}"));
    let mut reader = ImageReader::new(bytes)
        .with_guessed_format()
        .map_err(|e| Error::new(ErrorKind::Io, format!("cannot read: {e} (image of camera {name})")))?;
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_SIDE as u32);
    limits.max_image_height = Some(MAX_SIDE as u32);
    // Eight bytes a pixel is the widest that PNG has.
    limits.max_alloc = Some((8 * MAX_SIDE * MAX_SIDE) as u64);
    reader.limits(limits);
    let decoder = reader.into_decoder().map_err(broken)?;
    let (width, height) = decoder.dimensions();
    let (width, height) = (width as usize, height as usize);
    check_side(name, height, width)?;
    if let Some([h, w]) = size.filter(|&size| size != [height, width]) {
        let message =
            format!("camera {name}: image of {height}x{width}, the calibration expects {h}x{w} (height x width)");
        return Err(Error::mismatch(message));
    }
    if (height * width) as u64 > length.saturating_mul(MAX_PIXELS_PER_BYTE) {
        let message =
            format!("camera {name}: image of {height}x{width} in {length} bytes, expected more bytes for its size");
        return Err(Error::format(message));
    }
    let mut bgr = DynamicImage::from_decoder(decoder).map_err(broken)?.into_rgb8().into_raw();
    bgr.chunks_exact_mut(3).for_each(|p| p.swap(0, 2));
    Ok(Image { height, width, bgr })
}

#[cfg(test)]
mod tests;

//! A scene: one set of camera images with their calibration.

pub mod camera;
pub(crate) mod matrix;
mod stamps;

pub use crate::image::Image;
pub use crate::network::{MAX_SIDE, forward_of};
pub use stamps::read_stamps;

use crate::base::error::{Error, Result};
use crate::base::note::Note;
use crate::file::bounded::read_bounded;
use crate::image::check_side;
use crate::network::Network;
use crate::scene::camera::read_calibration_with_notes;
use safetensors::{Dtype, SafeTensors};
use std::path::{Component, Path};

/// Cameras that a scene may have.
pub const MAX_CAMERAS: usize = 64;

/// Largest `calibration.json` in bytes; one with 64 cameras needs a hundredth of it.
const MAX_CALIBRATION: u64 = 8 << 20;

/// Tensors of a scene file: the two that make the scene, and the labels that `voxcast synth --set` puts beside them.
const TENSORS: [&str; 6] = ["images", "lidar2img", "labels", "visible", "pixel.class", "pixel.depth"];

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
    /// Cameras keep the order of the file. Colours are 8 bits a channel, grey becomes three equal channels. JPEGs are
    /// decoded to the bytes that libjpeg-turbo gives, and with it OpenCV, Pillow and torchvision. What the files say and
    /// is not obeyed, [`Scene::open_with_notes`] tells.
    ///
    /// # Errors
    /// [`ErrorKind::Io`](crate::ErrorKind::Io) when a file is missing or unreadable, naming the camera;
    /// [`ErrorKind::Format`](crate::ErrorKind::Format) when it is malformed, not whole, holds no camera or more than
    /// [`MAX_CAMERAS`], a matrix that is not finite or not what it is called ([`read_calibration_with_notes`]), or a file
    /// name that leaves the directory; [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) when an image has another size
    /// than the calibration says; [`ErrorKind::TooLarge`](crate::ErrorKind::TooLarge) when a side exceeds [`MAX_SIDE`];
    /// [`ErrorKind::Unsupported`](crate::ErrorKind::Unsupported) for images that are transparent, turned by a tag,
    /// animated, of more than 8 bits a channel or of other colours than grey, RGB and YCbCr, for cameras that are no
    /// pinholes, and for a directory when the feature `images` is off.
    pub fn open(path: &Path) -> Result<Self> {
        Self::open_with_notes(path).map(|(scene, _)| scene)
    }

    /// [`Scene::open`], and notes on what the files say that is not obeyed or hardly ever meant: keys of a calibration
    /// that are not used, tensors beside the two, a colour profile, an intrinsic whose centre is outside its image.
    ///
    /// # Errors
    /// As [`Scene::open`].
    pub fn open_with_notes(path: &Path) -> Result<(Self, Vec<Note>)> {
        let mut notes = Vec::new();
        if path.is_dir() {
            return Ok((Self::open_directory(path, &mut notes)?, notes));
        }
        let bytes = read_bounded(path, u64::MAX).map_err(|e| e.in_file(path))?;
        let scene = Self::read_safetensors(&bytes, &mut notes).map_err(|e| e.in_file(path))?;
        Ok((scene, notes.into_iter().map(|note| note.in_file(path)).collect()))
    }

    /// Reads the scene of `images` and `lidar2img` from the bytes of a safetensors file, as [`Scene::open`] does.
    ///
    /// # Errors
    /// Those of [`Scene::open`], without a file name.
    pub fn from_safetensors(bytes: &[u8]) -> Result<Self> {
        Self::read_safetensors(bytes, &mut Vec::new())
    }

    fn read_safetensors(bytes: &[u8], notes: &mut Vec<Note>) -> Result<Self> {
        let file = SafeTensors::deserialize(bytes).map_err(|e| {
            let expected = "a scene: a directory with calibration.json, or a .safetensors file";
            Error::format(format!("not a safetensors file ({e}), expected {expected}"))
        })?;
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
        check_side(height, width)
            .map_err(|e| Error::new(e.kind(), format!("tensor \"images\": images of {}", e.message())))?;
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
            check_matrix(&name, &matrix, notes)?;
            scene.names.push(name);
            scene.images.push(Image { height, width, bgr: bgr.to_vec() });
            scene.lidar2img.push(matrix);
        }
        let mut unused: Vec<String> =
            file.names().into_iter().filter(|name| !TENSORS.contains(name)).map(|n| format!("{n:?}")).collect();
        if !unused.is_empty() {
            unused.sort_unstable();
            notes.push(Note::new(format!("tensors that are not used: {}", unused.join(", "))));
        }
        Ok(scene)
    }

    fn open_directory(directory: &Path, notes: &mut Vec<Note>) -> Result<Self> {
        let path = directory.join("calibration.json");
        let text = String::from_utf8(read_bounded(&path, MAX_CALIBRATION)?)
            .map_err(|_| Error::format("calibration is not UTF-8 text").in_file(&path))?;
        let (cameras, found) = read_calibration_with_notes(&text).map_err(|e| e.in_file(&path))?;
        notes.extend(found.into_iter().map(|note| note.in_file(&path)));
        check_count(cameras.len()).map_err(|e| e.in_file(&path))?;
        let mut scene = Scene { names: Vec::new(), images: Vec::new(), lidar2img: Vec::new() };
        for camera in cameras {
            let file = Path::new(&camera.file);
            if camera.file.is_empty() || file.components().any(|c| !matches!(c, Component::Normal(_))) {
                let message =
                    format!("camera {}: file {:?}, expected a path inside the scene", camera.name, camera.file);
                return Err(Error::format(message).in_file(&path));
            }
            let size = Some([camera.height, camera.width]);
            scene.images.push(read_image(&directory.join(file), &camera.name, size, notes)?);
            scene.names.push(camera.name);
            scene.lidar2img.push(camera.lidar2img);
        }
        Ok(scene)
    }

    /// Writes the scene as a directory that [`Scene::open`] reads back bit for bit: `calibration.json` and one PNG per
    /// camera, named after it. The directory is made if it is missing; each file appears whole or not at all.
    ///
    /// # Errors
    /// [`ErrorKind::Io`](crate::ErrorKind::Io) when the directory or a file cannot be written;
    /// [`ErrorKind::Format`](crate::ErrorKind::Format) when the numbers of names, images and matrices differ or an image
    /// has not the bytes that its size says.
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
            check_side(image.height, image.width)
                .map_err(|e| Error::new(e.kind(), format!("camera {name}: image of {}", e.message())))?;
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
            crate::image::png::write_rgb_png(&path, image.width, image.height, &rgb)?;
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
    /// [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) naming the camera, its size and the expected one.
    pub fn check(&self, network: &Network) -> Result<()> {
        let check = |(name, image): (&String, &Image)| check_padded(name, [image.height, image.width], network);
        self.names.iter().zip(&self.images).try_for_each(check)
    }
}

/// Refuses an image, of height and width, that does not pad to the size that `network` takes.
fn check_padded(camera: &str, [height, width]: [usize; 2], network: &Network) -> Result<()> {
    let padded = [height.next_multiple_of(32), width.next_multiple_of(32)];
    if padded == network.image {
        return Ok(());
    }
    Err(Error::mismatch(format!(
        "camera {camera}: image of {height}x{width} pads to {}x{}, the network expects {}x{} (height x width)",
        padded[0], padded[1], network.image[0], network.image[1]
    )))
}

fn check_count(cameras: usize) -> Result<()> {
    if (1..=MAX_CAMERAS).contains(&cameras) {
        return Ok(());
    }
    Err(Error::format(format!("{cameras} cameras, expected 1 to {MAX_CAMERAS}")))
}

/// Refuses a `lidar2img` that is none, and notes one that mirrors.
pub(crate) fn check_matrix(camera: &str, matrix: &[f32; 16], notes: &mut Vec<Note>) -> Result<()> {
    check_finite(camera, matrix)?;
    let rows: [[f64; 4]; 4] = std::array::from_fn(|r| std::array::from_fn(|c| f64::from(matrix[4 * r + c])));
    matrix::check_projection(&rows)
        .map_err(|(found, expected)| Error::format(format!("{camera}: lidar2img is {found}, expected {expected}")))?;
    if matrix::handedness(&rows) < 0.0 {
        notes.push(Note::new(format!("{camera}: lidar2img mirrors the image; is one of its axes turned?")));
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

#[cfg(feature = "images")]
use crate::image::file::read_image;

#[cfg(not(feature = "images"))]
fn read_image(path: &Path, _name: &str, _size: Option<[usize; 2]>, _notes: &mut Vec<Note>) -> Result<Image> {
    let message = "this build reads no image files (feature \"images\"), expected a .safetensors scene";
    Err(Error::new(crate::ErrorKind::Unsupported, message).in_file(path))
}

#[cfg(test)]
mod tests;

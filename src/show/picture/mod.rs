//! One picture of a scene and of what the network made of it, fit for a paper.
//!
//! A [`Figure`] becomes a page with the camera images, per occupancy a bird's-eye-view map and a shaded 3-D view, and a
//! legend with the share of each class. [`draw`] runs on one thread in a fixed order and calls no function whose result
//! depends on the machine: equal input gives equal bytes.

mod animation;
mod bev;
mod canvas;
mod cells;
mod layout;
mod legend;
mod matrix;
mod palette;
mod patch;
mod reliability;
mod text;
mod vehicle;
mod voxels;

pub use animation::Animation;
pub use matrix::{Matrix, draw_matrix};
pub use palette::{Class, Palette};
pub use reliability::{Curve, Diagram, Point, draw_diagram};
pub use text::FONT_LICENSE;

use crate::base::error::{Error, ErrorKind, Result};
use crate::image::png::write_rgb_png;
use crate::network::Grid;
use crate::scene::Image;
use canvas::{Canvas, Rect, Rgb};
use image::imageops::{self, FilterType};
use image::{ImageBuffer, Rgb as RgbPixel};
use layout::{GAP, LABEL, MARGIN, PAGE};
use std::path::Path;
use text::{Fonts, Weight};

/// Voxels that an occupancy may have.
const MAX_VOXELS: usize = 1 << 27;

/// Images that a figure shows; more are left out.
const MAX_IMAGES: usize = 64;

/// Occupancies that a figure shows; more are left out.
const MAX_OCCUPANCIES: usize = 4;

const PAPER: Rgb = [255; 3];
const INK: Rgb = [24, 27, 32];
const GREY: Rgb = [98, 104, 114];

/// A grid of classes to draw, with its place in the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Occupancy<'a> {
    pub(crate) caption: &'a str,
    pub(crate) classes: &'a [u8],
    pub(crate) grid: Grid,
    pub(crate) forward: [f32; 2],
    pub(crate) support: &'a [u16],
    /// Read by pages, where the reader chooses what is hidden.
    #[cfg(feature = "html")]
    pub(crate) confidence: &'a [u8],
}

impl<'a> Occupancy<'a> {
    /// A view of `classes`, row-major [X, Y, Z] with x slowest, of the voxels of `grid`.
    ///
    /// The origin of the grid's frame is taken for the place of the vehicle. `forward` is the vehicle's direction in the x-y
    /// plane, of any length (see [`Grid::forward`]); the map turns in quarter turns only. `caption` names the occupancy in the
    /// picture, such as "prediction"; it may be empty. Class 0, and classes that the palette does not have, are not drawn.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`] when `classes` has not as many bytes as the grid has voxels; [`ErrorKind::Format`] for an axis
    /// without voxels, for bounds that are not finite and ascending, and for a forward direction that is not finite or zero;
    /// [`ErrorKind::TooLarge`] beyond 2^27 voxels or an axis beyond 4096.
    pub fn new(caption: &'a str, classes: &'a [u8], grid: Grid, forward: [f32; 2]) -> Result<Self> {
        let size = grid.size;
        if size.contains(&0) {
            return Err(Error::format(format!("grid {size:?}, expected at least one voxel on every axis")));
        }
        let voxels = size.iter().try_fold(1usize, |n, &v| n.checked_mul(v));
        let Some(voxels) = voxels.filter(|&n| n <= MAX_VOXELS && size.iter().all(|&v| v <= 4096)) else {
            let message = format!("grid {size:?}, expected at most {MAX_VOXELS} voxels and 4096 on an axis");
            return Err(Error::new(ErrorKind::TooLarge, message));
        };
        if classes.len() != voxels {
            return Err(Error::mismatch(format!("{} classes, expected {voxels} for grid {size:?}", classes.len())));
        }
        for (axis, [low, high]) in ["x", "y", "z"].iter().zip(grid.bounds) {
            let sane = low.is_finite() && high.is_finite() && high - low >= 1e-3 && low.abs().max(high.abs()) <= 1e5;
            if !sane {
                let message = format!("bounds [{low}, {high}] on {axis}, expected ascending metres within 100 km");
                return Err(Error::format(message));
            }
        }
        let [fx, fy] = forward.map(f64::from);
        let length = (fx * fx + fy * fy).sqrt();
        if !(length.is_finite() && length > 1e-6) {
            return Err(Error::format(format!("forward direction {forward:?}, expected finite numbers, not both 0")));
        }
        let forward = [(fx / length) as f32, (fy / length) as f32];
        Ok(Self {
            caption,
            classes,
            grid,
            forward,
            support: &[],
            #[cfg(feature = "html")]
            confidence: &[],
        })
    }

    /// The same with the number of pixels that see each voxel: places that no camera sees are hatched on the map and pale
    /// in the 3-D view.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`] when `support` has not as many numbers as the grid has voxels.
    pub fn with_support(self, support: &'a [u16]) -> Result<Self> {
        if support.len() != self.classes.len() {
            let message = format!("{} support counts, expected {}", support.len(), self.classes.len());
            return Err(Error::mismatch(message));
        }
        Ok(Self { support, ..self })
    }

    /// The same with the probability that each voxel is occupied, 0 to 255 for 0 to 1
    /// ([`Confidence::occupied`](crate::Confidence::occupied)): pages get a slider that hides voxels by it. Pictures do not
    /// change.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`] when `occupied` has not as many numbers as the grid has voxels.
    #[cfg(feature = "html")]
    pub fn with_confidence(self, occupied: &'a [u8]) -> Result<Self> {
        if occupied.len() != self.classes.len() {
            let message = format!("{} confidences, expected {}", occupied.len(), self.classes.len());
            return Err(Error::mismatch(message));
        }
        Ok(Self { confidence: occupied, ..self })
    }

    /// Whether it is known that no camera sees voxel `index`.
    fn is_unseen(&self, index: usize) -> bool {
        self.support.get(index) == Some(&0)
    }
}

/// What to draw.
#[derive(Clone, Copy, Debug)]
pub struct Figure<'a> {
    /// First line of the page, in bold; may be empty.
    pub title: &'a str,
    /// Text under the title, broken into lines where it is long; may be empty.
    pub subtitle: &'a str,
    /// Camera names and images. Six with the names of nuScenes stand in its usual arrangement, others in the order given.
    /// At most 64 are shown.
    pub images: &'a [(&'a str, &'a Image)],
    /// What was predicted, and next to it what is compared: one below the other, at most four.
    pub occupancies: &'a [Occupancy<'a>],
    /// Names and colours of the classes, for all occupancies.
    pub palette: &'a Palette,
}

/// An RGB image.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Picture {
    /// Pixels of a row.
    pub width: usize,
    /// Rows of pixels.
    pub height: usize,
    /// `height * width * 3` bytes, red first, rows top to bottom.
    pub rgb: Vec<u8>,
}

impl Picture {
    /// Writes the picture as PNG. The file appears whole or not at all.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when it cannot be written.
    pub fn write_png(&self, path: &Path) -> Result<()> {
        write_rgb_png(path, self.width, self.height, &self.rgb)
    }
}

/// Draws the 3-D view of `occupancy` alone, on white. Sides are taken as 1 to 8192 pixels.
pub fn draw_voxels(occupancy: &Occupancy<'_>, palette: &Palette, width: usize, height: usize) -> Picture {
    let (width, height) = (width.clamp(1, 8192), height.clamp(1, 8192));
    Picture { width, height, rgb: voxels::render(occupancy, palette, width, height, PAPER) }
}

/// Draws the page: 2400 pixels wide, as high as it needs to be.
///
/// An image whose bytes do not fit its size leaves an empty frame. Time goes with the visible voxel faces and the pixels: one
/// to two seconds for grids up to 256 x 256 x 32.
pub fn draw(figure: &Figure<'_>) -> Picture {
    let fonts = Fonts::new();
    let images = &figure.images[..figure.images.len().min(MAX_IMAGES)];
    let occupancies = &figure.occupancies[..figure.occupancies.len().min(MAX_OCCUPANCIES)];
    let width = (PAGE - 2 * MARGIN) as f32;
    let title = fonts.fit(figure.title.trim(), TITLE_SIZE, Weight::Bold, width);
    let subtitle = fonts.wrap(figure.subtitle, SUBTITLE_SIZE, Weight::Regular, width, 3);

    // First the places, from top to bottom, then the page of that height.
    let mut y = MARGIN;
    let title_at = y;
    y += if title.is_empty() { 0 } else { 60 } + subtitle.len() * 40;
    y += if y > MARGIN { 20 } else { 0 };
    let mut label = Labels::default();
    let names: Vec<&str> = images.iter().map(|i| i.0).collect();
    let sizes: Vec<[usize; 2]> = images.iter().map(|i| [i.1.height, i.1.width]).collect();
    let images_at = y;
    let (places, height) = layout::cameras(&names, &sizes, y + LABEL);
    y += if places.is_empty() { 0 } else { LABEL + height + GAP };
    let mut views = Vec::new();
    for occupancy in occupancies {
        let places = |top: usize| layout::views(top + LABEL, bev::aspect(occupancy), occupancies.len());
        let (_, view) = places(y);
        let note =
            Note::new(&fonts, &caption("Semantic occupancy", occupancy), occupancy, figure.palette, view.w as f32);
        let (map, view) = places(y + note.height());
        let top = y;
        y += note.height() + LABEL + view.h + GAP;
        views.push((top, map, view, note));
    }
    let entries = legend::entries(occupancies, figure.palette);
    let legend_at = y;
    y += legend::height(&entries);
    let mut canvas = Canvas::new(PAGE, y + MARGIN - GAP / 2, PAPER);

    draw_heading(&mut canvas, &fonts, title_at, &title, &subtitle);
    if !places.is_empty() {
        let what = if places.len() == 1 { "Input image" } else { "Input images" };
        label.draw(&mut canvas, &fonts, MARGIN, images_at, what, "", width);
    }
    for ((name, image), place) in images.iter().zip(&places) {
        draw_image(&mut canvas, *place, image, &fonts, name);
    }
    for (occupancy, (top, map, view, note)) in occupancies.iter().zip(views) {
        let map_caption = caption("Bird’s-eye view", occupancy);
        label.draw(&mut canvas, &fonts, map.x, top, &map_caption, "", (map.w + GAP) as f32);
        let view_caption = caption("Semantic occupancy", occupancy);
        label.draw(&mut canvas, &fonts, view.x, top, &view_caption, &note.beside, view.w as f32);
        note.draw_below(&mut canvas, &fonts, view.x, top + LABEL);
        bev::draw(&mut canvas, map, occupancy, figure.palette, &fonts);
        canvas.put(view, &voxels::render(occupancy, figure.palette, view.w, view.h, PAPER));
    }
    legend::draw(&mut canvas, legend_at, &entries, &fonts);
    Picture { width: canvas.width, height: canvas.height, rgb: canvas.rgb }
}

const TITLE_SIZE: f32 = 46.0;
const SUBTITLE_SIZE: f32 = 27.0;
const LABEL_SIZE: f32 = 28.0;
const NOTE_SIZE: f32 = 23.0;
/// Least distance from a caption to the note beside it.
const NOTE_GAP: f32 = 24.0;
/// Height of a line of a note below its caption.
const NOTE_LINE: usize = 34;
/// More than a note ever takes.
const MAX_NOTE_LINES: usize = 8;

/// Hands out (a), (b), (c) ... in the order of the panels.
#[derive(Default)]
struct Labels {
    next: u8,
}

impl Labels {
    #[expect(clippy::too_many_arguments, reason = "a place, three texts and what they are drawn with")]
    fn draw(&mut self, canvas: &mut Canvas, fonts: &Fonts, x: usize, top: usize, text: &str, note: &str, width: f32) {
        let (x, y) = (x as f32, (top + LABEL) as f32 - 18.0);
        let letter = format!("({}) ", char::from(b'a' + self.next % 26));
        self.next += 1;
        let mut used = fonts.draw(canvas, &letter, [x, y], LABEL_SIZE, Weight::Bold, INK);
        let text = fonts.fit(text, LABEL_SIZE, Weight::Regular, width - used);
        used += fonts.draw(canvas, &text, [x + used, y], LABEL_SIZE, Weight::Regular, INK);
        let room = width - used - NOTE_GAP;
        if !note.is_empty() && room > 100.0 {
            let note = fonts.fit(note, NOTE_SIZE, Weight::Regular, room);
            let left = x + width - fonts.width(&note, NOTE_SIZE, Weight::Regular);
            fonts.draw(canvas, &note, [left, y], NOTE_SIZE, Weight::Regular, GREY);
        }
    }
}

/// What a panel shows, and of which occupancy.
fn caption(what: &str, occupancy: &Occupancy<'_>) -> String {
    match occupancy.caption {
        "" => what.to_owned(),
        of => format!("{what}, {of}"),
    }
}

/// The note of a 3-D view: beside its caption, or in lines of its own below it where it is too long for that.
struct Note {
    beside: String,
    below: Vec<String>,
}

impl Note {
    fn new(fonts: &Fonts, caption: &str, occupancy: &Occupancy<'_>, palette: &Palette, width: f32) -> Self {
        let note = note(occupancy, palette);
        // No letter is wider than m.
        let used = fonts.width("(m) ", LABEL_SIZE, Weight::Bold) + fonts.width(caption, LABEL_SIZE, Weight::Regular);
        if used + NOTE_GAP + fonts.width(&note, NOTE_SIZE, Weight::Regular) <= width {
            return Self { beside: note, below: vec![] };
        }
        Self { beside: String::new(), below: fonts.wrap(&note, NOTE_SIZE, Weight::Regular, width, MAX_NOTE_LINES) }
    }

    fn height(&self) -> usize {
        self.below.len() * NOTE_LINE
    }

    fn draw_below(&self, canvas: &mut Canvas, fonts: &Fonts, x: usize, top: usize) {
        for (i, line) in self.below.iter().enumerate() {
            let y = (top + (i + 1) * NOTE_LINE) as f32 - 18.0;
            fonts.draw(canvas, line, [x as f32, y], NOTE_SIZE, Weight::Regular, GREY);
        }
    }
}

/// Size of the grid and of a voxel, and how many are occupied.
fn note(occupancy: &Occupancy<'_>, palette: &Palette) -> String {
    let occupied = occupancy.classes.iter().filter(|&&c| palette.is_drawn(c)).count();
    let [x, y, z] = occupancy.grid.size;
    let step: [f32; 3] = std::array::from_fn(|k| {
        let [low, high] = occupancy.grid.bounds[k];
        ((high - low) / occupancy.grid.size[k] as f32 * 1000.0).round() / 1000.0
    });
    let size = match step {
        [a, b, c] if a == b && b == c => format!("{a} m"),
        [a, b, c] => format!("{a} × {b} × {c} m"),
    };
    let bare = occupancy.classes.chunks_exact(z).filter(|column| !column.iter().any(|&c| palette.is_drawn(c))).count();
    // The lines lie under the voxels: where these cover the ground there is nothing to explain.
    let lines = if bare * 20 > x * y { format!("; lines every {} m", voxels::PLATE_LINES) } else { String::new() };
    let unseen = if occupancy.support.contains(&0) { "; hatched and pale: seen by no camera" } else { "" };
    format!("{x} × {y} × {z} voxels of {size}, {} occupied{unseen}{lines}", legend::thousands(occupied))
}

fn draw_heading(canvas: &mut Canvas, fonts: &Fonts, top: usize, title: &str, subtitle: &[String]) {
    let x = MARGIN as f32;
    let mut y = top as f32;
    if !title.is_empty() {
        fonts.draw(canvas, title, [x, y + 40.0], TITLE_SIZE, Weight::Bold, INK);
        y += 60.0;
    }
    for line in subtitle {
        fonts.draw(canvas, line, [x, y + 28.0], SUBTITLE_SIZE, Weight::Regular, GREY);
        y += 40.0;
    }
}

/// Scales a camera image into its place and writes the camera's name into the corner.
fn draw_image(canvas: &mut Canvas, place: Rect, image: &Image, fonts: &Fonts, name: &str) {
    let size = u32::try_from(image.width).ok().zip(u32::try_from(image.height).ok());
    let pixels = size.and_then(|(w, h)| ImageBuffer::<RgbPixel<u8>, &[u8]>::from_raw(w, h, &image.bgr[..]));
    match pixels {
        Some(pixels) if image.width > 0 && image.height > 0 => {
            // The channels are swapped afterwards: scaling treats them alike.
            let mut scaled =
                imageops::resize(&pixels, place.w as u32, place.h as u32, FilterType::CatmullRom).into_raw();
            scaled.chunks_exact_mut(3).for_each(|p| p.swap(0, 2));
            canvas.put(place, &scaled);
        }
        _ => canvas.frame(place, 2, GREY),
    }
    let text = fonts.fit(&camera_title(name), 24.0, Weight::Regular, place.w as f32 - 44.0);
    if place.h < 60 || text.is_empty() {
        return;
    }
    let (x, y) = (place.x as f32 + 12.0, place.y as f32 + 12.0);
    let wide = fonts.width(&text, 24.0, Weight::Regular);
    canvas.fill_round([x, y, x + wide + 24.0, y + 38.0], 7.0, [0; 3], 0.55);
    fonts.draw(canvas, &text, [x + 12.0, y + 27.0], 24.0, Weight::Regular, [255; 3]);
}

/// "CAM_FRONT_LEFT" as "Front left".
fn camera_title(name: &str) -> String {
    let words = name.strip_prefix("CAM_").unwrap_or(name).replace('_', " ");
    if words.chars().any(char::is_lowercase) {
        return words;
    }
    let mut letters = words.chars();
    letters
        .next()
        .map_or_else(String::new, |first| first.to_uppercase().chain(letters.flat_map(char::to_lowercase)).collect())
}

#[cfg(test)]
mod tests;

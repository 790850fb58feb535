//! Text in Noto Sans, laid out by its advance widths and kerning.

use super::canvas::{Canvas, Rgb};
use ab_glyph::{Font, FontRef, PxScale, ScaleFont, point};

/// The licence under which the embedded Noto Sans fonts are distributed (SIL Open Font License 1.1).
pub const FONT_LICENSE: &str = include_str!("NotoSans-OFL.txt");

/// A face of the family.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Weight {
    Regular,
    Bold,
}

/// Both faces; parsing them is cheap, glyphs are outlined when they are drawn.
pub(crate) struct Fonts {
    regular: Option<FontRef<'static>>,
    bold: Option<FontRef<'static>>,
}

impl Fonts {
    pub(crate) fn new() -> Self {
        // The bytes are part of the program, and a test reads both faces.
        Self {
            regular: FontRef::try_from_slice(notosans::REGULAR_TTF).ok(),
            bold: FontRef::try_from_slice(notosans::BOLD_TTF).ok(),
        }
    }

    fn face(&self, weight: Weight) -> Option<&FontRef<'static>> {
        match weight {
            Weight::Regular => self.regular.as_ref(),
            Weight::Bold => self.bold.as_ref(),
        }
    }

    /// Calls `glyph` with each character's id and the x of its origin, and returns the whole width.
    fn lay_out(&self, text: &str, size: f32, weight: Weight, mut glyph: impl FnMut(ab_glyph::GlyphId, f32)) -> f32 {
        let Some(face) = self.face(weight).map(|f| f.as_scaled(scale(f, size))) else { return 0.0 };
        let (mut x, mut last) = (0.0, None);
        for c in text.chars() {
            let id = face.glyph_id(c);
            if let Some(last) = last {
                x += face.kern(last, id);
            }
            glyph(id, x);
            x += face.h_advance(id);
            last = Some(id);
        }
        x
    }

    /// Width in pixels of one line at `size` pixels per em.
    pub(crate) fn width(&self, text: &str, size: f32, weight: Weight) -> f32 {
        self.lay_out(text, size, weight, |_, _| {})
    }

    /// Draws one line with its baseline's left end at `at` = (x, y), and returns its width.
    pub(crate) fn draw(
        &self,
        canvas: &mut Canvas,
        text: &str,
        at: [f32; 2],
        size: f32,
        weight: Weight,
        colour: Rgb,
    ) -> f32 {
        let Some(face) = self.face(weight) else { return 0.0 };
        let px = scale(face, size);
        self.lay_out(text, size, weight, |id, x| {
            // Baselines sit on whole pixels: flat strokes stay sharp.
            let glyph = id.with_scale_and_position(px, point(at[0] + x, at[1].round()));
            if let Some(outline) = face.outline_glyph(glyph) {
                let origin = outline.px_bounds().min;
                outline.draw(|gx, gy, cover| {
                    canvas.blend(origin.x as i32 + gx as i32, origin.y as i32 + gy as i32, colour, cover.min(1.0));
                });
            }
        })
    }

    /// `text` cut with an ellipsis to at most `limit` pixels.
    pub(crate) fn fit(&self, text: &str, size: f32, weight: Weight, limit: f32) -> String {
        // More characters than a page is wide in pixels cannot fit.
        let mut kept: String = text.chars().take(400).collect();
        while !kept.is_empty() && self.width(&kept, size, weight) > limit {
            kept.truncate(kept.trim_end_matches('…').len());
            kept.pop();
            kept.push('…');
            if kept == "…" {
                return kept;
            }
        }
        kept
    }

    /// Breaks `text` at spaces into lines of at most `limit` pixels, at most `most` of them; longer words are cut.
    pub(crate) fn wrap(&self, text: &str, size: f32, weight: Weight, limit: f32, most: usize) -> Vec<String> {
        let mut lines: Vec<String> = Vec::new();
        let mut line = String::new();
        for word in text.split_whitespace() {
            let longer = if line.is_empty() { word.to_owned() } else { format!("{line} {word}") };
            if lines.len() + 1 < most && !line.is_empty() && self.width(&longer, size, weight) > limit {
                lines.push(std::mem::replace(&mut line, word.to_owned()));
            } else {
                line = longer;
            }
            if line.len() > 2000 {
                // Measuring ever longer lines that are cut anyway would take quadratic time.
                break;
            }
        }
        if !line.is_empty() {
            lines.push(line);
        }
        lines.iter().map(|line| self.fit(line, size, weight, limit)).collect()
    }
}

/// Pixels per em as the scale of ascent to descent that `ab_glyph` takes.
fn scale(face: &impl Font, size: f32) -> PxScale {
    let em = face.units_per_em().unwrap_or(1000.0);
    PxScale::from(size * face.height_unscaled() / em)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_faces_draw_and_measure() {
        let fonts = Fonts::new();
        for weight in [Weight::Regular, Weight::Bold] {
            let mut canvas = Canvas::new(200, 40, [255; 3]);
            let width = fonts.draw(&mut canvas, "Voxels 16 m", [5.0, 30.0], 24.0, weight, [0; 3]);
            assert_eq!(width, fonts.width("Voxels 16 m", 24.0, weight));
            assert!((100.0..180.0).contains(&width), "{width}");
            let ink = canvas.rgb.iter().filter(|&&v| v < 64).count();
            assert!(ink > 500, "{ink} dark values");
        }
        assert!(FONT_LICENSE.contains("SIL OPEN FONT LICENSE"));
    }

    #[test]
    fn long_text_is_cut_or_broken() {
        let fonts = Fonts::new();
        let width = |s: &str| fonts.width(s, 20.0, Weight::Regular);
        let cut = fonts.fit("a rather long caption", 20.0, Weight::Regular, 90.0);
        assert!(cut.ends_with('…') && width(&cut) <= 90.0 && cut.starts_with("a rat"), "{cut}");
        assert_eq!(fonts.fit("short", 20.0, Weight::Regular, 90.0), "short");
        assert_eq!(fonts.fit("x", 20.0, Weight::Regular, 0.0), "…");
        let lines = fonts.wrap("one two three four five six", 20.0, Weight::Regular, 90.0, 3);
        assert!(lines.len() == 3 && lines.iter().all(|l| width(l) <= 90.0), "{lines:?}");
        assert!(fonts.wrap(" ", 20.0, Weight::Regular, 90.0, 3).is_empty());
    }
}

//! A confusion matrix as a picture: which class is taken for which.

use super::canvas::{Canvas, Rect, Rgb};
use super::legend::thousands;
use super::text::{Fonts, Weight};
use super::{GREY, INK, PAPER, Palette, Picture};
use crate::base::error::{Error, Result};

const MARGIN: usize = 56;
const CELL: usize = 64;
const SIZE: f32 = 24.0;
/// Room for the longest class name, beside the rows and above the columns.
const NAMES: usize = 310;
/// Room for the number of voxels at the end of a row.
const TOTAL: usize = 170;
const HEADING: usize = 150;
/// The colour of a cell that has all of its row.
const FULL: Rgb = [16, 62, 128];

/// What to draw.
#[derive(Clone, Copy, Debug)]
pub struct Matrix<'a> {
    /// First line, in bold.
    pub title: &'a str,
    /// Second line.
    pub subtitle: &'a str,
    /// What rows are, such as "Truth".
    pub rows: &'a str,
    /// What columns are, such as "Prediction".
    pub columns: &'a str,
    /// Number of each row's class that was taken for each column's, row after row.
    pub counts: &'a [u64],
    /// Names and colours of the classes.
    pub palette: &'a Palette,
}

/// Draws the matrix: in each cell, and by its colour, the share of its row in per cent; at the end of a row, how many
/// voxels that is. Rows without voxels stay empty.
///
/// # Errors
/// [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) if there are not as many counts as the square of the number of
/// classes, or more than 64 classes.
pub fn draw_matrix(matrix: &Matrix<'_>) -> Result<Picture> {
    let classes = matrix.palette.classes();
    let n = classes.len();
    if matrix.counts.len() != n * n || !(1..=64).contains(&n) {
        let message = format!("{} counts for {n} classes, expected a square of up to 64", matrix.counts.len());
        return Err(Error::mismatch(message));
    }
    let fonts = Fonts::new();
    let (left, top) = (MARGIN + 40 + NAMES, MARGIN + HEADING + NAMES);
    let mut canvas = Canvas::new(left + n * CELL + TOTAL + MARGIN, top + n * CELL + MARGIN, PAPER);
    let wide = (canvas.width - 2 * MARGIN) as f32;
    let x = MARGIN as f32;
    let title = fonts.fit(matrix.title, 32.0, Weight::Bold, wide);
    fonts.draw(&mut canvas, &title, [x, MARGIN as f32 + 32.0], 32.0, Weight::Bold, INK);
    let subtitle = fonts.fit(matrix.subtitle, SIZE, Weight::Regular, wide);
    fonts.draw(&mut canvas, &subtitle, [x, MARGIN as f32 + 72.0], SIZE, Weight::Regular, GREY);
    fonts.draw(&mut canvas, matrix.columns, [left as f32, (MARGIN + 126) as f32], SIZE, Weight::Bold, INK);
    draw_upright(&mut canvas, &fonts, matrix.rows, [MARGIN, top + n * CELL], Weight::Bold);

    for (i, class) in classes.iter().enumerate() {
        let (x, y) = (left + i * CELL, top + i * CELL);
        let name = fonts.fit(&class.name, SIZE, Weight::Regular, (NAMES - 44) as f32);
        let from = left as f32 - 44.0 - fonts.width(&name, SIZE, Weight::Regular);
        fonts.draw(&mut canvas, &name, [from, (y + CELL / 2 + 9) as f32], SIZE, Weight::Regular, INK);
        swatch(&mut canvas, [left - 32, y + CELL / 2 - 10], class.rgb);
        draw_upright(&mut canvas, &fonts, &name, [x + CELL / 2 - 16, top - 44], Weight::Regular);
        swatch(&mut canvas, [x + CELL / 2 - 10, top - 32], class.rgb);
        let row = &matrix.counts[i * n..][..n];
        let total: u64 = row.iter().sum();
        let at = [(left + n * CELL + 16) as f32, (y + CELL / 2 + 9) as f32];
        fonts.draw(
            &mut canvas,
            &thousands(usize::try_from(total).unwrap_or(usize::MAX)),
            at,
            SIZE,
            Weight::Regular,
            GREY,
        );
        for (j, &count) in row.iter().enumerate().filter(|_| total > 0) {
            draw_cell(&mut canvas, &fonts, [left + j * CELL, y], count, total);
        }
    }
    let grid = Rect { x: left, y: top, w: n * CELL, h: n * CELL };
    canvas.frame(grid, 2, GREY);
    for i in 0..n {
        canvas.frame(Rect { x: left + i * CELL, y: top + i * CELL, w: CELL, h: CELL }, 2, GREY);
    }
    Ok(Picture { width: canvas.width, height: canvas.height, rgb: canvas.rgb })
}

fn swatch(canvas: &mut Canvas, [x, y]: [usize; 2], rgb: Rgb) {
    let (x, y) = (x as f32, y as f32);
    canvas.fill_round([x, y, x + 20.0, y + 20.0], 5.0, rgb, 1.0);
}

/// A cell as dark as its share is large; small shares are told from none by the square root.
fn draw_cell(canvas: &mut Canvas, fonts: &Fonts, [x, y]: [usize; 2], count: u64, total: u64) {
    let share = count as f64 / total as f64;
    let shade = share.sqrt() as f32;
    let (x, y, side) = (x as f32, y as f32, CELL as f32);
    canvas.fill_round([x, y, x + side, y + side], 0.0, FULL, shade);
    let text = match 100.0 * share {
        _ if count == 0 => return,
        percent if percent < 0.05 => "·".to_owned(),
        percent if percent < 9.95 => format!("{percent:.1}"),
        percent => format!("{percent:.0}"),
    };
    let colour = if shade > 0.5 { [255; 3] } else { INK };
    let from = x + (side - fonts.width(&text, 22.0, Weight::Regular)) / 2.0;
    fonts.draw(canvas, &text, [from, y + side / 2.0 + 8.0], 22.0, Weight::Regular, colour);
}

/// Draws a line that runs upwards from `at`, its letters' feet to the right.
fn draw_upright(canvas: &mut Canvas, fonts: &Fonts, text: &str, [x, y]: [usize; 2], weight: Weight) {
    let length = fonts.width(text, SIZE, weight).ceil() as usize + 1;
    let mut line = Canvas::new(length, 34, PAPER);
    fonts.draw(&mut line, text, [0.0, 25.0], SIZE, weight, INK);
    let mut turned = vec![0; line.rgb.len()];
    for row in 0..34 {
        for column in 0..length {
            let (from, to) = ((row * length + column) * 3, ((length - 1 - column) * 34 + row) * 3);
            turned[to..to + 3].copy_from_slice(&line.rgb[from..from + 3]);
        }
    }
    canvas.put(Rect { x, y: y.saturating_sub(length), w: 34, h: length }, &turned);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_shades_and_other_sizes_are_refused() {
        let palette = Palette::of(17);
        let mut counts = vec![0; 17 * 17];
        (counts[0], counts[18], counts[19]) = (5, 1, 3);
        let title = "a title that is too long for the page ".repeat(9);
        let matrix = Matrix {
            title: &title,
            subtitle: "",
            rows: "Truth",
            columns: "Prediction",
            counts: &counts,
            palette: &palette,
        };
        let picture = draw_matrix(&matrix).unwrap();
        let corner = |row: usize, column: usize| {
            let (x, y) = (MARGIN + 40 + NAMES + column * CELL + 4, MARGIN + HEADING + NAMES + row * CELL + 4);
            let at = (y * picture.width + x) * 3;
            [picture.rgb[at], picture.rgb[at + 1], picture.rgb[at + 2]]
        };
        assert_eq!((corner(0, 0), corner(0, 1), corner(5, 5)), (FULL, PAPER, PAPER));
        // A quarter of the row is half the shade.
        assert_eq!(corner(1, 1), [136, 159, 192]);
        assert!(corner(1, 2)[0] < corner(1, 1)[0]);
        assert!(draw_matrix(&Matrix { counts: &counts[1..], ..matrix }).is_err());
        assert!(draw_matrix(&Matrix { palette: &Palette::of(65), counts: &vec![0; 65 * 65], ..matrix }).is_err());
    }
}

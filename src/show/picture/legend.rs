//! The legend: swatch, name, number and share of voxels of each class.

use super::canvas::{Canvas, Rgb};
use super::layout::{MARGIN, PAGE};
use super::text::{Fonts, Weight};
use super::{GREY, INK, Occupancy, Palette};

/// Classes that a legend lists at most.
const MOST: usize = 40;

const COLUMNS: usize = 4;
const ROW: usize = 46;
const SPACE: usize = 56;
const SIZE: f32 = 26.0;

/// A line of the legend.
pub(crate) struct Entry {
    name: String,
    rgb: Rgb,
    /// Voxels of the class in each occupancy, and the share of the occupied ones in 0..=1.
    counts: Vec<(usize, f64)>,
}

/// The lines to show: all classes of a palette that has few, else those that occur, the most frequent 40 in their order.
pub(crate) fn entries(occupancies: &[Occupancy<'_>], palette: &Palette) -> Vec<Entry> {
    let histograms: Vec<([usize; 256], usize)> = occupancies
        .iter()
        .map(|o| {
            let mut counts = [0usize; 256];
            o.classes.iter().for_each(|&c| counts[usize::from(c)] += 1);
            let occupied = (0..=255u8).filter(|&c| palette.is_drawn(c)).map(|c| counts[usize::from(c)]).sum();
            (counts, occupied)
        })
        .collect();
    let total = |class: usize| histograms.iter().map(|(counts, _)| counts[class]).sum::<usize>();
    let mut shown: Vec<usize> = (1..palette.classes().len().min(256)).collect();
    if shown.len() > MOST {
        shown.retain(|&c| total(c) > 0);
        shown.sort_by_key(|&c| std::cmp::Reverse(total(c)));
        shown.truncate(MOST);
        shown.sort_unstable();
    }
    let entry = |class: usize| Entry {
        name: palette.classes()[class].name.clone(),
        rgb: palette.classes()[class].rgb,
        counts: histograms.iter().map(|(c, n)| (c[class], c[class] as f64 / (*n).max(1) as f64)).collect(),
    };
    shown.into_iter().map(entry).collect()
}

/// Pixels that the legend takes.
pub(crate) fn height(entries: &[Entry]) -> usize {
    match entries.len() {
        0 => 0,
        n => n.div_ceil(COLUMNS) * ROW + 30,
    }
}

/// Draws the legend from `top` down, filled column by column.
pub(crate) fn draw(canvas: &mut Canvas, top: usize, entries: &[Entry], fonts: &Fonts) {
    if entries.is_empty() {
        return;
    }
    let (left, right) = (MARGIN as f32, (PAGE - MARGIN) as f32);
    let y = top as f32;
    canvas.fill_polygon(&[[left, y], [right, y], [right, y + 2.0], [left, y + 2.0]], [205, 208, 214], 1.0);
    let rows = entries.len().div_ceil(COLUMNS);
    let width = (PAGE - 2 * MARGIN - (COLUMNS - 1) * SPACE) / COLUMNS;
    for (i, entry) in entries.iter().enumerate() {
        let x = (MARGIN + i / rows * (width + SPACE)) as f32;
        let y = (top + 24 + i % rows * ROW) as f32;
        draw_entry(canvas, [x, y], width as f32, entry, fonts);
    }
}

fn draw_entry(canvas: &mut Canvas, [x, y]: [f32; 2], width: f32, entry: &Entry, fonts: &Fonts) {
    let present = entry.counts.iter().any(|c| c.0 > 0);
    let border = entry.rgb.map(|c| (f32::from(c) * 0.62) as u8);
    canvas.fill_round([x, y + 6.0, x + 44.0, y + 36.0], 7.0, border, 1.0);
    canvas.fill_round([x + 2.0, y + 8.0, x + 42.0, y + 34.0], 5.0, entry.rgb, 1.0);
    let colour = if present { INK } else { [150, 155, 163] };
    let base = y + 30.0;
    // Numbers stand to the right, each column in a width of its own: counts only where there is one occupancy.
    let (size, column) = if entry.counts.len() > 1 { (23.0, 96.0) } else { (SIZE, 122.0) };
    let mut end = x + width;
    let shares: Vec<String> = entry.counts.iter().map(|&(n, share)| percent(n, share)).collect();
    for share in shares.iter().rev() {
        let wide = fonts.width(share, size, Weight::Regular);
        fonts.draw(canvas, share, [end - wide, base], size, Weight::Regular, colour);
        end -= column;
    }
    if let [(count, _)] = entry.counts[..]
        && count > 0
    {
        let text = thousands(count);
        let wide = fonts.width(&text, 22.0, Weight::Regular);
        fonts.draw(canvas, &text, [end - wide + 10.0, base], 22.0, Weight::Regular, GREY);
        end -= wide;
    }
    let room = (end - x - 60.0 - 12.0).max(0.0);
    let name = fonts.fit(&entry.name, size, Weight::Regular, room);
    fonts.draw(canvas, &name, [x + 60.0, base], size, Weight::Regular, colour);
}

fn percent(count: usize, share: f64) -> String {
    match share * 100.0 {
        _ if count == 0 => "–".to_owned(),
        p if p < 0.01 => "<0.01 %".to_owned(),
        p if p < 1.0 => format!("{p:.2} %"),
        p => format!("{p:.1} %"),
    }
}

/// A number with a comma between thousands.
pub(crate) fn thousands(n: usize) -> String {
    let digits = n.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::Grid;

    #[test]
    fn numbers_read_well() {
        let found = [0, 7, 999, 1000, 1_234_567].map(thousands);
        assert_eq!(found, ["0", "7", "999", "1,000", "1,234,567"]);
        assert_eq!(
            [percent(0, 0.0), percent(1, 1e-6), percent(5, 0.005), percent(9, 0.1234)],
            ["–", "<0.01 %", "0.50 %", "12.3 %"]
        );
    }

    #[test]
    fn counts_and_shares_are_of_the_occupied_voxels() {
        let classes = [0, 0, 4, 4, 4, 1, 255, 17];
        let bounds = [[-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]];
        let occupancy = Occupancy::new("", &classes, Grid::new([2, 2, 2], bounds), [0.0, 1.0]).unwrap();
        let entries = entries(&[occupancy], &Palette::of(17));
        assert_eq!((entries.len(), entries[3].name.as_str(), entries[3].counts[0]), (16, "car", (3, 0.75)));
        assert_eq!(entries[0].counts[0], (1, 0.25));
        let many = super::entries(&[occupancy], &Palette::of(256));
        assert_eq!(
            many.iter().map(|e| e.name.as_str()).collect::<Vec<_>>(),
            ["class 1", "class 4", "class 17", "class 255"]
        );
    }
}

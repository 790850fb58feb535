//! Tables of numbers, as lines of text and as Markdown.

/// A heading for each column, rows of as many cells. The first column is words, the others are numbers.
pub(super) struct Table {
    pub(super) head: Vec<String>,
    pub(super) rows: Vec<Vec<String>>,
}

impl Table {
    /// Columns aligned with spaces, for a terminal.
    pub(super) fn text(&self) -> String {
        let lines = || std::iter::once(&self.head).chain(&self.rows);
        let widths: Vec<usize> =
            (0..self.head.len()).map(|c| lines().map(|line| line[c].len()).max().unwrap_or(0)).collect();
        let mut text = String::new();
        for line in lines() {
            let mut out = format!("{:<width$}", line[0], width = widths[0]);
            line.iter().zip(&widths).skip(1).for_each(|(cell, &width)| out += &format!("  {cell:>width$}"));
            text += out.trim_end();
            text.push('\n');
        }
        text
    }

    pub(super) fn markdown(&self) -> String {
        let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
        let rule = format!("|---|{}\n", "---:|".repeat(self.head.len() - 1));
        let rows: String = self.rows.iter().map(|row| line(row)).collect();
        line(&self.head) + &rule + &rows
    }
}

/// A ratio in per cent; `-` for 0 / 0.
pub(super) fn percent(ratio: Option<f64>) -> String {
    ratio.map_or("-".to_owned(), |ratio| format!("{:.2}", 100.0 * ratio))
}

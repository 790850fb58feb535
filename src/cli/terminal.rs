//! What the user sees while work goes on, and how sizes and times are written.

use indicatif::{ProgressBar, ProgressStyle};
use std::time::Duration;
use voxcast::Note;

/// Says what was not obeyed or hardly ever meant, one line each, where errors go too.
pub fn say(notes: &[Note]) {
    for note in notes {
        eprintln!("voxcast: note: {note}");
    }
}

/// A share as people read it.
pub fn percent(share: f64) -> String {
    format!("{:.1} %", 100.0 * share)
}

/// A progress bar on a terminal; nothing in a pipe.
pub fn progress(what: &'static str, total: usize) -> ProgressBar {
    let bar = ProgressBar::new(total as u64);
    let style = ProgressStyle::with_template("{msg} [{bar:32}] {pos}/{len} {elapsed} (left {eta})");
    bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()).progress_chars("=> "));
    bar.set_message(what);
    bar
}

/// Bytes as people read them.
pub fn bytes(n: usize) -> String {
    match n {
        0..10_000 => format!("{n} B"),
        10_000..10_000_000 => format!("{:.1} kB", n as f64 / 1e3),
        _ => format!("{:.1} MB", n as f64 / 1e6),
    }
}

/// A duration as people read it.
pub fn time(t: Duration) -> String {
    let s = t.as_secs_f64();
    match s {
        ..0.001 => format!("{:.0} us", s * 1e6),
        ..1.0 => format!("{:.1} ms", s * 1e3),
        _ => format!("{s:.2} s"),
    }
}

//! What the user sees while work goes on, and how sizes and times are written.

use indicatif::{ProgressBar, ProgressStyle};
use std::fmt::Arguments;
use std::io::{ErrorKind, Write};
use std::path::Path;
use std::time::Duration;
use voxcast::{Error, Note, Result};

/// A line for standard output, formatted as by `println!`, which panics where this returns an error.
macro_rules! tell {
    ($($arguments:tt)*) => {
        $crate::cli::terminal::write(format_args!("{}\n", format_args!($($arguments)*)))
    };
}
pub(crate) use tell;

/// Writes to standard output. A reader that has gone, such as `head`, wants no more of it: that is no error, and whatever else
/// the command does goes on.
pub fn write(text: Arguments<'_>) -> Result<()> {
    match std::io::stdout().lock().write_fmt(text) {
        Err(e) if e.kind() != ErrorKind::BrokenPipe => Err(Error::io(Path::new("standard output"), "write", &e)),
        _ => Ok(()),
    }
}

/// Says what was not obeyed or hardly ever meant, one line each, where errors go too.
pub fn say(notes: &[Note]) {
    notes.iter().for_each(|note| complain(format_args!("note: {note}")));
}

/// A line on standard error. Where that cannot be written, there is nobody to say it to.
pub fn complain(line: Arguments<'_>) {
    let _ = writeln!(std::io::stderr().lock(), "voxcast: {line}");
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

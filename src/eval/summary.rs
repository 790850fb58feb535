//! What an evaluation came to: the report of one predictor or the comparison of two, and how shards are put together.

use super::journal::{Entry, Header, JournalReader};
use super::reliability::{Bin, Calibration, Reliability};
use super::subject::Shard;
use super::{Comparison, Confusion, FrameScore, Report, Scorer, Totals, write_text};
use crate::base::error::{Error, Result};
use crate::show::picture::{Curve, Diagram, Matrix, Palette, Point, draw_diagram, draw_matrix};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Totals, with the names of all that they count.
#[derive(Clone, Debug)]
pub struct Summary {
    header: Header,
    frames: usize,
    /// The sums.
    pub total: FrameScore,
}

impl Summary {
    /// What `totals` of the evaluation with this journal's header come to.
    pub fn new(header: Header, totals: Totals) -> Self {
        let frames = totals.counted();
        Self { header, frames, total: totals.finish() }
    }

    /// Puts the journals of shards together. The result is that of one run, to the last bit: counts are integers, and losses
    /// are added in the order of the set. `limit` says of how many frames from the first on the shards are, all if none.
    ///
    /// # Errors
    /// Those of [`JournalReader`]; [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) if journals are of different
    /// evaluations or numbers of shards, two are of one shard, a shard is missing, or one lacks frames.
    pub fn merge(journals: &[PathBuf], limit: Option<usize>) -> Result<Self> {
        let mut parts: Vec<(Header, &Path)> = Vec::new();
        let mut merged: Option<Totals> = None;
        for path in journals {
            let (mut reader, header) = JournalReader::open(path)?;
            fits(&header, &parts).map_err(|e| e.in_file(path))?;
            let frames = limit.map_or(header.what.frames, |limit| limit.min(header.what.frames));
            let none = || Totals::new(header.what.kind(), header.names.len(), frames);
            let totals = merged.get_or_insert_with(none);
            // Beyond the limit a journal may have more frames.
            while let Some(Entry { frame, index, score, .. }) = reader.next_entry()? {
                if index < frames && totals.has(index) {
                    return Err(reader.at_line(&Error::mismatch(format!("frame {frame} is there already"))));
                }
                if index < frames {
                    totals.add(index, score);
                }
            }
            parts.push((header, path));
        }
        let (Some(totals), Some((first, _))) = (merged, parts.first()) else {
            return Err(Error::format("no journals, expected one for each shard"));
        };
        check_complete(&parts, &totals)?;
        let header = Header::new(first.what.clone(), Shard::WHOLE, first.names.clone());
        Ok(Self::new(header, totals))
    }

    /// Frames that were scored.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// The predictors, as people call them.
    pub fn names(&self) -> &[String] {
        &self.header.names
    }

    /// The tables for a terminal.
    pub fn text(&self) -> String {
        self.with(|reports, comparison| match comparison {
            None => reports[0].text(),
            Some(comparison) => comparison.text(),
        })
    }

    /// The tables as Markdown: of two predictors, the comparison and both reports.
    pub fn markdown(&self) -> String {
        self.with(|reports, comparison| {
            let tables = comparison.iter().map(|c| c.markdown()).chain(reports.iter().map(Report::markdown));
            tables.collect::<Vec<String>>().join("\n")
        })
    }

    /// All ratios and counts: [`Report::json`], or of two predictors `comparison` and `reports`.
    pub fn json(&self) -> Value {
        self.with(|reports, comparison| match comparison {
            None => reports[0].json(),
            Some(comparison) => {
                let reports: Vec<Value> = reports.iter().map(Report::json).collect();
                json!({ "comparison": comparison.json(), "reports": reports })
            }
        })
    }

    /// Writes [`Summary::json`]. The file appears whole or not at all.
    ///
    /// # Errors
    /// [`ErrorKind::Io`](crate::ErrorKind::Io) if it cannot be written.
    pub fn write_json(&self, path: &Path) -> Result<()> {
        write_text(path, &format!("{:#}\n", self.json()))
    }

    /// Draws the confusion matrix as a PNG; of two predictors, that of the first one's classes with the second's.
    ///
    /// # Errors
    /// [`ErrorKind::Io`](crate::ErrorKind::Io) if it cannot be written.
    pub fn write_confusion(&self, path: &Path) -> Result<()> {
        let palette = Palette::of(self.header.what.classes.len());
        let subtitle = format!("{} frames; shares of each row in per cent", self.frames);
        self.with(|reports, comparison| {
            let all = reports[0].total.region(0);
            let data = &self.header.what.data;
            let (counts, rows, columns, title) = match comparison {
                None => (all.counts(), "Truth", "Prediction", reports[0].title.to_owned()),
                Some(c) => (c.agreement.counts(), "A", "B", format!("A: {}, B: {}, on {data}", c.names[0], c.names[1])),
            };
            let matrix = Matrix { title: &title, subtitle: &subtitle, rows, columns, counts, palette: &palette };
            draw_matrix(&matrix)?.write_png(path)
        })
    }

    /// Whether it was counted how often what the network was so sure of came true.
    pub fn has_calibration(&self) -> bool {
        self.header.what.calibration
    }

    /// Draws the reliability diagram of all voxels as a PNG: of "occupied" and of the class, or of two predictors of "occupied".
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) if calibration was not counted;
    /// [`ErrorKind::Io`](crate::ErrorKind::Io) if it cannot be written.
    pub fn write_reliability(&self, path: &Path) -> Result<()> {
        if !self.has_calibration() {
            let message = "nothing was counted of how sure the network was, expected an evaluation with calibration";
            return Err(Error::mismatch(message).in_file(path));
        }
        let all: Vec<&Calibration> = self.total.scores.iter().filter_map(|score| score.calibration.first()).collect();
        let named = match &all[..] {
            [one] => vec![("occupied", &one.occupied), ("class", &one.class)],
            several => ["A: occupied", "B: occupied"].into_iter().zip(several.iter().map(|c| &c.occupied)).collect(),
        };
        let curve = |(name, reliability): (&str, &Reliability)| {
            let error = reliability.expected_error().map_or("-".to_owned(), |error| format!("{:.2} %", 100.0 * error));
            let point = |Bin { voxels, said, found }: &Bin| Point {
                said: *said as f32,
                found: *found as f32,
                share: *voxels as f32 / reliability.voxels() as f32,
            };
            Curve {
                name: format!("{name}, calibration error {error}"),
                points: reliability.bins().iter().map(point).collect(),
            }
        };
        let curves: Vec<Curve> = named.into_iter().map(curve).collect();
        let title = self.with(|reports, _| reports[0].title.to_owned());
        let subtitle = format!("{} frames; 15 bins, the larger the more voxels", self.frames);
        draw_diagram(&Diagram { title: &title, subtitle: &subtitle, curves: &curves }).write_png(path)
    }

    /// Calls `f` with the report of each predictor, and the comparison of two.
    fn with<R>(&self, f: impl FnOnce(&[Report<'_>], Option<&Comparison<'_>>) -> R) -> R {
        let Header { what, shard, names, .. } = &self.header;
        let classes: Vec<&str> = what.classes.iter().map(String::as_str).collect();
        let masks: Vec<&str> = what.masks.iter().map(String::as_str).collect();
        let regions = Scorer::regions(&masks);
        let data = if *shard == Shard::WHOLE { what.data.clone() } else { format!("{}, shard {shard}", what.data) };
        let titles: Vec<String> = names.iter().map(|name| format!("{name} on {data}")).collect();
        let reports: Vec<Report<'_>> = titles
            .iter()
            .zip(&self.total.scores)
            .zip(&self.total.digests)
            .zip(&what.published)
            .map(|(((title, total), &digest), &published)| Report {
                title,
                classes: &classes,
                regions: &regions,
                rings: &what.rings,
                published,
                frames: self.frames,
                total,
                digest,
            })
            .collect();
        let sums: Vec<Confusion> = self.total.scores.iter().map(|score| score.region(0)).collect();
        let comparison = match &names[..] {
            [a, b] => Comparison::of([a, b], &data, &classes, self.frames, &sums, &self.total),
            _ => None,
        };
        f(&reports, comparison.as_ref())
    }
}

/// Refuses a journal, with this header, that does not belong to those before.
fn fits(header: &Header, parts: &[(Header, &Path)]) -> Result<()> {
    let Some((first, first_path)) = parts.first() else { return Ok(()) };
    if let Some(difference) = header.what.difference(&first.what) {
        let message = format!("it is of another evaluation than {}: {difference}", first_path.display());
        return Err(Error::mismatch(message));
    }
    if header.shard.count() != first.shard.count() {
        let message = format!("shard {}, {} is shard {}", header.shard, first_path.display(), first.shard);
        return Err(Error::mismatch(format!("{message}: expected as many shards")));
    }
    match parts.iter().find(|(other, _)| other.shard == header.shard) {
        None => Ok(()),
        Some((_, other)) => {
            Err(Error::mismatch(format!("shard {}, as {} is: they overlap", header.shard, other.display())))
        }
    }
}

/// Refuses a set of shards that is not whole.
fn check_complete(parts: &[(Header, &Path)], totals: &Totals) -> Result<()> {
    let count = parts.first().map_or(1, |(header, _)| header.shard.count());
    let missing: Vec<String> = (0..count)
        .filter(|&index| parts.iter().all(|(header, _)| header.shard.index() != index))
        .map(|index| format!("{index}/{count}"))
        .collect();
    if let [first, ..] = &missing[..] {
        let named =
            if missing.len() > 8 { format!("{first} and {} more", missing.len() - 1) } else { missing.join(", ") };
        return Err(Error::mismatch(format!("shards are missing: {named}")));
    }
    for (header, path) in parts {
        let lacking: Vec<usize> = header.shard.frames(totals.frames()).filter(|&index| !totals.has(index)).collect();
        if let Some(first) = lacking.first() {
            let (lacking, all) = (lacking.len(), header.shard.frames(totals.frames()).count());
            let message = format!(
                "shard {}: {lacking} of its {all} frames are missing, frame {first} the first: it has not ended",
                header.shard
            );
            return Err(Error::mismatch(message).in_file(path));
        }
    }
    Ok(())
}

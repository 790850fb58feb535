//! A file that keeps the score of every frame, so that an evaluation that was stopped goes on where it was.
//!
//! It is JSON by lines. The first line says what is evaluated; a file that says something else is refused. Each further
//! line is a frame. Lines are appended whole; one that a kill cut short is dropped when the file is opened again.

use super::losses::Losses;
use super::ray_iou::RayCounts;
use super::{Confusion, FrameScore, Kind, LossSum, Score};
use crate::base::error::{Error, ErrorKind, Result};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};

/// Longest line in bytes: a frame of twenty classes in twenty rings and regions needs a hundredth of it.
const MAX_LINE: u64 = 64 << 20;

/// Voxels or rays that a frame may count.
const MAX_COUNT: u64 = 1 << 40;

/// An open journal. No other process can open it meanwhile.
#[derive(Debug)]
pub struct Journal {
    file: File,
    path: PathBuf,
    /// Bytes of the lines that are whole.
    length: u64,
}

/// A frame as it is written. Counts are sparse: places and numbers, one after the other.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    frame: String,
    scores: Vec<LineScore>,
    agreement: Option<Vec<u64>>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct LineScore {
    regions: Vec<Vec<Vec<u64>>>,
    published: Vec<u64>,
    /// Labelled, predicted, and hits at each threshold.
    rays: [Vec<u64>; 5],
    /// Frames; then the bits of focal, Lovasz, geometric and semantic sums, because decimals may lose the last one.
    losses: [u64; 5],
}

impl Journal {
    /// Opens `path`, or begins it. `what` says what is evaluated; `found` is told each frame that is already there, by the
    /// name it was appended under.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`] if the file is of another evaluation; [`ErrorKind::Format`] for a file that is no journal or
    /// has a malformed line; [`ErrorKind::Io`] if it cannot be read, written and locked, or is open elsewhere.
    pub fn open(
        path: &Path,
        what: &Value,
        kind: Kind,
        predictors: usize,
        found: &mut dyn FnMut(&str, FrameScore),
    ) -> Result<Self> {
        let io = |doing: &'static str| move |e: std::io::Error| Error::io(path, doing, &e);
        let mut file = OpenOptions::new();
        let file = file.read(true).append(true).create(true).open(path).map_err(io("open"))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                return Err(Error::new(ErrorKind::Io, "another evaluation has it open").in_file(path));
            }
            Err(TryLockError::Error(e)) => return Err(Error::io(path, "lock", &e)),
        }
        let header = json!({ "voxcast": "evaluation", "version": 1, "what": what });
        let mut reader = BufReader::new(&file);
        let mut whole = 0;
        let mut text = Vec::new();
        for number in 1u64.. {
            text.clear();
            let length = (&mut reader).take(MAX_LINE).read_until(b'\n', &mut text).map_err(io("read"))?;
            let wrong = |message: String| Error::format(format!("line {number}: {message}")).in_file(path);
            let Some(line) = text.strip_suffix(b"\n") else {
                if length as u64 == MAX_LINE {
                    return Err(wrong(format!("longer than {MAX_LINE} bytes")));
                }
                break;
            };
            if number == 1 {
                let first: Value = serde_json::from_slice(line).map_err(|e| wrong(e.to_string()))?;
                if first != header {
                    let message = format!("it is of another evaluation: {first}, expected {header}");
                    return Err(Error::mismatch(message).in_file(path));
                }
            } else {
                let line: Line = serde_json::from_slice(line).map_err(|e| wrong(e.to_string()))?;
                let score = line.score(kind, predictors);
                found(
                    &line.frame,
                    score.ok_or_else(|| wrong("counts that no frame of this evaluation has".to_owned()))?,
                );
            }
            whole += length as u64;
        }
        let mut journal = Self { file, path: path.to_owned(), length: whole };
        if whole == 0 {
            // Nothing of ours: only an empty file may become a journal.
            if !text.is_empty() && !format!("{header}\n").as_bytes().starts_with(&text) {
                return Err(Error::format("not a journal of an evaluation").in_file(path));
            }
            journal.file.set_len(0).map_err(io("write"))?;
            journal.write(&header)?;
        } else {
            journal.file.set_len(whole).map_err(io("write"))?;
        }
        Ok(journal)
    }

    /// Appends a frame, and waits until the disk has it.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if it cannot be written; then nothing of it stays in the file.
    pub fn append(&mut self, frame: &str, score: &FrameScore) -> Result<()> {
        self.write(&Line::of(frame, score))
    }

    fn write(&mut self, line: &impl Serialize) -> Result<()> {
        let mut bytes = serde_json::to_vec(line).map_err(|e| Error::format(e.to_string()).in_file(&self.path))?;
        bytes.push(b'\n');
        let written = self.file.write_all(&bytes).and_then(|()| self.file.sync_data());
        if let Err(e) = written {
            // Half a line would make one of it and the next. If this fails too, the next opening refuses the file.
            let _ = self.file.set_len(self.length);
            return Err(Error::io(&self.path, "write", &e));
        }
        self.length += bytes.len() as u64;
        Ok(())
    }
}

impl Line {
    fn of(frame: &str, score: &FrameScore) -> Self {
        let scores = score.scores.iter().map(LineScore::of).collect();
        Self { frame: frame.to_owned(), scores, agreement: score.agreement.as_ref().map(sparse) }
    }

    /// The score, if it is of this kind.
    fn score(&self, kind: Kind, predictors: usize) -> Option<FrameScore> {
        if self.scores.len() != predictors || self.agreement.is_some() != (predictors == 2) {
            return None;
        }
        let scores = self.scores.iter().map(|score| score.score(kind)).collect::<Option<Vec<Score>>>()?;
        let agreement = match &self.agreement {
            Some(counts) => Some(dense(kind.classes, counts)?),
            None => None,
        };
        Some(FrameScore { scores, agreement })
    }
}

impl LineScore {
    fn of(score: &Score) -> Self {
        let RayCounts { labelled, predicted, hits: [one, two, four] } = &score.rays;
        let Losses { focal, lovasz, geometric, semantic } = score.losses.sum;
        let [focal, lovasz, geometric, semantic] = [focal, lovasz, geometric, semantic].map(f64::to_bits);
        Self {
            regions: score.regions.iter().map(|rings| rings.iter().map(sparse).collect()).collect(),
            published: sparse(&score.published),
            rays: [labelled, predicted, one, two, four].map(Vec::clone),
            losses: [score.losses.frames, focal, lovasz, geometric, semantic],
        }
    }

    fn score(&self, kind: Kind) -> Option<Score> {
        let rings = |rings: &Vec<Vec<u64>>| -> Option<Vec<Confusion>> {
            (rings.len() == kind.rings).then(|| rings.iter().map(|counts| dense(kind.classes, counts)).collect())?
        };
        let regions = self.regions.iter().map(rings).collect::<Option<Vec<_>>>()?;
        let fits = |counts: &Vec<u64>| counts.len() == kind.classes && counts.iter().all(|&n| n <= MAX_COUNT);
        let [labelled, predicted, one, two, four] = self.rays.clone();
        let possible = |hits: &Vec<u64>| {
            let most = labelled.iter().zip(&predicted).map(|(l, p)| l.min(p));
            hits.iter().zip(most).all(|(hits, most)| hits <= most)
        };
        let right = regions.len() == kind.regions
            && self.rays.iter().all(fits)
            && [&one, &two, &four].into_iter().all(possible);
        let [frames, losses @ ..] = self.losses;
        let [focal, lovasz, geometric, semantic] = losses.map(f64::from_bits);
        let published = dense(kind.classes + 1, &self.published)?;
        right.then_some(Score {
            regions,
            published,
            rays: RayCounts { labelled, predicted, hits: [one, two, four] },
            losses: LossSum { frames, sum: Losses { focal, lovasz, geometric, semantic } },
        })
    }
}

/// Place and number of the counts that are not 0.
fn sparse(confusion: &Confusion) -> Vec<u64> {
    let counts = (0u64..).zip(confusion.counts()).filter(|&(_, &count)| count > 0);
    counts.flat_map(|(place, &count)| [place, count]).collect()
}

/// The counts again; none if a place is beyond the matrix or a number beyond what frames have.
fn dense(classes: usize, pairs: &[u64]) -> Option<Confusion> {
    let mut counts = vec![0; classes * classes];
    for pair in pairs.chunks(2) {
        let &[place, count] = pair else { return None };
        *counts.get_mut(usize::try_from(place).ok()?)? = Some(count).filter(|&count| count <= MAX_COUNT)?;
    }
    Confusion::from_counts(classes, counts)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    const KIND: Kind = Kind { classes: 3, regions: 2, rings: 2 };

    fn frame(seed: u8, predictors: usize) -> FrameScore {
        let mut scores = vec![Score::new(KIND); predictors];
        for score in &mut scores {
            score.regions[1][0].add(seed % 3, 2);
            (score.rays.labelled[1], score.rays.predicted[1]) = (9, 12);
            score.published.add(3, seed % 3);
            score.rays.hits[2][1] = u64::from(seed);
            let value = f64::from(seed) / 3.0;
            score.losses.add(&Losses { focal: value, lovasz: value.exp(), geometric: 1e-300, semantic: -0.0 });
        }
        let agreement = (predictors == 2).then(|| Confusion::new(3));
        FrameScore { scores, agreement }
    }

    fn open(path: &Path, what: &str, predictors: usize) -> Result<(Journal, Vec<(String, FrameScore)>)> {
        let mut found = Vec::new();
        let journal = Journal::open(path, &json!(what), KIND, predictors, &mut |name, score| {
            found.push((name.to_owned(), score));
        })?;
        Ok((journal, found))
    }

    #[test]
    fn frames_come_back_in_bits_and_a_cut_line_is_dropped() {
        for predictors in [1, 2] {
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join("journal");
            let (mut journal, found) = open(&path, "x", predictors).unwrap();
            assert!(found.is_empty());
            let frames: Vec<_> = (1..4).map(|seed| (format!("frame \"{seed}\""), frame(seed, predictors))).collect();
            frames.iter().for_each(|(name, score)| journal.append(name, score).unwrap());
            drop(journal);
            let whole = fs::read(&path).unwrap();
            let header = whole.iter().position(|&b| b == b'\n').unwrap() + 1;
            // Cut anywhere, it opens with the frames whose lines are whole, and goes on from there.
            for length in 0..=whole.len() {
                fs::write(&path, &whole[..length]).unwrap();
                let lines = whole[..length].iter().filter(|&&b| b == b'\n').count();
                let (mut journal, found) = open(&path, "x", predictors).unwrap();
                assert_eq!(found, frames[..lines.saturating_sub(1)], "{length} bytes");
                journal.append("more", &frames[0].1).unwrap();
                drop(journal);
                let kept = whole[..length].iter().rposition(|&b| b == b'\n').map_or(header, |last| last + 1);
                assert_eq!(fs::read(&path).unwrap()[..kept], whole[..kept]);
                assert_eq!(open(&path, "x", predictors).unwrap().1.len(), lines.max(1));
            }
        }
    }

    #[test]
    fn what_does_not_belong_is_refused_and_left_alone() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("journal");
        let refused = |bytes: &[u8], what: &str, predictors: usize, expected: &str| {
            fs::write(&path, bytes).unwrap();
            let error = open(&path, what, predictors).unwrap_err();
            assert!(error.message().contains(expected), "{error} does not say {expected:?}");
            assert_eq!(error.path(), Some(path.as_path()));
            assert_eq!(fs::read(&path).unwrap(), bytes);
        };
        let (mut journal, _) = open(&path, "x", 1).unwrap();
        journal.append("one", &frame(1, 1)).unwrap();
        let error = open(&path, "x", 1).unwrap_err();
        assert!(error.message().contains("another evaluation has it open"), "{error}");
        drop(journal);
        let good = fs::read(&path).unwrap();
        refused(&good, "y", 1, "\"what\":\"x\"");
        refused(&good, "x", 2, "line 2: counts that no frame");
        refused(b"my notes", "x", 1, "not a journal");
        refused(b"my notes\n", "x", 1, "line 1");
        let text = String::from_utf8(good).unwrap();
        refused(text.replace("\"regions\":[", "\"regions\":[[],").as_bytes(), "x", 1, "line 2: counts");
        refused(text.replace("[5,1]", "[9,1]").as_bytes(), "x", 1, "line 2: counts");
        refused(text.replace("[5,1]", "[5]").as_bytes(), "x", 1, "line 2: counts");
        refused(text.replace("[5,1]", "[5,1099511627777]").as_bytes(), "x", 1, "line 2: counts");
        refused(text.replace("[0,9,0]", "[0,0,0]").as_bytes(), "x", 1, "line 2: counts");
        refused(text.replace("\"losses\"", "\"loses\"").as_bytes(), "x", 1, "line 2: ");
    }
}

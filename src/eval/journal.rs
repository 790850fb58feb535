//! A file that keeps the score of every frame, so that an evaluation that was stopped goes on where it was, and that many
//! machines can share one.
//!
//! It is JSON by lines. The first line says what is evaluated, and which shard of it; a file that says something else is
//! refused. Each further line is a frame. Lines are appended whole; one that a kill cut short is dropped when the file is
//! opened again.

use super::losses::Losses;
use super::ray_iou::RayCounts;
use super::reliability::{CODES, Calibration, Reliability};
use super::subject::{Shard, Subject};
use super::{Confusion, FrameScore, Kind, LossSum, Score};
use crate::base::error::{Error, ErrorKind, Result};
use serde::{Deserialize, Serialize};
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};

/// Longest line in bytes: a frame of twenty classes in twenty rings and regions needs a hundredth of it.
const MAX_LINE: u64 = 64 << 20;

/// Voxels or rays that a frame may count.
const MAX_COUNT: u64 = 1 << 40;

/// What the first line calls the file, and the layout of the lines.
const FORMAT: &str = "evaluation";
const VERSION: u32 = 4;

/// An open journal. No other process can open it meanwhile.
#[derive(Debug)]
pub struct Journal {
    file: File,
    path: PathBuf,
    /// Bytes of the lines that are whole.
    length: u64,
}

/// The first line.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Header {
    /// Tells journals from other files.
    voxcast: String,
    version: u32,
    /// What is evaluated.
    pub what: Subject,
    /// Which of its frames the file is for.
    pub shard: Shard,
    /// What the predictors are called, for people. It need not be the same from run to run.
    pub names: Vec<String>,
}

/// A frame as it is written. Counts are sparse: places and numbers, one after the other.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    frame: String,
    index: usize,
    truth: String,
    digests: Vec<String>,
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
    /// For each region, of "occupied" and of the class: place and number of the counts by code and outcome.
    calibration: Vec<[Vec<u64>; 2]>,
}

/// A frame's score with its place in the set.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    /// What the set calls the frame.
    pub frame: String,
    /// Its place in the set.
    pub index: usize,
    /// What it was held against: [`Truth::digest`](super::dataset::Truth::digest).
    pub truth: u64,
    /// What was found.
    pub score: FrameScore,
}

impl Entry {
    /// As a line of a journal, without its end.
    ///
    /// # Errors
    /// None that is known.
    pub fn to_line(&self) -> Result<String> {
        serde_json::to_string(&Line::of(self)).map_err(|e| Error::format(e.to_string()))
    }

    /// The entry of a line that [`Entry::to_line`] wrote, in an evaluation of `what`.
    ///
    /// # Errors
    /// [`ErrorKind::Format`] for anything else.
    pub fn from_line(line: &str, what: &Subject) -> Result<Self> {
        let line: Line = serde_json::from_str(line).map_err(|e| Error::format(e.to_string()))?;
        let malformed = || Error::format("counts that no frame of this evaluation has");
        let score = line.score(what.kind(), what.predictors.len()).ok_or_else(malformed)?;
        let truth = hexadecimal(&line.truth).ok_or_else(malformed)?;
        if line.index >= what.frames {
            return Err(Error::format(format!("frame {}, expected one of {}", line.index, what.frames)));
        }
        Ok(Self { frame: line.frame, index: line.index, truth, score })
    }
}

impl Header {
    /// The first line of a journal of `shard` of `what`.
    pub fn new(what: Subject, shard: Shard, names: Vec<String>) -> Self {
        Self { voxcast: FORMAT.to_owned(), version: VERSION, what, shard, names }
    }

    fn parse(line: &[u8]) -> Result<Self> {
        // The version comes first: another one may have other fields.
        #[derive(Deserialize)]
        struct Version {
            voxcast: String,
            version: u32,
        }
        let Version { voxcast, version } = serde_json::from_slice(line)
            .map_err(|e| Error::format(format!("not the first line of a journal of an evaluation: {e}")))?;
        if (voxcast.as_str(), version) != (FORMAT, VERSION) {
            let message = format!("{voxcast:?} of version {version}, expected {FORMAT:?} of version {VERSION}");
            return Err(Error::format(message));
        }
        let header: Self = serde_json::from_slice(line).map_err(|e| Error::format(e.to_string()))?;
        let predictors = [header.what.predictors.len(), header.what.published.len()];
        if predictors != [header.names.len(); 2] || !matches!(header.names.len(), 1 | 2) {
            return Err(Error::format(format!("{} names of predictors, expected one or two", header.names.len())));
        }
        Ok(header)
    }

    /// Refuses the header of another evaluation or shard. Names may differ.
    fn check(&self, expected: &Header) -> Result<()> {
        if let Some(difference) = self.what.difference(&expected.what) {
            return Err(Error::mismatch(format!("it is of another evaluation: {difference}")));
        }
        if self.shard != expected.shard {
            return Err(Error::mismatch(format!("it is of shard {}, expected {}", self.shard, expected.shard)));
        }
        Ok(())
    }
}

/// A journal that is read line by line.
#[derive(Debug)]
pub struct JournalReader<'a, R = File> {
    lines: BufReader<R>,
    path: &'a Path,
    header: Option<Header>,
    /// The line read last, counted from 1.
    number: u64,
    /// Bytes of the lines that are whole.
    whole: u64,
    /// The line read last. Without an end it was cut short, or is still being written.
    line: Vec<u8>,
}

impl<'a> JournalReader<'a> {
    /// Opens `path` and reads its first line. The file is not changed; another process may be writing it.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if it cannot be read; [`ErrorKind::Format`] if it is no journal.
    pub fn open(path: &'a Path) -> Result<(Self, Header)> {
        let reader = Self::new(File::open(path).map_err(|e| Error::io(path, "open", &e))?, path)?;
        match reader.header.clone() {
            Some(header) => Ok((reader, header)),
            None => Err(reader.not_a_journal()),
        }
    }
}

impl<'a, R: Read> JournalReader<'a, R> {
    /// Reads the first line, if there is a whole one.
    fn new(file: R, path: &'a Path) -> Result<Self> {
        let lines = BufReader::new(file);
        let mut reader = Self { lines, path, header: None, number: 0, whole: 0, line: Vec::new() };
        if reader.advance()? {
            reader.header = Some(Header::parse(&reader.line).map_err(|e| reader.at_line(&e))?);
        }
        Ok(reader)
    }

    /// The next frame; none after the last whole line.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if the file cannot be read; [`ErrorKind::Format`] for a line that is no frame of the journal's shard.
    pub fn next_entry(&mut self) -> Result<Option<Entry>> {
        if self.header.is_none() || !self.advance()? {
            return Ok(None);
        }
        let Some(header) = &self.header else { return Ok(None) };
        let line = std::str::from_utf8(&self.line).map_err(|e| self.at_line(&Error::format(e.to_string())))?;
        let entry = Entry::from_line(line, &header.what).map_err(|e| self.at_line(&e))?;
        if !header.shard.has(entry.index) {
            let message = format!("frame {} is not of shard {}", entry.index, header.shard);
            return Err(self.at_line(&Error::format(message)));
        }
        Ok(Some(entry))
    }

    /// The error, said of the line read last.
    pub fn at_line(&self, error: &Error) -> Error {
        Error::new(error.kind(), format!("line {}: {}", self.number, error.message())).in_file(self.path)
    }

    fn not_a_journal(&self) -> Error {
        Error::format("not a journal of an evaluation").in_file(self.path)
    }

    /// Reads the next line, without its end. False if there is no whole one.
    fn advance(&mut self) -> Result<bool> {
        self.line.clear();
        let read = (&mut self.lines).take(MAX_LINE).read_until(b'\n', &mut self.line);
        let length = read.map_err(|e| Error::io(self.path, "read", &e))? as u64;
        self.number += 1;
        if self.line.pop_if(|end| *end == b'\n').is_none() {
            if length == MAX_LINE {
                return Err(self.at_line(&Error::format(format!("longer than {MAX_LINE} bytes"))));
            }
            return Ok(false);
        }
        self.whole += length;
        Ok(true)
    }
}

impl Journal {
    /// Opens `path`, or begins it. `header` says what is evaluated; `found` is told each frame that is already there.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`] if the file is of another evaluation or shard; [`ErrorKind::Format`] for a file that is no
    /// journal or has a malformed line; [`ErrorKind::Io`] if it cannot be read, written and locked, or is open elsewhere;
    /// what `found` returns.
    pub fn open(path: &Path, header: &Header, found: &mut dyn FnMut(Entry) -> Result<()>) -> Result<Self> {
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
        let mut reader = JournalReader::new(&file, path)?;
        if let Some(there) = &reader.header {
            there.check(header).map_err(|e| e.in_file(path))?;
        }
        while let Some(entry) = reader.next_entry()? {
            // What is wrong with another file is not said of this one.
            found(entry).map_err(|e| if e.path().is_some() { e } else { reader.at_line(&e) })?;
        }
        if reader.header.is_none() {
            // Nothing of ours: only an empty file, or one whose first line was cut short, may become a journal.
            let start = format!("{{\"voxcast\":\"{FORMAT}\"");
            let shorter = reader.line.len().min(start.len());
            if reader.line[..shorter] != start.as_bytes()[..shorter] {
                return Err(reader.not_a_journal());
            }
        }
        let (whole, empty) = (reader.whole, reader.header.is_none());
        drop(reader);
        let mut journal = Self { file, path: path.to_owned(), length: whole };
        journal.file.set_len(whole).map_err(io("write"))?;
        if empty {
            journal.write(serde_json::to_string(header).map_err(|e| Error::format(e.to_string()).in_file(path))?)?;
        }
        Ok(journal)
    }

    /// Appends a frame, and waits until the disk has it.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if it cannot be written; then nothing of it stays in the file.
    pub fn append(&mut self, entry: &Entry) -> Result<()> {
        self.write(entry.to_line().map_err(|e| e.in_file(&self.path))?)
    }

    fn write(&mut self, mut line: String) -> Result<()> {
        line.push('\n');
        let written = self.file.write_all(line.as_bytes()).and_then(|()| self.file.sync_data());
        if let Err(e) = written {
            // Half a line would make one of it and the next. If this fails too, the next opening refuses the file.
            let _ = self.file.set_len(self.length);
            return Err(Error::io(&self.path, "write", &e));
        }
        self.length += line.len() as u64;
        Ok(())
    }
}

impl Line {
    fn of(entry: &Entry) -> Self {
        let FrameScore { digests, scores, agreement } = &entry.score;
        Self {
            frame: entry.frame.clone(),
            index: entry.index,
            truth: format!("{:016x}", entry.truth),
            digests: digests.iter().map(|digest| format!("{digest:016x}")).collect(),
            scores: scores.iter().map(LineScore::of).collect(),
            agreement: agreement.as_ref().map(sparse),
        }
    }

    /// The score, if it is of this kind.
    fn score(&self, kind: Kind, predictors: usize) -> Option<FrameScore> {
        if self.scores.len() != predictors || self.agreement.is_some() != (predictors == 2) {
            return None;
        }
        let digests = self.digests.iter().map(|text| hexadecimal(text)).collect::<Option<Vec<u64>>>()?;
        let scores = self.scores.iter().map(|score| score.score(kind)).collect::<Option<Vec<Score>>>()?;
        let agreement = match &self.agreement {
            Some(counts) => Some(dense(kind.classes, counts)?),
            None => None,
        };
        (digests.len() == predictors).then_some(FrameScore { digests, scores, agreement })
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
            calibration: score.calibration.iter().map(|c| [&c.occupied, &c.class].map(sparse_codes)).collect(),
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
        let calibration = |[occupied, class]: &[Vec<u64>; 2]| {
            Some(Calibration { occupied: dense_codes(occupied)?, class: dense_codes(class)? })
        };
        let calibration = self.calibration.iter().map(calibration).collect::<Option<Vec<_>>>()?;
        let right = right && calibration.len() == kind.regions;
        right.then_some(Score {
            regions,
            published,
            rays: RayCounts { labelled, predicted, hits: [one, two, four] },
            losses: LossSum { frames, sum: Losses { focal, lovasz, geometric, semantic } },
            calibration,
        })
    }
}

/// A digest as lines have them.
fn hexadecimal(text: &str) -> Option<u64> {
    u64::from_str_radix(text, 16).ok().filter(|_| text.len() == 16)
}

/// Place and number of the counts that are not 0.
fn pairs(counts: &[u64]) -> Vec<u64> {
    let counts = (0u64..).zip(counts).filter(|&(_, &count)| count > 0);
    counts.flat_map(|(place, &count)| [place, count]).collect()
}

/// Fills in counts from [`pairs`]; none if a place is beyond them or a number beyond what frames have.
fn fill(counts: &mut [u64], pairs: &[u64]) -> Option<()> {
    for pair in pairs.chunks(2) {
        let &[place, count] = pair else { return None };
        *counts.get_mut(usize::try_from(place).ok()?)? = Some(count).filter(|&count| count <= MAX_COUNT)?;
    }
    Some(())
}

fn sparse(confusion: &Confusion) -> Vec<u64> {
    pairs(confusion.counts())
}

fn dense(classes: usize, pairs: &[u64]) -> Option<Confusion> {
    let mut counts = vec![0; classes * classes];
    fill(&mut counts, pairs)?;
    Confusion::from_counts(classes, counts)
}

fn sparse_codes(reliability: &Reliability) -> Vec<u64> {
    pairs(reliability.counts().as_flattened())
}

fn dense_codes(pairs: &[u64]) -> Option<Reliability> {
    let mut counts = vec![[0; 2]; CODES];
    fill(counts.as_flattened_mut(), pairs)?;
    Reliability::from_counts(counts)
}

#[cfg(test)]
mod tests;

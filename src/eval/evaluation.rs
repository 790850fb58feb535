//! A whole evaluation: frames of a data set, several at a time, each with all its predictors.

use super::dataset::{DataSet, Grid};
use super::journal::{Entry, Header, Journal};
use super::subject::{Scope, Subject};
use super::summary::Summary;
use super::{Confusion, FrameScore, Prediction, Scorer, Totals};
use crate::base::digest;
use crate::base::error::{Error, Result};
use crate::base::note::{Note, Said};
use crate::base::threads::Threads;
use crate::model::Model;
use crate::runtime::session::{Moving, Occupancy, SessionOptions};
use crate::scene::Scene;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;
use voxcast_kernels::Isa;

/// How often whoever waits for frames hears of them, at least.
const TICK: Duration = Duration::from_millis(200);

/// Who predicts.
#[derive(Debug)]
pub struct Predictor {
    /// What people call it.
    pub name: String,
    /// What it says.
    pub says: Says,
}

/// What a predictor says.
#[derive(Debug)]
pub enum Says {
    /// What a model makes of the images.
    Model(Arc<Model>),
    /// The same classes for every frame, in the voxels of a grid.
    Always(Vec<u8>, Grid),
}

impl Predictor {
    /// A model, under the name of its file.
    pub fn model(model: Arc<Model>) -> Self {
        let name = model.path().map_or_else(|| "a model in memory".to_owned(), |path| path.display().to_string());
        Self { name, says: Says::Model(model) }
    }

    /// The voxels that it speaks of.
    pub(super) fn grid(&self) -> Grid {
        match &self.says {
            Says::Model(model) => Grid::of(model.network()),
            Says::Always(_, grid) => *grid,
        }
    }

    /// By what it is known again.
    fn identity(&self) -> String {
        match &self.says {
            Says::Model(model) => match model.checksum() {
                Some(checksum) => format!("model {checksum:016x}"),
                None => format!("model {}", self.name),
            },
            Says::Always(classes, _) => format!("classes {:016x}", digest::bytes(classes)),
        }
    }

    /// Refuses a model of other classes than the set's.
    pub(super) fn check(&self, classes: usize, data: &str) -> Result<()> {
        let Says::Model(model) = &self.says else { return Ok(()) };
        let found = model.network().classes;
        if found == classes {
            return Ok(());
        }
        let error = Error::mismatch(format!("a model of {found} classes, {data} has {classes}"));
        Err(match model.path() {
            Some(path) => error.in_file(path),
            None => error,
        })
    }
}

/// How frames are computed. None of it changes a result.
#[derive(Clone, Copy, Debug)]
pub struct Means {
    /// Frames at a time, each with a session of its own; no more than threads.
    pub workers: usize,
    /// Threads of all of them together.
    pub threads: usize,
    /// Instruction set of the kernels.
    pub isa: Isa,
}

impl Means {
    /// Frames at a time where nobody says how many, at most as many as threads: two sessions of one thread each are faster than one of
    /// two (docs/many-machines.md), and every further one takes the memory of a session. The program and the Python package have it
    /// from here; `benches/workers.rs` compares it with others.
    pub const WORKERS: usize = 2;
}

/// One or two predictors, the data set on which they are scored, and how.
pub struct Evaluation {
    set: Box<dyn DataSet>,
    predictors: Vec<(Predictor, Scorer)>,
    header: Header,
    /// Frames from the first on, of which those of the shard are scored.
    frames: usize,
}

impl std::fmt::Debug for Evaluation {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Evaluation").field("header", &self.header).field("frames", &self.frames).finish_non_exhaustive()
    }
}

impl Evaluation {
    /// Prepares the evaluation of `predictors`, one or two that are compared, on `set`, which was named `data`.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) for a model that has not the set's classes; those of
    /// [`Scorer::new`].
    pub fn new(set: Box<dyn DataSet>, data: &str, predictors: Vec<Predictor>, scope: &Scope) -> Result<Self> {
        let with_scorer = |predictor: Predictor| {
            predictor.check(set.classes().len(), data)?;
            let grids = [set.grid(), predictor.grid()];
            let scorer = Scorer::new(set.classes().len(), set.masks().len(), grids[0], grids[1], &scope.options)?;
            Ok((predictor, scorer.with_published(set.published())))
        };
        let predictors = predictors.into_iter().map(with_scorer).collect::<Result<Vec<_>>>()?;
        let identities = predictors.iter().map(|(predictor, scorer)| (predictor.identity(), scorer.published()));
        let what = Subject::new(&*set, data, identities.collect(), scope);
        let names = predictors.iter().map(|(predictor, _)| predictor.name.clone()).collect();
        let header = Header::new(what, scope.shard, names);
        let frames = scope.limit.map_or(set.len(), |limit| set.len().min(limit));
        Ok(Self { set, predictors, header, frames })
    }

    /// What is evaluated.
    pub fn what(&self) -> &Subject {
        &self.header.what
    }

    /// Nothing counted yet.
    pub fn totals(&self) -> Totals {
        Totals::new(self.what().kind(), self.predictors.len(), self.frames)
    }

    /// The frames to score that `totals` lacks, in the order of the set.
    pub fn left(&self, totals: &Totals) -> Vec<usize> {
        self.header.shard.frames(self.frames).filter(|&index| !totals.has(index)).collect()
    }

    /// Opens the journal at `path`, or begins it, and counts the frames that it has. Their labels are read, and must be those
    /// against which the frames were scored. `watch` is told of each frame how many have been counted; what it returns as an
    /// error ends that.
    ///
    /// # Errors
    /// Those of [`Journal::open`], of [`DataSet::truth`] and of `watch`; [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) if the
    /// labels of a frame have changed.
    pub fn resume(
        &self,
        path: &Path,
        totals: &mut Totals,
        watch: &mut dyn FnMut(usize) -> Result<()>,
    ) -> Result<Journal> {
        let mut counted = 0;
        Journal::open(path, &self.header, &mut |entry| {
            self.check_name(&entry)?;
            // A journal of a higher limit has more frames.
            if entry.index < self.frames && !totals.has(entry.index) {
                self.check_truth(&entry)?;
                totals.add(entry.index, entry.score);
                counted += 1;
                watch(counted)?;
            }
            Ok(())
        })
    }

    /// Counts, and appends to the journal, the frame of a line that a [`Worker`] of the same evaluation gave in another process.
    /// False if it has been counted; then nothing is done.
    ///
    /// # Errors
    /// [`ErrorKind::Format`](crate::ErrorKind::Format) for a line that is no entry of this evaluation; those of the journal.
    pub fn add(&self, totals: &mut Totals, journal: Option<&mut Journal>, line: &str) -> Result<bool> {
        let entry = Entry::from_line(line, self.what())?;
        self.check_name(&entry)?;
        if entry.index >= self.frames || totals.has(entry.index) {
            return Ok(false);
        }
        if let Some(journal) = journal {
            journal.append(&entry)?;
        }
        totals.add(entry.index, entry.score);
        Ok(true)
    }

    /// Refuses an entry that names another frame than the set.
    fn check_name(&self, entry: &Entry) -> Result<()> {
        let (found, expected) = (&entry.frame, self.set.id(entry.index));
        if found == expected {
            return Ok(());
        }
        Err(Error::format(format!("frame {} is {found:?}, expected {expected:?}", entry.index)))
    }

    /// Refuses an entry that was scored against other labels than the set has now.
    fn check_truth(&self, entry: &Entry) -> Result<()> {
        let (found, expected) = (entry.truth, self.set.truth(entry.index)?.digest());
        if found == expected {
            return Ok(());
        }
        let message = format!(
            "frame {} was scored against other labels than the set has now: digest {found:016x}, expected {expected:016x}; \
             score into another file",
            entry.frame
        );
        Err(Error::mismatch(message))
    }

    /// Scores the frames that `totals` lacks, and counts them. `watch` is told how many are done and what of their images has
    /// not been said yet, on the calling thread, a few times a second and whenever a frame is; what it returns as an error
    /// ends the evaluation once the frames under way are done. Every frame that was done is counted, and in the journal, in any case.
    ///
    /// # Errors
    /// The first of `watch`, of a frame, or of the journal.
    pub fn run(
        self: &Arc<Self>,
        means: &Means,
        totals: &mut Totals,
        mut journal: Option<&mut Journal>,
        watch: &mut dyn FnMut(usize, &[Note]) -> Result<()>,
    ) -> Result<()> {
        let left = self.left(totals);
        let workers = means.workers.min(means.threads.max(1)).min(left.len());
        let threads = (means.threads / workers.max(1)).max(1);
        let next = AtomicUsize::new(0);
        let (sender, results) = channel::<Result<(Entry, Vec<Note>)>>();
        std::thread::scope(|scope| {
            for _ in 0..workers {
                let (sender, left, next) = (sender.clone(), &left, &next);
                scope.spawn(move || {
                    let work = || -> Result<()> {
                        let mut worker = Worker::new(self.clone(), means.isa, Threads::new(threads)?);
                        while let Some(&index) = left.get(next.fetch_add(1, Ordering::Relaxed)) {
                            let entry = worker.score(index)?;
                            // Whoever waits has gone only if a panic is on its way there.
                            let _ = sender.send(Ok((entry, worker.take_notes())));
                        }
                        Ok(())
                    };
                    if let Err(error) = work() {
                        let _ = sender.send(Err(error));
                    }
                });
            }
            drop(sender);
            let (mut done, mut failed, mut said) = (0, None, Said::default());
            loop {
                let mut notes = Vec::new();
                let outcome = match results.recv_timeout(TICK) {
                    Ok(Ok((entry, of_frame))) => {
                        notes = of_frame;
                        let kept = journal.as_mut().map_or(Ok(()), |journal| journal.append(&entry));
                        totals.add(entry.index, entry.score);
                        done += 1;
                        kept
                    }
                    Ok(Err(error)) => Err(error),
                    Err(RecvTimeoutError::Timeout) => Ok(()),
                    Err(RecvTimeoutError::Disconnected) => break,
                };
                if failed.is_none()
                    && let Err(error) = outcome.and_then(|()| watch(done, said.fresh(notes)))
                {
                    next.store(left.len(), Ordering::Relaxed);
                    failed = Some(error);
                }
            }
            failed.map_or(Ok(()), Err)
        })
    }

    /// What `totals` come to.
    pub fn summary(&self, totals: Totals) -> Summary {
        Summary::new(self.header.clone(), totals)
    }
}

/// One of those that score frames side by side.
#[derive(Debug)]
pub struct Worker {
    evaluation: Arc<Evaluation>,
    options: SessionOptions,
    /// For each predictor that is a model, the means to run it, made for its first frame.
    running: Vec<Option<Moving>>,
    /// What is to be said of the frames since [`Worker::take_notes`].
    notes: Vec<Note>,
}

impl Worker {
    /// A worker with threads of its own. It takes memory for its sessions when the first frame comes.
    pub fn new(evaluation: Arc<Evaluation>, isa: Isa, threads: Threads) -> Self {
        let &Subject { losses: logits, calibration: confidence, .. } = evaluation.what();
        let options = SessionOptions { isa, threads, logits, confidence, ..SessionOptions::default() };
        let running = evaluation.predictors.iter().map(|_| None).collect();
        Self { evaluation, options, running, notes: Vec::new() }
    }

    /// What is to be said of the frames that were read since the last call ([`DataSet::scene`]).
    pub fn take_notes(&mut self) -> Vec<Note> {
        std::mem::take(&mut self.notes)
    }

    /// Scores frame `index` of the set.
    ///
    /// # Errors
    /// Names the frame, or the file that is at fault.
    ///
    /// # Panics
    /// If there is no such frame.
    pub fn score(&mut self, index: usize) -> Result<Entry> {
        let Evaluation { set, predictors, .. } = &*self.evaluation;
        let truth = set.truth(index)?;
        // Read for the first model: who looks at no image needs none.
        let mut scene: Option<Scene> = None;
        let said = |e: Error| match e.path() {
            Some(_) => e,
            None => Error::new(e.kind(), format!("frame {}: {}", set.id(index), e.message())),
        };
        let mut score = FrameScore { digests: Vec::new(), scores: Vec::new(), agreement: None };
        let mut on_truth: Vec<Vec<u8>> = Vec::new();
        for ((Predictor { says, .. }, scorer), running) in predictors.iter().zip(&mut self.running) {
            let prediction = match says {
                Says::Model(model) => {
                    let scene = match &mut scene {
                        Some(scene) => scene,
                        none => {
                            let (read, notes) = set.scene(index)?;
                            self.notes.extend(notes);
                            none.insert(read)
                        }
                    };
                    let Occupancy { classes, support, logits, confidence, .. } =
                        run(running, model, scene, &self.options).map_err(said)?;
                    Prediction { classes, support: Some(support), logits, confidence }
                }
                Says::Always(classes, _) => Prediction { classes, support: None, logits: None, confidence: None },
            };
            score.digests.push(digest::bytes(prediction.classes));
            score.scores.push(scorer.score(&truth, &prediction).map_err(said)?);
            if predictors.len() == 2 {
                on_truth.push(scorer.resampled(&truth.grid_to_lidar, prediction.classes).into_owned());
            }
        }
        if let [first, second] = &on_truth[..] {
            let mut agreement = Confusion::new(set.classes().len());
            first.iter().zip(second).for_each(|(&first, &second)| agreement.add(first, second));
            score.agreement = Some(agreement);
        }
        Ok(Entry { frame: set.id(index).to_owned(), index, truth: truth.digest(), score })
    }
}

/// What a model makes of a scene, with a session that is made for the first one.
pub(super) fn run<'r>(
    running: &'r mut Option<Moving>,
    model: &Arc<Model>,
    scene: &Scene,
    options: &SessionOptions,
) -> Result<Occupancy<'r>> {
    scene.check(model.network())?;
    let running = match running {
        Some(running) => running,
        none => none.insert(Moving::new(model, None, scene, options)?),
    };
    running.calibrate(scene)?;
    running.session.run_scene(scene)
}

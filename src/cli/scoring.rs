//! How `eval` computes: frames of a data set, several at a time, each with all its predictors.

use super::frame::{Moving, RigFile};
use super::terminal;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use voxcast::dataset::{DataSet, Frame, Grid};
use voxcast::eval::{Confusion, FrameScore, Journal, Prediction, Scorer, Totals};
use voxcast::{Error, Isa, Model, Occupancy, Result, SessionOptions, Threads};

/// Who predicts, and how that is scored.
pub struct Predictor {
    pub name: String,
    pub says: Says,
    pub scorer: Scorer,
}

/// What a predictor says.
pub enum Says {
    /// What a model makes of the images.
    Model(Arc<Model>),
    /// The same classes for every frame.
    Always(Vec<u8>),
}

impl Says {
    /// The voxels of which it speaks; those of `always` for what looks at no image.
    pub fn grid(&self, always: Grid) -> Grid {
        match self {
            Says::Model(model) => Grid::of(model.network()),
            Says::Always(_) => always,
        }
    }

    /// By what it is known again.
    pub fn identity(&self) -> String {
        match self {
            Says::Model(model) => match model.checksum() {
                Some(checksum) => format!("model {checksum:016x}"),
                None => format!("model {}", model.path().unwrap_or(Path::new("")).display()),
            },
            Says::Always(classes) => format!("classes {:016x}", voxcast::digest::bytes(classes)),
        }
    }
}

/// How frames are computed. None of it changes a result.
pub struct Means {
    pub workers: usize,
    pub threads: usize,
    pub isa: Isa,
    pub losses: bool,
}

/// What the workers share.
struct Shared {
    totals: Totals,
    journal: Option<Journal>,
    failed: Option<Error>,
}

/// Scores all frames of `set` that `totals` lacks, and returns the totals.
pub fn score(
    set: &dyn DataSet,
    predictors: &[Predictor],
    means: &Means,
    totals: Totals,
    journal: Option<Journal>,
    count: usize,
) -> Result<Totals> {
    let left: Vec<usize> = (0..count).filter(|&index| !totals.has(index)).collect();
    let workers = means.workers.min(left.len());
    let threads = (means.threads / workers.max(1)).max(1);
    let next = AtomicUsize::new(0);
    let shared = Mutex::new(Shared { totals, journal, failed: None });
    let bar = terminal::progress("scoring", left.len());
    let work = || -> Result<()> {
        let threads = Threads::new(threads)?;
        let options = SessionOptions { isa: means.isa, threads, logits: means.losses, ..SessionOptions::default() };
        let mut worker = Worker { predictors, options, running: predictors.iter().map(|_| None).collect() };
        while let Some(&index) = left.get(next.fetch_add(1, Ordering::Relaxed)) {
            let score = worker.score(set, index)?;
            let mut shared = lock(&shared);
            if shared.failed.is_some() {
                return Ok(());
            }
            if let Some(journal) = &mut shared.journal {
                journal.append(set.id(index), &score)?;
            }
            shared.totals.add(index, score);
            bar.inc(1);
        }
        Ok(())
    };
    std::thread::scope(|scope| {
        for _ in 0..workers {
            scope.spawn(|| {
                if let Err(error) = work() {
                    next.store(left.len(), Ordering::Relaxed);
                    lock(&shared).failed.get_or_insert(error);
                }
            });
        }
    });
    bar.finish_and_clear();
    let Shared { totals, failed, .. } = shared.into_inner().unwrap_or_else(|e| e.into_inner());
    failed.map_or(Ok(totals), Err)
}

fn lock(shared: &Mutex<Shared>) -> MutexGuard<'_, Shared> {
    shared.lock().unwrap_or_else(|e| e.into_inner())
}

/// One of those that score frames side by side.
struct Worker<'a> {
    predictors: &'a [Predictor],
    options: SessionOptions,
    /// For each predictor that is a model, the means to run it, made for its first frame.
    running: Vec<Option<Moving>>,
}

impl Worker<'_> {
    fn score(&mut self, set: &dyn DataSet, index: usize) -> Result<FrameScore> {
        let blind = self.predictors.iter().all(|predictor| matches!(predictor.says, Says::Always(_)));
        let (scene, truth) = if blind {
            (None, set.truth(index)?)
        } else {
            let Frame { scene, truth } = set.frame(index)?;
            (Some(scene), truth)
        };
        let said = |e: Error| match e.path() {
            Some(_) => e,
            None => Error::new(e.kind(), format!("frame {}: {}", set.id(index), e.message())),
        };
        let mut scores = Vec::with_capacity(self.predictors.len());
        let mut on_truth: Vec<Vec<u8>> = Vec::new();
        for (Predictor { says, scorer, .. }, running) in self.predictors.iter().zip(&mut self.running) {
            let prediction = match (says, &scene) {
                (Says::Model(model), Some(scene)) => {
                    scene.check(model.network()).map_err(said)?;
                    let running = match running {
                        Some(running) => running,
                        none => {
                            none.insert(Moving::new(model, RigFile::default(), scene, &self.options).map_err(said)?)
                        }
                    };
                    running.calibrate(scene).map_err(said)?;
                    let Occupancy { classes, support, logits, .. } = running.session.run_scene(scene).map_err(said)?;
                    Prediction { classes, support: Some(support), logits }
                }
                (Says::Always(classes), _) => Prediction { classes, support: None, logits: None },
                // Not reached: a scene is read where a model is among the predictors.
                (Says::Model(_), None) => continue,
            };
            scores.push(scorer.score(&truth, &prediction).map_err(said)?);
            if self.predictors.len() == 2 {
                on_truth.push(scorer.resampled(&truth.grid_to_lidar, prediction.classes).into_owned());
            }
        }
        let agreement = match &on_truth[..] {
            [first, second] => {
                let mut agreement = Confusion::new(set.classes().len());
                first.iter().zip(second).for_each(|(&first, &second)| agreement.add(first, second));
                Some(agreement)
            }
            _ => None,
        };
        Ok(FrameScore { scores, agreement })
    }
}

//! `voxcast eval`

use super::source::{FORMS, Source};
use super::{Machine, frame, terminal};
use clap::Args;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use voxcast::dataset::{DataSet, Frame, Grid};
use voxcast::eval::{Options, Prediction, Report, Score, Scorer, majority};
use voxcast::rig::RigBuilder;
use voxcast::{Error, Model, Occupancy, Result, Rig, Session, SessionOptions, Threads};

/// Score a model on a data set with labels: IoU, mIoU and every class, near and far, seen and unseen.
#[derive(Args, Debug)]
#[command(after_help = format!("\
Examples:
  voxcast eval --model model.safetensors --data synthetic:heldout
  voxcast eval --model model.safetensors --data synthetic:heldout --json scores.json --markdown scores.md
  voxcast eval --majority synthetic:train --data synthetic:heldout    # what can be said without looking
  voxcast eval --model model.safetensors --data surroundocc:nuscenes:nuscenes_occ:val
  voxcast eval --model model.safetensors --data semantickitti:kitti:08

{FORMS}"))]
pub struct Eval {
    /// The model
    #[arg(long, required_unless_present = "majority", conflicts_with = "majority")]
    model: Option<PathBuf>,
    /// Instead of a model, predict in each voxel the class that is most frequent there in another set
    #[arg(long, value_name = "SET")]
    majority: Option<Source>,
    /// The data set, as below: synthetic:DIR, surroundocc:..., occ3d:... or semantickitti:...
    #[arg(long, value_name = "SET")]
    data: Source,
    /// Only the first N frames
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    limit: Option<u32>,
    /// Frames that are computed at the same time, each with its own session. It does not change a result
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    workers: u16,
    /// Also compute the four losses of the training, of level 0
    #[arg(long, conflicts_with = "majority")]
    losses: bool,
    /// Write all ratios and counts as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Write the tables as Markdown
    #[arg(long, value_name = "FILE")]
    markdown: Option<PathBuf>,
    #[command(flatten)]
    machine: Machine,
}

/// Who predicts.
enum Predictor {
    Model(Arc<Model>),
    /// The same classes for every frame.
    Constant(Vec<u8>),
}

impl Eval {
    pub fn run(self) -> Result<()> {
        for path in [&self.json, &self.markdown].into_iter().flatten() {
            frame::check_output(path)?;
        }
        let set = self.data.open()?;
        let options = Options::default();
        let (predictor, grid, title) = self.predictor(&*set)?;
        let scorer = Scorer::new(set.classes().len(), set.masks().len(), set.grid(), grid, &options)?;
        let count = self.limit.map_or(set.len(), |limit| set.len().min(limit as usize));
        let scores = self.score(&*set, &predictor, &scorer, count)?;
        let regions = Scorer::regions(set.masks());
        let mut total = Score::new(set.classes().len(), regions.len(), options.rings.len() + 1);
        scores.iter().for_each(|score| total.merge(score));
        let report = Report {
            title: &title,
            classes: set.classes(),
            regions: &regions,
            rings: &options.rings,
            frames: count,
            total: &total,
        };
        print!("{}", report.text());
        if let Some(path) = &self.json {
            write(path, &format!("{:#}\n", report.json()))?;
        }
        if let Some(path) = &self.markdown {
            write(path, &report.markdown())?;
        }
        Ok(())
    }

    fn predictor(&self, set: &dyn DataSet) -> Result<(Predictor, Grid, String)> {
        if let Some(source) = &self.majority {
            let other = source.open()?;
            if other.classes() != set.classes() {
                return Err(Error::mismatch(format!("{source} has other classes than {}", self.data)));
            }
            let bar = terminal::progress("counting", other.len());
            let classes = majority(&*other, &mut |done| bar.set_position(done as u64))?;
            bar.finish_and_clear();
            let title = format!("majority of {source} on {}", self.data);
            return Ok((Predictor::Constant(classes), other.grid(), title));
        }
        let path = self.model.as_deref().unwrap_or(Path::new(""));
        let model = Model::open(path)?;
        let (found, expected) = (model.network().classes, set.classes().len());
        if found != expected {
            let message = format!("a model of {found} classes, {} has {expected}", self.data);
            return Err(Error::mismatch(message).in_file(path));
        }
        let title = format!("{} on {}", path.display(), self.data);
        let grid = Grid::of(model.network());
        Ok((Predictor::Model(Arc::new(model)), grid, title))
    }

    /// Scores the first `count` frames, several at a time.
    fn score(&self, set: &dyn DataSet, predictor: &Predictor, scorer: &Scorer, count: usize) -> Result<Vec<Score>> {
        let workers = usize::from(self.workers).min(count);
        let threads = (self.machine.threads.count() / workers.max(1)).max(1);
        let isa = self.machine.isa()?;
        let next = AtomicUsize::new(0);
        let results: Mutex<Result<Vec<Option<Score>>>> = Mutex::new(Ok(vec![None; count]));
        let bar = terminal::progress("scoring", count);
        let work = || -> Result<()> {
            let threads = Threads::new(threads)?;
            let options = SessionOptions { isa, threads, logits: self.losses, ..SessionOptions::default() };
            let mut worker = Worker { predictor, options, running: None };
            loop {
                let index = next.fetch_add(1, Ordering::Relaxed);
                if index >= count {
                    return Ok(());
                }
                let score = worker.score(set, index, scorer)?;
                if let Ok(scores) = &mut *results.lock().unwrap_or_else(|e| e.into_inner()) {
                    scores[index] = Some(score);
                }
                bar.inc(1);
            }
        };
        std::thread::scope(|scope| {
            for _ in 0..workers {
                scope.spawn(|| {
                    if let Err(error) = work() {
                        next.store(count, Ordering::Relaxed);
                        let mut results = results.lock().unwrap_or_else(|e| e.into_inner());
                        if results.is_ok() {
                            *results = Err(error);
                        }
                    }
                });
            }
        });
        bar.finish_and_clear();
        let scores = results.into_inner().unwrap_or_else(|e| e.into_inner())?;
        Ok(scores.into_iter().flatten().collect())
    }
}

/// One of those that score frames side by side.
struct Worker<'a> {
    predictor: &'a Predictor,
    options: SessionOptions,
    running: Option<Running>,
}

/// The means to run frames, made for the first one.
struct Running {
    session: Session,
    builder: RigBuilder,
    calibration: Vec<[f32; 16]>,
}

impl Worker<'_> {
    fn score(&mut self, set: &dyn DataSet, index: usize, scorer: &Scorer) -> Result<Score> {
        match self.predictor {
            Predictor::Constant(classes) => {
                scorer.score(&set.truth(index)?, &Prediction { classes, support: None, logits: None })
            }
            Predictor::Model(model) => {
                let Frame { scene, truth } = set.frame(index)?;
                let said = |e: Error| Error::new(e.kind(), format!("frame {}: {}", set.id(index), e.message()));
                scene.check(model.network()).map_err(said)?;
                let running = match &mut self.running {
                    Some(running) => running,
                    none => none.insert(Running::new(model, &scene.lidar2img, &self.options).map_err(said)?),
                };
                running.calibrate(&scene.lidar2img).map_err(said)?;
                let result = running.session.run_scene(&scene).map_err(said)?;
                let Occupancy { classes, support, logits, .. } = result;
                scorer.score(&truth, &Prediction { classes, support: Some(support), logits })
            }
        }
    }
}

impl Running {
    fn new(model: &Arc<Model>, calibration: &[[f32; 16]], options: &SessionOptions) -> Result<Self> {
        let builder = RigBuilder::new(model.network(), calibration.len(), options.isa)?;
        let mut builder = builder.with_threads(options.threads.clone());
        let rig = Arc::new(builder.build(calibration)?);
        let session = Session::new(model.clone(), rig, options)?;
        Ok(Self { session, builder, calibration: calibration.to_vec() })
    }

    /// Builds the matrices anew where the cameras have moved.
    fn calibrate(&mut self, calibration: &[[f32; 16]]) -> Result<()> {
        if self.calibration != calibration {
            let rig: Rig = self.builder.build(calibration)?;
            self.session.set_rig(Arc::new(rig))?;
            self.calibration = calibration.to_vec();
        }
        Ok(())
    }
}

/// Writes a text file, whole or not at all.
fn write(path: &Path, text: &str) -> Result<()> {
    voxcast::eval::write_text(path, text)
}

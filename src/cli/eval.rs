//! `voxcast eval`

use super::shard::ShardArgument;
use super::{Machine, frame, terminal};
use clap::Args;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use voxcast::dataset::{DataSet, FORMS, Named};
use voxcast::eval::{
    ABOUT, Evaluation, Journal, Means, Predictor, Says, Scope, Shard, Summary, Totals, majority, write_submission,
    write_text,
};
use voxcast::{Error, Model, Result};

/// Score a model on a data set with labels: IoU, mIoU and every class, near and far, seen and unseen.
///
/// With --compare, two models are scored on the same frames and set against each other. With --shard, this machine scores
/// a part of the frames, and --merge puts the parts together.
#[derive(Args, Debug)]
#[command(after_help = format!("\
Examples:
  voxcast eval --model model.safetensors --data synthetic:heldout
  voxcast eval --model model.safetensors --data synthetic:heldout --json scores.json --markdown scores.md
  voxcast eval --model model.safetensors --data synthetic:heldout --resume scores.jsonl --confusion confusion.png
  voxcast eval --model model.safetensors --data synthetic:heldout --calibration --reliability reliability.png
  voxcast eval --compare f32.safetensors f16.safetensors --data synthetic:heldout
  voxcast eval --majority synthetic:train --data synthetic:heldout    # what can be said without looking
  voxcast eval --model model.safetensors --data surroundocc:nuscenes:nuscenes_occ:val
  voxcast eval --model model.safetensors --data semantickitti:kitti:08
  voxcast eval --model model.safetensors --data openocc:nuscenes/v1.0-test:none --submission submission.gz

Many machines, here the third of eight; then, once all have ended, the numbers of one run:
  voxcast eval --model model.safetensors --data synthetic:heldout --shard 2/8 --resume shard-2.jsonl
  voxcast eval --merge shard-*.jsonl --json scores.json

{FORMS}"))]
pub struct Eval {
    /// The model
    #[arg(long, required_unless_present_any = ["majority", "compare", "merge"],
        conflicts_with_all = ["majority", "compare"])]
    model: Option<PathBuf>,
    /// Score two models, and compare what they say class by class
    #[arg(long, value_names = ["A", "B"], num_args = 2, action = clap::ArgAction::Set, conflicts_with = "majority")]
    compare: Vec<PathBuf>,
    /// Instead of a model, predict in each voxel the class that is most frequent there in another set
    #[arg(long, value_name = "SET")]
    majority: Option<Named>,
    /// The data set, as below: synthetic:DIR, surroundocc:..., occ3d:..., semantickitti:... and others
    #[arg(long, value_name = "SET", required_unless_present = "merge")]
    data: Option<Named>,
    /// Only the first N frames
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    limit: Option<u32>,
    /// Frames that are computed at the same time, each with its own session; no more than threads. It does not change a result
    #[arg(long, value_name = "N", default_value_t = Means::WORKERS as u16,
        value_parser = clap::value_parser!(u16).range(1..=256))]
    workers: u16,
    /// Also compute the four losses of the training, of level 0
    #[arg(long, conflicts_with = "majority")]
    losses: bool,
    /// Also count how often what the network says is so likely comes true: the expected calibration error of "occupied" and of
    /// the class, and precision and recall of "occupied" from each probability on
    #[arg(long, conflicts_with = "majority")]
    calibration: bool,
    /// Draw the reliability diagram of that. With --merge, of shards that had --calibration
    #[arg(long, value_name = "FILE.png", conflicts_with = "majority")]
    reliability: Option<PathBuf>,
    /// Keep every frame's score in FILE, and go on from those that are there already, after a stop or with a higher
    /// --limit
    #[arg(long, value_name = "FILE")]
    resume: Option<PathBuf>,
    /// Score frames I, I + N, I + 2N, ... only, as one of N machines that share the set. auto takes I and N from a Slurm
    /// array, or from a Kubernetes Indexed Job that sets JOB_COMPLETIONS
    #[arg(long, value_name = "I/N|auto", requires = "resume")]
    shard: Option<ShardArgument>,
    /// Instead of scoring, put together what --resume kept for each shard. Takes --limit, if the shards had it
    #[arg(long, value_name = "JOURNAL", num_args = 1..,
        conflicts_with_all = ["model", "compare", "majority", "data", "losses", "calibration", "resume",
            "shard"])]
    merge: Vec<PathBuf>,
    /// Instead of scoring, write what OpenOcc v2's challenge takes, gzip of a pickle: class and distance along its rays. For
    /// openocc sets; LABELS is not read, and may be any word where there are none
    #[arg(long, value_name = "FILE.gz", conflicts_with_all = ["compare", "merge", "losses", "calibration",
        "reliability", "resume", "shard", "confusion", "json", "markdown"])]
    submission: Option<PathBuf>,
    /// What the submission says of itself: method, team, authors, e-mail, "institution / company" or "country / region".
    /// May be given again
    #[arg(long, value_name = "KEY=VALUE", requires = "submission", value_parser = about)]
    about: Vec<(String, String)>,
    /// Draw the confusion matrix; with --compare, of A's classes with B's
    #[arg(long, value_name = "FILE.png")]
    confusion: Option<PathBuf>,
    /// Write all ratios and counts as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Write the tables as Markdown
    #[arg(long, value_name = "FILE")]
    markdown: Option<PathBuf>,
    #[command(flatten)]
    machine: Machine,
}

/// `KEY=VALUE`.
fn about(text: &str) -> std::result::Result<(String, String), String> {
    let (key, value) = text.split_once('=').ok_or("expected KEY=VALUE")?;
    match ABOUT.contains(&key) {
        true => Ok((key.to_owned(), value.to_owned())),
        false => Err(format!("expected one of {}", ABOUT.join(", "))),
    }
}

/// Opens the journal, and shows how far its frames are counted.
fn resume(evaluation: &Evaluation, path: &Path, totals: &mut Totals) -> Result<Journal> {
    let bar = terminal::progress("comparing labels with the journal's", evaluation.left(totals).len());
    let journal = evaluation.resume(path, totals, &mut |counted| {
        bar.set_position(counted as u64);
        Ok(())
    })?;
    bar.finish_and_clear();
    Ok(journal)
}

impl Eval {
    pub fn run(self) -> Result<()> {
        let outputs = [
            ("--resume", &self.resume),
            ("--json", &self.json),
            ("--markdown", &self.markdown),
            ("--confusion", &self.confusion),
            ("--reliability", &self.reliability),
            ("--submission", &self.submission),
        ];
        let inputs = self.model.iter().map(|path| ("--model", path));
        let inputs = inputs.chain(self.compare.iter().map(|path| ("--compare", path)));
        let inputs = inputs.chain(self.merge.iter().map(|path| ("--merge", path)));
        frame::check_outputs(inputs, outputs.iter().filter_map(|(name, path)| Some((*name, path.as_ref()?))))?;
        let limit = self.limit.map(|limit| limit as usize);
        match (&self.data, &self.submission) {
            (Some(data), Some(submission)) => self.submit(submission, data, limit),
            (Some(data), None) => self.report(&self.score(data, limit)?),
            // clap has seen to it that there are journals.
            (None, _) => self.report(&Summary::merge(&self.merge, limit)?),
        }
    }

    fn submit(&self, path: &Path, data: &Named, limit: Option<usize>) -> Result<()> {
        let set = data.open_openocc()?;
        let options = frame::options(&self.machine)?;
        let bar = terminal::progress("predicting", limit.map_or(set.len(), |limit| set.len().min(limit)));
        for predictor in self.predictors(&set, data)? {
            write_submission(path, &set, &predictor, &self.about, limit, &options, &mut |done, notes| {
                bar.suspend(|| terminal::say(notes));
                bar.set_position(done as u64);
                Ok(())
            })?;
        }
        bar.finish_and_clear();
        Ok(())
    }

    fn score(&self, data: &Named, limit: Option<usize>) -> Result<Summary> {
        let shard = match &self.shard {
            Some(shard) => shard.resolve(&|name| std::env::var(name).ok())?,
            None => Shard::WHOLE,
        };
        let set = data.open()?;
        let predictors = self.predictors(&*set, data)?;
        let calibration = self.calibration || self.reliability.is_some();
        let scope = Scope { losses: self.losses, calibration, limit, shard, ..Scope::default() };
        let evaluation = Arc::new(Evaluation::new(set, &data.to_string(), predictors, &scope)?);
        let mut totals = evaluation.totals();
        let mut journal = self.resume.as_deref().map(|path| resume(&evaluation, path, &mut totals)).transpose()?;
        let means = Means {
            workers: usize::from(self.workers),
            threads: self.machine.threads.count(),
            isa: self.machine.isa()?,
        };
        let bar = terminal::progress("scoring", evaluation.left(&totals).len());
        evaluation.run(&means, &mut totals, journal.as_mut(), &mut |done, notes| {
            bar.suspend(|| terminal::say(notes));
            bar.set_position(done as u64);
            Ok(())
        })?;
        bar.finish_and_clear();
        Ok(evaluation.summary(totals))
    }

    fn predictors(&self, set: &dyn DataSet, data: &Named) -> Result<Vec<Predictor>> {
        if let Some(source) = &self.majority {
            let other = source.open()?;
            if other.classes() != set.classes() {
                return Err(Error::mismatch(format!("{source} has other classes than {data}")));
            }
            let bar = terminal::progress("counting", other.len());
            let classes = majority(&*other, &mut |done| bar.set_position(done as u64))?;
            bar.finish_and_clear();
            let says = Says::Always(classes, other.grid());
            return Ok(vec![Predictor { name: format!("majority of {source}"), says }]);
        }
        self.model.iter().chain(&self.compare).map(|path| Ok(Predictor::model(Arc::new(Model::open(path)?)))).collect()
    }

    fn report(&self, summary: &Summary) -> Result<()> {
        terminal::write(format_args!("{}", summary.text()))?;
        if let Some(path) = &self.json {
            summary.write_json(path)?;
        }
        if let Some(path) = &self.markdown {
            write_text(path, &summary.markdown())?;
        }
        if let Some(path) = &self.confusion {
            summary.write_confusion(path)?;
        }
        if let Some(path) = &self.reliability {
            summary.write_reliability(path)?;
        }
        Ok(())
    }
}

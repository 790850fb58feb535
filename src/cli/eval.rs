//! `voxcast eval`

use super::scoring::{self, Means, Predictor, Says};
use super::source::{FORMS, Source};
use super::{Machine, frame, terminal};
use clap::Args;
use serde_json::json;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use voxcast::dataset::DataSet;
use voxcast::eval::{
    Comparison, Confusion, FrameScore, Journal, Options, Report, Scorer, Totals, majority, write_text,
};
use voxcast::picture::{Matrix, Palette, draw_matrix};
use voxcast::{Error, Model, Result};

/// Score a model on a data set with labels: IoU, mIoU and every class, near and far, seen and unseen.
///
/// With --compare, two models are scored on the same frames and set against each other.
#[derive(Args, Debug)]
#[command(after_help = format!("\
Examples:
  voxcast eval --model model.safetensors --data synthetic:heldout
  voxcast eval --model model.safetensors --data synthetic:heldout --json scores.json --markdown scores.md
  voxcast eval --model model.safetensors --data synthetic:heldout --resume scores.jsonl --confusion confusion.png
  voxcast eval --compare f32.safetensors f16.safetensors --data synthetic:heldout
  voxcast eval --majority synthetic:train --data synthetic:heldout    # what can be said without looking
  voxcast eval --model model.safetensors --data surroundocc:nuscenes:nuscenes_occ:val
  voxcast eval --model model.safetensors --data semantickitti:kitti:08

{FORMS}"))]
pub struct Eval {
    /// The model
    #[arg(long, required_unless_present_any = ["majority", "compare"], conflicts_with_all = ["majority", "compare"])]
    model: Option<PathBuf>,
    /// Score two models, and compare what they say class by class
    #[arg(long, value_names = ["A", "B"], num_args = 2, action = clap::ArgAction::Set, conflicts_with = "majority")]
    compare: Vec<PathBuf>,
    /// Instead of a model, predict in each voxel the class that is most frequent there in another set
    #[arg(long, value_name = "SET")]
    majority: Option<Source>,
    /// The data set, as below: synthetic:DIR, surroundocc:..., occ3d:..., semantickitti:... and others
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
    /// Keep every frame's score in FILE, and go on from those that are there already, after a stop or with a higher
    /// --limit
    #[arg(long, value_name = "FILE")]
    resume: Option<PathBuf>,
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

impl Eval {
    pub fn run(self) -> Result<()> {
        for path in [&self.json, &self.markdown, &self.confusion, &self.resume].into_iter().flatten() {
            frame::check_output(path)?;
        }
        self.check_apart()?;
        let set = self.data.open()?;
        let options = Options::default();
        let predictors = self.predictors(&*set, &options)?;
        let count = self.limit.map_or(set.len(), |limit| set.len().min(limit as usize));
        let kind = predictors[0].scorer.kind();
        let mut totals = Totals::new(kind, predictors.len(), count);
        let journal = match &self.resume {
            Some(path) => Some(self.journal(path, &*set, &predictors, &options, &mut totals, count)?),
            None => None,
        };
        let means = Means {
            workers: usize::from(self.workers),
            threads: self.machine.threads.count(),
            isa: self.machine.isa()?,
            losses: self.losses,
        };
        let totals = scoring::score(&*set, &predictors, &means, totals, journal, count)?.finish();
        self.report(&*set, &predictors, &options, &totals, count)
    }

    /// Refuses two outputs in one file, of which the last would be left: a report in the place of hours of scores.
    fn check_apart(&self) -> Result<()> {
        let mut taken: Vec<(&str, PathBuf)> = Vec::new();
        for (flag, path) in [
            ("--resume", &self.resume),
            ("--json", &self.json),
            ("--markdown", &self.markdown),
            ("--confusion", &self.confusion),
        ] {
            let Some(path) = path else { continue };
            let place = std::path::absolute(path).map_err(|e| Error::io(path, "find", &e))?;
            let place = std::fs::canonicalize(&place).unwrap_or(place);
            if let Some((other, _)) = taken.iter().find(|(_, other)| *other == place) {
                return Err(Error::mismatch(format!("{other} and {flag} write the same file")).in_file(path));
            }
            taken.push((flag, place));
        }
        Ok(())
    }

    fn predictors(&self, set: &dyn DataSet, options: &Options) -> Result<Vec<Predictor>> {
        let predictor = |name: String, says: Says, always| -> Result<Predictor> {
            let grid = says.grid(always);
            let scorer = Scorer::new(set.classes().len(), set.masks().len(), set.grid(), grid, options)?;
            let scorer = scorer.with_published(set.published());
            Ok(Predictor { name, says, scorer })
        };
        if let Some(source) = &self.majority {
            let other = source.open()?;
            if other.classes() != set.classes() {
                return Err(Error::mismatch(format!("{source} has other classes than {}", self.data)));
            }
            let bar = terminal::progress("counting", other.len());
            let classes = majority(&*other, &mut |done| bar.set_position(done as u64))?;
            bar.finish_and_clear();
            return Ok(vec![predictor(format!("majority of {source}"), Says::Always(classes), other.grid())?]);
        }
        let open = |path: &PathBuf| {
            let model = Model::open(path)?;
            let (found, expected) = (model.network().classes, set.classes().len());
            if found != expected {
                let message = format!("a model of {found} classes, {} has {expected}", self.data);
                return Err(Error::mismatch(message).in_file(path));
            }
            predictor(path.display().to_string(), Says::Model(Arc::new(model)), set.grid())
        };
        self.model.iter().chain(&self.compare).map(open).collect()
    }

    /// Opens the journal and counts the frames that it has.
    fn journal(
        &self,
        path: &Path,
        set: &dyn DataSet,
        predictors: &[Predictor],
        options: &Options,
        totals: &mut Totals,
        count: usize,
    ) -> Result<Journal> {
        let what = json!({
            "data": self.data.to_string(),
            "predictors": predictors.iter().map(|predictor| predictor.says.identity()).collect::<Vec<_>>(),
            "grid": { "size": set.grid().size, "bounds": set.grid().bounds },
            "classes": set.classes(),
            "masks": set.masks(),
            "losses": self.losses,
            "rings": options.rings,
            "version": env!("CARGO_PKG_VERSION"),
        });
        let index_of: HashMap<&str, usize> = (0..count).map(|index| (set.id(index), index)).collect();
        Journal::open(path, &what, predictors[0].scorer.kind(), predictors.len(), &mut |frame, score| {
            if let Some(&index) = index_of.get(frame).filter(|&&index| !totals.has(index)) {
                totals.add(index, score);
            }
        })
    }

    fn report(
        &self,
        set: &dyn DataSet,
        predictors: &[Predictor],
        options: &Options,
        totals: &FrameScore,
        frames: usize,
    ) -> Result<()> {
        let (data, regions) = (self.data.to_string(), Scorer::regions(set.masks()));
        let titles: Vec<String> = predictors.iter().map(|predictor| format!("{} on {data}", predictor.name)).collect();
        let reports: Vec<Report<'_>> = titles
            .iter()
            .zip(&totals.scores)
            .zip(predictors)
            .map(|((title, total), predictor)| Report {
                title,
                classes: set.classes(),
                regions: &regions,
                rings: &options.rings,
                published: predictor.scorer.published(),
                frames,
                total,
            })
            .collect();
        let sums: Vec<Confusion> = totals.scores.iter().map(|score| score.region(0)).collect();
        let names = || Some([predictors.first()?.name.as_str(), predictors.get(1)?.name.as_str()]);
        let comparison = names().and_then(|names| Comparison::of(names, &data, set.classes(), frames, &sums, totals));
        let (text, markdown, json) = match &comparison {
            None => (reports[0].text(), reports[0].markdown(), reports[0].json()),
            Some(comparison) => {
                let [a, b] = [&reports[0], &reports[1]];
                let json = json!({ "comparison": comparison.json(), "reports": [a.json(), b.json()] });
                let markdown = [comparison.markdown(), a.markdown(), b.markdown()].join("\n");
                (comparison.text(), markdown, json)
            }
        };
        print!("{text}");
        if let Some(path) = &self.json {
            write_text(path, &format!("{json:#}\n"))?;
        }
        if let Some(path) = &self.markdown {
            write_text(path, &markdown)?;
        }
        if let Some(path) = &self.confusion {
            let palette = Palette::of(set.classes().len());
            let (counts, rows, columns, title) = match &comparison {
                None => (sums[0].counts(), "Truth", "Prediction", titles[0].clone()),
                Some(c) => (c.agreement.counts(), "A", "B", format!("A: {}, B: {}, on {data}", c.names[0], c.names[1])),
            };
            let subtitle = format!("{frames} frames; shares of each row in per cent");
            let matrix = Matrix { title: &title, subtitle: &subtitle, rows, columns, counts, palette: &palette };
            draw_matrix(&matrix)?.write_png(path)?;
        }
        Ok(())
    }
}

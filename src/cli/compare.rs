//! `voxcast compare`

use super::dump::Dump as Collector;
use super::terminal::tell;
use super::{Machine, frame, terminal};
use clap::Args;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use voxcast::compare::{Dump, Outcome, Stage, compare};
use voxcast::session::views;
use voxcast::{Error, ErrorKind, Isa, Result, Session, SessionOptions};

/// Compare two dumps, or two runs, and name the first stage that differs, where, and by how much.
///
/// A dump is what `voxcast run --dump` or `-o` wrote, or a .safetensors of another program with the same names. With
/// --model, the scene is run twice instead: with the model and these options, and with --against, --against-isa or
/// --against-unfolded.
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  voxcast compare stages-here/ stages-there/
  voxcast compare stages/ expected.safetensors --tolerance 5e-3 --common
  voxcast compare a.npz b.npz
  voxcast compare --model f32.safetensors --against f16.safetensors scene/ --tolerance 0.05
  voxcast compare --model int8.safetensors --against f32.safetensors scene/ --tolerance inf    (where does int8 lose?)
  voxcast compare --model model.safetensors --against-isa scalar scene/

The column snr is the ratio of signal to noise of a stage in decibels, the second run being the signal. Stages of int8 models
are compared as the numbers that their integers stand for.

Exit codes: 0 they agree, 1 they differ (the first stage is named on stderr) or a file is at fault, 2 usage.")]
pub struct Compare {
    /// Two dumps; with --model, one scene
    #[arg(num_args = 1..=2, required = true, value_name = "DUMP|SCENE")]
    paths: Vec<PathBuf>,
    /// Largest difference of a stage, over its root mean square, that passes; for classes the share of voxels [default:
    /// equal bits]
    #[arg(long, value_name = "T")]
    tolerance: Option<f64>,
    /// Leave out stages that only one of them has
    #[arg(long)]
    common: bool,
    /// Run this model on a scene
    #[arg(long)]
    model: Option<PathBuf>,
    /// The scene's matrices [default: built from its calibration]
    #[arg(long, requires = "model")]
    rig: Option<PathBuf>,
    /// Use that rig even if it was made from another calibration than the scene's
    #[arg(long, requires = "rig")]
    any_rig: bool,
    /// The model of the other run [default: the same]
    #[arg(long, requires = "model", value_name = "MODEL")]
    against: Option<PathBuf>,
    /// The instruction set of the other run
    #[arg(long, requires = "model", value_name = "NAME")]
    against_isa: Option<String>,
    /// The other run is without the projection fold
    #[arg(long, requires = "model")]
    against_unfolded: bool,
    /// Print the table as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    machine: Machine,
}

impl Compare {
    pub fn run(self) -> Result<()> {
        let (stages, common) = match (&self.model, &self.paths[..]) {
            (None, [a, b]) => (compare(&Dump::open(a)?, &Dump::open(b)?, self.tolerance, self.common)?, self.common),
            (Some(model), [scene]) => {
                let common = self.common || self.against_unfolded;
                (self.runs(model, scene, common)?, common)
            }
            (None, _) => return usage("two dumps, or --model and a scene"),
            (Some(_), _) => return usage("one scene beside --model"),
        };
        if self.json {
            tell!("{}", json(&stages))?;
        } else {
            print(&stages)?;
        }
        let Some(first) = stages.iter().find(|s| s.diverges()) else {
            if !self.json {
                let note = if common { " that both have" } else { "" };
                tell!("all {} stages{note} agree", stages.len())?;
            }
            return Ok(());
        };
        Err(Error::mismatch(format!("the first stage that differs is {}: {}", first.name, describe(first))))
    }

    fn runs(&self, model: &Path, scene: &Path, common: bool) -> Result<Vec<Stage>> {
        let place = Scratch::new()?;
        let options = frame::options(&self.machine)?;
        let mut other = options.clone();
        if let Some(name) = &self.against_isa {
            other.isa =
                Isa::parse(name).map_err(|e| Error::new(ErrorKind::Unsupported, format!("--against-isa: {e}")))?;
        }
        other.unfolded = self.against_unfolded;
        let [a, b] = [place.0.join("a"), place.0.join("b")];
        self.dump(model, scene, options, true, &a)?;
        self.dump(self.against.as_deref().unwrap_or(model), scene, other, false, &b)?;
        compare(&Dump::open(&a)?, &Dump::open(&b)?, self.tolerance, common)
    }

    /// Runs a scene and writes every stage that the graph has. Notes are printed if `say`: once for two runs of one scene.
    fn dump(&self, model: &Path, scene: &Path, mut options: SessionOptions, say: bool, directory: &Path) -> Result<()> {
        let (model, scene, mut notes) = frame::open(model, scene)?;
        (options.logits, options.coarse_heads) = (true, true);
        let file = frame::RigFile { path: self.rig.as_deref(), any: self.any_rig };
        let (rig, of_rig) = frame::rig(file, &model, &scene, &options)?;
        let rig = Arc::new(rig);
        notes.extend(of_rig);
        if say {
            terminal::say(&notes);
        }
        let mut session: Session = frame::session(&model, rig.clone(), &options)?;
        let graph = session.graph().clone();
        let names: Vec<&str> = graph.stages().chain(["classes"]).collect();
        let mut collector = Collector::new(Some(&names.join(",")), model.network())?;
        let bar = terminal::progress("running", graph.operations.len());
        let result = session.run_observed(&views(&scene), &mut |event| {
            bar.inc(1);
            collector.observe(&graph, &event);
        })?;
        bar.finish_and_clear();
        collector.finish(directory, &rig, result.grid, result.classes)
    }
}

fn usage(expected: &str) -> Result<()> {
    use clap::CommandFactory;
    let message = format!("expected {expected}");
    super::Arguments::command().error(clap::error::ErrorKind::WrongNumberOfValues, message).exit()
}

/// A directory for two dumps, which goes with the program's run.
struct Scratch(PathBuf);

impl Scratch {
    fn new() -> Result<Self> {
        let base = std::env::temp_dir();
        for number in 0u32..1000 {
            let path = base.join(format!("voxcast-compare-{}-{number}", std::process::id()));
            match std::fs::create_dir(&path) {
                Ok(()) => return Ok(Self(path)),
                Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists => {}
                Err(e) => return Err(Error::io(&path, "create", &e)),
            }
        }
        Err(Error::new(ErrorKind::Io, "cannot create: no name is free").in_file(&base))
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn describe(stage: &Stage) -> String {
    match &stage.outcome {
        Outcome::Equal => "equal".to_owned(),
        Outcome::OnlyIn(0) => "only in the first".to_owned(),
        Outcome::OnlyIn(_) => "only in the second".to_owned(),
        Outcome::Shapes([a, b]) => format!("shapes {a:?} and {b:?}"),
        Outcome::Differs(d) => {
            let [x, y] = d.values;
            format!("{} of {} elements, most at {:?}: {x} and {y}", d.count, stage.elements, d.at)
        }
    }
}

fn print(stages: &[Stage]) -> Result<()> {
    let first = stages.iter().position(Stage::diverges);
    tell!(
        "{:28} {:>10} {:>10} {:>9} {:>9} {:>7} {:>10}  at: values",
        "stage",
        "elements",
        "differing",
        "max",
        "over rms",
        "snr dB",
        "ulp"
    )?;
    for (index, stage) in stages.iter().enumerate() {
        let mark = if first == Some(index) { "  <- first" } else { "" };
        match &stage.outcome {
            Outcome::Differs(d) => {
                let ulp = d.ulp.map_or_else(|| "-".to_owned(), |ulp| ulp.to_string());
                let snr = d.snr.map_or_else(|| "-".to_owned(), |snr| format!("{snr:.1}"));
                let [x, y] = d.values;
                tell!(
                    "{:28} {:>10} {:>10} {:>9.2e} {:>9.2e} {snr:>7} {ulp:>10}  {:?}: {x} {y}{mark}",
                    stage.name,
                    stage.elements,
                    d.count,
                    d.max,
                    d.relative,
                    d.at
                )?;
            }
            _ => tell!("{:28} {:>10} {:>10}{mark}", stage.name, stage.elements, describe(stage))?,
        }
    }
    Ok(())
}

fn json(stages: &[Stage]) -> serde_json::Value {
    let stage = |s: &Stage| {
        let mut value = serde_json::json!({
            "stage": s.name,
            "elements": s.elements,
            "diverges": s.diverges(),
            "outcome": describe(s),
        });
        if let Outcome::Differs(d) = &s.outcome {
            // JSON has no NaN.
            let number = |v: f64| if v.is_finite() { serde_json::json!(v) } else { serde_json::json!(v.to_string()) };
            value["differing"] = d.count.into();
            value["max"] = number(d.max);
            value["over_rms"] = number(d.relative);
            value["snr_db"] = d.snr.map_or(serde_json::Value::Null, number);
            value["ulp"] = d.ulp.into();
            value["at"] = d.at.clone().into();
            value["values"] = d.values.map(number).to_vec().into();
        }
        value
    };
    let first = stages.iter().find(|s| s.diverges()).map(|s| s.name.as_str());
    serde_json::json!({"first": first, "stages": stages.iter().map(stage).collect::<Vec<_>>()})
}

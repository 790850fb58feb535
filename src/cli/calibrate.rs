//! `voxcast calibrate`, and what `import --calibrate` shares with it.

use super::terminal::tell;
use super::{Machine, frame, terminal};
use clap::Args;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use voxcast::calibrate::{Calibrator, spread};
use voxcast::dataset::{DataSet, Named};
use voxcast::model::ranges::Ranges;
use voxcast::{Error, Isa, Model, Network, Note, Result, Scene, Threads};

/// Measure the range of every tensor of a model on scenes, for int8 models to be made from.
///
/// Each tensor gets the threshold whose 127 steps leave the smallest sum of squared errors. The ranges are JSON, to be
/// looked at, kept and used again with `voxcast import --precision int8 --ranges`.
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  voxcast calibrate model.safetensors scenes/* -o ranges.json
  voxcast calibrate model.safetensors synthetic:train --frames 64 -o ranges.json
  voxcast import epoch_24.pth --network nuscenes-200 --precision int8 --ranges ranges.json -o int8.safetensors

A scene is a directory or a .safetensors file, as for run; a data set has a name, as for eval. Frames are spread evenly over all
that are given. A camera whose image is of one colour throughout is noted and left out.")]
pub struct Calibrate {
    /// The model, of f32 or f16 weights
    model: PathBuf,
    /// Scenes and data sets: directories, .safetensors files, synthetic:DIR and others
    #[arg(required = true, value_name = "SCENE")]
    scenes: Vec<String>,
    /// The ranges to write
    #[arg(short, long, value_name = "RANGES.json")]
    output: PathBuf,
    /// Frames to look at, at most
    #[arg(long, value_name = "N", default_value_t = FRAMES, value_parser = clap::value_parser!(u32).range(1..))]
    frames: u32,
    #[command(flatten)]
    machine: Machine,
}

/// Frames that calibration looks at, unless it is told how many.
pub const FRAMES: u32 = 32;

impl Calibrate {
    pub fn run(self) -> Result<()> {
        frame::check_outputs([("MODEL", &self.model)], [("--output", &self.output)])?;
        let model = Arc::new(Model::open(&self.model)?);
        let in_model = |e: Error| e.in_file(&self.model);
        let means = (self.machine.isa()?, self.machine.threads()?);
        let ranges = measure(&model, &self.scenes, self.frames, means).map_err(in_model)?;
        ranges.save(&self.output)?;
        tell!("{}: {} tensors, measured on {} frames", self.output.display(), ranges.tensors.len(), ranges.frames)?;
        Ok(())
    }
}

/// Measures the ranges of `model` on `frames` of the scenes and sets of these names, with progress and notes.
pub fn measure(model: &Arc<Model>, names: &[String], frames: u32, (isa, threads): (Isa, Threads)) -> Result<Ranges> {
    let scenes = Scenes::open(names)?;
    let mut calibrator = Calibrator::new(model.clone(), isa, &threads)?;
    let chosen: Vec<usize> = spread(scenes.len(), frames as usize).collect();
    let bar = terminal::progress("calibrating", chosen.len());
    for index in chosen {
        let (scene, notes) = scenes.read(index, model.network())?;
        let at = scenes.path(index);
        let seen = calibrator.see(&scene).map_err(|e| e.in_file(&at))?;
        let seen = seen.into_iter().map(|note| note.in_file(&at));
        bar.suspend(|| terminal::say(&notes.into_iter().chain(seen).collect::<Vec<_>>()));
        bar.inc(1);
    }
    bar.finish_and_clear();
    calibrator.ranges()
}

/// `count` of the scenes and sets of these names.
pub fn some(names: &[String], count: usize, network: &Network) -> Result<Vec<Scene>> {
    let scenes = Scenes::open(names)?;
    spread(scenes.len(), count).map(|index| Ok(scenes.read(index, network)?.0)).collect()
}

/// Frames without regard to labels, one after the other.
pub struct Scenes(Vec<Source>);

enum Source {
    Scene(PathBuf),
    Set(String, Box<dyn DataSet>),
}

impl Source {
    fn len(&self) -> usize {
        match self {
            Source::Scene(_) => 1,
            Source::Set(_, set) => set.len(),
        }
    }
}

impl Scenes {
    /// Opens scenes by their paths and data sets by their names: what is there as a file is a scene.
    pub fn open(names: &[String]) -> Result<Self> {
        let source = |name: &String| match name.parse::<Named>() {
            Ok(set) if !Path::new(name).exists() => Ok(Source::Set(name.clone(), set.open()?)),
            _ => Ok(Source::Scene(PathBuf::from(name))),
        };
        names.iter().map(source).collect::<Result<_>>().map(Self)
    }

    pub fn len(&self) -> usize {
        self.0.iter().map(Source::len).sum()
    }

    /// The source that has frame `index`, and its number there.
    fn find(&self, mut index: usize) -> (&Source, usize) {
        for source in &self.0 {
            if index < source.len() {
                return (source, index);
            }
            index -= source.len();
        }
        unreachable!("a frame of the list")
    }

    /// What messages call frame `index`.
    pub fn path(&self, index: usize) -> PathBuf {
        match self.find(index) {
            (Source::Scene(path), _) => path.clone(),
            (Source::Set(name, set), index) => PathBuf::from(format!("{name} frame {}", set.id(index))),
        }
    }

    /// Frame `index` for a network, and what is to be said of it.
    pub fn read(&self, index: usize, network: &Network) -> Result<(Scene, Vec<Note>)> {
        match self.find(index) {
            (Source::Scene(path), _) => frame::read(path, network),
            (Source::Set(_, set), frame) => {
                let (scene, notes) = set.scene(frame)?;
                scene.check(network).map_err(|e| e.in_file(&self.path(index)))?;
                Ok((scene, notes))
            }
        }
    }
}

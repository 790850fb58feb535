//! `voxcast import`

use super::terminal::tell;
use super::{ThreadCount, calibrate, frame, terminal};
use clap::{Args, CommandFactory};
use indicatif::ProgressBar;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use voxcast::calibrate::Mixed;
use voxcast::checkpoint::Checkpoint;
use voxcast::container::Container;
use voxcast::graph::Rewrites;
use voxcast::import::{Integers, Source};
use voxcast::model::ranges::Ranges;
use voxcast::model::unpacked::Unpacked;
use voxcast::model::{FORMAT, Model, Options, use_winograd};
use voxcast::network::BUILT_IN;
use voxcast::weights::Precision;
use voxcast::{Error, ErrorKind, Isa, Network, Note, Result};

/// Turn a training checkpoint into a model: batch norms and the projection folded in f64, weights packed as the kernels
/// read them. Or a model with direct sums into one that uses Winograd's minimal filtering.
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  voxcast import epoch_24.pth --network nuscenes-200 -o model.safetensors
  voxcast import weights.safetensors --network network.json --precision f16 -o model.safetensors
  voxcast import epoch_24.pth --network nuscenes-200 --exact -o model.safetensors    (every convolution a direct sum)
  voxcast import epoch_24.pth --network nuscenes-200 --precision int8 --calibrate scenes/* -o int8.safetensors
  voxcast import model.safetensors --precision int8 --calibrate synthetic:train -o int8.safetensors
  voxcast import model.safetensors --precision int8 --calibrate synthetic:train --auto-mixed 30 -o int8.safetensors
  voxcast import model.safetensors --precision int8 --ranges ranges.json --keep-f32 img_backbone.layer1 -o int8.safetensors

A .pth file, of either format that torch.save writes, is read without executing anything: it may hold tensors and plain
containers, and whatever else its pickle wants to call is refused by name. What wrappers put in front of names (module.,
_orig_mod., model.) is taken off, name by name. Notes on standard error say which state was taken of several, and which
tensors the network does not have.

int8 needs the range of every tensor: measured here (--calibrate), or by voxcast calibrate (--ranges). docs/int8.md says which
operations stay in f32 and how to find the ones that lose most.")]
pub struct Import {
    /// mmengine .pth, .safetensors with the same names, or a model of f32 or f16 that uses direct sums
    checkpoint: PathBuf,
    /// nuscenes-200, nuscenes-256, semantickitti-256, edge, or a network.json [default: that of a model]
    #[arg(long, value_name = "NAME|FILE.json")]
    network: Option<String>,
    /// How weights are stored; arithmetic is in integers for int8, else f32 [default: f32, or that of a model]
    #[arg(long, value_parser = ["f32", "f16", "int8", "i8"], hide_possible_values = true, value_name = "f32|f16|int8")]
    precision: Option<String>,
    /// Scenes and data sets to measure ranges on, for int8: directories, .safetensors files, synthetic:DIR and others
    #[arg(long, value_name = "SCENE", num_args = 1.., conflicts_with = "ranges")]
    calibrate: Vec<String>,
    /// Frames to measure ranges on, at most, spread over all that are given
    #[arg(long, value_name = "N", default_value_t = calibrate::FRAMES, requires = "calibrate",
        value_parser = clap::value_parser!(u32).range(1..))]
    calibrate_frames: u32,
    /// Ranges that voxcast calibrate has measured, for int8
    #[arg(long, value_name = "RANGES.json")]
    ranges: Option<PathBuf>,
    /// Operations of an int8 model that stay in f32: names, or the start of names up to a dot
    #[arg(long, value_name = "NAME", value_delimiter = ',')]
    keep_f32: Vec<String>,
    /// Keep the fewest operations of an int8 model in f32 with which the logits' ratio of signal to noise is at least DB
    /// decibels, measured on two of the frames of --calibrate
    #[arg(long, value_name = "DB", requires = "calibrate")]
    auto_mixed: Option<f64>,
    /// Rewrites applied to the network: all, batch-norm (keeps the pyramid's features), none (keeps batch norms
    /// and direct sums too)
    #[arg(long, default_value = "all", value_parser = ["all", "batch-norm", "none"])]
    fold: String,
    /// Compute every convolution as a direct sum, none by Winograd's minimal filtering: slower, and a rounding error about
    /// half as large. int8 is exact either way
    #[arg(long)]
    exact: bool,
    /// The model to write
    #[arg(short, long, value_name = "MODEL")]
    output: PathBuf,
    /// Leave out the self-test, for which two cameras are computed once
    #[arg(long)]
    no_self_test: bool,
    #[command(flatten)]
    threads: ThreadCount,
}

/// Frames on which precisions are mixed.
const MIXED_FRAMES: usize = 2;

impl Import {
    pub fn run(self) -> Result<()> {
        let inputs = [Some(&self.checkpoint), self.ranges.as_ref()];
        let inputs = ["CHECKPOINT", "--ranges"].into_iter().zip(inputs);
        frame::check_outputs(inputs.filter_map(|(name, path)| Some((name, path?))), [("--output", &self.output)])?;
        let given = self.precision.as_deref().and_then(Precision::parse);
        match self.model()? {
            Some(model) if model.quantisation().is_some() => {
                let message = "a model of int8, expected a checkpoint, or a model of f32 or f16";
                Err(Error::mismatch(message).in_file(&self.checkpoint))
            }
            Some(model) => {
                let precision = given.unwrap_or(model.options().precision);
                self.check_usage(precision);
                let network = self.network.as_deref().map(read_network).transpose()?;
                if network.is_some_and(|network| network != *model.network()) {
                    let message = format!(
                        "--network {} is not the model's network, expected that or no --network",
                        self.network.as_deref().unwrap_or_default()
                    );
                    return Err(Error::mismatch(message).in_file(&self.checkpoint));
                }
                if precision == model.options().precision && self.fold == "all" && !self.exact {
                    let bar = terminal::progress("transforming", 0);
                    use_winograd(&model, &self.output, &mut steps(&bar)).map_err(|e| e.in_file(&self.checkpoint))?;
                    return self.finish(&bar, &[], &[]);
                }
                let source = Unpacked::new(&model).map_err(|e| e.in_file(&self.checkpoint))?;
                self.convert(&source, model.network(), precision, vec![])
            }
            None => {
                let precision = given.unwrap_or(Precision::F32);
                self.check_usage(precision);
                let Some(network) = &self.network else { return usage("--network, unless the checkpoint is a model") };
                let network = read_network(network)?;
                let checkpoint = Checkpoint::open(&self.checkpoint)?;
                self.convert(&checkpoint, &network, precision, checkpoint.notes())?;
                terminal::say(&Vec::from_iter(checkpoint.unused_note()));
                Ok(())
            }
        }
    }

    /// Refuses arguments that do not go with the precision.
    fn check_usage(&self, precision: Precision) {
        let ranges = self.ranges.is_some() || !self.calibrate.is_empty();
        let _ = match precision {
            Precision::I8 if !ranges => usage("--calibrate SCENE... or --ranges FILE with --precision int8"),
            Precision::I8 if self.fold == "none" => usage("--fold all or batch-norm with --precision int8"),
            Precision::F32 | Precision::F16 if ranges => usage("--precision int8 with --calibrate or --ranges"),
            Precision::F32 | Precision::F16 if !self.keep_f32.is_empty() => usage("--precision int8 with --keep-f32"),
            _ => Ok(()),
        };
    }

    /// The checkpoint as a model, if it is one.
    fn model(&self) -> Result<Option<Model>> {
        let container = Container::open(&self.checkpoint).ok();
        let is_model = container.is_some_and(|c| c.metadata().get("format").is_some_and(|format| format == FORMAT));
        is_model.then(|| Model::open(&self.checkpoint)).transpose()
    }

    /// The rewrites that are asked for. Integers are summed directly, and ranges measured so.
    fn rewrites(&self, precision: Precision) -> Rewrites {
        let rewrites = match self.fold.as_str() {
            "all" => Rewrites::ALL,
            "none" => Rewrites::NONE,
            _ => Rewrites { projection: false, ..Rewrites::ALL },
        };
        let winograd = rewrites.winograd && !self.exact && precision != Precision::I8;
        Rewrites { winograd, ..rewrites }
    }

    fn convert(&self, source: &dyn Source, network: &Network, precision: Precision, notes: Vec<Note>) -> Result<()> {
        let in_checkpoint = |e: Error| e.in_file(&self.checkpoint);
        let rewrites = self.rewrites(precision);
        let bar = terminal::progress("importing", 0);
        let progress = &mut steps(&bar);
        let ranges = match precision {
            Precision::I8 => Some(self.ranges(source, network, rewrites)?),
            Precision::F32 | Precision::F16 => None,
        };
        let keep_f32 = match (&ranges, self.auto_mixed) {
            (Some(ranges), Some(target)) => self.mix(source, network, ranges, target)?,
            _ => self.keep_f32.clone(),
        };
        match &ranges {
            None => {
                let options = Options { precision, rewrites };
                voxcast::import::import(source, network, options, &self.output, progress)
            }
            Some(ranges) => {
                let integers = Integers { rewrites, ranges, keep_f32: &keep_f32 };
                voxcast::import::import_int8(source, network, &integers, &self.output, progress)
            }
        }
        .map_err(in_checkpoint)?;
        self.finish(&bar, &notes, &keep_f32)
    }

    /// Adds the self-test, and says what was written.
    /// `asked` are the operations that were to stay in f32.
    fn finish(&self, bar: &ProgressBar, notes: &[Note], asked: &[String]) -> Result<()> {
        if !self.no_self_test {
            bar.set_message("self-test");
            let hint = |e: Error| {
                let message =
                    format!("the model is written, without its self-test: {} (see --no-self-test)", e.message());
                Error::new(e.kind(), message).in_file(&self.output)
            };
            voxcast::selftest::record(&self.output, Isa::best(), &self.threads.threads()?).map_err(hint)?;
        }
        bar.finish_and_clear();
        terminal::say(notes);
        let model = Model::open(&self.output)?;
        terminal::say(&Vec::from_iter(offsets_note(&model, asked)));
        tell!(
            "{}: {} weights, {}, checksum {:016x}",
            self.output.display(),
            model.options().precision.name(),
            terminal::bytes(model.file_size()),
            model.checksum().unwrap_or_default()
        )?;
        Ok(())
    }

    /// The operations to keep in f32 so that the logits are as close to those of f32 as `target` asks.
    fn mix(&self, source: &dyn Source, network: &Network, ranges: &Ranges, target: f64) -> Result<Vec<String>> {
        let scenes = calibrate::some(&self.calibrate, MIXED_FRAMES, network)?;
        let integers = Integers { rewrites: self.rewrites(Precision::I8), ranges, keep_f32: &self.keep_f32 };
        let threads = self.threads.threads()?;
        let mixed = Mixed::new(source, network, integers, &scenes, (Isa::best(), &threads))?;
        let bar = terminal::progress("mixing", mixed.runs());
        let choice = mixed.find(target, &mut |done| bar.set_position(done as u64))?;
        bar.finish_and_clear();
        tell!(
            "logits at {:.1} dB, {} operations in f32 (all int8: {:.1} dB): {}",
            choice.snr,
            choice.keep_f32.len(),
            choice.least,
            choice.keep_f32.join(",")
        )?;
        Ok(choice.keep_f32)
    }

    /// The ranges from their file, or measured with the weights in f32.
    fn ranges(&self, source: &dyn Source, network: &Network, rewrites: Rewrites) -> Result<Ranges> {
        if let Some(path) = &self.ranges {
            return Ranges::open(path, network);
        }
        let bar = terminal::progress("folding", 0);
        let options = Options { precision: Precision::F32, rewrites };
        let bytes = voxcast::import::import_to_bytes(source, network, options, &mut steps(&bar));
        bar.finish_and_clear();
        let model = Arc::new(Model::from_bytes(bytes.map_err(|e| e.in_file(&self.checkpoint))?)?);
        calibrate::measure(&model, &self.calibrate, self.calibrate_frames, (Isa::best(), self.threads.threads()?))
    }
}

/// What is to be said of deformable convolutions that stay in f32 though nobody asked for it.
fn offsets_note(model: &Model, asked: &[String]) -> Option<Note> {
    let kept = model.quantisation()?.keep_f32.iter().filter(|name| !asked.contains(name)).count();
    let message = format!(
        "{kept} deformable convolutions stay in f32, for their offsets are farther than integers tell apart (inspect --operations)"
    );
    (kept > 0).then(|| Note::new(message))
}

/// How many of how many steps are done, on `bar`.
fn steps(bar: &ProgressBar) -> impl FnMut(usize, usize) + '_ {
    |done, total| {
        bar.set_length(total as u64);
        bar.set_position(done as u64);
    }
}

/// Ends the program as clap does where it finds arguments wrong.
fn usage(expected: &str) -> Result<()> {
    let message = format!("expected {expected}");
    super::Arguments::command().error(clap::error::ErrorKind::ArgumentConflict, message).exit()
}

/// A built-in network by name, or one from a JSON file.
pub fn read_network(name: &str) -> Result<Network> {
    if let Some(network) = Network::built_in(name) {
        return Ok(network);
    }
    let path = Path::new(name);
    if !path.exists() {
        return Err(Error::new(
            ErrorKind::Io,
            format!("--network {name}: neither a file nor one of {}", BUILT_IN.join(", ")),
        ));
    }
    let text = std::fs::read_to_string(path).map_err(|e| Error::io(path, "read", &e))?;
    Network::from_json(&text).map_err(|e| e.in_file(path))
}

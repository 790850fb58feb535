//! `voxcast import`

use super::{ThreadCount, terminal};
use clap::{Args, CommandFactory};
use std::path::{Path, PathBuf};
use voxcast::checkpoint::Checkpoint;
use voxcast::container::{Container, FORMAT};
use voxcast::graph::Rewrites;
use voxcast::model::{Model, Options, use_winograd};
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
  voxcast import direct.safetensors -o model.safetensors    (a model: its weights transformed, all else as it is)

A .pth file, of either format that torch.save writes, is read without executing anything: it may hold tensors and plain
containers, and whatever else its pickle wants to call is refused by name. What wrappers put in front of names (module.,
_orig_mod., model.) is taken off, name by name. Notes on standard error say which state was taken of several, and which
tensors the network does not have.")]
pub struct Import {
    /// mmengine .pth, or .safetensors with the same names; or a model that uses direct sums
    checkpoint: PathBuf,
    /// nuscenes-200, nuscenes-256, semantickitti-256, edge, or a network.json; a model names its own
    #[arg(long, value_name = "NAME|FILE.json")]
    network: Option<String>,
    /// How weights are stored: f32 or f16; arithmetic is f32 either way [default: f32, a model keeps its own]
    #[arg(long, value_parser = ["f32", "f16"], hide_possible_values = true)]
    precision: Option<String>,
    /// Rewrites applied to the network: all, batch-norm (keeps the pyramid's features), none (keeps batch norms and direct
    /// sums too) [default: all, a model keeps its own]
    #[arg(long, value_parser = ["all", "batch-norm", "none"], hide_possible_values = true)]
    fold: Option<String>,
    /// Compute every convolution as a direct sum, none by Winograd's minimal filtering: slower, and a rounding error about
    /// half as large
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

impl Import {
    pub fn run(self) -> Result<()> {
        let bar = terminal::progress("importing", 0);
        let mut progress = |done, total| {
            bar.set_length(total as u64);
            bar.set_position(done as u64);
        };
        let mut notes = vec![];
        if is_model(&self.checkpoint) {
            self.transform(&mut progress)?;
        } else {
            let (network, options) = self.options()?;
            let checkpoint = Checkpoint::open(&self.checkpoint)?;
            voxcast::import::import(&checkpoint, &network, options, &self.output, &mut progress)
                .map_err(|e| e.in_file(&self.checkpoint))?;
            notes.extend(checkpoint.notes());
            notes.extend(unused(&checkpoint).map(|note| note.in_file(&self.checkpoint)));
        }
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
        terminal::say(&notes);
        let model = Model::open(&self.output)?;
        println!(
            "{}: {} weights, {}, checksum {:016x}",
            self.output.display(),
            model.options().precision.name(),
            terminal::bytes(model.file_size()),
            model.checksum().unwrap_or_default()
        );
        Ok(())
    }

    /// What a checkpoint becomes.
    fn options(&self) -> Result<(Network, Options)> {
        let Some(network) = &self.network else {
            return usage(clap::error::ErrorKind::MissingRequiredArgument, "a checkpoint needs --network");
        };
        let rewrites = match self.fold.as_deref() {
            None | Some("all") => Rewrites::ALL,
            Some("none") => Rewrites::NONE,
            Some(_) => Rewrites { projection: false, ..Rewrites::ALL },
        };
        let rewrites = Rewrites { winograd: rewrites.winograd && !self.exact, ..rewrites };
        let precision = self.precision.as_deref().and_then(Precision::parse).unwrap_or(Precision::F32);
        Ok((read_network(network)?, Options { precision, rewrites }))
    }

    /// A model becomes one that uses Winograd's minimal filtering.
    fn transform(&self, progress: &mut dyn FnMut(usize, usize)) -> Result<()> {
        let given = [
            ("--network", self.network.is_some()),
            ("--precision", self.precision.is_some()),
            ("--fold", self.fold.is_some()),
            ("--exact", self.exact),
        ];
        if let Some((option, _)) = given.into_iter().find(|(_, given)| *given) {
            let message = format!("{option} is for checkpoints: a model keeps its network, precision and folds");
            return usage(clap::error::ErrorKind::ArgumentConflict, &message);
        }
        let model = Model::open(&self.checkpoint)?;
        use_winograd(&model, &self.output, progress).map_err(|e| e.in_file(&self.checkpoint))
    }
}

/// Says how the command is used.
fn usage<T>(kind: clap::error::ErrorKind, message: &str) -> Result<T> {
    super::Arguments::command().error(kind, message).exit()
}

/// Whether the file says that it is a model. What cannot be read is no model: the checkpoint's reader says why.
fn is_model(path: &Path) -> bool {
    Container::open(path)
        .is_ok_and(|file| file.metadata().get(FORMAT).is_some_and(|format| format.starts_with("voxcast-model")))
}

/// Ends of names that training keeps for itself: counters of batch norms and of moving averages.
const COUNTERS: [&str; 3] = ["num_batches_tracked", "steps", "n_averaged"];

/// What the checkpoint has and the network does not: it would change the result if it belonged to it.
fn unused(checkpoint: &Checkpoint) -> Option<Note> {
    let is_counter = |name: &str| COUNTERS.contains(&name.rsplit('.').next().unwrap_or(name));
    let unused: Vec<&str> = checkpoint.unused().filter(|name| !is_counter(name)).collect();
    let shown: Vec<String> = unused.iter().take(3).map(|name| format!("{name:?}")).collect();
    let more = if unused.len() > 3 { ", ..." } else { "" };
    let message = format!("{} tensors that the network does not have: {}{more}", unused.len(), shown.join(", "));
    (!unused.is_empty()).then(|| Note::new(message))
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

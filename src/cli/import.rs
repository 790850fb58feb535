//! `voxcast import`

use super::{ThreadCount, terminal};
use clap::Args;
use std::path::{Path, PathBuf};
use voxcast::checkpoint::Checkpoint;
use voxcast::graph::Rewrites;
use voxcast::model::{Model, Options};
use voxcast::network::BUILT_IN;
use voxcast::weights::Precision;
use voxcast::{Error, ErrorKind, Isa, Network, Note, Result};

/// Turn a training checkpoint into a model: batch norms and the projection folded in f64, weights packed as the kernels
/// read them.
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  voxcast import epoch_24.pth --network nuscenes-200 -o model.safetensors
  voxcast import weights.safetensors --network network.json --precision f16 -o model.safetensors

A .pth file, of either format that torch.save writes, is read without executing anything: it may hold tensors and plain
containers, and whatever else its pickle wants to call is refused by name. What wrappers put in front of names (module.,
_orig_mod., model.) is taken off, name by name. Notes on standard error say which state was taken of several, and which
tensors the network does not have.")]
pub struct Import {
    /// mmengine .pth, or .safetensors with the same names
    checkpoint: PathBuf,
    /// nuscenes-200, nuscenes-256, semantickitti-256, edge, or a network.json
    #[arg(long, value_name = "NAME|FILE.json")]
    network: String,
    /// How weights are stored; arithmetic is f32 either way
    #[arg(long, default_value = "f32", value_parser = ["f32", "f16"])]
    precision: String,
    /// Rewrites applied to the network: all, batch-norm (keeps the pyramid's features), none (keeps batch norms too)
    #[arg(long, default_value = "all", value_parser = ["all", "batch-norm", "none"])]
    fold: String,
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
        let network = read_network(&self.network)?;
        let rewrites = match self.fold.as_str() {
            "all" => Rewrites::ALL,
            "none" => Rewrites::NONE,
            _ => Rewrites { projection: false, ..Rewrites::ALL },
        };
        let precision = Precision::parse(&self.precision).unwrap_or(Precision::F32);
        let checkpoint = Checkpoint::open(&self.checkpoint)?;
        let bar = terminal::progress("importing", 0);
        let options = Options { precision, rewrites };
        voxcast::import::import(&checkpoint, &network, options, &self.output, &mut |done, total| {
            bar.set_length(total as u64);
            bar.set_position(done as u64);
        })
        .map_err(|e| e.in_file(&self.checkpoint))?;
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
        terminal::say(&checkpoint.notes());
        terminal::say(&Vec::from_iter(checkpoint.unused_note()));
        let model = Model::open(&self.output)?;
        println!(
            "{}: {} weights, {}, checksum {:016x}",
            self.output.display(),
            precision.name(),
            terminal::bytes(model.file_size()),
            model.checksum().unwrap_or_default()
        );
        Ok(())
    }
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

//! `voxcast rig`

use super::terminal::tell;
use super::{Machine, frame, import, terminal};
use clap::Args;
use std::path::{Path, PathBuf};
use std::time::Instant;
use voxcast::{Model, Network, Result};

/// Build the six projection matrices of a scene's cameras and write them as a rig, which `run` maps.
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  voxcast rig scene/ --model model.safetensors -o rig.safetensors
  voxcast rig scene/calibration.json --model model.safetensors -o rig.safetensors
  voxcast rig scene/ --network network.json -o rig.safetensors

Matrices depend on a network's sizes, not on its weights, so that a network which is still to be trained has its rig too.
A rig holds the digests of the calibration that it was made from: `run` refuses it for another one. Where cameras see less
than 10 % of the voxels of level 1 together, or one of them less than 2 %, a note on standard error says so: axes, metres
or intrinsics are hardly those of the images then.")]
pub struct BuildRig {
    /// A scene, or only its calibration.json
    #[arg(value_name = "SCENE|CALIBRATION.json")]
    scene: PathBuf,
    /// The model whose network the matrices are for
    #[arg(long, required_unless_present = "network")]
    model: Option<PathBuf>,
    /// The network, where there is no model yet: nuscenes-200, nuscenes-256, semantickitti-256, edge, or a network.json
    #[arg(long, value_name = "NAME|FILE.json", conflicts_with = "model")]
    network: Option<String>,
    /// The rig to write
    #[arg(short, long, value_name = "RIG")]
    output: PathBuf,
    /// Print the summary as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    machine: Machine,
}

impl BuildRig {
    pub fn run(self) -> Result<()> {
        let inputs = [Some(&self.scene), self.model.as_ref()];
        let inputs = ["SCENE", "--model"].into_iter().zip(inputs);
        frame::check_outputs(inputs.filter_map(|(name, path)| Some((name, path?))), [("--output", &self.output)])?;
        let network = self.network()?;
        let (names, lidar2img) = frame::calibration(&self.scene, &network)?;
        let threads = self.machine.threads()?;
        let mut builder = voxcast::rig::RigBuilder::new(&network, lidar2img.len(), self.machine.isa()?)
            .map_err(|e| e.in_file(self.source()))?
            .with_threads(threads.clone());
        let start = Instant::now();
        let rig = builder.build(&lidar2img).map_err(|e| e.in_file(&self.scene))?;
        let elapsed = start.elapsed();
        rig.save(&self.output, &network)?;
        let visibility = rig.visibility(&network);
        let notes = visibility.notes(&names);
        terminal::say(&notes);
        if self.json {
            let matrix =
                |m: voxcast::rig::Csr<'_>| serde_json::json!({"rows": m.ptr.len() - 1, "entries": m.col.len()});
            let level = |index| {
                let level = rig.level(index);
                serde_json::json!({"volume": matrix(level.volume), "bev": matrix(level.bev)})
            };
            let cameras = names.iter().zip(&visibility.cameras);
            let value = serde_json::json!({
                "levels": [level(0), level(1), level(2)],
                "seen": visibility.seen,
                "cameras": cameras.map(|(name, seen)| serde_json::json!({"name": name, "seen": seen})).collect::<Vec<_>>(),
                "notes": notes.iter().map(ToString::to_string).collect::<Vec<_>>(),
                "seconds": elapsed.as_secs_f64(),
            });
            tell!("{value}")?;
            return Ok(());
        }
        for index in 0..3 {
            let level = rig.level(index);
            for (name, matrix) in [("volume", level.volume), ("bev", level.bev)] {
                let (rows, entries) = (matrix.ptr.len() - 1, matrix.col.len());
                tell!(
                    "level {} {name:6} {rows:>9} rows {entries:>10} entries {:>7.1} a row",
                    index + 1,
                    entries as f64 / rows as f64
                )?;
            }
        }
        let shares = names.iter().zip(&visibility.cameras);
        let shares: Vec<String> = shares.map(|(name, &share)| format!("{name} {}", terminal::percent(share))).collect();
        tell!("cameras see {} of the voxels: {}", terminal::percent(visibility.seen), shares.join(", "))?;
        tell!("six matrices in {} on {} threads", terminal::time(elapsed), threads.count())?;
        Ok(())
    }

    /// Where the network stands.
    fn source(&self) -> &Path {
        let name = || Path::new(self.network.as_deref().unwrap_or_default());
        self.model.as_deref().unwrap_or_else(name)
    }

    /// What `--model` or `--network` names; clap has seen to it that one of them is there.
    fn network(&self) -> Result<Network> {
        match (&self.model, &self.network) {
            (Some(path), _) => Ok(Model::open(path)?.network().clone()),
            (None, name) => import::read_network(name.as_deref().unwrap_or_default()),
        }
    }
}

//! `voxcast rig`

use super::{Machine, frame, terminal};
use clap::Args;
use std::path::PathBuf;
use std::time::Instant;
use voxcast::{Model, Result};

/// Build the six projection matrices of a scene's cameras and write them as a rig, which `run` maps.
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  voxcast rig scene/ --model model.safetensors -o rig.safetensors
  voxcast rig scene/calibration.json --model model.safetensors -o rig.safetensors")]
pub struct BuildRig {
    /// A scene, or only its calibration.json
    #[arg(value_name = "SCENE|CALIBRATION.json")]
    scene: PathBuf,
    /// The model whose network the matrices are for
    #[arg(long)]
    model: PathBuf,
    /// The rig to write
    #[arg(short, long, value_name = "RIG")]
    output: PathBuf,
    #[command(flatten)]
    machine: Machine,
}

impl BuildRig {
    pub fn run(self) -> Result<()> {
        let model = Model::open(&self.model)?;
        let lidar2img = frame::calibration(&self.scene)?;
        let threads = self.machine.threads()?;
        let mut builder = voxcast::rig::RigBuilder::new(model.network(), lidar2img.len(), self.machine.isa()?)
            .map_err(|e| e.in_file(&self.model))?
            .with_threads(threads.clone());
        let start = Instant::now();
        let rig = builder.build(&lidar2img).map_err(|e| e.in_file(&self.scene))?;
        let elapsed = start.elapsed();
        rig.save(&self.output, model.network())?;
        for index in 0..3 {
            let level = rig.level(index);
            for (name, matrix) in [("volume", level.volume), ("bev", level.bev)] {
                let (rows, entries) = (matrix.ptr.len() - 1, matrix.col.len());
                println!(
                    "level {} {name:6} {rows:>9} rows {entries:>10} entries {:>7.1} a row",
                    index + 1,
                    entries as f64 / rows as f64
                );
            }
        }
        println!("six matrices in {} on {} threads", terminal::time(elapsed), threads.count());
        Ok(())
    }
}

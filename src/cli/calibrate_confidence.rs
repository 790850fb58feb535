//! `voxcast calibrate-confidence`

use super::terminal::tell;
use super::{Machine, frame, terminal};
use clap::Args;
use std::path::PathBuf;
use std::sync::Arc;
use voxcast::dataset::{FORMS, Named};
use voxcast::eval::fit_temperature;
use voxcast::{Model, Result};

/// Fit the temperature of a model's probabilities to labels, and write the model with it.
///
/// A network is often surer than it should be, or less. What `run --confidence` gives is a softmax of the logits divided by a
/// temperature: the one at which the labels are likeliest. It changes neither classes nor logits; weights and self-test stay as
/// they are. `eval --calibration` says how good the probabilities are, on other frames than those of the fit.
#[derive(Args, Debug)]
#[command(after_help = format!("\
Examples:
  voxcast calibrate-confidence model.safetensors --data synthetic:tuning -o model.safetensors
  voxcast eval --model model.safetensors --data synthetic:heldout --calibration

Every frame is run some five times. The same model and frames give the same temperature on every machine.

{FORMS}"))]
pub struct CalibrateConfidence {
    /// The model, of any precision
    model: PathBuf,
    /// Frames with labels that training did not see
    #[arg(long, value_name = "SET")]
    data: Named,
    /// Only the first N frames
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    limit: Option<u32>,
    /// The model to write, which may be the same file
    #[arg(short, long, value_name = "MODEL")]
    output: PathBuf,
    #[command(flatten)]
    machine: Machine,
}

impl CalibrateConfidence {
    pub fn run(self) -> Result<()> {
        frame::check_output(&self.output)?;
        // Not mapped: the file may be replaced.
        let model = Arc::new(Model::read(&self.model)?);
        let set = self.data.open()?;
        let options = frame::options(&self.machine)?;
        let limit = self.limit.map(|limit| limit as usize);
        let bar = terminal::progress("fitting", 0);
        let frames = limit.map_or(set.len(), |limit| set.len().min(limit)).max(1);
        let fit = fit_temperature(&model, &*set, &self.data.to_string(), limit, &options, &mut |done, notes| {
            bar.suspend(|| terminal::say(notes));
            bar.set_length((done.div_ceil(frames) * frames) as u64);
            bar.set_position(done as u64);
            Ok(())
        })?;
        bar.finish_and_clear();
        model.save_with_temperature(fit.temperature, &self.output)?;
        let (was, voxels) = (model.temperature(), fit.voxels);
        tell!(
            "{}: temperature {} (before {was}), of {voxels} voxels in {} frames, each run {} times",
            self.output.display(),
            fit.temperature,
            fit.frames,
            fit.passes
        )?;
        Ok(())
    }
}

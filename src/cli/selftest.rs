//! `voxcast selftest`

use super::terminal::tell;
use super::{Machine, terminal};
use clap::Args;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;
use voxcast::{Error, ErrorKind, Model, Result};

/// Check that this machine computes what the model must give, operation by operation.
///
/// The model carries a stimulus and the digest of every operation's result. They are the same on every machine,
/// instruction set and number of threads; a difference means a fault of the machine, the build or the file. Two cameras are
/// computed, whatever the network has.
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  voxcast selftest model.safetensors
  voxcast selftest model.safetensors --isa scalar --threads 1
  voxcast selftest model.safetensors --json")]
pub struct SelfTest {
    /// The model
    model: PathBuf,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    machine: Machine,
}

impl SelfTest {
    pub fn run(self) -> Result<()> {
        let model = Arc::new(Model::open(&self.model)?);
        let (isa, threads) = (self.machine.isa()?, self.machine.threads()?);
        let start = Instant::now();
        let report = voxcast::selftest::run(&model, isa, &threads).map_err(|e| e.in_file(&self.model))?;
        let elapsed = start.elapsed();
        if self.json {
            let fault = report.fault.as_ref().map(|fault| {
                serde_json::json!({
                    "operation": fault.operation,
                    "stage": fault.stage,
                    "camera": fault.camera,
                    "expected": fault.expected,
                    "found": fault.found,
                })
            });
            let (operations, seconds) = (report.operations, elapsed.as_secs_f64());
            tell!("{}", serde_json::json!({"operations": operations, "fault": fault, "seconds": seconds}))?;
        }
        if let Some(fault) = report.fault {
            return Err(Error::new(ErrorKind::Mismatch, format!("self-test failed: {fault}")).in_file(&self.model));
        }
        if !self.json {
            tell!(
                "{} operations give what they must, in {} on {} threads with {}",
                report.operations,
                terminal::time(elapsed),
                threads.count(),
                isa.name()
            )?;
        }
        Ok(())
    }
}

//! Arguments and commands. One file per command under `cli/`.

mod calibrate;
mod calibrate_confidence;
mod compare;
mod demo;
mod dump;
mod eval;
mod frame;
mod frames;
mod import;
mod inspect;
mod profile;
mod rig;
mod run;
mod selftest;
mod sequence;
mod shard;
mod synth;
mod terminal;
mod view;

use clap::{Args, Parser, Subcommand};
use voxcast::{Error, ErrorKind, Isa, Result, Threads};

/// Camera images to a semantic voxel grid on a CPU, with the same bits every time.
#[derive(Debug, Parser)]
#[command(name = "voxcast", version, about, after_help = EXAMPLES)]
pub struct Arguments {
    #[command(subcommand)]
    command: Command,
}

const EXAMPLES: &str = "\
Examples:
  voxcast demo -o demo-out
  voxcast import epoch_24.pth --network nuscenes-200 -o model.safetensors
  voxcast rig scene/ --model model.safetensors -o rig.safetensors
  voxcast run --model model.safetensors --rig rig.safetensors scene/ -o out.npz --png out.png
  voxcast run --model model.safetensors log.mcap -o out.mcap
  voxcast view out.npz --scene scene/ -o out.html
  voxcast inspect model.safetensors
  voxcast eval --model model.safetensors --data synthetic:heldout

A scene is a directory with calibration.json and its images, or a .safetensors file with `images` (u8 [N, H, W, 3], BGR)
and `lidar2img` (f32 [N, 4, 4]).

Exit codes: 0 done, 1 the input or the machine is at fault (one line on stderr), 2 usage.";

#[derive(Debug, Subcommand)]
enum Command {
    /// Run the network that ships with the program on a drawn street; needs no other file
    Demo(demo::Demo),
    /// Turn a training checkpoint into a model
    Import(import::Import),
    /// Measure the ranges of a model's tensors on scenes, for int8
    Calibrate(calibrate::Calibrate),
    /// Fit the temperature of a model's probabilities to labels
    CalibrateConfidence(calibrate_confidence::CalibrateConfidence),
    /// Build the projection matrices of a scene's cameras
    Rig(rig::BuildRig),
    /// Run a model on a scene
    Run(run::Run),
    /// Make a page of a result, to look at in a browser
    View(view::View),
    /// Say what is in a model or a rig
    Inspect(inspect::Inspect),
    /// Time every operation of a model
    Profile(profile::Profile),
    /// Compare two dumps or two runs, stage by stage
    Compare(compare::Compare),
    /// Check that this machine computes what a model must give
    Selftest(selftest::SelfTest),
    /// Draw synthetic street scenes with labels
    Synth(synth::Synth),
    /// Score a model on a data set with labels
    Eval(eval::Eval),
}

/// Says why the program failed.
pub fn complain(error: &Error) {
    terminal::complain(format_args!("{error}"));
}

impl Arguments {
    pub fn run(self) -> Result<()> {
        match self.command {
            Command::Demo(command) => command.run(),
            Command::Import(command) => command.run(),
            Command::Calibrate(command) => command.run(),
            Command::CalibrateConfidence(command) => command.run(),
            Command::Rig(command) => command.run(),
            Command::Run(command) => command.run(),
            Command::View(command) => command.run(),
            Command::Inspect(command) => command.run(),
            Command::Profile(command) => command.run(),
            Command::Compare(command) => command.run(),
            Command::Selftest(command) => command.run(),
            Command::Synth(command) => command.run(),
            Command::Eval(command) => command.run(),
        }
    }
}

/// On how many threads to compute. It does not change a result.
#[derive(Args, Debug)]
pub struct ThreadCount {
    /// Threads that compute [default: one per CPU]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
}

impl ThreadCount {
    pub fn count(&self) -> usize {
        match self.threads {
            Some(count) => usize::from(count),
            None => std::thread::available_parallelism().map_or(1, usize::from),
        }
    }

    pub fn threads(&self) -> Result<Threads> {
        Threads::new(self.count())
    }
}

/// How to run a network. None of it changes a result.
#[derive(Args, Debug)]
pub struct Machine {
    #[command(flatten)]
    threads: ThreadCount,
    /// Instruction set: scalar (the specification, and slow), avx2, avx2-vnni, avx512,
    /// avx512-vnni, neon, neon-dot, neon-i8mm [default: the fastest of this CPU]
    #[arg(long, value_name = "NAME")]
    isa: Option<String>,
}

impl Machine {
    pub fn threads(&self) -> Result<Threads> {
        self.threads.threads()
    }

    pub fn isa(&self) -> Result<Isa> {
        let unsupported = |e: voxcast::IsaError| Error::new(ErrorKind::Unsupported, format!("--isa: {e}"));
        self.isa.as_deref().map_or(Ok(Isa::best()), |name| Isa::parse(name).map_err(unsupported))
    }
}

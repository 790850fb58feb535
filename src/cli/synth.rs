//! `voxcast synth`

use super::import::read_network;
use super::terminal::tell;
use super::{ThreadCount, frame, terminal};
use clap::Args;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use voxcast::container::Container;
use voxcast::network::Grid;
use voxcast::synth::{Synthesiser, set_file};
use voxcast::{Error, Result};

/// Draw synthetic street scenes with the class of every voxel, from seeds.
///
/// The same seed gives the same bytes on every machine. A scene directory holds calibration.json, one PNG per camera,
/// labels.npz (classes and visible, u8 [X, Y, Z]) and labels.npy (rows x, y, z, class of the voxels that are not empty). A
/// set holds one .safetensors per seed, which is a scene as well.
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  voxcast synth --seed 7 -o scene
  voxcast synth --seed 7 --frames 40 -o drive        # drive/000, drive/001, ...
  voxcast synth --seed 0 --count 3000 --set train --pixels
  voxcast synth --network network.json --seed 7 -o scene")]
pub struct Synth {
    /// The world to draw; of a set the first
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Scene directory to write
    #[arg(short, long, value_name = "DIR", required_unless_present = "set", conflicts_with = "set")]
    output: Option<PathBuf>,
    /// Write a sequence: N scene directories 000, 001, ... of a drive through one world
    #[arg(long, value_name = "N", requires = "output", value_parser = clap::value_parser!(u32).range(1..=1000))]
    frames: Option<u32>,
    /// Write a set into DIR: a file per seed. Frames that are there stay, so that an interrupted set can be completed
    #[arg(long, value_name = "DIR")]
    set: Option<PathBuf>,
    /// Seeds of the set
    #[arg(long, value_name = "N", requires = "set", default_value_t = 100)]
    count: u64,
    /// Also write class and distance of every pixel into the set
    #[arg(long, requires = "set")]
    pixels: bool,
    /// Network whose images and grid to draw: a built-in name or a network.json
    #[arg(long, value_name = "NAME|FILE.json", default_value = "edge")]
    network: String,
    /// Draw for the cameras of this calibration.json instead of nuScenes' ring
    #[arg(long, value_name = "FILE.json")]
    calibration: Option<PathBuf>,
    #[command(flatten)]
    threads: ThreadCount,
}

impl Synth {
    pub fn run(self) -> Result<()> {
        let mut synthesiser = Synthesiser::new(&read_network(&self.network)?)?;
        if let Some(path) = &self.calibration {
            let cameras: Vec<_> = frame::cameras(path)?.into_iter().map(|c| (c.name, c.lidar2img)).collect();
            synthesiser = synthesiser.with_cameras(&cameras).map_err(|e| e.in_file(path))?;
        }
        let workers = self.threads.count();
        if let Some(directory) = &self.set {
            return self.write_set(&synthesiser, directory, workers);
        }
        let output = self.output.as_deref().unwrap_or(Path::new("."));
        frame::create_directory(output)?;
        let grid = Grid::of(synthesiser.network());
        let Some(frames) = self.frames.map(|n| n as usize) else {
            synthesiser.frame(self.seed).save_scene(output, grid)?;
            tell!("scene of seed {} in {}", self.seed, output.display())?;
            return Ok(());
        };
        work("frames", frames as u64, workers, |index| {
            let frame = synthesiser.frame_of(self.seed, index as usize, frames);
            frame.save_scene(&output.join(format!("{index:03}")), grid)
        })?;
        tell!("{frames} scenes of seed {} in {}", self.seed, output.display())?;
        Ok(())
    }

    fn write_set(&self, synthesiser: &Synthesiser, directory: &Path, workers: usize) -> Result<()> {
        frame::create_directory(directory)?;
        synthesiser.begin_set(directory)?;
        let grid = Grid::of(synthesiser.network());
        let last = self.seed.checked_add(self.count).filter(|&end| end <= 1_000_000_000);
        if last.is_none() {
            return Err(Error::mismatch(format!("seeds from {} on, expected seeds below 1000000000", self.seed)));
        }
        work("frames", self.count, workers, |index| {
            let seed = self.seed + index;
            let path = directory.join(set_file(seed));
            // Files appear whole or not at all.
            match path.exists() {
                true if self.pixels => has_pixels(&path),
                true => Ok(()),
                false => synthesiser.frame(seed).save_tensors(&path, grid, self.pixels),
            }
        })?;
        tell!("{} frames in {}", self.count, directory.display())?;
        Ok(())
    }
}

/// Refuses a frame that was drawn before and lacks what is asked for now.
fn has_pixels(path: &Path) -> Result<()> {
    match Container::open(path)?.tensor("pixel.class") {
        Some(_) => Ok(()),
        None => Err(Error::mismatch("it was drawn without --pixels, expected tensor \"pixel.class\"").in_file(path)),
    }
}

/// Does pieces of work `0..count` on several threads, with progress, until one fails.
fn work(what: &'static str, count: u64, workers: usize, piece: impl Fn(u64) -> Result<()> + Sync) -> Result<()> {
    let (next, failed) = (AtomicU64::new(0), Mutex::new(None));
    let bar = terminal::progress(what, count as usize);
    std::thread::scope(|scope| {
        for _ in 0..workers.clamp(1, count.clamp(1, 1024) as usize) {
            scope.spawn(|| {
                loop {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    if index >= count {
                        return;
                    }
                    if let Err(error) = piece(index) {
                        next.store(count, Ordering::Relaxed);
                        failed.lock().unwrap_or_else(|e| e.into_inner()).get_or_insert(error);
                        return;
                    }
                    bar.inc(1);
                }
            });
        }
    });
    bar.finish_and_clear();
    failed.into_inner().unwrap_or_else(|e| e.into_inner()).map_or(Ok(()), Err)
}

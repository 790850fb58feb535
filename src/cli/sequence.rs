//! `voxcast run` over the scenes of a drive or the frames of a robot log, with one session.

use super::frame;
use super::frames::{self, Frame, Frames, Results};
use super::run::{Run, digest, draw, masked, seen, title};
use super::terminal;
use super::terminal::tell;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use voxcast::log::Summary;
use voxcast::note::Said;
use voxcast::picture::Animation;
use voxcast::session::Moving;
use voxcast::{Error, Model, Note, Result, Scene, SessionOptions};

/// The scenes in `path`, in the order of their names, if it is a directory of scenes rather than a scene: directories
/// with a calibration.json, and .safetensors files.
pub fn scenes(path: &Path) -> Result<Option<Vec<PathBuf>>> {
    if !path.is_dir() || path.join("calibration.json").exists() {
        return Ok(None);
    }
    let failed = |e: std::io::Error| Error::io(path, "read", &e);
    let mut scenes = Vec::new();
    for entry in std::fs::read_dir(path).map_err(failed)? {
        let entry = entry.map_err(failed)?.path();
        let tensors = entry.extension().is_some_and(|e| e == "safetensors") && entry.is_file();
        if tensors || entry.join("calibration.json").exists() {
            scenes.push(entry);
        }
    }
    scenes.sort();
    Ok((!scenes.is_empty()).then_some(scenes))
}

/// What is known about a frame that was run.
struct Done {
    name: String,
    digest: String,
    /// The share of the voxels that a camera sees.
    seen: f64,
    stamp: u64,
    /// Names of cameras without an image.
    missing: Vec<String>,
    read: Duration,
    frame: Duration,
}

impl Run {
    /// Runs the scene, the scenes of a directory, or the frames of a log.
    pub fn run(self) -> Result<()> {
        if frames::is_log(&self.scene) {
            return self.run_sequence(None);
        }
        if !self.camera.is_empty() || self.frame.is_some() || self.tolerance.is_some() {
            let message = "--camera, --frame and --tolerance are about logs, and this is none (.mcap)";
            return Err(Error::mismatch(message).in_file(&self.scene));
        }
        if let Some(scenes) = scenes(&self.scene)? {
            return self.run_sequence(Some(&scenes));
        }
        if frames::is_log(&self.output) && self.animation.is_none() {
            return self.run_sequence(Some(std::slice::from_ref(&self.scene)));
        }
        self.run_scene()
    }

    /// Runs the scenes in `scenes`, or the log that the user names.
    fn run_sequence(&self, scenes: Option<&[PathBuf]>) -> Result<()> {
        for (flag, given) in
            [("--png", self.png.is_some()), ("--html", self.html.is_some()), ("--dump", self.dump.is_some())]
        {
            if given {
                let message = match scenes {
                    Some([_]) => format!("{flag} goes with -o OUT.npz, and not with a log"),
                    Some(scenes) => format!("{flag} shows one scene, and this is a sequence of {}", scenes.len()),
                    None => format!("{flag} shows one scene, and this is a log"),
                };
                return Err(Error::mismatch(message).in_file(&self.scene));
            }
        }
        self.check_outputs(Some(&self.output).filter(|path| frames::is_log(path)))?;
        let model = Arc::new(Model::open(&self.model)?);
        let mut frames = match scenes {
            Some(scenes) => Frames::of_scenes(scenes)?,
            None => Frames::of_log(self, model.network())?,
        };
        let mut results = Results::create(self, model.network())?;
        let mut options = frame::options(&self.machine)?;
        options.logits = self.logits;
        options.confidence = self.wants_confidence();
        options.unfolded = self.unfolded;

        let mut driver: Option<Driver> = None;
        let mut animation: Option<Animation> = None;
        let count = frames.len();
        let mut done: Vec<Done> = Vec::with_capacity(count);
        let mut said = Said::default();
        let bar = terminal::progress("running", count);
        for index in 0..count {
            let start = Instant::now();
            let mut frame = frames.read(index, model.network(), results.takes_files())?;
            let notes = std::mem::take(&mut frame.notes);
            let (scene, path) = (&frame.scene, frame.path.clone());
            let read = start.elapsed();
            bar.suspend(|| terminal::say(said.fresh(notes)));
            let driver = match &mut driver {
                Some(driver) => driver,
                none => {
                    let driver = none.insert(Driver::new(self, &model, scene, &options)?);
                    bar.suspend(|| terminal::say(said.fresh(std::mem::take(&mut driver.notes))));
                    driver
                }
            };
            driver.prepare(self, &frame).map_err(|e| e.in_file(&path))?;
            let start = Instant::now();
            let result = driver.moving.session.run_scene(scene).map_err(|e| e.in_file(&path))?;
            let latency = start.elapsed();
            if let Some(path) = &self.animation {
                let subtitle = format!("{}, {} of {count}", frame.name, index + 1);
                let page = draw(model.network(), scene, &result, &title(&self.model), &subtitle, self.hide_below)?;
                let page = page.scaled(usize::from(self.width));
                let animation = match &mut animation {
                    Some(animation) => animation,
                    none => {
                        let size = [page.width, page.height];
                        none.insert(Animation::create(path, size, count, self.rate)?)
                    }
                };
                animation.push(&page.fitted(animation.size()))?;
            }
            let missing = frame.missing().map(|camera| scene.names[camera].clone()).collect();
            let (name, stamp) = (frame.name.clone(), frame.stamp);
            let (digest, seen) = (digest(&result), seen(&result));
            done.push(Done { name, digest, seen, stamp, missing, read, frame: latency });
            results.push(model.network(), frame, result, latency, self.logits)?;
            bar.inc(1);
        }
        bar.finish_and_clear();
        results.finish()?;
        if let Some(animation) = animation {
            animation.finish()?;
        }
        let rigs = driver.map_or((0, Duration::ZERO), |driver| (driver.moving.rigs, driver.moving.rig_time));
        self.print_sequence(&done, frames.summary(), rigs, said.notes())
    }

    fn print_sequence(
        &self,
        done: &[Done],
        log: Option<&Summary>,
        (rigs, rig_time): (usize, Duration),
        notes: &[Note],
    ) -> Result<()> {
        let latency = Latency::of(done.iter().map(|done| done.frame));
        let read = Latency::of(done.iter().map(|done| done.read));
        let all: String = done.iter().map(|done| done.digest.as_str()).collect();
        let all = format!("{:016x}", voxcast::digest::bytes(all.as_bytes()));
        if self.json {
            let scenes: Vec<_> = done
                .iter()
                .map(|done| {
                    let mut scene = serde_json::json!({
                        "scene": done.name,
                        "digest": done.digest,
                        "seen": done.seen,
                        "read_seconds": done.read.as_secs_f64(),
                        "frame_seconds": done.frame.as_secs_f64(),
                    });
                    if log.is_some() {
                        scene["stamp"] = done.stamp.into();
                        scene["missing"] = done.missing.clone().into();
                    }
                    scene
                })
                .collect();
            let mut value = serde_json::json!({
                "digest": all,
                "scenes": scenes,
                "rigs": rigs,
                "notes": notes.iter().map(ToString::to_string).collect::<Vec<_>>(),
                "seconds": { "frame": latency.json(), "read": read.json(), "rigs": rig_time.as_secs_f64() },
            });
            if let Some(log) = log {
                value["log"] = serde_json::json!({
                    "extent": log.extent.to_string(),
                    "read": log.extent.read,
                    "length": log.extent.length,
                    "cameras": log.cameras.iter().map(|(name, topic)| [name, topic]).collect::<Vec<_>>(),
                    "frame": log.frame,
                    "incomplete": log.incomplete,
                    "left_out": log.left_out,
                    "without_transform": log.without_transform,
                });
            }
            return tell!("{value}");
        }
        let what = if log.is_some() { "frames" } else { "scenes" };
        tell!("{} {what} with one session, digest {all}", done.len())?;
        let shares = || done.iter().map(|done| done.seen);
        tell!(
            "cameras see {} to {} of the voxels",
            terminal::percent(shares().fold(1.0, f64::min)),
            terminal::percent(shares().fold(0.0, f64::max))
        )?;
        if let Some(log) = log {
            tell!("log {}", log.extent)?;
            let cameras: Vec<String> = log.cameras.iter().map(|(name, topic)| format!("{name} {topic}")).collect();
            tell!("cameras in frame {}: {}", log.frame, cameras.join(", "))?;
            tell!(
                "{} frames lack an image, {} images belong to no frame, {} frames have no transform at their time",
                log.incomplete,
                log.left_out,
                log.without_transform
            )?;
        }
        tell!("frame {latency}")?;
        tell!("reading a {} {read}", if log.is_some() { "frame" } else { "scene" })?;
        tell!("rigs: {rigs}, in {}", terminal::time(rig_time))
    }
}

/// One session for all scenes.
struct Driver {
    moving: Moving,
    /// What is to be said of the first rig.
    notes: Vec<Note>,
    masked: BTreeSet<usize>,
}

impl Driver {
    fn new(run: &Run, model: &Arc<Model>, scene: &Scene, options: &SessionOptions) -> Result<Self> {
        let start = Instant::now();
        let (rig, notes) = frame::rig(run.rig_file(), model, scene, options)?;
        let rig_time = start.elapsed();
        let mut moving = Moving::new(model, Some(rig), scene, options)?;
        moving.rig_time = rig_time;
        Ok(Self { moving, notes, masked: BTreeSet::new() })
    }

    /// Makes the session ready for a frame: builds the matrices anew where its cameras have moved, and masks those that
    /// the user names and those without an image.
    fn prepare(&mut self, run: &Run, frame: &Frame) -> Result<()> {
        let scene = &frame.scene;
        if run.any_rig {
            self.moving.check_count(scene)?;
        } else if run.rig.is_some() && !self.moving.fits(scene) {
            let message =
                "another calibration than the first scene, and --rig is of one; leave --rig out, or add --any-rig";
            return Err(Error::mismatch(message));
        } else {
            self.moving.calibrate(scene)?;
        }
        let mut masked = masked(&run.mask, scene)?;
        masked.extend(frame.missing());
        for camera in self.masked.symmetric_difference(&masked) {
            self.moving.session.set_masked(*camera, masked.contains(camera))?;
        }
        self.masked = masked;
        Ok(())
    }
}

/// How long things took. The first one, which also waits for pages of the model, stands apart where there are others.
struct Latency {
    first: Duration,
    median: Duration,
    percentile_99: Duration,
    worst: Duration,
}

impl Latency {
    fn of(times: impl Iterator<Item = Duration>) -> Self {
        let times: Vec<Duration> = times.collect();
        let first = times.first().copied().unwrap_or_default();
        let mut sorted = if times.len() > 1 { times[1..].to_vec() } else { times };
        sorted.sort_unstable();
        // The nearest rank: the least time that the share of all does not exceed.
        let rank = |share: f64| {
            let rank = (share * sorted.len() as f64).ceil() as usize;
            sorted.get(rank.saturating_sub(1)).copied().unwrap_or_default()
        };
        Self { first, median: rank(0.5), percentile_99: rank(0.99), worst: rank(1.0) }
    }

    fn json(&self) -> serde_json::Value {
        serde_json::json!({
            "first": self.first.as_secs_f64(),
            "median": self.median.as_secs_f64(),
            "percentile_99": self.percentile_99.as_secs_f64(),
            "worst": self.worst.as_secs_f64(),
        })
    }
}

impl std::fmt::Display for Latency {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [first, median, percentile, worst] =
            [self.first, self.median, self.percentile_99, self.worst].map(terminal::time);
        write!(f, "median {median}, 99th percentile {percentile}, worst {worst}; the first {first}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranks_of_latencies_by_hand() {
        let milliseconds = |times: &[u64]| Latency::of(times.iter().map(|&t| Duration::from_millis(t)));
        let of = |l: Latency| [l.first, l.median, l.percentile_99, l.worst].map(|t| t.as_millis());
        // Without the first: 1, 2, 3, 9.
        assert_eq!(of(milliseconds(&[50, 9, 1, 3, 2])), [50, 2, 9, 9]);
        assert_eq!(of(milliseconds(&[7])), [7, 7, 7, 7]);
        let times: Vec<u64> = std::iter::once(0).chain(1..=200).collect();
        assert_eq!(of(milliseconds(&times)), [0, 100, 198, 200]);
        assert_eq!(of(milliseconds(&[])), [0; 4]);
    }
}

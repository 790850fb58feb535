//! `voxcast run` over the scenes of a drive, with one session.

use super::frame;
use super::run::{Run, digest, draw, masked, title, write};
use super::terminal;
use std::collections::{BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use voxcast::picture::Animation;
use voxcast::session::Moving;
use voxcast::{Error, Model, Result, Rig, Scene, SessionOptions};

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

/// What the results of scenes are called: a directory's name, or a file's without its ending.
fn names(scenes: &[PathBuf]) -> Result<Vec<String>> {
    let mut names = Vec::with_capacity(scenes.len());
    let mut taken = HashMap::new();
    for path in scenes {
        let name = if path.is_dir() { path.file_name() } else { path.file_stem() };
        let name = name.unwrap_or_default().to_string_lossy().into_owned();
        if let Some(other) = taken.insert(name.clone(), path) {
            let message = format!("its result would be called {name}.npz, as that of {}", other.display());
            return Err(Error::mismatch(message).in_file(path));
        }
        names.push(name);
    }
    Ok(names)
}

/// What is known about a scene that was run.
struct Done {
    name: String,
    digest: String,
    read: Duration,
    frame: Duration,
}

impl Run {
    pub fn run_sequence(&self, scenes: &[PathBuf]) -> Result<()> {
        for (flag, given) in
            [("--png", self.png.is_some()), ("--html", self.html.is_some()), ("--dump", self.dump.is_some())]
        {
            if given {
                let message = format!("{flag} shows one scene, and this is a sequence of {}", scenes.len());
                return Err(Error::mismatch(message).in_file(&self.scene));
            }
        }
        if let Some(path) = &self.animation {
            frame::check_output(path)?;
        }
        let names = names(scenes)?;
        std::fs::create_dir_all(&self.output).map_err(|e| Error::io(&self.output, "create", &e))?;
        let model = Arc::new(Model::open(&self.model)?);
        let mut options = frame::options(&self.machine)?;
        options.logits = self.logits;
        options.unfolded = self.unfolded;

        let mut driver: Option<Driver> = None;
        let mut animation: Option<Animation> = None;
        let mut done: Vec<Done> = Vec::with_capacity(scenes.len());
        let bar = terminal::progress("running", scenes.len());
        for (path, name) in scenes.iter().zip(names) {
            let start = Instant::now();
            let scene = Scene::open(path)?;
            scene.check(model.network()).map_err(|e| e.in_file(path))?;
            let read = start.elapsed();
            let driver = match &mut driver {
                Some(driver) => driver,
                none => none.insert(Driver::new(self, &model, &scene, &options)?),
            };
            driver.prepare(self, &scene).map_err(|e| e.in_file(path))?;
            let start = Instant::now();
            let result = driver.moving.session.run_scene(&scene).map_err(|e| e.in_file(path))?;
            let frame = start.elapsed();
            write(&self.output.join(format!("{name}.npz")), model.network(), &result, self.logits)?;
            if let Some(path) = &self.animation {
                let subtitle = format!("{name}, {} of {}", done.len() + 1, scenes.len());
                let page = draw(model.network(), &scene, &result, &title(&self.model), &subtitle)?;
                let page = page.scaled(usize::from(self.width));
                let animation = match &mut animation {
                    Some(animation) => animation,
                    none => {
                        let size = [page.width, page.height];
                        none.insert(Animation::create(path, size, scenes.len(), self.rate)?)
                    }
                };
                animation.push(&page.fitted(animation.size()))?;
            }
            done.push(Done { name, digest: digest(&result), read, frame });
            bar.inc(1);
        }
        bar.finish_and_clear();
        if let Some(animation) = animation {
            animation.finish()?;
        }
        let rigs = driver.map_or((0, Duration::ZERO), |driver| (driver.moving.rigs, driver.moving.rig_time));
        self.print_sequence(&done, rigs);
        Ok(())
    }

    fn print_sequence(&self, done: &[Done], (rigs, rig_time): (usize, Duration)) {
        let latency = Latency::of(done.iter().map(|done| done.frame));
        let read = Latency::of(done.iter().map(|done| done.read));
        let all: String = done.iter().map(|done| done.digest.as_str()).collect();
        let all = format!("{:016x}", voxcast::digest::bytes(all.as_bytes()));
        if self.json {
            let scenes: Vec<_> = done
                .iter()
                .map(|done| {
                    serde_json::json!({
                        "scene": done.name,
                        "digest": done.digest,
                        "read_seconds": done.read.as_secs_f64(),
                        "frame_seconds": done.frame.as_secs_f64(),
                    })
                })
                .collect();
            let value = serde_json::json!({
                "digest": all,
                "scenes": scenes,
                "rigs": rigs,
                "seconds": { "frame": latency.json(), "read": read.json(), "rigs": rig_time.as_secs_f64() },
            });
            println!("{value}");
            return;
        }
        println!("{} scenes with one session, digest {all}", done.len());
        println!("frame {latency}");
        println!("reading a scene {read}");
        println!("rigs: {rigs}, in {}", terminal::time(rig_time));
    }
}

/// One session for all scenes.
struct Driver {
    moving: Moving,
    masked: BTreeSet<usize>,
}

impl Driver {
    fn new(run: &Run, model: &Arc<Model>, scene: &Scene, options: &SessionOptions) -> Result<Self> {
        let rig = run.rig.as_deref().map(|path| Rig::open(path, model.network(), scene.cameras())).transpose()?;
        Ok(Self { moving: Moving::new(model, rig, scene, options)?, masked: BTreeSet::new() })
    }

    /// Makes the session ready for a scene: builds the matrices anew where its cameras have moved, and masks those that
    /// the user names.
    fn prepare(&mut self, run: &Run, scene: &Scene) -> Result<()> {
        if run.rig.is_some() && !self.moving.fits(scene) {
            let message = "another calibration than the first scene, and --rig is of one; leave --rig out";
            return Err(Error::mismatch(message));
        }
        self.moving.calibrate(scene)?;
        let masked = masked(&run.mask, scene)?;
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
    fn names_are_told_apart() {
        let dir = tempfile::tempdir().unwrap();
        let paths = ["153.612", "153.664", "a.safetensors"].map(|name| dir.path().join(name));
        paths[..2].iter().for_each(|path| std::fs::create_dir(path).unwrap());
        assert_eq!(names(&paths).unwrap(), ["153.612", "153.664", "a"]);
        let twice = [dir.path().join("153.612"), dir.path().join("153.612.safetensors")];
        assert!(names(&twice).unwrap_err().message().contains("called 153.612.npz"));
    }

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

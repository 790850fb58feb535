//! `voxcast run`

use super::dump::Dump;
use super::terminal::tell;
use super::view::name_of;
use super::{Machine, frame, terminal};
use clap::{ArgGroup, Args};
use std::borrow::Cow;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use voxcast::html::Page;
use voxcast::npz::{Array, Elements, write_npz};
use voxcast::picture::{self, Figure, Palette};
use voxcast::session::{Confidence, Occupancy, views};
use voxcast::{Error, Network, Note, Result, Scene};

/// Run a model on a scene, a drive or a robot log and write the class of every voxel.
///
/// A directory of scenes, such as a drive that `voxcast synth --frames` draws, is run with one session, in the order of names.
/// Latencies are those of all scenes but the first, which stands apart: it also waits for the model's pages. A log (.mcap)
/// of Foxglove's messages or a ROS 2 bag is run likewise, frame by frame; with -o OUT.mcap results become a log.
#[derive(Args, Debug)]
#[command(group(ArgGroup::new("pictures").multiple(true)), after_help = "\
Examples:
  voxcast run --model model.safetensors scene/ -o out.npz
  voxcast run --model model.safetensors --rig rig.safetensors scene/ -o out.npz --logits --png out.png
  voxcast run --model model.safetensors scene/ -o out.npz --html out.html
  voxcast run --model model.safetensors scene/ -o out.npz --confidence --html out.html
  voxcast run --model model.safetensors scene/ -o out.npz --mask CAM_BACK,2
  voxcast run --model model.safetensors drive/ -o out/ --animation drive.png
  voxcast run --model model.safetensors drive/ -o out.mcap          # opens in Foxglove, Rerun and PlotJuggler
  voxcast run --model model.safetensors log.mcap -o out.mcap
  voxcast run --model model.safetensors bag.mcap -o out/ --frame base_link --camera front=/front/image_raw
  voxcast run --model model.safetensors scene/ -o out.npz --dump stages/ --stages level1.volume,logits.lvl0

In Python: numpy.load('out.npz')['classes'] is u8 [X, Y, Z], and ['support'] u16 [X, Y, Z] says by how many feature
pixels each voxel is seen: where it is 0, no camera sees the place, and its class is a guess. Pictures hatch such places.
With --confidence, ['confidence_occupied'] / 255 is the probability that a voxel is occupied, ['confidence_class'] / 255 that of
its class, by a softmax with the temperature that `calibrate-confidence` has fitted, if any.
['bounds'] f32 [3, 2] are the grid's metres, ['colours'] u8 [K, 3] those of the classes in pictures.
Without --rig the matrices are built from the scene's calibration before the frame. A rig that was made from another
calibration is an error, unless --any-rig is given; one that does not say from which, as those of other programs, is used,
and a note says so. Notes go to standard error and change nothing: what in the scene's files is not obeyed, and cameras
that see too little of the grid (all together less than 10 % of the voxels, or one less than 2 %).
In logs, cameras are found by their topics, images are joined to frames by their stamps, transforms are chained at the
images' times, distorted images are straightened, and a camera without an image is masked.
The digest is the XXH3-64 of the classes; it is the same on any number of threads and any instruction set.")]
pub struct Run {
    /// The model
    #[arg(long)]
    pub(super) model: PathBuf,
    /// The scene's matrices: made by `voxcast rig`, or plain CSR of another program
    #[arg(long)]
    pub(super) rig: Option<PathBuf>,
    /// Use that rig even if it was made from another calibration than the scene's
    #[arg(long, requires = "rig")]
    pub(super) any_rig: bool,
    /// A scene directory or .safetensors, a directory of those, or a robot log (.mcap)
    pub(super) scene: PathBuf,
    /// The .npz to write, of a sequence or log the directory for one per frame, or a log (.mcap). A .npz holds `classes` u8 and `support` u16, both [X, Y, Z], `bounds` and `colours`
    #[arg(short, long, value_name = "OUT")]
    pub(super) output: PathBuf,
    /// Also write `logits` f32 [X, Y, Z, K]
    #[arg(long)]
    pub(super) logits: bool,
    /// Also write how sure the network is: `confidence_occupied` and `confidence_class`, u8 [X, Y, Z], 0 to 255 for
    /// probabilities from 0 to 1. Pages get a slider, logs two fields
    #[arg(long)]
    pub(super) confidence: bool,
    /// In pictures, leave out voxels that are occupied with a lower probability than P, 0 to 1
    #[arg(long, value_name = "P", value_parser = probability, requires = "pictures")]
    pub(super) hide_below: Option<f32>,
    /// Draw images, bird's-eye view and voxels
    #[arg(long, value_name = "FILE", group = "pictures")]
    pub(super) png: Option<PathBuf>,
    /// Write a page to look at in a browser: voxels to turn, and the images with the voxels on them
    #[arg(long, value_name = "FILE")]
    pub(super) html: Option<PathBuf>,
    /// Of a sequence: draw images, map and voxels of every scene as one animated PNG
    #[arg(long, value_name = "FILE.png", group = "pictures")]
    pub(super) animation: Option<PathBuf>,
    /// Pictures of the animation per second
    #[arg(long, value_name = "N", default_value_t = 4, requires = "animation", value_parser = clap::value_parser!(u16).range(1..=50))]
    pub(super) rate: u16,
    /// Width of the animation in pixels
    #[arg(long, value_name = "PIXELS", default_value_t = 960, requires = "animation",
        value_parser = clap::value_parser!(u16).range(160..=2400))]
    pub(super) width: u16,
    /// Of a log: a camera and the topic of its images, as often as there are cameras, in the order of the network's training
    /// [default: all topics with images]
    #[arg(long, value_name = "NAME=TOPIC", value_parser = camera)]
    pub(super) camera: Vec<(String, String)>,
    /// Of a log: the frame of reference in which the network sees [default: a lidar's]
    #[arg(long, value_name = "NAME")]
    pub(super) frame: Option<String>,
    /// Of a log: by how much later than its first image the others of a frame may be, less than a camera's period
    /// [default: 50]
    #[arg(long, value_name = "MILLISECONDS", value_parser = clap::value_parser!(u32).range(0..=10_000))]
    pub(super) tolerance: Option<u32>,
    /// Leave cameras out, by name or number from 0, separated by commas: as if the rig had them not
    #[arg(long, value_name = "CAMERAS", value_delimiter = ',')]
    pub(super) mask: Vec<String>,
    /// Write stages of the network to DIR/stages.safetensors, channels first
    #[arg(long, value_name = "DIR")]
    pub(super) dump: Option<PathBuf>,
    /// Stages or operations to dump, separated by commas; for those that the projection fold removes, the network runs
    /// without it [default: every stage]
    #[arg(long, value_name = "NAMES", requires = "dump")]
    stages: Option<String>,
    /// Run without the projection fold, which rounds differently
    #[arg(long)]
    pub(super) unfolded: bool,
    /// Print the summary as JSON
    #[arg(long)]
    pub(super) json: bool,
    #[command(flatten)]
    pub(super) machine: Machine,
}

/// A number from 0 to 1.
fn probability(text: &str) -> std::result::Result<f32, String> {
    let value: Option<f32> = text.parse().ok().filter(|value| (0.0..=1.0).contains(value));
    value.ok_or_else(|| "expected a number from 0 to 1".to_owned())
}

/// `NAME=TOPIC`.
fn camera(text: &str) -> std::result::Result<(String, String), String> {
    let parts = text.split_once('=').filter(|(name, topic)| !name.is_empty() && !topic.is_empty());
    let (name, topic) = parts.ok_or("expected NAME=TOPIC, such as front=/front/image_raw")?;
    Ok((name.to_owned(), topic.to_owned()))
}

impl Run {
    /// Runs one scene.
    pub(super) fn run_scene(self) -> Result<()> {
        if self.animation.is_some() {
            let message = "--animation needs a directory of scenes, and this is one scene";
            return Err(Error::mismatch(message).in_file(&self.scene));
        }
        let start = Instant::now();
        self.check_outputs(Some(&self.output))?;
        let (model, scene, mut notes) = frame::open(&self.model, &self.scene)?;
        let mut dump = self.dump.as_ref().map(|_| Dump::new(self.stages.as_deref(), model.network())).transpose()?;
        let mut options = frame::options(&self.machine)?;
        options.logits = self.logits;
        options.confidence = self.wants_confidence();
        options.unfolded = self.unfolded || dump.as_ref().is_some_and(|d| d.needs_unfolded(model.network()));
        options.coarse_heads = dump.as_ref().is_some_and(Dump::needs_coarse_heads);
        options.logits |= dump.as_ref().is_some_and(|d| d.wants("logits.lvl0"));
        let loaded = start.elapsed();

        let start = Instant::now();
        let (rig, of_rig) = frame::rig(self.rig_file(), &model, &scene, &options)?;
        let rig_time = start.elapsed();
        let rig = Arc::new(rig);
        notes.extend(of_rig);
        terminal::say(&notes);
        let mut session = frame::session(&model, rig.clone(), &options)?;

        let masked = masked(&self.mask, &scene).map_err(|e| e.in_file(&self.scene))?;
        for &camera in &masked {
            session.set_masked(camera, true)?;
        }

        let graph = session.graph().clone();
        let total = graph.camera_operations * (scene.cameras() - masked.len()) + graph.operations.len()
            - graph.camera_operations;
        let bar = terminal::progress("running", total);
        let start = Instant::now();
        let mut dumping = Duration::ZERO;
        let result = session.run_observed(&views(&scene), &mut |event| {
            bar.inc(1);
            if let Some(dump) = &mut dump {
                let start = Instant::now();
                dump.observe(&graph, &event);
                dumping += start.elapsed();
            }
        })?;
        let frame_time = start.elapsed() - dumping;
        bar.finish_and_clear();

        let network = model.network();
        write(&self.output, network, &result, self.logits)?;
        if let Some(path) = &self.png {
            draw(network, &scene, &result, &title(&self.model), "", self.hide_below)?.write_png(path)?;
        }
        if let Some(path) = &self.html {
            let page = name_of(&self.output);
            write_page(path, network, &result, Some(&scene), None, [&page, &title(&self.model)])?;
        }
        if let (Some(dump), Some(directory)) = (dump, &self.dump) {
            dump.finish(directory, &rig, result.grid, result.classes)?;
        }
        let summary = Summary { loaded, rig_time, mapped: self.rig.is_some(), frame_time, notes };
        summary.print(network, &result, self.json)
    }

    /// Whether it is asked how sure the network is.
    pub(super) fn wants_confidence(&self) -> bool {
        self.confidence || self.hide_below.is_some()
    }

    /// Refuses files to write that cannot be written, or that are read or written under another name.
    /// `output` is what `--output` names, if that is a file.
    pub(super) fn check_outputs(&self, output: Option<&PathBuf>) -> Result<()> {
        let named = frame::named;
        let inputs =
            [named("--model", Some(&self.model)), named("--rig", self.rig.as_ref()), named("SCENE", Some(&self.scene))];
        let outputs = [
            named("--output", output),
            named("--png", self.png.as_ref()),
            named("--html", self.html.as_ref()),
            named("--animation", self.animation.as_ref()),
        ];
        frame::check_outputs(inputs.into_iter().flatten(), outputs.into_iter().flatten())
    }

    pub(super) fn rig_file(&self) -> frame::RigFile<'_> {
        frame::RigFile { path: self.rig.as_deref(), any: self.any_rig }
    }
}

/// The share of the voxels that a camera sees, masked ones left out.
pub fn seen(result: &Occupancy<'_>) -> f64 {
    let seen = result.support.iter().filter(|&&pixels| pixels != 0).count();
    seen as f64 / result.support.len().max(1) as f64
}

/// The cameras that `names` are, each once.
pub fn masked(names: &[String], scene: &Scene) -> Result<BTreeSet<usize>> {
    let find = |name: &String| {
        let number = || name.parse().ok().filter(|&camera| camera < scene.cameras());
        scene.names.iter().position(|n| n == name).or_else(number).ok_or_else(|| {
            let known = scene.names.join(", ");
            Error::mismatch(format!("--mask names camera {name:?}, the scene has {known}"))
        })
    };
    names.iter().map(find).collect()
}

/// A model's file name without its ending.
pub fn title(model: &Path) -> String {
    model.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

/// Writes the result as a `.npz`.
pub fn write(path: &Path, network: &Network, result: &Occupancy<'_>, logits: bool) -> Result<()> {
    let [x, y, z] = result.grid.size;
    let shape = [x, y, z, network.classes];
    let colours: Vec<u8> = Palette::of(network.classes).classes().iter().flat_map(|c| c.rgb).collect();
    let table = [network.classes, 3];
    let colours = Array { name: "colours", shape: &table, elements: Elements::U8(&colours) };
    let mut arrays = vec![Array { name: "classes", shape: &shape[..3], elements: Elements::U8(result.classes) }];
    if let Some(values) = result.logits.filter(|_| logits) {
        arrays.push(Array { name: "logits", shape: &shape, elements: Elements::F32(values) });
    }
    if let Some(Confidence { occupied, class }) = result.confidence {
        let array = |name, codes| Array { name, shape: &shape[..3], elements: Elements::U8(codes) };
        arrays.extend([array("confidence_occupied", occupied), array("confidence_class", class)]);
    }
    arrays.push(Array { name: "support", shape: &shape[..3], elements: Elements::U16(result.support) });
    arrays.push(Array { name: "bounds", shape: &[3, 2], elements: Elements::F32(result.grid.bounds.as_flattened()) });
    arrays.push(colours);
    write_npz(path, &arrays)
}

/// Writes a result, and the truth if there is one, as a page with a title and a subtitle.
pub fn write_page(
    path: &Path,
    network: &Network,
    result: &Occupancy<'_>,
    scene: Option<&Scene>,
    truth: Option<&[u8]>,
    [title, subtitle]: [&str; 2],
) -> Result<()> {
    let palette = Palette::of(network.classes);
    let mut prediction = picture::Occupancy::new("", result.classes, result.grid, result.grid.forward())?
        .with_support(result.support)?;
    if let Some(confidence) = result.confidence {
        prediction = prediction.with_confidence(confidence.occupied)?;
    }
    Page { title, subtitle, prediction, truth, scene, palette: &palette }.write(path)
}

/// The picture of a result, without the voxels that are occupied with a lower probability than `hide_below`, if the result says
/// how sure it is.
pub fn draw(
    network: &Network,
    scene: &Scene,
    result: &Occupancy<'_>,
    title: &str,
    subtitle: &str,
    hide_below: Option<f32>,
) -> Result<picture::Picture> {
    let palette = Palette::of(network.classes);
    let classes = match result.confidence.zip(hide_below) {
        None => Cow::Borrowed(result.classes),
        Some((confidence, least)) => {
            let drawn = |(&class, &code): (&u8, &u8)| if f32::from(code) < 255.0 * least { 0 } else { class };
            Cow::Owned(result.classes.iter().zip(confidence.occupied).map(drawn).collect())
        }
    };
    let occupancy =
        picture::Occupancy::new("", &classes, result.grid, result.grid.forward())?.with_support(result.support)?;
    let images: Vec<_> = scene.names.iter().map(String::as_str).zip(&scene.images).collect();
    Ok(picture::draw(&Figure { title, subtitle, images: &images, occupancies: &[occupancy], palette: &palette }))
}

struct Summary {
    loaded: Duration,
    rig_time: Duration,
    mapped: bool,
    frame_time: Duration,
    notes: Vec<Note>,
}

impl Summary {
    fn print(&self, network: &Network, result: &Occupancy<'_>, json: bool) -> Result<()> {
        let mut counts = vec![0usize; network.classes];
        result.classes.iter().for_each(|&class| counts[usize::from(class)] += 1);
        let digest = digest(result);
        let logits = result.logits_digest().map(|d| format!("{d:016x}"));
        if json {
            let value = serde_json::json!({
                "grid": result.grid.size,
                "counts": counts,
                "digest": digest,
                "logits_digest": logits,
                "seen": seen(result),
                "notes": self.notes.iter().map(ToString::to_string).collect::<Vec<_>>(),
                "seconds": {
                    "load": self.loaded.as_secs_f64(),
                    "rig": self.rig_time.as_secs_f64(),
                    "frame": self.frame_time.as_secs_f64(),
                },
            });
            return tell!("{value}");
        }
        let [x, y, z] = result.grid.size;
        let occupied = result.classes.len() - counts[0];
        tell!(
            "{x}x{y}x{z} voxels, {occupied} occupied ({}), digest {digest}",
            terminal::percent(occupied as f64 / result.classes.len() as f64)
        )?;
        tell!("cameras see {} of the voxels", terminal::percent(seen(result)))?;
        if let Some(logits) = logits {
            tell!("logits digest {logits}")?;
        }
        tell!(
            "load {}, {} rig {}, frame {}",
            terminal::time(self.loaded),
            if self.mapped { "map" } else { "build" },
            terminal::time(self.rig_time),
            terminal::time(self.frame_time)
        )
    }
}

/// XXH3-64 of the classes, by which two results are compared at a glance.
pub fn digest(result: &Occupancy<'_>) -> String {
    format!("{:016x}", result.digest())
}

//! `voxcast demo`

use super::frame::{self, RigFile};
use super::terminal::tell;
use super::{Machine, run, terminal};
use clap::Args;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use voxcast::eval::Confusion;
use voxcast::graph::Rewrites;
use voxcast::import::{Integers, import, import_int8};
use voxcast::model::Options;
use voxcast::model::ranges::Ranges;
use voxcast::model::unpacked::Unpacked;
use voxcast::network::Grid;
use voxcast::picture::{self, Figure, Palette};
use voxcast::session::{Occupancy, views};
use voxcast::synth::{CLASSES, Frame, Synthesiser};
use voxcast::weights::Precision;
use voxcast::{Error, Model, Network, Result, SessionOptions};

/// The trained network that ships (`docs/model-card.md`), as a part of the program.
#[cfg(feature = "shipped")]
fn edge() -> Result<&'static [u8]> {
    Ok(include_bytes!("../../assets/edge.safetensors"))
}

/// Says that it is not a part of the program.
#[cfg(not(feature = "shipped"))]
fn edge() -> Result<&'static [u8]> {
    let message = "this program was built without the network that ships (feature `shipped`): give a model with --model FILE, \
                   for instance assets/edge.safetensors of the source";
    Err(Error::new(voxcast::ErrorKind::Unsupported, message))
}

/// The ranges of its tensors, measured on drawn streets (`docs/int8.md`).
static EDGE_RANGES: &str = include_str!("../../assets/edge.ranges.json");

/// Draw a street, run the network that ships with the program on it, and show what it made of it beside the truth.
///
/// The network was trained on drawn streets like this one, none of which it is shown here. It has never seen a photograph
/// and is not for driving.
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  voxcast demo -o demo-out
  voxcast demo -o demo-out --seed 1000007              (another street)
  voxcast demo -o demo-out --precision f32             (in floating point: slower, and hardly another result)
  voxcast demo -o demo-out --threads 1                 (the same digest as with any other number of threads)
  voxcast demo -o demo-out --threads 1 --isa scalar    (the same digest again)
  voxcast demo -o demo-out --model model.safetensors   (another network)

It writes the scene with its labels, the model unless one is given, the rig, occupancy.npz, occupancy.png and demo.html, a
page to look at in a browser: prediction, truth and difference as voxels to turn.")]
pub struct Demo {
    /// Directory for scene/, model, rig, occupancy, picture and page
    #[arg(short, long, value_name = "DIR", default_value = "voxcast-demo")]
    output: PathBuf,
    /// Precision of the network: f16 as it ships, or f32 or int8 made of that when the program starts
    #[arg(long, default_value = "int8", value_parser = ["f32", "f16", "int8", "i8"], hide_possible_values = true,
        value_name = "f32|f16|int8")]
    precision: String,
    /// A model to run, as it is, in place of the network that ships
    #[arg(long, value_name = "FILE", conflicts_with = "precision")]
    model: Option<PathBuf>,
    /// Which street is drawn; the network that ships was trained on 0 to 5434 and 7000000 to 7002599
    #[arg(long, default_value_t = 1_000_006)]
    seed: u64,
    #[command(flatten)]
    machine: Machine,
}

impl Demo {
    pub fn run(self) -> Result<()> {
        let shipped = if self.model.is_none() { Some(edge()?) } else { None };
        let directory = &self.output;
        frame::create_directory(directory)?;
        let options = frame::options(&self.machine)?;

        let path = self.model.clone().unwrap_or_else(|| directory.join("model.safetensors"));
        let outputs =
            ["rig.safetensors", "occupancy.npz", "occupancy.png", "demo.html"].map(|name| directory.join(name));
        frame::check_outputs([("--model", &path)], outputs.iter().map(|output| ("--output", output)))?;
        if let Some(edge) = shipped {
            write_model(edge, &path, Precision::parse(&self.precision).unwrap_or(Precision::I8), &options)?;
        }
        let model = Arc::new(Model::open(&path)?);
        let network = model.network();
        if network.classes != CLASSES.len() {
            let (found, expected) = (network.classes, CLASSES.len());
            let message = format!("a network of {found} classes, expected the {expected} of drawn streets");
            return Err(Error::mismatch(message).in_file(&path));
        }
        let start = Instant::now();
        let drawn = Synthesiser::new(network)?.frame(self.seed);
        drawn.save_scene(&directory.join("scene"), Grid::of(network))?;
        tell!("street of seed {} drawn in {}", self.seed, terminal::time(start.elapsed()))?;

        let start = Instant::now();
        let (rig, _) = frame::rig(RigFile::default(), &model, &drawn.scene, &options)?;
        let rig = Arc::new(rig);
        tell!("six matrices built in {}", terminal::time(start.elapsed()))?;
        rig.save(&directory.join("rig.safetensors"), network)?;

        let mut session = frame::session(&model, rig, &options)?;
        tell!("session of {} planned", terminal::bytes(session.taken().total()))?;
        // The first frame waits for the model's pages.
        session.run(&views(&drawn.scene))?;
        let (mut cameras, mut fusion) = (Duration::ZERO, Duration::ZERO);
        let start = Instant::now();
        let result = session.run_observed(&views(&drawn.scene), &mut |event| {
            *(if event.camera.is_some() { &mut cameras } else { &mut fusion }) += event.elapsed;
        })?;
        tell!(
            "frame of {} cameras in {} on {} threads with {} (backbone and pyramid {}, after the gather {}), digest {}",
            drawn.scene.cameras(),
            terminal::time(start.elapsed()),
            options.threads.count(),
            options.isa.name(),
            terminal::time(cameras),
            terminal::time(fusion),
            run::digest(&result)
        )?;
        let score = score(&drawn, &result);
        tell!("{score}")?;
        run::write(&directory.join("occupancy.npz"), network, &result, false)?;
        let street = self.street();
        draw(&directory.join("occupancy.png"), network, &drawn, &result, &format!("{street}: {score}"))?;
        let titles = ["voxcast demo", street];
        let page = directory.join("demo.html");
        run::write_page(&page, network, &result, Some(&drawn.scene), Some(&drawn.labels), titles)?;
        let d = directory.display();
        tell!(
            "see {d}/occupancy.png and {d}/demo.html; the same again: voxcast run --model {} {d}/scene -o out.npz",
            path.display()
        )?;
        Ok(())
    }

    /// What is known of the street.
    fn street(&self) -> &'static str {
        match self.model {
            None => "a street that the network was not trained on",
            Some(_) => "a drawn street",
        }
    }
}

/// Writes the network that ships in a precision.
fn write_model(edge: &'static [u8], path: &Path, precision: Precision, options: &SessionOptions) -> Result<()> {
    if precision == Precision::F16 {
        return voxcast::model::write_bytes(path, edge);
    }
    let shipped = Model::from_bytes(edge)?;
    let (source, network, rewrites) = (Unpacked::new(&shipped)?, shipped.network(), Rewrites::ALL);
    if precision == Precision::I8 {
        let ranges = Ranges::from_json(EDGE_RANGES, network)?;
        let integers = Integers { rewrites, ranges: &ranges, keep_f32: &[] };
        import_int8(&source, network, &integers, path, &mut |_, _| ())?;
    } else {
        import(&source, network, Options { precision, rewrites }, path, &mut |_, _| ())?;
    }
    voxcast::selftest::record(path, options.isa, &options.threads)
}

/// How much of this one street is right, of all voxels and of those that a camera sees.
fn score(drawn: &Frame, result: &Occupancy<'_>) -> String {
    let mut confusions = [Confusion::new(CLASSES.len()), Confusion::new(CLASSES.len())];
    for ((&truth, &class), &seen) in drawn.labels.iter().zip(result.classes).zip(&drawn.visible) {
        confusions[0].add(truth, class);
        if seen != 0 {
            confusions[1].add(truth, class);
        }
    }
    let percent = |value: Option<f64>| value.map_or_else(|| "-".to_owned(), |v| format!("{:.1}", 100.0 * v));
    let [all, seen] = confusions.map(|c| format!("IoU {}, mIoU {}", percent(c.iou()), percent(c.mean_iou())));
    format!("of all voxels {all}; of those that a camera sees {seen}")
}

/// The picture: images, prediction and truth.
fn draw(path: &Path, network: &Network, drawn: &Frame, result: &Occupancy<'_>, what: &str) -> Result<()> {
    let palette = Palette::of(network.classes);
    let grid = result.grid;
    let occupancy = |caption, classes| picture::Occupancy::new(caption, classes, grid, grid.forward());
    let occupancies =
        [occupancy("prediction", result.classes)?.with_support(result.support)?, occupancy("truth", &drawn.labels)?];
    let images: Vec<_> = drawn.scene.names.iter().map(String::as_str).zip(&drawn.scene.images).collect();
    let [height, width] = network.image;
    let cameras = match images.len() {
        6 => "six cameras".to_owned(),
        1 => "one camera".to_owned(),
        cameras => format!("{cameras} cameras"),
    };
    let subtitle = format!("{cameras} of {height} x {width} pixels, {what}");
    let figure = Figure {
        title: "voxcast demo",
        subtitle: &subtitle,
        images: &images,
        occupancies: &occupancies,
        palette: &palette,
    };
    picture::draw(&figure).write_png(path)
}

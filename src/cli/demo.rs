//! `voxcast demo`

use super::{Machine, frame, run, terminal};
use clap::Args;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;
use voxcast::demo::demo_scene;
use voxcast::import::import;
use voxcast::model::Options;
use voxcast::seeded::SeededWeights;
use voxcast::session::views;
use voxcast::{Error, Model, Network, Result, Session};

/// Run a small network with seeded, untrained weights on a drawn ring of cameras: the whole path, and the pictures.
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  voxcast demo -o demo-out
  voxcast demo -o demo-out --seed 7
  voxcast demo -o demo-out --threads 1                 (the same digest as with any other number of threads)
  voxcast demo -o demo-out --threads 1 --isa scalar    (the same digest again, after some minutes)

The classes mean nothing: nobody trained this network.")]
pub struct Demo {
    /// Directory for scene/, model, rig, occupancy and picture
    #[arg(short, long, value_name = "DIR", default_value = "voxcast-demo")]
    output: PathBuf,
    /// Which street is drawn and which weights are used
    #[arg(long, default_value_t = 3)]
    seed: u64,
    #[command(flatten)]
    machine: Machine,
}

impl Demo {
    pub fn run(self) -> Result<()> {
        let directory = &self.output;
        std::fs::create_dir_all(directory).map_err(|e| Error::io(directory, "create", &e))?;
        let options = frame::options(&self.machine)?;

        let start = Instant::now();
        let model_path = directory.join("model.safetensors");
        let weights = SeededWeights { seed: self.seed };
        import(&weights, &network(), Options::default(), &model_path, &mut |_, _| ())?;
        let model = Arc::new(Model::open(&model_path)?);
        let scene = demo_scene(model.network(), self.seed);
        scene.save(&directory.join("scene"))?;
        println!("model and scene made in {}", terminal::time(start.elapsed()));

        let start = Instant::now();
        let rig = Arc::new(frame::rig(None, &model, &scene, &options)?);
        println!("six matrices built in {}", terminal::time(start.elapsed()));
        rig.save(&directory.join("rig.safetensors"), model.network())?;

        let mut session = Session::new(model.clone(), rig, &options)?;
        println!("session of {} planned", terminal::bytes(session.taken().total()));
        let start = Instant::now();
        let result = session.run(&views(&scene))?;
        println!(
            "frame of {} cameras in {} on {} threads with {}, digest {}",
            scene.cameras(),
            terminal::time(start.elapsed()),
            options.threads.count(),
            options.isa.name(),
            run::digest(&result)
        );
        run::write(&directory.join("occupancy.npz"), model.network(), &result, false)?;
        let subtitle = format!("untrained network, seeded weights, drawn scene (seed {})", self.seed);
        let picture = run::draw(model.network(), &scene, &result, "voxcast demo", &subtitle)?;
        picture.write_png(&directory.join("occupancy.png"))?;
        let d = directory.display();
        println!(
            "see {d}/occupancy.png; the same again: voxcast run --model {d}/model.safetensors {d}/scene -o out.npz"
        );
        Ok(())
    }
}

/// Small enough to be made and run in a moment.
fn network() -> Network {
    let full = Network::built_in("nuscenes-200").expect("built in");
    Network {
        depths: [1, 1, 2, 1],
        width: 16,
        fpn: 64,
        channels: [16, 32, 48, 64],
        key_dims: [4, 6, 8],
        image: [128, 224],
        grids: [[100, 100, 8], [50, 50, 4], [25, 25, 2]],
        samples: [3, 3, 3],
        ..full
    }
}

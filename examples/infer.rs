//! A model and a scene to classes: `cargo run --release --example infer -- MODEL SCENE`.
#![allow(clippy::print_stdout, reason = "a program talks to its user")]

use std::path::PathBuf;
use std::sync::Arc;
use voxcast::rig::RigBuilder;
use voxcast::{Isa, Model, Scene, Session, SessionOptions, Threads};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let paths: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    let [model, scene] = &paths[..] else { return Err("usage: infer MODEL SCENE".into()) };
    let model = Arc::new(Model::open(model)?);
    let scene = Scene::open(scene)?;

    // Once: the six matrices, and all memory that frames need.
    let rig = RigBuilder::new(model.network(), scene.cameras(), Isa::best())?.build(&scene.lidar2img)?;
    let options = SessionOptions { threads: Threads::new(2)?, ..SessionOptions::default() };
    let mut session = Session::new(model, Arc::new(rig), &options)?;

    // Every frame. classes[(x * Y + y) * Z + z] is the class of voxel (x, y, z); 0 is empty.
    let occupancy = session.run_scene(&scene)?;
    let occupied = occupancy.classes.iter().filter(|&&class| class != 0).count();
    println!("{occupied} voxels of {:?} are occupied", occupancy.grid.size);
    Ok(())
}

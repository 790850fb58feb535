//! What commands share that run frames: model, scene, rig and session from files.

use super::{Machine, terminal};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use voxcast::camera::{Camera, read_calibration_with_notes};
use voxcast::rig::RigBuilder;
use voxcast::{Error, ErrorKind, Model, Network, Note, Result, Rig, Scene, Session, SessionOptions};

/// Names and matrices of the cameras.
pub type Cameras = (Vec<String>, Vec<[f32; 16]>);

/// The cameras of a calibration.json; what in it is not used is said.
pub fn cameras(path: &Path) -> Result<Vec<Camera>> {
    let text = std::fs::read_to_string(path).map_err(|e| Error::io(path, "read", &e))?;
    let (cameras, notes) = read_calibration_with_notes(&text).map_err(|e| e.in_file(path))?;
    terminal::say(&notes.into_iter().map(|note| note.in_file(path)).collect::<Vec<_>>());
    Ok(cameras)
}

/// Cameras of a scene directory, of its calibration.json alone, or of a scene file, whose images are of the size that
/// `network` takes.
pub fn calibration(path: &Path, network: &Network) -> Result<Cameras> {
    if path.extension().is_some_and(|e| e == "json") {
        let cameras = cameras(path)?;
        cameras.iter().try_for_each(|camera| camera.check(network)).map_err(|e| e.in_file(path))?;
        return Ok(cameras.into_iter().map(|c| (c.name, c.lidar2img)).unzip());
    }
    let (scene, notes) = read(path, network)?;
    terminal::say(&notes);
    Ok((scene.names, scene.lidar2img))
}

/// Refuses a place that cannot be written, before a long computation rather than after.
pub fn check_output(path: &Path) -> Result<()> {
    let directory = path.parent().filter(|d| !d.as_os_str().is_empty()).unwrap_or(Path::new("."));
    match std::fs::metadata(directory) {
        Ok(metadata) if metadata.is_dir() && !path.is_dir() => Ok(()),
        Ok(_) => Err(Error::new(ErrorKind::Io, "cannot write: not a regular file in a directory").in_file(path)),
        Err(e) => Err(Error::io(path, "write", &e)),
    }
}

/// Makes a directory, and those that it lies in, where they are not there.
pub fn create_directory(path: &Path) -> Result<()> {
    if path.exists() && !path.is_dir() {
        return Err(Error::new(ErrorKind::Io, "cannot create: a file is there, expected a directory").in_file(path));
    }
    std::fs::create_dir_all(path).map_err(|e| Error::io(path, "create", &e))
}

/// Refuses outputs that cannot be written, as [`check_output`] does, and one in the place of another or of an input, of which the
/// last would be left. Each has the name by which the command line knows it.
pub fn check_outputs<'a, P: AsRef<Path> + 'a>(
    inputs: impl IntoIterator<Item = (&'a str, P)>,
    outputs: impl IntoIterator<Item = (&'a str, P)>,
) -> Result<()> {
    let place = |path: &Path| {
        let place = std::path::absolute(path).map_err(|e| Error::io(path, "find", &e))?;
        Ok(std::fs::canonicalize(&place).unwrap_or(place))
    };
    let mut taken = Vec::new();
    for (name, path) in inputs {
        taken.push((name, place(path.as_ref())?));
    }
    for (name, path) in outputs {
        let path = path.as_ref();
        check_output(path)?;
        let place = place(path)?;
        if let Some((other, _)) = taken.iter().find(|(_, other)| *other == place) {
            return Err(Error::mismatch(format!("{other} and {name} name the same file")).in_file(path));
        }
        taken.push((name, place));
    }
    Ok(())
}

/// An argument that may be missing, for [`check_outputs`].
pub fn named<'a>(name: &'a str, path: Option<&'a PathBuf>) -> Option<(&'a str, &'a Path)> {
    path.map(|path| (name, path.as_path()))
}

/// Which rig a command uses.
#[derive(Clone, Copy, Debug, Default)]
pub struct RigFile<'a> {
    /// Its file; none where it is built from the scene's calibration.
    pub path: Option<&'a Path>,
    /// Whether it may be of another calibration.
    pub any: bool,
}

/// The rig from its file, or built from the scene's calibration, and what is to be said of it.
pub fn rig(file: RigFile<'_>, model: &Model, scene: &Scene, options: &SessionOptions) -> Result<(Rig, Vec<Note>)> {
    let rig = open_rig(file.path, model, scene, options)?;
    let mut notes = Vec::new();
    if let Some(path) = file.path {
        match rig.check_calibration(&scene.lidar2img) {
            Ok(true) => {}
            Ok(false) => notes.push(Note::new("a rig that does not say of which calibration it is; used as it is")),
            Err(e) if file.any => notes.push(Note::new(format!("{}; used because of --any-rig", e.message()))),
            Err(e) => {
                let hint = "leave --rig out to build the scene's own, or use this one with --any-rig";
                return Err(Error::new(e.kind(), format!("{}; {hint}", e.message())).in_file(path));
            }
        }
        notes.iter_mut().for_each(|note| *note = note.clone().in_file(path));
    }
    notes.extend(implausible(&rig, model.network(), &scene.names));
    Ok((rig, notes))
}

/// What is to be said of a rig whose cameras see too little.
pub fn implausible(rig: &Rig, network: &Network, names: &[String]) -> Vec<Note> {
    rig.visibility(network).notes(names)
}

fn open_rig(path: Option<&Path>, model: &Model, scene: &Scene, options: &SessionOptions) -> Result<Rig> {
    match path {
        Some(path) => Rig::open(path, model.network(), scene.cameras()),
        None => {
            let built = RigBuilder::new(model.network(), scene.cameras(), options.isa)
                .and_then(|builder| builder.with_threads(options.threads.clone()).build(&scene.lidar2img));
            built.map_err(|e| in_model(e, model))
        }
    }
}

/// A session of `model`; what it cannot do is the model's doing.
pub fn session(model: &Arc<Model>, rig: Arc<Rig>, options: &SessionOptions) -> Result<Session> {
    Session::new(model.clone(), rig, options).map_err(|e| in_model(e, model))
}

/// The error, said of the model's file.
fn in_model(error: Error, model: &Model) -> Error {
    match model.path() {
        Some(path) => error.in_file(path),
        None => error,
    }
}

/// Opens model and scene, checks that they belong together, and notes what is not obeyed or does not look right.
pub fn open(model: &Path, scene: &Path) -> Result<(Arc<Model>, Scene, Vec<Note>)> {
    let model = Arc::new(Model::open(model)?);
    let (loaded, notes) = read(scene, model.network())?;
    Ok((model, loaded, notes))
}

/// The scene for a network, and what is to be said of it.
pub fn read(path: &Path, network: &Network) -> Result<(Scene, Vec<Note>)> {
    let (scene, mut notes) = Scene::open_with_notes(path)?;
    scene.check(network).map_err(|e| e.in_file(path))?;
    let (cameras, expected) = (scene.cameras(), network.cameras);
    if cameras != expected {
        let message = format!("its number of cameras is {cameras}, the network was trained for {expected}");
        notes.push(Note::new(message).in_file(path));
    }
    Ok((scene, notes))
}

/// Session options that the machine arguments ask for.
pub fn options(machine: &Machine) -> Result<SessionOptions> {
    Ok(SessionOptions { isa: machine.isa()?, threads: machine.threads()?, ..SessionOptions::default() })
}

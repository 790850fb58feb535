//! What commands share that run frames: model, scene, rig and session from files.

use super::Machine;
use std::path::Path;
use std::sync::Arc;
use voxcast::rig::RigBuilder;
use voxcast::{Error, ErrorKind, Model, Result, Rig, Scene, Session, SessionOptions};

/// Calibration of a scene directory, of its calibration.json alone, or of a scene file.
pub fn calibration(path: &Path) -> Result<Vec<[f32; 16]>> {
    if path.extension().is_some_and(|e| e == "json") {
        let text = std::fs::read_to_string(path).map_err(|e| Error::io(path, "read", &e))?;
        let cameras = voxcast::camera::read_calibration(&text).map_err(|e| e.in_file(path))?;
        return Ok(cameras.into_iter().map(|c| c.lidar2img).collect());
    }
    Ok(Scene::open(path)?.lidar2img)
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

/// The rig from its file, or built from the scene's calibration.
pub fn rig(path: Option<&Path>, model: &Model, scene: &Scene, options: &SessionOptions) -> Result<Rig> {
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

/// Opens model and scene, and checks that they belong together.
pub fn open(model: &Path, scene: &Path) -> Result<(Arc<Model>, Scene)> {
    let model = Arc::new(Model::open(model)?);
    let loaded = Scene::open(scene)?;
    loaded.check(model.network()).map_err(|e| e.in_file(scene))?;
    Ok((model, loaded))
}

/// Session options that the machine arguments ask for.
pub fn options(machine: &Machine) -> Result<SessionOptions> {
    Ok(SessionOptions { isa: machine.isa()?, threads: machine.threads()?, ..SessionOptions::default() })
}

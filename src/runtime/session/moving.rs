//! A session for cameras that move.

use super::{Session, SessionOptions};
use crate::base::error::{Error, Result};
use crate::model::Model;
use crate::rig::{Rig, RigBuilder};
use crate::scene::Scene;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// A session for scenes whose cameras may stand elsewhere from one to the next: frames of a data set, a drive.
pub struct Moving {
    /// The session, with the rig of the scene that was prepared last.
    pub session: Session,
    builder: RigBuilder,
    calibration: Vec<[f32; 16]>,
    /// How many rigs it had, and how long building them took.
    pub rigs: usize,
    /// See `rigs`.
    pub rig_time: Duration,
}

impl std::fmt::Debug for Moving {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Moving").field("session", &self.session).field("rigs", &self.rigs).finish_non_exhaustive()
    }
}

impl Moving {
    /// A session with `rig`, which is that of the scene's cameras, or one that is built of them.
    ///
    /// # Errors
    /// Those of [`RigBuilder::build`] and [`Session::new`], said of the model's file.
    pub fn new(model: &Arc<Model>, rig: Option<Rig>, scene: &Scene, options: &SessionOptions) -> Result<Self> {
        let of_model = |e: Error| match model.path() {
            Some(path) => e.in_file(path),
            None => e,
        };
        let builder = RigBuilder::new(model.network(), scene.cameras(), options.isa).map_err(of_model)?;
        let mut builder = builder.with_threads(options.threads.clone());
        let start = Instant::now();
        let rig = match rig {
            Some(rig) => rig,
            None => builder.build(&scene.lidar2img).map_err(of_model)?,
        };
        let rig_time = start.elapsed();
        let session = Session::new(model.clone(), Arc::new(rig), options).map_err(of_model)?;
        Ok(Self { session, builder, calibration: scene.lidar2img.clone(), rigs: 1, rig_time })
    }

    /// Whether the scene's cameras stand where those of the rig do.
    pub fn fits(&self, scene: &Scene) -> bool {
        self.calibration == scene.lidar2img
    }

    /// Refuses another number of cameras than the rig's.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) with both numbers.
    pub fn check_count(&self, scene: &Scene) -> Result<()> {
        if self.calibration.len() == scene.cameras() {
            return Ok(());
        }
        let (found, expected) = (scene.cameras(), self.calibration.len());
        Err(Error::mismatch(format!("{found} cameras, expected {expected} as in the scenes before")))
    }

    /// Builds the matrices anew if the scene's cameras have moved.
    ///
    /// # Errors
    /// Those of [`Moving::check_count`] and [`RigBuilder::build`].
    pub fn calibrate(&mut self, scene: &Scene) -> Result<()> {
        self.check_count(scene)?;
        if !self.fits(scene) {
            let start = Instant::now();
            let rig: Rig = self.builder.build(&scene.lidar2img)?;
            self.session.set_rig(Arc::new(rig))?;
            self.calibration.clone_from(&scene.lidar2img);
            self.rigs += 1;
            self.rig_time += start.elapsed();
        }
        Ok(())
    }
}

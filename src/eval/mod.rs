//! Evaluation: how well a prediction agrees with the labels of a data set.
//!
//! A [`Scorer`] compares one frame's prediction with its truth and gives a [`Score`], which is counts; scores
//! add up, and the ratios of the sum are those of the whole set, not means of frames. All but the losses are integers, so
//! that their total does not depend on the order of the frames; losses are to be added in the order of the set.
//!
//! Truth is never changed to suit a network. Where its voxels are not the network's, each labelled voxel is compared with
//! the predicted voxel that contains its centre; where there is none, the network has said nothing, and it counts as
//! predicted empty. Networks predict in the lidar frame; labels with other axes are led there by [`Truth::grid_to_lidar`].
//!
//! An [`Evaluation`] does all of that over a set, on several threads; a [`Journal`] keeps it from stop to stop, and
//! [`Summary::merge`] puts the journals of many machines together.

mod comparison;
mod confusion;
pub mod dataset;
mod evaluation;
mod journal;
pub mod losses;
mod majority;
pub mod ray_iou;
pub mod reliability;
mod report;
mod subject;
mod submission;
mod summary;
mod table;
mod temperature;
mod totals;

pub use comparison::Comparison;
pub use confusion::Confusion;
pub use dataset::Published;
pub use evaluation::{Evaluation, Means, Predictor, Says, Worker};
pub use journal::{Entry, Header, Journal, JournalReader};
pub use majority::majority;
pub use report::Report;
pub use subject::{Scope, Shard, Subject};
pub use submission::{ABOUT, write_submission};
pub use summary::Summary;
pub use temperature::{Fit, fit_temperature};
pub use totals::{FrameScore, Totals};

use crate::base::error::{Error, Result};
use crate::eval::dataset::{Axes, Grid, IGNORED, OTHERS, Pose, Truth, is_class};
use crate::file::replace::replace_file;
use crate::runtime::session::Confidence;
use losses::{Losses, losses};
use ray_iou::{RayCounts, count_rays};
use reliability::Calibration;
use std::borrow::Cow;
use std::io::Write;
use std::path::Path;

/// What a network or a rule says about a frame.
#[derive(Clone, Copy, Debug)]
pub struct Prediction<'a> {
    /// Class of each voxel, `[x, y, z]`, z fastest.
    pub classes: &'a [u8],
    /// By how many feature pixels each voxel is seen ([`Occupancy::support`](crate::Occupancy::support)), where the
    /// prediction comes from images.
    pub support: Option<&'a [u16]>,
    /// Logits `[x, y, z, classes]`, if the losses are to be known. Truth must then have the prediction's grid.
    pub logits: Option<&'a [f32]>,
    /// How sure the network is of each voxel, if its calibration is to be known.
    pub confidence: Option<Confidence<'a>>,
}

/// What to score.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Ends of the distance rings in metres, ascending. Beyond the last there is one more ring.
    pub rings: Vec<f64>,
}

impl Default for Options {
    fn default() -> Self {
        Self { rings: vec![20.0, 35.0, 50.0] }
    }
}

/// Compares predictions with truth, frame by frame.
#[derive(Clone, Debug)]
pub struct Scorer {
    classes: usize,
    truth: Grid,
    prediction: Grid,
    masks: usize,
    /// Ends of the rings in metres.
    ends: Vec<f64>,
    directions: Vec<[f64; 3]>,
    /// Ring of each column (x, y) of the truth, if its axes are the lidar's.
    ring_of: Vec<u8>,
    correspondence: Correspondence,
    published: Option<Published>,
}

/// How voxels of the truth are found in the prediction.
#[derive(Clone, Debug)]
enum Correspondence {
    /// The two grids are one.
    Same,
    /// For each axis and index of the truth, the index in the prediction.
    Indices([Vec<Option<usize>>; 3]),
    /// By the pose of each frame, from the truth's axes to the lidar's.
    Posed,
}

impl Scorer {
    /// For truth of `classes` classes with `masks` masks in the voxels of `truth`, and predictions in those of
    /// `prediction`.
    ///
    /// # Errors
    /// [`ErrorKind::Format`](crate::ErrorKind::Format) for rings that are not ascending, positive and fewer than 255;
    /// [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) for a prediction with axes of the ego vehicle where the truth has
    /// not.
    pub fn new(classes: usize, masks: usize, truth: Grid, prediction: Grid, options: &Options) -> Result<Self> {
        let rings = &options.rings;
        let ascending = rings.windows(2).all(|pair| pair[0] < pair[1]);
        if rings.len() > 254 || !ascending || !rings.iter().all(|&r| r > 0.0 && r.is_finite()) {
            return Err(Error::format(format!("rings {rings:?}, expected ascending metres, at most 254")));
        }
        let [nx, ny, _] = truth.size;
        let mut ring_of = Vec::with_capacity(nx * ny);
        for x in 0..nx {
            for y in 0..ny {
                ring_of.push(ring(rings, truth.centre(0, x), truth.centre(1, y)) as u8);
            }
        }
        let correspondence = match (truth.axes, prediction.axes) {
            _ if truth == prediction => Correspondence::Same,
            (Axes::Ego, Axes::Lidar) => Correspondence::Posed,
            (Axes::Lidar, Axes::Ego) => {
                let message =
                    "a prediction with axes of the ego vehicle, expected those of the lidar, as the labels have";
                return Err(Error::mismatch(message));
            }
            _ => Correspondence::Indices([0, 1, 2].map(|axis| nearest(&truth, &prediction, axis))),
        };
        let (ends, directions) = (rings.clone(), ray_iou::directions());
        let published = None;
        Ok(Self { classes, truth, prediction, masks, ends, directions, ring_of, correspondence, published })
    }

    /// The same scorer, which also counts as the set's own evaluation does, if that is defined for the two grids.
    #[must_use]
    pub fn with_published(self, published: Option<Published>) -> Self {
        let published = published.filter(|published| published.applies(&self.truth, &self.prediction));
        Self { published, ..self }
    }

    /// How the set's own evaluation is counted, if it is.
    pub fn published(&self) -> Option<Published> {
        self.published
    }

    /// Names of the regions that scores are told apart by: "all" voxels, those of each mask, and those that the rig
    /// supports, which are seen by at least one feature pixel. Without a rig, nothing is supported.
    pub fn regions<'a>(masks: &[&'a str]) -> Vec<&'a str> {
        [&["all"], masks, &["supported"]].concat()
    }

    /// Scores a frame.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) if truth or prediction have not the voxels of the scorer's
    /// grids, or classes beyond its own.
    pub fn score(&self, truth: &Truth, prediction: &Prediction<'_>) -> Result<Score> {
        self.check(truth, prediction)?;
        let mut score = Score::new(self.kind());
        let pose = &truth.grid_to_lidar;
        let resampled = self.resampled(pose, prediction.classes);
        let (grid, classes) = (&self.truth, self.classes);
        score.rays = count_rays(grid, classes, &truth.labels, &resampled, &truth.origins, &self.directions);
        if let Some(published) = self.published {
            let (grids, classes) = ([&self.truth, &self.prediction], [prediction.classes, &resampled[..]]);
            score.published = published.count(self.classes, truth, grids, classes);
        }
        if let Some(logits) = prediction.logits {
            score.losses.add(&losses(logits, &truth.labels, classes, None));
        }
        let [nx, ny, nz] = self.truth.size;
        let columns = (0..nx).flat_map(|x| (0..ny).map(move |y| [x, y]));
        for (([x, y], &column_ring), first) in columns.zip(&self.ring_of).zip((0..).step_by(nz)) {
            for z in 0..nz {
                let label = truth.labels[first + z];
                if !is_class(label) {
                    continue;
                }
                let ring = match grid.axes {
                    Axes::Lidar => usize::from(column_ring),
                    Axes::Ego => self.ring_at(pose, [x, y, z]),
                };
                let at = self.predicted_voxel(pose, [x, y, z]);
                let class = resampled[first + z];
                score.regions[0][ring].add(label, class);
                for (mask, region) in truth.masks.iter().zip(1..) {
                    if mask[first + z] != 0 {
                        score.regions[region][ring].add(label, class);
                    }
                }
                let supported = prediction.support.zip(at).is_some_and(|(support, at)| support[at] > 0);
                if supported {
                    score.regions[self.masks + 1][ring].add(label, class);
                }
                let Some((confidence, at)) = prediction.confidence.zip(at) else { continue };
                let masks = truth.masks.iter().map(|mask| mask[first + z] != 0);
                let within = std::iter::once(true).chain(masks).chain([supported]);
                for (calibration, _) in score.calibration.iter_mut().zip(within).filter(|(_, within)| *within) {
                    calibration.add([confidence.occupied[at], confidence.class[at]], label, class);
                }
            }
        }
        Ok(score)
    }

    /// The prediction on the grid of the truth: for each of its voxels, the class where its centre lies. `pose` is the
    /// frame's [`Truth::grid_to_lidar`].
    ///
    /// # Panics
    /// If `classes` has not the voxels of the prediction's grid.
    pub fn resampled<'a>(&self, pose: &Pose, classes: &'a [u8]) -> Cow<'a, [u8]> {
        assert_eq!(classes.len(), self.prediction.voxels(), "voxels of the prediction");
        if self.truth == self.prediction {
            return Cow::Borrowed(classes);
        }
        let [nx, ny, nz] = self.truth.size;
        let voxels = (0..nx).flat_map(|x| (0..ny).flat_map(move |y| (0..nz).map(move |z| [x, y, z])));
        Cow::Owned(voxels.map(|voxel| self.predicted_voxel(pose, voxel).map_or(0, |at| classes[at])).collect())
    }

    /// Centre of voxel `voxel` of the truth in the lidar frame.
    fn centre(&self, pose: &Pose, voxel: [usize; 3]) -> [f64; 3] {
        pose.apply([0, 1, 2].map(|axis| self.truth.centre(axis, voxel[axis])))
    }

    /// Ring of a voxel of the truth, whose axes are not the lidar's.
    fn ring_at(&self, pose: &Pose, voxel: [usize; 3]) -> usize {
        let [x, y, _] = self.centre(pose, voxel);
        ring(&self.ends, x, y)
    }

    /// How many regions and rings a score has.
    pub fn kind(&self) -> Kind {
        Kind { classes: self.classes, regions: self.masks + 2, rings: self.ends.len() + 1 }
    }

    /// Where the prediction speaks of voxel `[x, y, z]` of the truth; nowhere if that lies outside its grid.
    fn predicted_voxel(&self, pose: &Pose, [x, y, z]: [usize; 3]) -> Option<usize> {
        let [x, y, z] = match &self.correspondence {
            Correspondence::Same => [x, y, z],
            Correspondence::Indices([along_x, along_y, along_z]) => [along_x[x]?, along_y[y]?, along_z[z]?],
            Correspondence::Posed => {
                let centre = self.centre(pose, [x, y, z]);
                let index = |axis: usize| self.prediction.index(axis, centre[axis]);
                [index(0)?, index(1)?, index(2)?]
            }
        };
        let [_, ny, nz] = self.prediction.size;
        Some((x * ny + y) * nz + z)
    }

    fn check(&self, truth: &Truth, prediction: &Prediction<'_>) -> Result<()> {
        let (voxels, predicted) = (self.truth.voxels(), self.prediction.voxels());
        let check = |what: &str, found: usize, expected: usize| {
            if found == expected {
                return Ok(());
            }
            Err(Error::mismatch(format!("{what}: {found}, expected {expected}")))
        };
        check("labelled voxels", truth.labels.len(), voxels)?;
        check("masks", truth.masks.len(), self.masks)?;
        for mask in &truth.masks {
            check("voxels of a mask", mask.len(), voxels)?;
        }
        check("predicted voxels", prediction.classes.len(), predicted)?;
        check("voxels with support", prediction.support.map_or(predicted, <[u16]>::len), predicted)?;
        for codes in prediction.confidence.iter().flat_map(|confidence| [confidence.occupied, confidence.class]) {
            check("voxels with confidence", codes.len(), predicted)?;
        }
        if let Some(logits) = prediction.logits {
            if self.truth != self.prediction {
                let message = "losses need labels on the grid of the network, which these are not";
                return Err(Error::mismatch(message));
            }
            check("logits", logits.len(), predicted * self.classes)?;
        }
        let beyond = |class: &u8| usize::from(*class) >= self.classes;
        let label = truth.labels.iter().find(|label| beyond(label) && ![OTHERS, IGNORED].contains(*label));
        if let Some(found) = label.or_else(|| prediction.classes.iter().find(|class| beyond(class))) {
            return Err(Error::mismatch(format!("class {found}, expected one of {}", self.classes)));
        }
        Ok(())
    }
}

/// For each index along `axis` of `truth`, the index in `prediction` whose voxel contains the centre.
fn nearest(truth: &Grid, prediction: &Grid, axis: usize) -> Vec<Option<usize>> {
    (0..truth.size[axis]).map(|i| prediction.index(axis, truth.centre(axis, i))).collect()
}

/// The ring of a place in the lidar frame, of those that end at `ends`.
fn ring(ends: &[f64], x: f64, y: f64) -> usize {
    let distance = (x * x + y * y).sqrt();
    ends.iter().position(|&end| distance < end).unwrap_or(ends.len())
}

/// How large a score is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Kind {
    /// Classes, the empty one among them.
    pub classes: usize,
    /// Regions ([`Scorer::regions`]).
    pub regions: usize,
    /// Distance rings, that beyond the last end among them.
    pub rings: usize,
}

/// The score of a frame, or of many: a confusion for each region and ring.
#[derive(Clone, Debug, PartialEq)]
pub struct Score {
    /// For each of [`Scorer::regions`], for each ring of [`Options::rings`] and for what lies beyond the last.
    pub regions: Vec<Vec<Confusion>>,
    /// What the set's own evaluation counts ([`Scorer::published`]): the classes, and the one that networks do not have.
    pub published: Confusion,
    /// What rays meet, in [`Truth::origins`].
    pub rays: RayCounts,
    /// Losses of level 0 of the frames whose logits were given.
    pub losses: LossSum,
    /// For each region, how often what the network was so sure of came true, in the voxels of which it speaks; nothing counted
    /// where it did not say how sure it is.
    pub calibration: Vec<Calibration>,
}

/// Losses, summed over frames.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LossSum {
    /// Frames counted.
    pub frames: u64,
    /// Their sum.
    pub sum: Losses,
}

impl LossSum {
    /// Counts a frame.
    pub fn add(&mut self, losses: &Losses) {
        self.merge(&LossSum { frames: 1, sum: *losses });
    }

    /// Adds another sum.
    pub fn merge(&mut self, other: &LossSum) {
        self.frames += other.frames;
        self.sum.focal += other.sum.focal;
        self.sum.lovasz += other.sum.lovasz;
        self.sum.geometric += other.sum.geometric;
        self.sum.semantic += other.sum.semantic;
    }

    /// The mean of a frame; none without frames.
    pub fn mean(&self) -> Option<Losses> {
        let share = |sum: f64| sum / self.frames as f64;
        let Losses { focal, lovasz, geometric, semantic } = self.sum;
        (self.frames > 0).then(|| Losses {
            focal: share(focal),
            lovasz: share(lovasz),
            geometric: share(geometric),
            semantic: share(semantic),
        })
    }
}

impl Score {
    /// Nothing counted.
    pub fn new(kind: Kind) -> Self {
        let regions = vec![vec![Confusion::new(kind.classes); kind.rings]; kind.regions];
        let published = Confusion::new(kind.classes + 1);
        let calibration = vec![Calibration::default(); kind.regions];
        Self { regions, published, rays: RayCounts::new(kind.classes), losses: LossSum::default(), calibration }
    }

    /// Adds the counts of another score of the same kind.
    ///
    /// # Panics
    /// If it is of another kind.
    pub fn merge(&mut self, other: &Score) {
        assert_eq!(self.regions.len(), other.regions.len(), "regions");
        self.published.merge(&other.published);
        self.rays.merge(&other.rays);
        self.losses.merge(&other.losses);
        self.calibration.iter_mut().zip(&other.calibration).for_each(|(own, other)| own.merge(other));
        for (own, other) in self.regions.iter_mut().zip(&other.regions) {
            assert_eq!(own.len(), other.len(), "rings");
            own.iter_mut().zip(other).for_each(|(own, other)| own.merge(other));
        }
    }

    /// The confusion of a region, all rings together.
    ///
    /// # Panics
    /// If there is no such region.
    pub fn region(&self, region: usize) -> Confusion {
        let rings = &self.regions[region];
        rings[1..].iter().fold(rings[0].clone(), |mut sum, ring| {
            sum.merge(ring);
            sum
        })
    }
}

/// Writes `text` to `path`. The file appears whole or not at all.
///
/// # Errors
/// [`ErrorKind::Io`](crate::ErrorKind::Io) if it cannot be written.
pub fn write_text(path: &Path, text: &str) -> Result<()> {
    replace_file(path, |out| out.write_all(text.as_bytes()))
}

#[cfg(test)]
mod tests;

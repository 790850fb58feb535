//! The file that OpenOcc v2's challenge takes (CVPR 2024, "Occupancy and Flow"): what rays of a lidar meet in the prediction,
//! as its program renders them.
//!
//! The file is gzip of a pickle of `{"method": ..., "results": {sample: {"pcd_cls": u8 [N], "pcd_dist": f16 [N], "pcd_flow": f16
//! [N, 2]}}}`. Rays go out from up to eight places of the lidar in the frames of the scene ([`NuScenes::ray_origins`]), from
//! each in the [`directions`](super::ray_iou::directions) of RayIoU. A ray has the class of the first voxel that is not empty,
//! in the set's own numbers, and the distance at which it *leaves* that voxel; one that meets none has the last voxel of
//! the grid. Networks here predict no flow: it is 0.
//!
//! Distances follow the program in its types, so that they are its own to the last bit where sines are: origins and ends of
//! rays in voxels as f32, the walk in f64, its end in f32 times 0.4, rounded to f16.

use super::dataset::nuscenes::Labels;
use super::dataset::{DataSet, Grid, NuScenes};
use super::evaluation::run;
use super::ray_iou::directions;
use super::{Options, Predictor, Says, Scorer};
use crate::base::error::{Error, Result};
use crate::base::note::{Note, Said};
use crate::file::replace::replace_file;
use crate::runtime::session::{Moving, SessionOptions};
use flate2::{Compression, GzBuilder};
use half::f16;
use std::io::{self, Write};
use std::path::Path;

/// What a submission says of itself, in the order of the file.
pub const ABOUT: [&str; 6] = ["method", "team", "authors", "e-mail", "institution / company", "country / region"];

/// Most voxels that the program follows a ray through.
const MOST_STEPS: usize = 1001;

/// Writes what `predictor` says of the first `limit` frames of `set`, of all if none, to `path`, which appears when it is
/// whole. Labels are not read. `about` has values for some of [`ABOUT`]; the others are empty. `watch` is told after each
/// frame how many are done and what has not been said yet of their images; what it returns as an error ends the work.
///
/// # Errors
/// [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) for another set than OpenOcc's, a model of other classes, and what
/// [`ABOUT`] does not have; those of the set, of sessions and of writing.
pub fn write_submission(
    path: &Path,
    set: &NuScenes,
    predictor: &Predictor,
    about: &[(String, String)],
    limit: Option<usize>,
    options: &SessionOptions,
    watch: &mut dyn FnMut(usize, &[Note]) -> Result<()>,
) -> Result<()> {
    if set.labels() != Labels::OpenOcc {
        return Err(Error::mismatch("a submission of another set, expected one of OpenOcc's"));
    }
    if let Some((key, _)) = about.iter().find(|(key, _)| !ABOUT.contains(&key.as_str())) {
        return Err(Error::mismatch(format!("a submission has no {key:?}, expected one of {}", ABOUT.join(", "))));
    }
    predictor.check(set.classes().len(), "OpenOcc")?;
    let frames = limit.map_or(set.len(), |limit| set.len().min(limit));
    let mut caster = Caster::new(set, predictor, options)?;
    let mut said = Said::default();
    let mut failed = None;
    let written = replace_file(path, |out| {
        let mut pickle = Pickler(GzBuilder::new().mtime(0).write(out, Compression::default()));
        pickle.begin(about)?;
        for index in 0..frames {
            let done = caster.frame(index).and_then(|(rays, notes)| {
                watch(index + 1, said.fresh(notes))?;
                Ok(rays)
            });
            match done {
                Ok(rays) => pickle.frame(set.sample(index), &rays)?,
                Err(error) => {
                    failed = Some(error);
                    return Err(io::ErrorKind::Other.into());
                }
            }
        }
        pickle.end()
    });
    match failed {
        Some(error) => Err(error),
        None => written,
    }
}

/// What the rays of a frame meet.
struct Rays {
    classes: Vec<u8>,
    distances: Vec<f16>,
}

/// Predicts frames and casts rays into them.
struct Caster<'a> {
    set: &'a NuScenes,
    predictor: &'a Predictor,
    scorer: Scorer,
    options: &'a SessionOptions,
    running: Option<Moving>,
    directions: Vec<[f32; 3]>,
}

impl<'a> Caster<'a> {
    fn new(set: &'a NuScenes, predictor: &'a Predictor, options: &'a SessionOptions) -> Result<Self> {
        let grid = predictor.grid();
        let scorer = Scorer::new(set.classes().len(), 0, set.grid(), grid, &Options::default())?;
        let directions = directions().into_iter().map(|ray| ray.map(|v| v as f32)).collect();
        Ok(Self { set, predictor, scorer, options, running: None, directions })
    }

    /// The rays of a frame, and what is to be said of its images.
    fn frame(&mut self, index: usize) -> Result<(Rays, Vec<Note>)> {
        let set = self.set;
        let said = |e: Error| match e.path() {
            Some(_) => e,
            None => Error::new(e.kind(), format!("frame {}: {}", set.id(index), e.message())),
        };
        let (predicted, notes) = match &self.predictor.says {
            Says::Model(model) => {
                let (scene, notes) = set.scene(index)?;
                (run(&mut self.running, model, &scene, self.options).map_err(said)?.classes, notes)
            }
            Says::Always(classes, _) => (&classes[..], Vec::new()),
        };
        let classes = self.scorer.resampled(&set.grid_to_lidar(index), predicted);
        let mut rays = Rays { classes: Vec::new(), distances: Vec::new() };
        for origin in set.ray_origins(index) {
            for direction in &self.directions {
                let (distance, voxel) = cast(&set.grid(), &classes, &origin, direction);
                rays.classes.push(set.published_class(classes[voxel]));
                rays.distances.push(distance);
            }
        }
        Ok((rays, notes))
    }
}

/// The metres at which a ray leaves the first voxel that is not empty, and which that is; those of the last voxel where all are.
/// A ray that never enters the grid is -0.4 m long and has the first voxel, as in the published program.
fn cast(grid: &Grid, classes: &[u8], origin: &[f64; 3], direction: &[f32; 3]) -> (f16, usize) {
    let edge = grid.edge(0) as f32;
    // In voxels of the grid, and rounded as the program does it.
    let voxels = |place: f64, axis: usize| ((place - f64::from(grid.bounds[axis][0])) / f64::from(edge)) as f32;
    let from: [f64; 3] = std::array::from_fn(|axis| f64::from(voxels(origin[axis], axis)));
    let to: [f64; 3] = std::array::from_fn(|a| f64::from(voxels(f64::from(direction[a]) + origin[a], a)));
    let along: [f64; 3] = std::array::from_fn(|axis| to[axis] - from[axis]);
    let length = along.iter().map(|v| v * v).sum::<f64>().sqrt();
    let along = along.map(|v| v / length);
    // Amanatides and Woo, from the voxel of the origin on, which is rounded towards 0.
    let mut voxel = from.map(|v| v as i64);
    let step = along.map(|v| if v >= 0.0 { 1 } else { -1 });
    let mut next: [f64; 3] = std::array::from_fn(|axis| {
        let border = voxel[axis] + i64::from(step[axis] > 0);
        if along[axis] == 0.0 { f64::MAX } else { (border as f64 - from[axis]) / along[axis] }
    });
    let delta: [f64; 3] =
        std::array::from_fn(|axis| if along[axis] == 0.0 { f64::MAX } else { step[axis] as f64 / along[axis] });
    let mut last = None;
    for _ in 0..MOST_STEPS {
        let inside = (0..3).all(|axis| usize::try_from(voxel[axis]).is_ok_and(|v| v < grid.size[axis]));
        if !inside && last.is_some() {
            break;
        }
        let [x, y, z] = next;
        let axis = match (x < y, x < z, y < z) {
            (true, true, _) => 0,
            (false, _, true) => 1,
            _ => 2,
        };
        if inside {
            let [x, y, z] = voxel.map(|v| v as usize);
            let at = (x * grid.size[1] + y) * grid.size[2] + z;
            last = Some((next[axis], at));
            if classes[at] != 0 {
                break;
            }
        }
        voxel[axis] += step[axis];
        next[axis] += delta[axis];
    }
    let (distance, at) = last.unwrap_or((-1.0, 0));
    (f16::from_f32(distance as f32 * edge), at)
}

/// Writes the instructions of a pickle of protocol 4.
struct Pickler<W>(W);

impl<W: Write> Pickler<W> {
    fn text(&mut self, text: &str) -> io::Result<()> {
        self.0.write_all(b"X")?;
        self.0.write_all(&(text.len() as u32).to_le_bytes())?;
        self.0.write_all(text.as_bytes())
    }

    fn int(&mut self, n: usize) -> io::Result<()> {
        self.0.write_all(b"J")?;
        self.0.write_all(&(n as i32).to_le_bytes())
    }

    /// `numpy.ndarray(shape, type, bytes)`, which every version of NumPy has.
    fn array(&mut self, shape: &[usize], kind: &str, bytes: &[u8]) -> io::Result<()> {
        self.0.write_all(b"cnumpy\nndarray\n((")?;
        shape.iter().try_for_each(|&length| self.int(length))?;
        self.0.write_all(b"t")?;
        self.text(kind)?;
        self.0.write_all(b"B")?;
        self.0.write_all(&(bytes.len() as u32).to_le_bytes())?;
        self.0.write_all(bytes)?;
        self.0.write_all(b"tR")
    }

    fn begin(&mut self, about: &[(String, String)]) -> io::Result<()> {
        self.0.write_all(b"\x80\x04}")?;
        for name in ABOUT {
            self.text(name)?;
            self.text(about.iter().find(|(key, _)| key == name).map_or("", |(_, value)| value))?;
            self.0.write_all(b"s")?;
        }
        self.text("results")?;
        self.0.write_all(b"}")
    }

    fn frame(&mut self, sample: &str, rays: &Rays) -> io::Result<()> {
        let count = rays.classes.len();
        let distances: Vec<u8> = rays.distances.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.text(sample)?;
        self.0.write_all(b"}")?;
        self.text("pcd_cls")?;
        self.array(&[count], "|u1", &rays.classes)?;
        self.0.write_all(b"s")?;
        self.text("pcd_dist")?;
        self.array(&[count], "<f2", &distances)?;
        self.0.write_all(b"s")?;
        self.text("pcd_flow")?;
        self.array(&[count, 2], "<f2", &vec![0; 4 * count])?;
        self.0.write_all(b"ss")
    }

    fn end(mut self) -> io::Result<()> {
        self.0.write_all(b"s.")?;
        self.0.flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::dataset::Axes;

    const GRID: Grid = Grid { size: [20, 16, 8], bounds: [[-4.0, 4.0], [-3.2, 3.2], [-1.0, 2.2]], axes: Axes::Ego };

    fn at([x, y, z]: [usize; 3]) -> usize {
        (x * 16 + y) * 8 + z
    }

    #[test]
    fn a_ray_is_as_long_as_to_where_it_leaves_what_it_meets() {
        let mut classes = vec![0; GRID.voxels()];
        classes[at([15, 8, 4])] = 3;
        let cast = |origin, direction| {
            let (distance, voxel) = cast(&GRID, &classes, &origin, &direction);
            (distance.to_f32(), voxel)
        };
        // The voxel is 2 to 2.4 m ahead; f16 has three digits.
        let (distance, voxel) = cast([0.1, 0.2, 0.8], [1.0, 0.0, 0.0]);
        assert!((distance - 2.3).abs() < 2e-3 && voxel == at([15, 8, 4]), "{distance}");
        // Nothing behind: up to the end of the grid.
        let (distance, voxel) = cast([0.1, 0.2, 0.8], [-1.0, 0.0, 0.0]);
        assert!((distance - 4.1).abs() < 3e-3 && voxel == at([0, 8, 4]), "{distance}");
        let (distance, voxel) = cast([2.1, 0.2, 0.8], [0.0, 0.0, 1.0]);
        assert!((distance - 0.2).abs() < 1e-3 && voxel == at([15, 8, 4]), "from inside: {distance}");
        assert_eq!(cast([0.0, 0.0, 9.0], [1.0, 0.0, 0.0]), (f16::from_f32(-0.4).to_f32(), 0), "never in the grid");
    }

    #[test]
    fn walking_meets_what_small_steps_meet() {
        let mut random = crate::base::random::Random::new(5);
        let classes: Vec<u8> = (0..GRID.voxels()).map(|_| u8::from(random.range(0.0, 1.0) < 0.02)).collect();
        for ray in directions().iter().step_by(37) {
            let origin = [0.33, 0.21, 0.57];
            let index = |t: f64| -> Option<[usize; 3]> {
                let mut voxel = [0; 3];
                for a in 0..3 {
                    let place = ((origin[a] + t * ray[a] - f64::from(GRID.bounds[a][0])) / GRID.edge(a)).floor();
                    voxel[a] = (place >= 0.0 && place < GRID.size[a] as f64).then_some(place as usize)?;
                }
                Some(voxel)
            };
            let times = || (0..).map(|i| f64::from(i) * 5e-4);
            let met = times().map(|t| (t, index(t))).find(|(_, voxel)| voxel.is_none_or(|v| classes[at(v)] != 0));
            let (start, met) = met.expect("a wall or the end");
            // Where that voxel ends, or, of the last one, where the grid does.
            let expected = match met {
                Some(voxel) => times().map(|t| start + t).find(|&t| index(t) != Some(voxel)).expect("an end"),
                None => start,
            };
            let (distance, voxel) = cast(&GRID, &classes, &origin, &ray.map(|v| v as f32));
            let distance = f64::from(distance.to_f32());
            // Steps may miss a corner by a hair; f16 rounds.
            assert!((distance - expected).abs() < 5e-3, "{ray:?}: {distance} {expected}");
            assert!(met.is_none_or(|met| at(met) == voxel), "{ray:?}");
        }
    }
}

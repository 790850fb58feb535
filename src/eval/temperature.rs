//! Fitting the temperature of a network's softmax to labels.
//!
//! Of the temperatures T, that one is chosen at which the labels are likeliest: where the cross-entropy of softmax(logits / T),
//! summed over the labelled voxels, is least (Guo et al., arXiv 1706.04599). In b = 1 / T it is convex, and its derivative is
//!
//! ```text
//! sum over voxels of  (sum over k of p[k] logits[k]) - logits[label],   p = softmax(b logits)
//! ```
//!
//! whose zero Newton's method finds, within a bracket, and bisection where that does not arrive. Every step runs the network on all frames once more, so that no logits
//! are kept. Sums are taken in a fixed order and exp is the kernels' own: the same set gives the same temperature on every
//! machine and number of threads.

use super::Options;
use super::dataset::{DataSet, Frame, Truth, is_class};
use super::evaluation::{Predictor, run};
use super::{Prediction, Scorer};
use crate::base::error::{Error, Result};
use crate::base::note::Note;
use crate::graph::Temperature;
use crate::model::Model;
use crate::runtime::session::{Moving, SessionOptions};
use std::sync::Arc;
use voxcast_kernels::math::exp;

/// Inverse temperatures that are looked at.
const LEAST: f64 = 0.01;
const MOST: f64 = 100.0;

/// Newton's method has arrived when it moves less than this share.
const CLOSE: f64 = 1e-4;

/// Steps of Newton's method, after which the bracket is bisected: towards labels that no temperature fits it walks without end.
const STEPS: usize = 8;

/// Passes over the set, which bisection does not need.
const PASSES: usize = 32;

/// What a fit came to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fit {
    /// The temperature, to four decimals.
    pub temperature: Temperature,
    /// Frames that it was fitted to.
    pub frames: usize,
    /// Labelled voxels in them.
    pub voxels: u64,
    /// How often each frame was run.
    pub passes: usize,
}

/// First and second derivative of the cross-entropy by the inverse temperature, and the voxels that they are of.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Slope {
    first: f64,
    second: f64,
    voxels: u64,
}

impl Slope {
    fn add(&mut self, other: &Self) {
        self.first += other.first;
        self.second += other.second;
        self.voxels += other.voxels;
    }

    /// Counts a voxel with this label. `inverse` is the inverse temperature.
    fn see(&mut self, logits: &[f32], label: u8, inverse: f32) {
        let largest = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let [mut total, mut mean, mut square] = [0.0f64; 3];
        for &logit in logits {
            let below = logit - largest;
            let p = f64::from(exp(below * inverse));
            let below = f64::from(below);
            total += p;
            mean += p * below;
            square += p * below * below;
        }
        let mean = mean / total;
        self.first += mean - f64::from(logits[usize::from(label)] - largest);
        self.second += square / total - mean * mean;
        self.voxels += 1;
    }
}

/// The next inverse temperature to look at, and the bracket in which the best one lies.
#[derive(Clone, Copy, Debug)]
struct Search {
    inverse: f64,
    bracket: [f64; 2],
    steps: usize,
}

impl Search {
    fn new() -> Self {
        Self { inverse: 1.0, bracket: [LEAST, MOST], steps: 0 }
    }

    /// Moves to where the slope seems to be zero. True when that is close to where it was.
    ///
    /// # Errors
    /// If no temperature fits, or logits are not finite.
    fn advance(&mut self, slope: &Slope) -> Result<bool> {
        if !slope.first.is_finite() || !slope.second.is_finite() {
            return Err(Error::format("logits that are not finite, expected finite numbers"));
        }
        let at = self.inverse;
        self.bracket[usize::from(slope.first > 0.0)] = at;
        let [low, high] = self.bracket;
        let newton = at - slope.first / slope.second;
        let newton = Some(newton).filter(|newton| self.steps < STEPS && *newton > low && *newton < high);
        self.steps += 1;
        self.inverse = newton.unwrap_or((low * high).sqrt());
        if slope.first == 0.0 {
            self.inverse = at;
        }
        if self.inverse < LEAST * (1.0 + 2.0 * CLOSE) || self.inverse > MOST * (1.0 - 2.0 * CLOSE) {
            let message = format!("no temperature from {} to {} fits the labels", 1.0 / MOST, 1.0 / LEAST);
            return Err(Error::mismatch(message));
        }
        Ok((self.inverse - at).abs() <= CLOSE * at)
    }
}

/// Fits the temperature of `model` to the labelled voxels of the first `limit` frames of `set`, which was named `data`; all if
/// none. Runs each frame several times, with the instruction set and threads of `options`. `watch` is told how many frames were
/// run in all and what of their images has not been said yet; what it returns as an error ends the fit.
///
/// # Errors
/// [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) for a model of other classes than the set's, for a set without labelled
/// voxels, and for labels that no temperature fits; those of the frames and of `watch`.
pub fn fit_temperature(
    model: &Arc<Model>,
    set: &dyn DataSet,
    data: &str,
    limit: Option<usize>,
    options: &SessionOptions,
    watch: &mut dyn FnMut(usize, &[Note]) -> Result<()>,
) -> Result<Fit> {
    let predictor = Predictor::model(model.clone());
    predictor.check(set.classes().len(), data)?;
    let grids = [set.grid(), predictor.grid()];
    let scorer = Scorer::new(set.classes().len(), set.masks().len(), grids[0], grids[1], &Options::default())?;
    let options = SessionOptions { logits: true, ..options.clone() };
    let frames = limit.map_or(set.len(), |limit| set.len().min(limit));
    let mut running: Option<Moving> = None;
    let mut search = Search::new();
    for pass in 0..PASSES {
        let mut sum = Slope::default();
        for index in 0..frames {
            let Frame { scene, truth, notes } = set.frame(index)?;
            let said = |e: Error| match e.path() {
                Some(_) => e,
                None => Error::new(e.kind(), format!("frame {}: {}", set.id(index), e.message())),
            };
            let result = run(&mut running, model, &scene, &options).map_err(said)?;
            let prediction = Prediction { classes: result.classes, support: None, logits: None, confidence: None };
            scorer.check(&truth, &prediction).map_err(said)?;
            let logits = result.logits.unwrap_or_default();
            sum.add(&scorer.slope(&truth, logits, search.inverse as f32, options.threads.count()));
            let notes = if pass == 0 { &notes[..] } else { &[] };
            watch(pass * frames + index + 1, notes)?;
        }
        if sum.voxels == 0 {
            return Err(Error::mismatch(format!("{data} has no labelled voxels where the network predicts")));
        }
        if search.advance(&sum)? {
            let decimals = (1e4 / search.inverse).round() / 1e4;
            let temperature = Temperature::try_from(decimals as f32)?;
            return Ok(Fit { temperature, frames, voxels: sum.voxels, passes: pass + 1 });
        }
    }
    Err(Error::mismatch(format!("{PASSES} steps find no temperature that fits the labels")))
}

impl Scorer {
    /// The slope of a frame's cross-entropy. Planes of voxels are shared out among threads, and their sums added in order.
    fn slope(&self, truth: &Truth, logits: &[f32], inverse: f32, threads: usize) -> Slope {
        let [nx, ny, nz] = self.truth.size;
        let plane = |x: usize| {
            let mut sum = Slope::default();
            for (y, z) in (0..ny).flat_map(|y| (0..nz).map(move |z| (y, z))) {
                let label = truth.labels[(x * ny + y) * nz + z];
                let at = self.predicted_voxel(&truth.grid_to_lidar, [x, y, z]);
                if let (true, Some(at)) = (is_class(label), at) {
                    sum.see(&logits[at * self.classes..][..self.classes], label, inverse);
                }
            }
            sum
        };
        let mut planes = vec![Slope::default(); nx];
        std::thread::scope(|scope| {
            let share = nx.div_ceil(threads.max(1)).max(1);
            for (planes, first) in planes.chunks_mut(share).zip((0..).step_by(share)) {
                scope.spawn(move || planes.iter_mut().zip(first..).for_each(|(sum, x)| *sum = plane(x)));
            }
        });
        planes.iter().fold(Slope::default(), |mut sum, plane| {
            sum.add(plane);
            sum
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The zero of the slope of these voxels.
    fn fitted(voxels: &[(Vec<f32>, u8)]) -> Result<f64> {
        let mut search = Search::new();
        for _ in 0..PASSES {
            let mut sum = Slope::default();
            voxels.iter().for_each(|(logits, label)| sum.see(logits, *label, search.inverse as f32));
            if search.advance(&sum)? {
                return Ok(search.inverse);
            }
        }
        panic!("no end");
    }

    #[test]
    fn shares_that_are_known_are_found() {
        // Of two classes whose logits differ by d, three of four labels are the larger: b d = ln 3.
        for difference in [0.05f32, 1.0, 3.0, 60.0] {
            let voxel = |label| (vec![0.5, 0.5 + difference], label);
            let voxels = [voxel(1), voxel(1), voxel(0), voxel(1)];
            let (found, expected) = (fitted(&voxels).expect("a fit"), 3f64.ln() / f64::from(difference));
            assert!((found / expected - 1.0).abs() < 1e-3, "{found}, expected {expected}");
        }
    }

    #[test]
    fn the_slope_is_the_derivative_of_the_cross_entropy() {
        let (logits, label) = ([0.3f32, -1.2, 2.5, 0.0], 3);
        let entropy = |b: f64| {
            let sum: f64 = logits.iter().map(|&l| (b * f64::from(l)).exp()).sum();
            sum.ln() - b * f64::from(logits[3])
        };
        let mut slope = Slope::default();
        slope.see(&logits, label, 0.75);
        let (h, b) = (1e-4, 0.75);
        let first = (entropy(b + h) - entropy(b - h)) / (2.0 * h);
        let second = (entropy(b + h) - 2.0 * entropy(b) + entropy(b - h)) / (h * h);
        assert!((slope.first - first).abs() < 1e-5 && (slope.second - second).abs() < 1e-5, "{slope:?}");
    }

    #[test]
    fn what_no_temperature_fits_is_refused() {
        let always = [(vec![0.0, 1.0], 1)];
        assert!(fitted(&always).expect_err("always right").message().contains("no temperature from 0.01 to 100"));
        let never = [(vec![0.0, 1.0], 0)];
        assert!(fitted(&never).expect_err("always wrong").message().contains("no temperature"));
        let equal = [(vec![1.0, 1.0], 0)];
        assert_eq!(fitted(&equal).expect("any fits"), 1.0, "nothing to tell");
        let broken = [(vec![f32::NAN, 1.0], 0)];
        assert!(fitted(&broken).expect_err("NaN").message().contains("not finite"));
    }
}

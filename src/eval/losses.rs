//! The four losses of the network's training, as numbers: focal, Lovasz-softmax, geometric and semantic scene-class
//! affinity. They are computed in f64 over the voxels of one level, in natural logarithms.
//!
//! `docs/evaluation.md` has the formulas.

use crate::eval::dataset::is_class;

/// A term -ln q is cut off here, as PyTorch's binary cross-entropy does.
const MAX_LOG: f64 = 100.0;

/// The losses of a level. Training adds the four, and the levels with weights 1, 1/2, 1/4 and 1/8 from level 0 on.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Losses {
    /// Mean over the voxels of -w (1 - p)^2 ln p, p being the probability of the true class and w that class's weight
    /// (arXiv 1708.02002, gamma 2).
    pub focal: f64,
    /// Lovasz-softmax: the mean over the classes that occur of the Lovasz extension of 1 - IoU (arXiv 1705.08790).
    pub lovasz: f64,
    /// Geometric scene-class affinity: -ln of precision, recall and specificity of "occupied" (arXiv 2112.00726).
    pub geometric: f64,
    /// Semantic scene-class affinity: the same of every class that occurs, the mean over these (arXiv 2112.00726).
    pub semantic: f64,
}

/// The losses of `logits`, `[voxels, classes]`, for `labels` (one per voxel), over the voxels whose label is a class; zeros if all
/// are. `weights` are those of the focal loss, one per class, 1 by default.
///
/// Takes 8 bytes per logit for the probabilities, and 16 per voxel to sort them.
///
/// # Panics
/// If there are no classes, a length does not fit, or a class is not below `classes`.
pub fn losses(logits: &[f32], labels: &[u8], classes: usize, weights: Option<&[f64]>) -> Losses {
    assert_eq!(logits.len(), labels.len() * classes, "logits for every voxel and class");
    assert!(weights.is_none_or(|w| w.len() == classes), "a weight for every class");
    let mut probabilities = Vec::with_capacity(logits.len());
    let mut truth = Vec::with_capacity(labels.len());
    let mut focal = 0.0;
    for (logits, &label) in logits.chunks_exact(classes).zip(labels) {
        if !is_class(label) {
            continue;
        }
        let class = usize::from(label);
        assert!(class < classes, "a label is a class");
        let largest = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let shifted = |logit: f32| f64::from(logit) - f64::from(largest);
        let log_sum = logits.iter().map(|&logit| shifted(logit).exp()).sum::<f64>().ln();
        let log_p = shifted(logits[class]) - log_sum;
        focal -= weights.map_or(1.0, |w| w[class]) * (1.0 - log_p.exp()).powi(2) * log_p;
        probabilities.extend(logits.iter().map(|&logit| (shifted(logit) - log_sum).exp()));
        truth.push(label);
    }
    if truth.is_empty() {
        return Losses::default();
    }
    Losses {
        focal: focal / truth.len() as f64,
        lovasz: lovasz(&probabilities, &truth, classes),
        geometric: geometric(&probabilities, &truth, classes),
        semantic: semantic(&probabilities, &truth, classes),
    }
}

/// For each class that occurs, voxels are sorted by their error |[truth is c] - p_c| downwards, and each error is weighted
/// by what its voxel adds to the Jaccard loss once it joins the wrong ones.
fn lovasz(probabilities: &[f64], truth: &[u8], classes: usize) -> f64 {
    let (mut sum, mut present) = (0.0, 0);
    for class in 0..classes {
        let total = truth.iter().filter(|&&label| usize::from(label) == class).count() as f64;
        if total == 0.0 {
            continue;
        }
        let error = |(p, &label): (&[f64], &u8)| {
            let member = usize::from(label) == class;
            (if member { 1.0 - p[class] } else { p[class] }, member)
        };
        let mut errors: Vec<(f64, bool)> = probabilities.chunks_exact(classes).zip(truth).map(error).collect();
        errors.sort_by(|a, b| b.0.total_cmp(&a.0));
        let (mut left, mut union, mut before) = (total, total, 0.0);
        for (error, member) in errors {
            if member {
                left -= 1.0;
            } else {
                union += 1.0;
            }
            let jaccard = 1.0 - left / union;
            sum += error * (jaccard - before);
            before = jaccard;
        }
        present += 1;
    }
    sum / f64::from(present)
}

/// What the two affinities measure, of one class or of all that is occupied.
#[derive(Clone, Copy, Default)]
struct Mass {
    /// Sum of the probabilities, and over the members alone.
    all: f64,
    members: f64,
    /// Number of members.
    count: f64,
}

impl Mass {
    fn add(&mut self, probability: f64, member: bool) {
        self.all += probability;
        if member {
            self.members += probability;
            self.count += 1.0;
        }
    }

    /// -ln of precision, recall and specificity, of `voxels` voxels.
    fn affinity(&self, voxels: f64) -> f64 {
        let others = voxels - self.count;
        let spared = others - (self.all - self.members);
        negative_log(self.members, self.all) + negative_log(self.members, self.count) + negative_log(spared, others)
    }
}

/// -ln (part / whole), from 0 to [`MAX_LOG`]; 0 where there is nothing to measure.
fn negative_log(part: f64, whole: f64) -> f64 {
    // Of a whole that rounding has made negative nothing is left either.
    if whole <= 0.0 {
        return 0.0;
    }
    let ratio = part / whole;
    if ratio > 0.0 { (-ratio.ln()).clamp(0.0, MAX_LOG) } else { MAX_LOG }
}

fn geometric(probabilities: &[f64], truth: &[u8], classes: usize) -> f64 {
    let mut occupied = Mass::default();
    probabilities.chunks_exact(classes).zip(truth).for_each(|(p, &label)| occupied.add(1.0 - p[0], label != 0));
    occupied.affinity(truth.len() as f64)
}

fn semantic(probabilities: &[f64], truth: &[u8], classes: usize) -> f64 {
    let mut masses = vec![Mass::default(); classes];
    for (p, &label) in probabilities.chunks_exact(classes).zip(truth) {
        for (class, (mass, &p)) in masses.iter_mut().zip(p).enumerate() {
            mass.add(p, class == usize::from(label));
        }
    }
    let present: Vec<&Mass> = masses.iter().filter(|mass| mass.count > 0.0).collect();
    present.iter().map(|mass| mass.affinity(truth.len() as f64)).sum::<f64>() / present.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::dataset::IGNORED;
    use serde_json::Value;

    /// Cases and values of the training code, computed with PyTorch in f64.
    const CASES: &str = include_str!("losses/cases.json");

    #[test]
    fn values_of_the_training_code() {
        let cases: Vec<Value> = serde_json::from_str(CASES).expect("JSON");
        assert!(cases.len() >= 5);
        let number = |v: &Value| v.as_f64().expect("a number");
        for case in cases {
            let rows: Vec<&Vec<Value>> =
                case["logits"].as_array().expect("rows").iter().filter_map(Value::as_array).collect();
            let classes = rows[0].len();
            let logits: Vec<f32> = rows.iter().flat_map(|row| row.iter().map(|v| number(v) as f32)).collect();
            let labels: Vec<u8> = case["labels"].as_array().expect("labels").iter().map(|v| number(v) as u8).collect();
            let weights: Option<Vec<f64>> = case["class_weights"].as_array().map(|w| w.iter().map(number).collect());
            let found = losses(&logits, &labels, classes, weights.as_deref());
            for (key, found) in [
                ("focal", found.focal),
                ("lovasz", found.lovasz),
                ("geometric", found.geometric),
                ("semantic", found.semantic),
            ] {
                let expected = number(&case["losses"][key]);
                let close = (found - expected).abs() <= 1e-9 * expected.abs().max(1.0);
                assert!(close, "{} {key}: {found}, expected {expected}", case["name"]);
            }
        }
    }

    #[test]
    fn nothing_known_is_no_loss() {
        assert_eq!(losses(&[1.0, 2.0], &[IGNORED], 2, None), Losses::default());
    }
}

//! The integers of a product's columns: from weights and scales in f64.

use super::step;
use crate::base::error::{Error, ErrorKind, Result};
use crate::graph::scale::{LEVELS, Scale};
use crate::graph::site::Site;
use crate::graph::weights::Span;
use voxcast_kernels::quantised::MULTIPLIER_BITS;

/// The smallest multiplier: below, its own rounding would show in an output.
const LEAST_MULTIPLIER: f64 = 256.0;
/// The largest magnitudes of a bias and of a residual's multiplier, which leave the sums of products half of an i32 each and
/// more.
const MOST_BIAS: f64 = (1u32 << 30) as f64;
const MOST_RESIDUAL: f64 = (1u32 << 22) as f64;

/// What the elements on both sides of a product stand for.
#[derive(Clone, Copy, Debug)]
pub(super) struct Steps {
    /// Of the input.
    pub(super) input: f64,
    /// Of the output.
    pub(super) output: f64,
    /// Of the residual, if there is one.
    pub(super) residual: Option<f64>,
}

/// A column in integers.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Column {
    /// -127..=127.
    pub(super) weights: Vec<f64>,
    /// In units of the sum.
    pub(super) bias: f64,
    /// What one step of the residual is in units of the sum; 0 without one.
    pub(super) residual: f64,
    /// From the sum to the output.
    pub(super) multiplier: f64,
}

impl Steps {
    /// Those of an operation whose tensors all have scales.
    pub(super) fn of(site: &Site<'_>) -> Self {
        let output = site.output().scale.map_or(1.0, Scale::wide);
        Self { input: step(site.input(0)), output, residual: site.added().map(step) }
    }

    /// The column of these weights, and of a bias in real units.
    ///
    /// Its scale is the finest that represents the largest weight, made coarser where the bias, the residual's multiplier or
    /// the column's own multiplier would leave their ranges otherwise. With a residual it is such that the residual's
    /// multiplier is a whole number, so that nothing of the residual is rounded before the end.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] if the output's step, or the residual's, is too fine for the weights.
    pub(super) fn column(&self, weights: &[f64], bias: f64) -> Result<Column> {
        let power = super::power(MULTIPLIER_BITS);
        let least = LEAST_MULTIPLIER / power * self.output / self.input;
        let (scale, residual) = self.scale(Span::of(weights, bias), least);
        if self.residual.is_some() && residual < 1.0 {
            return Err(self.refused("residual", self.residual.unwrap_or_default()));
        }
        let unit = self.input * scale;
        let multiplier = (power * (unit / self.output)).round();
        if multiplier >= f64::from(i32::MAX) {
            return Err(self.refused("output", self.output));
        }
        let weights = weights.iter().map(|w| (w / scale).round().clamp(-LEVELS, LEVELS)).collect();
        Ok(Column { weights, bias: (bias / unit).round(), residual, multiplier })
    }

    /// The finest step of an output to which sums of a column of this span can be brought: two of their units.
    pub(super) fn finest(&self, span: Span) -> f64 {
        let (scale, _) = self.scale(span, 0.0);
        // What is lost where a step is rounded to f32, and the multiplier to an integer.
        2.0 * self.input * scale * (1.0 + 1e-6)
    }

    /// The scale of weights of this span, at least `least`, and the residual's multiplier.
    fn scale(&self, Span { weight, bias }: Span, least: f64) -> (f64, f64) {
        let scale = (weight / LEVELS).max(bias.abs() / (self.input * MOST_BIAS)).max(least);
        let Some(step) = self.residual else { return (scale, 0.0) };
        let scale = scale.max(step / (self.input * MOST_RESIDUAL));
        let residual = (step / (self.input * scale)).floor();
        if residual < 1.0 { (scale, 0.0) } else { (step / (self.input * residual), residual) }
    }

    fn refused(&self, what: &str, step: f64) -> Error {
        let message = format!(
            "the {what}'s step of {step:e} is too fine for its weights and for an input's step of {:e}; keep it in f32",
            self.input
        );
        Error::new(ErrorKind::Unsupported, message)
    }
}

/// Columns of one scale, whose sums are not brought to an output's.
#[derive(Clone, Copy, Debug)]
pub(super) struct Common {
    input: f64,
    scale: f64,
}

impl Steps {
    /// The finest scale for weights up to `most`, and these biases.
    pub(super) fn common(input: f64, most: f64, bias: &[f64]) -> Common {
        let bias = bias.iter().fold(0.0f64, |most, bias| most.max(bias.abs()));
        let scale = (most / LEVELS).max(bias / (input * MOST_BIAS));
        Common { input, scale: if scale > 0.0 { scale } else { 1.0 } }
    }
}

impl Common {
    /// What one step of the sums is.
    pub(super) fn unit(self) -> f64 {
        self.input * self.scale
    }

    /// The column of these weights.
    pub(super) fn column(self, weights: &[f64], bias: f64) -> Column {
        let weights = weights.iter().map(|w| (w / self.scale).round().clamp(-LEVELS, LEVELS)).collect();
        Column { weights, bias: (bias / self.unit()).round(), residual: 0.0, multiplier: 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEPS: Steps = Steps { input: 0.5, output: 1.0, residual: None };

    #[test]
    fn a_column_by_hand() {
        // The scale is 0.01, a sum's unit 0.005.
        let column = STEPS.column(&[1.27, -0.635, 0.0, 0.014], -0.25).expect("a column");
        assert_eq!(column.weights, [127.0, -64.0, 0.0, 1.0]);
        assert_eq!((column.bias, column.residual), (-50.0, 0.0));
        assert_eq!(column.multiplier, (0.005f64 * 4_294_967_296.0).round());
    }

    #[test]
    fn a_residual_is_a_whole_number_of_units() {
        let steps = Steps { residual: Some(0.0173), ..STEPS };
        // 0.0173 / 0.005 is 3.46: the unit becomes 0.0173 / 3, and the weights' scale 0.0115.
        let column = steps.column(&[1.27, 0.0], 0.0).expect("a column");
        assert_eq!((column.residual, column.weights[0]), (3.0, 110.0));
        assert_eq!(column.multiplier, (0.0173f64 / 3.0 * 4_294_967_296.0).round());
        let error = Steps { residual: Some(0.004), ..STEPS }.column(&[1.27], 0.0).expect_err("too fine");
        assert!(error.message().contains("the residual's step of 4e-3 is too fine"), "{error}");
    }

    #[test]
    fn columns_of_next_to_nothing_keep_their_bias() {
        for weights in [[0.0; 3], [1e-30; 3], [1e-12; 3]] {
            for (bias, residual) in [(0.0, None), (3.0, None), (-1e3, Some(0.5))] {
                let column = Steps { residual, ..STEPS }.column(&weights, bias).expect("a column");
                assert!(column.multiplier >= LEAST_MULTIPLIER && column.bias.abs() <= MOST_BIAS, "{column:?}");
                assert!(column.residual <= MOST_RESIDUAL);
                let out = column.bias * column.multiplier / 4_294_967_296.0;
                assert!((out - bias / STEPS.output).abs() < 1e-2, "{column:?}");
                let added = column.residual * column.multiplier / 4_294_967_296.0;
                assert!((added - residual.unwrap_or(0.0) / STEPS.output).abs() < 1e-3, "{column:?}");
            }
        }
    }

    #[test]
    fn an_output_too_fine_is_refused() {
        let error = Steps { output: 0.009, ..STEPS }.column(&[1.27], 0.0).expect_err("too fine");
        assert!(error.message().contains("the output's step of 9e-3 is too fine"), "{error}");
    }
}

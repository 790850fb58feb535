//! From checkpoint to stored parts: norms folded in f64, weights packed as the kernels read them.

use super::recipe::ConvNames;
use super::temperature::Temperature;
use crate::base::error::{Error, Result};
use voxcast_kernels::LANES;
use voxcast_kernels::panels::{packed_index, packed_len};

/// Added to a batch norm's variance (the published networks' value).
pub(crate) const EPSILON: f64 = 1e-5;

/// Where weights come from, by the names of published checkpoints.
pub trait Source {
    /// The tensor `name` in row-major order. It must have this shape and finite elements.
    ///
    /// # Errors
    /// Naming the tensor, if it is missing, has another shape or holds a number that is not finite.
    fn tensor(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>>;

    /// The temperature that was fitted to the network with these weights; 1 if none was.
    fn temperature(&self) -> Temperature {
        Temperature::ONE
    }
}

/// The elements of one part, in f64. They are rounded once, to the type in which the part is stored.
pub type Values = Vec<f64>;

/// A convolution in f64.
#[derive(Clone, Debug)]
pub struct Dense {
    /// `[outputs, inputs * taps]` in the checkpoint's order.
    pub weight: Values,
    /// One per output.
    pub bias: Values,
}

/// What a column's sums are made of, as far as their scale depends on it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Span {
    /// The largest magnitude of a weight.
    pub weight: f64,
    /// The bias.
    pub bias: f64,
}

impl Span {
    /// That of these weights and a bias.
    pub fn of(weights: &[f64], bias: f64) -> Self {
        Self { weight: weights.iter().fold(0.0, |most, w| most.max(w.abs())), bias }
    }
}

impl Dense {
    /// The spans of its outputs.
    pub fn spans(&self) -> Vec<Span> {
        let columns = self.weight.chunks_exact(self.weight.len() / self.bias.len()).zip(&self.bias);
        columns.map(|(weights, &bias)| Span::of(weights, bias)).collect()
    }
}

/// A source's weights, with norms folded in.
#[derive(Clone, Copy)]
pub struct Weights<'a>(pub &'a dyn Source);

impl std::fmt::Debug for Weights<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Weights").finish_non_exhaustive()
    }
}

impl Weights<'_> {
    /// The tensor `name` as it is.
    ///
    /// # Errors
    /// As [`Source::tensor`].
    pub fn tensor(&self, name: &str, shape: &[usize]) -> Result<Values> {
        self.0.tensor(name, shape)
    }

    /// Weights of shape `shape` (outputs first) and bias, with the norm folded in.
    ///
    /// # Errors
    /// As [`Source::tensor`]; a negative variance.
    pub fn dense(&self, names: &ConvNames, shape: &[usize], outputs: usize) -> Result<Dense> {
        let mut weight = self.tensor(&format!("{}.weight", names.prefix), shape)?;
        let mut bias = match names.bias {
            true => self.tensor(&format!("{}.bias", names.prefix), &[outputs])?,
            false => vec![0.0; outputs],
        };
        let scale = self.fold(names, &mut bias)?;
        let per_output = weight.len() / outputs;
        for (row, scale) in weight.chunks_exact_mut(per_output).zip(scale) {
            row.iter_mut().for_each(|w| *w *= scale);
        }
        Ok(Dense { weight, bias })
    }

    /// The factor of each output's weights; `bias` becomes the folded one.
    ///
    /// # Errors
    /// As [`Weights::dense`].
    pub fn fold(&self, names: &ConvNames, bias: &mut [f64]) -> Result<Values> {
        let Some(prefix) = &names.norm else { return Ok(vec![1.0; bias.len()]) };
        let [scale, shift] = self.norm(prefix, bias.len())?;
        for ((b, scale), shift) in bias.iter_mut().zip(&scale).zip(&shift) {
            *b = *b * scale + shift;
        }
        Ok(scale)
    }

    /// A batch norm as scale and shift.
    ///
    /// # Errors
    /// As [`Weights::dense`].
    pub fn norm(&self, prefix: &str, channels: usize) -> Result<[Values; 2]> {
        let tensor = |name: &str| self.tensor(&format!("{prefix}.{name}"), &[channels]);
        let (gamma, beta, mean, variance) =
            (tensor("weight")?, tensor("bias")?, tensor("running_mean")?, tensor("running_var")?);
        if let Some(i) = variance.iter().position(|&v| v < 0.0) {
            return Err(Error::format(format!(
                "tensor \"{prefix}.running_var\": element [{i}] is {}, expected a variance of at least 0",
                variance[i]
            )));
        }
        let scale: Values = gamma.iter().zip(&variance).map(|(g, v)| g / (v + EPSILON).sqrt()).collect();
        let shift = beta.iter().zip(&mean).zip(&scale).map(|((b, m), s)| b - m * s).collect();
        Ok([scale, shift])
    }
}

/// `a` [rows, inner] times `b` [inner, columns].
pub fn matmul(a: &[f64], b: &[f64], rows: usize, inner: usize, columns: usize) -> Values {
    let mut out = vec![0.0; rows * columns];
    for (a, out) in a.chunks_exact(inner).zip(out.chunks_exact_mut(columns)) {
        for (&a, b) in a.iter().zip(b.chunks_exact(columns)) {
            out.iter_mut().zip(b).for_each(|(out, b)| *out += a * b);
        }
    }
    out
}

/// Weights `[outputs, inputs, taps]` to panels with k running over (tap, input).
pub fn packed(weight: &[f64], inputs: usize, outputs: usize) -> Values {
    let depth = weight.len() / outputs;
    let taps = depth / inputs;
    packed_by(depth, outputs, |k, n| weight[n * depth + k % inputs * taps + k / inputs])
}

/// The panels of a matrix of `depth` rows whose element in row k and column n is `weight(k, n)`.
pub fn packed_by(depth: usize, columns: usize, weight: impl Fn(usize, usize) -> f64) -> Values {
    let mut out = vec![0.0; packed_len(depth, columns)];
    for n in 0..columns {
        for k in 0..depth {
            out[packed_index(depth, k, n)] = weight(k, n);
        }
    }
    out
}

/// Depthwise weights `[channels, taps]` to `[taps, channels padded to 16]`.
pub fn packed_taps(weight: &[f64], taps: usize, channels: usize) -> Values {
    let mut out = vec![];
    for tap in 0..taps {
        let row: Values = (0..channels).map(|c| weight[c * taps + tap]).collect();
        out.extend(padded(row));
    }
    out
}

/// With zeros up to a multiple of 16.
pub fn padded(mut values: Values) -> Values {
    values.resize(values.len().next_multiple_of(LANES), 0.0);
    values
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn matrices_multiply() {
        // [[1, 2], [3, 4], [5, 6]] times [[1, 0, 2], [0, 1, 3]].
        let found = matmul(&[1., 2., 3., 4., 5., 6.], &[1., 0., 2., 0., 1., 3.], 3, 2, 3);
        assert_eq!(found, [1., 2., 8., 3., 4., 18., 5., 6., 28.]);
    }
}

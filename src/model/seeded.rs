//! Weights drawn from a seed: for a program that shows itself, and for tests and benches that need no checkpoint.

use crate::base::error::Result;
use crate::base::random::Random;
use crate::model::import::Source;

/// Weights that keep activations of order one, each tensor drawn from the seed and its name. Batch norms do nothing.
#[derive(Clone, Copy, Debug)]
pub struct SeededWeights {
    /// Other seeds give other weights.
    pub seed: u64,
}

impl Source for SeededWeights {
    fn tensor(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>> {
        let len: usize = shape.iter().product();
        let constant = |value: f64| Ok(vec![value; len]);
        if name.ends_with("running_mean") {
            return constant(0.0);
        }
        if name.ends_with("running_var") || (shape.len() == 1 && name.ends_with(".weight")) {
            return constant(1.0);
        }
        // FNV-1a of the name, so that a tensor does not depend on the order in which tensors are asked for.
        let mut hash = 0xcbf2_9ce4_8422_2325u64;
        for byte in name.bytes() {
            hash = (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
        }
        let mut random = Random::new(hash ^ self.seed.wrapping_mul(0x9e37_79b9_7f4a_7c15));
        // Inputs of an output: the transposed convolution lists inputs first, and each output meets 8 of its 64 taps.
        let fan = match shape {
            [inputs, _, 4, 4, 4] => inputs * 8,
            [_, rest @ ..] => rest.iter().product(),
            [] => 1,
        };
        let deviation = if shape.len() == 1 { 0.05 } else { (1.6 / fan as f64).sqrt() };
        Ok((0..len).map(|_| f64::from(random.normal()) * deviation).collect())
    }
}

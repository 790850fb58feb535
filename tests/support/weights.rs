//! Drawn weights.

use voxcast::Result;
use voxcast::import::Source;
use voxcast::random::Random;
use voxcast::seeded::SeededWeights;

/// Drawn weights whose batch norms do something, unlike those of [`SeededWeights`].
pub(crate) struct Weights(pub(crate) u64);

impl Source for Weights {
    fn tensor(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>> {
        let mut values = SeededWeights { seed: self.0 }.tensor(name, shape)?;
        let seed = name.bytes().fold(self.0, |h, b| h.wrapping_mul(0x0100_0000_01b3) ^ u64::from(b));
        let mut random = Random::new(seed);
        if name.ends_with("running_mean") {
            values.iter_mut().for_each(|v| *v = f64::from(random.normal()) * 0.1);
        } else if name.ends_with("running_var") || (shape.len() == 1 && name.ends_with(".weight")) {
            values.iter_mut().for_each(|v| *v = f64::from(random.range(0.5, 1.5)));
        }
        Ok(values)
    }
}

/// [`Weights`] with some made smaller, so that images in units of a byte become activations of order one and stay so: else
/// every softmax would choose one token and every deformable sample leave its image.
#[allow(dead_code, reason = "not every test that draws weights needs it")]
pub(crate) struct Tempered(pub(crate) u64);

impl Source for Tempered {
    fn tensor(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>> {
        let mut values = Weights(self.0).tensor(name, shape)?;
        let factor = match name {
            "img_backbone.conv1.weight" => 1.0 / 64.0,
            _ if shape.len() < 4 => 1.0,
            _ if name.contains("bev_attn_layer") => 0.4,
            _ if name.contains("img_neck") => 0.5,
            _ if name.contains("conv_offset") => 5.0,
            _ if name.contains("img_backbone") => 0.8,
            _ => 1.0,
        };
        values.iter_mut().for_each(|v| *v *= factor);
        Ok(values)
    }
}

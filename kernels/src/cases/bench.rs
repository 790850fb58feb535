//! A kernel's work at one of the network's shapes.

use crate::isa::Isa;
use std::boxed::Box;
use std::format;
use std::ops::Range;
use std::string::String;
use std::vec;
use std::vec::Vec;

/// `n` unequal values up to `scale`, of both signs.
pub fn values(n: usize, scale: f32) -> Vec<f32> {
    (0..n).map(|i| ((i * 37 % 101) as f32 * 0.02 - 1.0) * scale).collect()
}

/// Work that can be run again and again: some units, each of which writes as many values.
pub struct Bench {
    /// What runs it in the network.
    pub name: String,
    /// Multiply-adds of all units.
    pub multiply_adds: u64,
    /// Bytes that must be read and written, each once.
    pub bytes: u64,
    units: usize,
    out: Vec<f32>,
    kernel: Box<Kernel>,
}

/// Computes units into values.
type Kernel = dyn FnMut(Isa, Range<usize>, &mut [f32]);

impl Bench {
    /// `units` units of `each` values. `multiply_adds` are a unit's; `read` are the bytes that all of them read.
    pub fn new(
        name: impl Into<String>,
        [units, each]: [usize; 2],
        multiply_adds: usize,
        read: usize,
        kernel: impl FnMut(Isa, Range<usize>, &mut [f32]) + 'static,
    ) -> Self {
        Self {
            name: name.into(),
            multiply_adds: (units * multiply_adds) as u64,
            bytes: (read + 4 * units * each) as u64,
            units,
            out: values(units * each, 1.0),
            kernel: Box::new(kernel),
        }
    }

    /// Does all of it.
    pub fn run(&mut self, isa: Isa) {
        (self.kernel)(isa, 0..self.units, &mut self.out);
    }

    /// The difference between a few units in the middle and what the specification makes of them, if there is any.
    pub fn difference(&mut self, isa: Isa) -> Option<String> {
        let few = self.units / 2..(self.units / 2 + 2).min(self.units);
        let each = self.out.len() / self.units;
        let mut run = |isa| {
            let mut out = vec![0.5; few.len() * each];
            (self.kernel)(isa, few.clone(), &mut out);
            out
        };
        let (got, want) = (run(isa), run(Isa::Scalar));
        let i = got.iter().zip(&want).position(|(a, b)| a.to_bits() != b.to_bits())?;
        Some(format!("value {i} is {:e}, not {:e}", got[i], want[i]))
    }
}

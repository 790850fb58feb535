//! A kernel's work at one of the network's shapes.

use super::{Output, Plain};
use crate::isa::Isa;
use std::boxed::Box;
use std::ops::Range;
use std::string::String;
use std::vec::Vec;

/// `n` unequal values up to `scale`, of both signs.
pub fn values(n: usize, scale: f32) -> Vec<f32> {
    (0..n).map(|i| ((i * 37 % 101) as f32 * 0.02 - 1.0) * scale).collect()
}

/// `n` unequal bytes of both signs, all that an 8-bit tensor can hold.
pub fn bytes(n: usize) -> Vec<i8> {
    (0..n).map(|i| (i * 37 % 255) as i8).map(|x| x.max(-127)).collect()
}

/// What a kernel writes.
pub trait Element: Plain {
    /// `n` values to begin with.
    fn some(n: usize) -> Vec<Self>;
    /// The values as a case's output.
    fn output(values: &[Self]) -> Output;
}

impl Element for f32 {
    fn some(n: usize) -> Vec<Self> {
        values(n, 1.0)
    }
    fn output(values: &[Self]) -> Output {
        values.into()
    }
}

impl Element for i8 {
    fn some(n: usize) -> Vec<Self> {
        bytes(n)
    }
    fn output(values: &[Self]) -> Output {
        values.into()
    }
}

/// Work that can be run again and again: some units, each of which writes as many values.
pub struct Bench {
    /// What runs it in the network.
    pub name: String,
    /// Multiply-adds of all units.
    pub multiply_adds: u64,
    /// Bytes that must be read and written, each once.
    pub bytes: u64,
    work: Box<dyn Work>,
}

/// All units of a bench, whatever they write.
trait Work {
    fn run(&mut self, isa: Isa);
    /// What `isa` makes of a few units in the middle.
    fn few(&mut self, isa: Isa) -> Output;
}

struct Units<T, F> {
    units: usize,
    out: Vec<T>,
    kernel: F,
}

impl<T: Element, F: FnMut(Isa, Range<usize>, &mut [T])> Work for Units<T, F> {
    fn run(&mut self, isa: Isa) {
        (self.kernel)(isa, 0..self.units, &mut self.out);
    }

    fn few(&mut self, isa: Isa) -> Output {
        let few = self.units / 2..(self.units / 2 + 2).min(self.units);
        let mut out = T::some(few.len() * (self.out.len() / self.units));
        (self.kernel)(isa, few, &mut out);
        T::output(&out)
    }
}

impl Bench {
    /// `units` units of `each` values. `multiply_adds` are a unit's; `read` are the bytes that all of them read.
    pub fn new<T: Element + 'static>(
        name: impl Into<String>,
        [units, each]: [usize; 2],
        multiply_adds: usize,
        read: usize,
        kernel: impl FnMut(Isa, Range<usize>, &mut [T]) + 'static,
    ) -> Self {
        Self {
            name: name.into(),
            multiply_adds: (units * multiply_adds) as u64,
            bytes: (read + size_of::<T>() * units * each) as u64,
            work: Box::new(Units { units, out: T::some(units * each), kernel }),
        }
    }

    /// Does all of it.
    pub fn run(&mut self, isa: Isa) {
        self.work.run(isa);
    }

    /// The difference between a few units in the middle and what the specification makes of them, if there is any.
    pub fn difference(&mut self, isa: Isa) -> Option<String> {
        let got = self.work.few(isa);
        got.difference(&self.work.few(Isa::Scalar))
    }
}

//! What is known of every kernel from its line in [`REGISTRY`], which stands in `ops.rs`: how to call it with any arguments,
//! and at the network's shapes.
//!
//! Tests take from it that the specification computes its formula, and that every instruction set gives its bits and stays inside
//! its slices, the fuzz target any shapes and bits, the benchmarks their work. A kernel's part is its module `cases`: a file beside it,
//! `ops/KERNEL/cases.rs`, or some lines in its own.

mod bench;
pub(crate) mod draw;
mod memory;
pub(crate) mod right_i8;
#[cfg(all(target_arch = "x86_64", target_os = "linux", target_env = "gnu"))]
mod trap;

pub use bench::{Bench, Element, bytes, values};
pub use draw::{Draw, MAX_WORK, Weights};
pub use memory::{Held, Memory, Plain};
#[cfg(all(target_arch = "x86_64", target_os = "linux", target_env = "gnu"))]
pub use trap::carried_out;

pub use crate::ops::REGISTRY;

use crate::isa::Isa;
use std::boxed::Box;
use std::format;
use std::string::String;
use std::vec::Vec;

/// A kernel that is known.
#[derive(Clone, Copy)]
pub struct Entry {
    /// The name of its file in `ops`.
    pub name: &'static str,
    /// A call with arguments that are drawn, unless it would be too much work.
    pub draw: fn(&mut Draw) -> Option<Box<dyn Case>>,
    /// Its work in the network.
    pub benches: fn() -> Vec<Bench>,
}

/// One call of a kernel with its arguments.
pub trait Case {
    /// Calls it with slices in `memory` that are exactly as long as they must be.
    fn run(&self, isa: Isa, memory: Memory) -> Output;

    /// What the formula gives in f64; none of a kernel that its own tests compare with f64.
    fn exact(&self) -> Option<Exact> {
        None
    }
}

/// What a call should give, but for rounding.
#[derive(Clone, Debug)]
pub struct Exact {
    /// In the order of [`Output::values`].
    pub values: Vec<f64>,
    /// How far f32 may be from a value v that was computed of values up to 1: this times 1 + |v|.
    pub tolerance: f64,
}

/// What a call returned and wrote.
#[derive(Clone, Debug, Default)]
pub struct Output {
    /// Values, any NaN being equal to any NaN.
    pub values: Vec<f32>,
    /// Integers, classes, pixels and truth.
    pub codes: Vec<i64>,
}

impl From<&[f32]> for Output {
    fn from(values: &[f32]) -> Self {
        Self { values: values.to_vec(), codes: Vec::new() }
    }
}

impl From<&[i8]> for Output {
    fn from(values: &[i8]) -> Self {
        Self { values: Vec::new(), codes: values.iter().copied().map(i64::from).collect() }
    }
}

impl Output {
    /// The first difference in bits, in words.
    pub fn difference(&self, want: &Self) -> Option<String> {
        if [self.values.len(), self.codes.len()] != [want.values.len(), want.codes.len()] {
            return Some("lengths differ".into());
        }
        let same = |(a, b): (&f32, &f32)| a.to_bits() == b.to_bits() || (a.is_nan() && b.is_nan());
        if let Some(i) = self.values.iter().zip(&want.values).position(|pair| !same(pair)) {
            return Some(format!("value {i} is {:e}, not {:e}", self.values[i], want.values[i]));
        }
        let i = self.codes.iter().zip(&want.codes).position(|(a, b)| a != b)?;
        Some(format!("code {i} is {}, not {}", self.codes[i], want.codes[i]))
    }
}

/// Every instruction set that tests can run here: those of the CPU, and on Linux with glibc `avx2-vnni` where the CPU has
/// AVX2 without AVX-VNNI. Then a signal handler carries out its instruction, some ten thousand times slower than a CPU.
pub fn isas() -> impl Iterator<Item = Isa> {
    let isas = Isa::available();
    #[cfg(all(target_arch = "x86_64", target_os = "linux", target_env = "gnu"))]
    let isas = isas.chain(trap::avx2_vnni());
    isas
}

/// The names of [`isas`], and which of them is not the CPU's own.
pub fn isas_in_words() -> String {
    let name = |isa: Isa| match Isa::parse(isa.name()) {
        Ok(_) => String::from(isa.name()),
        Err(_) => format!("{} by a signal handler", isa.name()),
    };
    isas().map(name).collect::<Vec<_>>().join(", ")
}

/// Runs `case` in each of `memories` on each of `isas`, and on no other before.
///
/// # Panics
/// If one gives other bits than the specification.
pub fn agree(name: &str, case: &dyn Case, isas: &[Isa], memories: &[Memory]) -> Output {
    let want = case.run(Isa::Scalar, Memory::Heap);
    for &memory in memories {
        for &isa in isas {
            if let Some(difference) = case.run(isa, memory).difference(&want) {
                panic!("{name} on {} in {memory:?}: {difference}", isa.name());
            }
        }
    }
    want
}

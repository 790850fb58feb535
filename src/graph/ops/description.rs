//! What is to be known of an operation, in one place: [`Description`].

use crate::base::error::Result;
use crate::graph::call::{Call, Tile};
use crate::graph::element::Elements;
use crate::graph::matrices::Level;
use crate::graph::parts::Part;
use crate::graph::site::Site;
use crate::graph::weights::{Span, Values, Weights};
use std::fmt::Debug;
use voxcast_kernels::Isa;

/// Who computes.
#[derive(Clone, Copy, Debug)]
pub struct Machine {
    /// Instruction set of the kernels.
    pub isa: Isa,
    /// Threads.
    pub workers: usize,
}

/// An operation: what it reads, stores, needs and costs, how its output is cut into tiles, and how a tile is computed.
///
/// Plan, executor, import, model, profile and memory accounting ask this and nothing else, so none of them knows which
/// operations there are. The reference (`tests/reference`) asks for the [`Description::shader`].
pub trait Description: Debug + Sync {
    /// What reports call it.
    fn kind(&self) -> &'static str;

    /// The input, by number, that the first output overwrites.
    fn in_place(&self) -> Option<usize> {
        None
    }

    /// Whether the first output may overwrite the residual that is added before the ReLU, where nothing reads it later:
    /// true if an element of the output depends on no other element of the residual.
    fn overwrites_residual(&self) -> bool {
        false
    }

    /// Stored parts, in the order in which [`Description::evaluate`] computes them.
    fn parts(&self, site: &Site<'_>) -> Vec<Part> {
        let _ = site;
        Vec::new()
    }

    /// The elements of every part.
    ///
    /// # Errors
    /// Those of the source of the weights.
    fn evaluate(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Values>> {
        let _ = (site, weights);
        Ok(Vec::new())
    }

    /// Checks stored parts, which have their sizes, for what kernels take for granted of them: a model file may hold anything.
    ///
    /// # Errors
    /// What was found and what was expected.
    fn verify(&self, site: &Site<'_>, parts: &[Elements<'_>]) -> std::result::Result<(), String> {
        let _ = (site, parts);
        Ok(())
    }

    /// The spans of the columns whose sums are brought to an integer output's steps; none where there are no such sums. They do
    /// not depend on a scale.
    ///
    /// # Errors
    /// Those of the source of the weights.
    fn spans(&self, site: &Site<'_>, weights: &Weights<'_>) -> Result<Vec<Span>> {
        let _ = (site, weights);
        Ok(Vec::new())
    }

    /// The finest step of the output to which sums of columns of these spans can be brought; of an output without scale in units
    /// of its own step. 0 if any will do.
    fn finest(&self, site: &Site<'_>, spans: &[Span]) -> f64 {
        let _ = (site, spans);
        0.0
    }

    /// Bytes of scratch that a worker needs.
    fn scratch(&self, site: &Site<'_>) -> usize {
        let _ = site;
        0
    }

    /// Multiply-adds of the operation as the network's definition has it, of one camera where it runs per camera. 0 for
    /// one that only moves or adds elements, and for a gather, whose cost is memory.
    fn multiply_adds(&self, site: &Site<'_>) -> u128 {
        let _ = site;
        0
    }

    /// Multiply-adds that the kernel executes: fewer than [`Description::multiply_adds`] for an algorithm that saves some.
    fn executed_multiply_adds(&self, site: &Site<'_>) -> u128 {
        self.multiply_adds(site)
    }

    /// How many times as long a multiply-add of this operation takes as one of a large product, about.
    fn pace(&self) -> u64 {
        1
    }

    /// Elements that the operation reads and writes.
    fn moved(&self, site: &Site<'_>, levels: &[Level<'_>; 3]) -> usize {
        let _ = levels;
        let read = site.reads().map(|t| t.len()).fold(0, usize::saturating_add);
        read.saturating_add(site.rows().saturating_mul(site.channels))
    }

    /// Positions of the output in one tile: small, so that a slice of tiles can be short, but enough to be worth handing
    /// out. It must not show in a result.
    fn tile(&self, site: &Site<'_>, machine: Machine) -> usize;

    /// Computes one tile.
    fn execute(&self, call: &Call<'_>, tile: Tile<'_>);

    /// The operation as one plain shader of the unfolded network; none where the reference composes it of several.
    fn shader(&self, site: &Site<'_>) -> Option<Shader> {
        let _ = site;
        None
    }
}

/// A plain shader: one invocation per element of the output, tensors channels first, weights as the checkpoint has them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Shader {
    /// Its file, without `.wgsl`.
    pub name: &'static str,
    /// The words of its struct of shapes, laid out as WGSL says: a vec3 takes four.
    pub shape: Vec<usize>,
    /// Its weights by checkpoint name and shape, bound after the inputs. A name that the network lacks is bound as one 0.
    pub weights: Vec<(Option<String>, Vec<usize>)>,
}

/// Voxels or cells that one worker takes at a time of an operation that mostly moves memory.
pub(super) const ROWS: usize = 500;

/// Elements in the image rows or volume planes that one worker computes at a time, at least.
const LINE_ELEMENTS: usize = 1 << 14;

/// Positions of a few whole lines of the output, which is made of `lines` of them: image rows or volume planes.
pub(super) fn whole_lines(site: &Site<'_>, lines: usize, machine: Machine) -> usize {
    let positions = site.rows() / lines;
    let per_tile = LINE_ELEMENTS.div_ceil((positions * site.output().channels).max(1));
    positions * per_tile.min(lines.div_ceil(8 * machine.workers)).max(1)
}

/// As a factor of a count of multiply-adds. Rows take up to 32 bits, and there are several factors of up to 21.
pub(super) fn wide(v: usize) -> u128 {
    v as u128
}

//! Checkpoint to model: folds batch norms and the projection in f64, packs, and writes what the kernels read.

pub use crate::graph::weights::Source;

use crate::base::error::{Error, ErrorKind, Result};
use crate::file::container::{self, Data, Tensor};
use crate::graph::parts::{Part, Precision};
use crate::graph::weights::{Span, Values, Weights};
use crate::graph::{Element, Graph, LEVELS, Operation, Results, Rewrites, Scale};
#[cfg(feature = "import")]
use crate::model::checkpoint::Checkpoint;
use crate::model::ranges::Ranges;
use crate::model::{self, Form, Options, parts};
use crate::network::Network;
use half::f16;
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::path::Path;

#[cfg(feature = "import")]
impl Source for Checkpoint {
    fn tensor(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>> {
        let Some(tensor) = self.get(name) else {
            let near = self.nearest(name);
            let (what, names) = match near.is_empty() {
                true => ("its names begin with", self.names().take(3).collect()),
                false => ("the nearest names are", near),
            };
            let names: Vec<String> = names.iter().map(|name| format!("{name:?}")).collect();
            let names = names.join(", ");
            return Err(Error::format(format!(
                "tensor \"{name}\" is missing, expected shape {shape:?}; {what} {names}"
            )));
        };
        if tensor.shape() != shape {
            return Err(Error::mismatch(format!(
                "tensor \"{name}\" has shape {:?}, the network expects {shape:?}",
                tensor.shape()
            )));
        }
        if let Some(prefix) = name.strip_suffix("attention_biases") {
            check_offsets(self, &format!("{prefix}attention_bias_idxs"), shape)?;
        }
        tensor.to_f64()
    }
}

/// Checks that the table of offsets beside a window's biases, if the checkpoint has one, is the one that the kernel
/// computes with: of points row by row, the offset (|dy|, |dx|) has the number |dy| side + |dx|.
#[cfg(feature = "import")]
fn check_offsets(checkpoint: &Checkpoint, name: &str, biases: &[usize]) -> Result<()> {
    let Some(table) = checkpoint.get(name) else { return Ok(()) };
    let points = biases.last().copied().unwrap_or_default();
    let side = points.isqrt();
    if table.shape() != [points, points] {
        let message = format!("tensor \"{name}\" has shape {:?}, expected [{points}, {points}]", table.shape());
        return Err(Error::mismatch(message));
    }
    for (at, found) in table.to_f64()?.into_iter().enumerate() {
        let (a, b) = (at / points, at % points);
        let expected = (a / side).abs_diff(b / side) * side + (a % side).abs_diff(b % side);
        if found != expected as f64 {
            let message = format!("tensor \"{name}\": element [{a}, {b}] is {found}, expected {expected}");
            return Err(Error::mismatch(message));
        }
    }
    Ok(())
}

/// Makes a model in floating point of the weights that `source` has and writes it to `path`, by way of a temporary file
/// beside it. `progress` is told how many of how many tensors are done.
///
/// # Errors
/// A tensor that is missing, has another shape, or holds a number that is not finite, by name; failed writes.
pub fn import(
    source: &dyn Source,
    network: &Network,
    options: Options,
    path: &Path,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<()> {
    Conversion::new(source, Form::floating(network, options)?)?.write(path, progress)
}

/// Makes a model in floating point of the weights that `source` has, in memory: the bytes that [`import`] would write.
///
/// # Errors
/// Those of [`import`] that are not about the file; [`ErrorKind::TooLarge`] if the system has no memory for it.
pub fn import_to_bytes(
    source: &dyn Source,
    network: &Network,
    options: Options,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Vec<u8>> {
    Conversion::new(source, Form::floating(network, options)?)?.bytes(progress)
}

/// How a model of 8-bit integers is made. A deformable convolution stays in floating point also where its offsets are farther than
/// integers tell apart; the model's [`Quantisation::keep_f32`](crate::graph::Quantisation::keep_f32) has those too.
#[derive(Clone, Debug)]
pub struct Integers<'a> {
    /// Which rewrites come first. Batch norms are folded.
    pub rewrites: Rewrites,
    /// The ranges of the network's tensors.
    pub ranges: &'a Ranges,
    /// Operations that stay in floating point, by name, or by the start of names up to a dot.
    pub keep_f32: &'a [String],
}

impl Integers<'_> {
    /// The form of the model. A scale that is finer than the sums of the weights that write its tensor is made as coarse as they
    /// are, and with it whatever depends on it. Offsets have steps of their own: where these are too fine, they stay in f32.
    fn form(&self, source: &dyn Source, network: &Network) -> Result<Form> {
        let mut least: BTreeMap<String, f64> = BTreeMap::new();
        let mut keep_f32 = self.keep_f32.to_vec();
        let mut folded = Folded { source, spans: BTreeMap::new() };
        loop {
            let scale = |name: &str| {
                let scale = self.ranges.scale(name)?;
                let least = least.get(name).copied().unwrap_or_default();
                // A little more, for it is rounded to f32.
                if scale.wide() < least { Scale::of_range(least * LEVELS * (1.0 + 1e-6)) } else { Ok(scale) }
            };
            let quantisation = model::quantisation(network, self.rewrites, &keep_f32, &scale)?;
            let form = Form::integers(network, self.rewrites, quantisation)?;
            let graph = form.graph(false, Results::ALL)?;
            let Some((operation, finest)) = folded.too_fine(&graph)? else { return Ok(form) };
            let tensor = graph.tensor(operation.output());
            if tensor.scale.is_none() {
                keep_f32.push(operation.name.clone());
            } else if least.insert(tensor.name.clone(), finest).is_some_and(|before| finest <= before) {
                // Another tensor's scale decides; the operation itself says what is wrong.
                return Ok(form);
            }
        }
    }
}

/// What is known of a source's weights, each of which is read and folded once.
struct Folded<'a> {
    source: &'a dyn Source,
    /// Of operations by name.
    spans: BTreeMap<String, Vec<Span>>,
}

impl Folded<'_> {
    /// The first operation whose output's steps are finer than it can write, and what it can.
    fn too_fine<'g>(&mut self, graph: &'g Graph) -> Result<Option<(&'g Operation, f64)>> {
        for operation in &graph.operations {
            let (description, site) = (operation.op.description(), graph.site(operation));
            let spans = match self.spans.entry(operation.name.clone()) {
                Entry::Occupied(known) => known.into_mut(),
                Entry::Vacant(unknown) => unknown.insert(description.spans(&site, &Weights(self.source))?),
            };
            let finest = description.finest(&site, spans);
            if graph.tensor(operation.output()).scale.map_or(1.0, Scale::wide) < finest {
                return Ok(Some((operation, finest)));
            }
        }
        Ok(None)
    }
}

/// [`import`] to a model of 8-bit integers.
///
/// # Errors
/// As [`import`]; a tensor whose range is missing, zero or underflows, by name; an operation to be kept that the network
/// does not have, or whose weights do not go with the ranges.
pub fn import_int8(
    source: &dyn Source,
    network: &Network,
    integers: &Integers<'_>,
    path: &Path,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<()> {
    Conversion::new(source, integers.form(source, network)?)?.write(path, progress)
}

/// [`import_to_bytes`] to a model of 8-bit integers.
///
/// # Errors
/// Those of [`import_int8`] that are not about the file; [`ErrorKind::TooLarge`] if the system has no memory for it.
pub fn import_int8_to_bytes(
    source: &dyn Source,
    network: &Network,
    integers: &Integers<'_>,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Vec<u8>> {
    Conversion::new(source, integers.form(source, network)?)?.bytes(progress)
}

/// Everything that goes into a model, in file order.
struct Conversion<'a> {
    source: &'a dyn Source,
    form: Form,
    graphs: Vec<Graph>,
    /// Graph and operation of each operation that stores something.
    operations: Vec<(usize, usize)>,
    /// The values of the operation whose parts are being written.
    current: RefCell<(usize, Vec<Values>)>,
}

impl<'a> Conversion<'a> {
    fn new(source: &'a dyn Source, form: Form) -> Result<Self> {
        let form = Form { temperature: source.temperature(), ..form };
        let graphs = form.graphs()?;
        let operations = model::stored(&graphs);
        Ok(Self { source, form, graphs, operations, current: RefCell::new((usize::MAX, vec![])) })
    }

    fn write(&self, path: &Path, progress: &mut dyn FnMut(usize, usize)) -> Result<()> {
        container::write(path, self.tensors(progress), &self.form.metadata(), model::LAYOUT)
    }

    fn bytes(&self, progress: &mut dyn FnMut(usize, usize)) -> Result<Vec<u8>> {
        container::to_bytes(self.tensors(progress), &self.form.metadata(), model::LAYOUT)
    }

    fn precision(&self) -> Precision {
        self.form.options.precision
    }

    fn operation(&self, index: usize) -> (&Graph, &Operation) {
        let (g, o) = self.operations[index];
        (&self.graphs[g], &self.graphs[g].operations[o])
    }

    /// The tensors to write. Each is made when its turn comes.
    fn tensors<'b>(&'b self, progress: &'b mut dyn FnMut(usize, usize)) -> Vec<Tensor<'b>> {
        let total = self.operations.len();
        let progress = std::rc::Rc::new(RefCell::new(progress));
        let mut tensors = vec![];
        for index in 0..total {
            let (graph, operation) = self.operation(index);
            let parts = parts(graph, operation);
            let count = parts.len();
            for (i, part) in parts.into_iter().enumerate() {
                let name = format!("{}.{}", operation.name, part.suffix);
                let (label, stored, progress) = (name.clone(), part.clone(), progress.clone());
                let make = move || {
                    if i + 1 == count {
                        (progress.borrow_mut())(index + 1, total);
                    }
                    self.part(index, i, &label, &stored)
                };
                tensors.push(model::tensor(name, &part, self.precision(), Data::Make(Box::new(make))));
            }
        }
        tensors
    }

    /// The bytes of part `i` of operation `index`.
    fn part(&self, index: usize, i: usize, name: &str, part: &Part) -> Result<Vec<u8>> {
        let mut current = self.current.borrow_mut();
        if current.0 != index {
            let (graph, operation) = self.operation(index);
            let weights = Weights(self.source);
            let evaluated = operation.op.description().evaluate(&graph.site(operation), &weights);
            let of_operation = |e: Error| match e.kind() {
                ErrorKind::Unsupported => {
                    Error::new(e.kind(), format!("operation \"{}\": {}", operation.name, e.message()))
                }
                _ => e,
            };
            *current = (index, evaluated.map_err(of_operation)?);
        }
        encode(name, part, &current.1[i], self.precision())
    }
}

/// The bytes of a stored tensor: each value rounded once, to f32, and from there to a narrower type if it is stored in one.
pub(super) fn encode(name: &str, part: &Part, values: &[f64], precision: Precision) -> Result<Vec<u8>> {
    let single = |value: f64| {
        let single = value as f32;
        let bad = || Error::format(format!("tensor \"{name}\": folding gives {single}, expected finite numbers"));
        single.is_finite().then_some(single).ok_or_else(bad)
    };
    let half = |value: f64| {
        let single = single(value)?;
        let half = f16::from_f32(single);
        let large = || {
            let message =
                format!("tensor \"{name}\": {single} does not fit half precision, expected at most 65504; use f32");
            Error::new(ErrorKind::Unsupported, message)
        };
        half.is_finite().then_some(half).ok_or_else(large)
    };
    let integer = |value: f64, [least, most]: [f64; 2]| {
        let fits = value.fract() == 0.0 && (least..=most).contains(&value);
        let bad = || Error::format(format!("tensor \"{name}\": {value}, expected an integer of {least} to {most}"));
        fits.then_some(value).ok_or_else(bad)
    };
    let element = part.element(precision);
    let mut bytes = Vec::with_capacity(part.stored_len(precision) * element.bytes());
    for &value in values {
        match element {
            Element::F32 => bytes.extend(single(value)?.to_le_bytes()),
            Element::F16 => bytes.extend(half(value)?.to_le_bytes()),
            Element::U8 => bytes.push(integer(value, [0.0, 255.0])? as u8),
            Element::I8 => bytes.extend((integer(value, [-128.0, 127.0])? as i8).to_le_bytes()),
            Element::I32 => bytes.extend((integer(value, [i32::MIN, i32::MAX].map(f64::from))? as i32).to_le_bytes()),
        }
    }
    bytes.resize(part.stored_len(precision) * element.bytes(), 0);
    Ok(bytes)
}

#[cfg(test)]
mod tests;

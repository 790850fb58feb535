//! A model as a source of weights: what import packed, under the checkpoint's names again.
//!
//! Which stored number is which number of the checkpoint is not written down a second time. Each operation's description is
//! asked to evaluate numbered weights, and where a number comes to lie, its value is read.

use crate::base::error::{Error, ErrorKind, Result};
use crate::graph::parts::Precision;
use crate::graph::weights::{EPSILON, Source, Values, Weights};
use crate::graph::{Element, Graph, Temperature};
use crate::model::Model;
use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};

/// The tensors of one operation by name.
type Tensors = BTreeMap<String, Values>;

/// The weights of a model in floating point, under the names of the checkpoint that it was made from.
///
/// Batch norms are part of the convolutions before them. The norm itself is one that only adds the bias.
#[derive(Debug)]
pub struct Unpacked<'a> {
    model: &'a Model,
    graph: Graph,
    /// The operation that reads each tensor, with the tensor's shape.
    readers: BTreeMap<String, (usize, Vec<usize>)>,
    /// The operation whose tensors were asked for last.
    current: RefCell<Option<(usize, Tensors)>>,
}

/// What evaluates to numbers by which stored values are found again.
#[derive(Default)]
struct Probe {
    /// Names and shapes, in the order in which they were asked for.
    asked: RefCell<Vec<(String, Vec<usize>)>>,
    /// Whether tensors of weights are numbered.
    numbered: bool,
    /// Prefixes of batch norms.
    norms: BTreeSet<String>,
}

impl Probe {
    /// Whether the tensor holds numbers of the model, and is no batch norm's nor a bias that a norm has taken up.
    fn is_stored(&self, name: &str) -> bool {
        let (prefix, last) = name.rsplit_once('.').unwrap_or(("", name));
        match self.norms.contains(prefix) {
            true => last == "bias",
            false => last != "bias" || self.norms.is_empty(),
        }
    }

    /// What a tensor of a norm holds beside its bias: such that it scales by one and shifts by nothing.
    fn constant(&self, name: &str) -> Option<f64> {
        let (prefix, last) = name.rsplit_once('.')?;
        match last {
            "running_mean" => Some(0.0),
            "running_var" => Some(1.0 - EPSILON),
            "weight" if self.norms.contains(prefix) => Some(1.0),
            _ => None,
        }
    }

    /// The number before that of the first element of the tensor asked for at `index`.
    fn base(asked: &[(String, Vec<usize>)], index: usize) -> usize {
        asked[..index].iter().map(|(_, shape)| shape.iter().product::<usize>()).sum()
    }
}

impl Source for Probe {
    fn tensor(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>> {
        let mut asked = self.asked.borrow_mut();
        asked.push((name.to_owned(), shape.to_vec()));
        let len = shape.iter().product();
        let base = Self::base(&asked, asked.len() - 1);
        Ok(match self.constant(name) {
            Some(value) => vec![value; len],
            None if self.numbered && self.is_stored(name) => (1..=len).map(|i| (base + i) as f64).collect(),
            None => vec![0.0; len],
        })
    }
}

impl<'a> Unpacked<'a> {
    /// The weights of `model`.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] for a model of int8, whose weights are rounded, one whose weights are transformed, and one that
    /// keeps its batch norms.
    pub fn new(model: &'a Model) -> Result<Self> {
        let options = model.options();
        if options.precision == Precision::I8 || !options.rewrites.batch_norm {
            let message = "a model of int8 or with batch norms of its own, expected one of f32 or f16 with folded ones";
            return Err(Error::new(ErrorKind::Unsupported, message));
        }
        if options.rewrites.winograd {
            let message = "a model whose weights are transformed for Winograd's minimal filtering, expected one that was \
                           imported with --exact";
            return Err(Error::new(ErrorKind::Unsupported, message));
        }
        let graph = model.graph(true, crate::graph::Results::ALL);
        let mut readers = BTreeMap::new();
        for index in 0..graph.operations.len() {
            for (name, shape) in Self::probe(&graph, index, Probe::default())?.0 {
                readers.insert(name, (index, shape));
            }
        }
        Ok(Self { model, graph, readers, current: RefCell::new(None) })
    }

    /// What operation `index` asks for, and what it makes of that.
    #[allow(clippy::type_complexity, reason = "two lists, used in this file alone")]
    fn probe(graph: &Graph, index: usize, probe: Probe) -> Result<(Vec<(String, Vec<usize>)>, Vec<Values>)> {
        let operation = &graph.operations[index];
        let values = operation.op.description().evaluate(&graph.site(operation), &Weights(&probe))?;
        Ok((probe.asked.into_inner(), values))
    }

    /// The tensors of operation `index`.
    fn read(&self, index: usize) -> Result<Tensors> {
        let (asked, _) = Self::probe(&self.graph, index, Probe::default())?;
        let norm = |(name, _): &(String, Vec<usize>)| name.strip_suffix(".running_mean").map(str::to_owned);
        let norms: BTreeSet<String> = asked.iter().filter_map(norm).collect();
        let (asked, places) =
            Self::probe(&self.graph, index, Probe { numbered: true, norms: norms.clone(), ..Probe::default() })?;
        let mut numbers = vec![0.0; Probe::base(&asked, asked.len())];
        let refs = self.model.part_refs(&self.graph, &self.graph.operations[index])?;
        for (places, part) in places.iter().zip(&refs) {
            let elements = self.model.resolve(part);
            let value = |i: usize| match elements.element() {
                Element::F16 => f64::from(elements.of::<half::f16>()[i].to_f32()),
                _ => f64::from(elements.of::<f32>()[i]),
            };
            for (i, place) in places.iter().enumerate() {
                let number = place.round() as usize;
                if number > 0 {
                    numbers[number - 1] = value(i);
                }
            }
        }
        let probe = Probe { norms, ..Probe::default() };
        let mut numbers = numbers.into_iter();
        let mut tensors = Tensors::new();
        for (name, shape) in asked {
            let len = shape.iter().product();
            let values: Values = numbers.by_ref().take(len).collect();
            let values = probe.constant(&name).map_or(values, |constant| vec![constant; len]);
            tensors.insert(name, values);
        }
        Ok(tensors)
    }
}

impl Source for Unpacked<'_> {
    fn temperature(&self) -> Temperature {
        self.model.temperature()
    }

    fn tensor(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>> {
        let Some((index, found)) = self.readers.get(name) else {
            return Err(Error::format(format!("tensor \"{name}\" is missing, expected shape {shape:?}")));
        };
        if found != shape {
            let message = format!("tensor \"{name}\" has shape {found:?}, the network expects {shape:?}");
            return Err(Error::mismatch(message));
        }
        let mut current = self.current.borrow_mut();
        if current.as_ref().is_none_or(|(of, _)| of != index) {
            *current = Some((*index, self.read(*index)?));
        }
        let tensors = current.as_ref().map(|(_, tensors)| tensors);
        Ok(tensors.and_then(|tensors| tensors.get(name)).cloned().unwrap_or_default())
    }
}

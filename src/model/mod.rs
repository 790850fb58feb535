//! A model: weights in the layout that the kernels read, with the network they belong to, mapped and used in place.
//!
//! The file is described in `docs/format.md`. It holds no graph: the operations follow from the network's parameters, so
//! a file can hold wrong numbers but cannot change what runs.

#[cfg(feature = "import")]
pub mod checkpoint;
pub mod import;
pub mod seeded;
pub mod selftest;
mod transform;

pub use transform::use_winograd;

use crate::base::error::{Error, ErrorKind, Result};
use crate::file::container::{Container, Data, Layout, Tensor};
use crate::graph::parts::{Part, Precision};
use crate::graph::{Element, Elements, Graph, Operation, Results, Rewrites};
use crate::model::selftest::SelfTest;
use crate::network::Network;
use safetensors::Dtype;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Value of the metadata key `format`.
pub const FORMAT: &str = "voxcast-model-1";

/// How a model is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Options {
    /// How large weights are stored.
    pub precision: Precision,
    /// Which rewrites the model carries weights for. With the projection fold it also carries those of the graph without
    /// it, so that every stage can be looked at; they are not touched otherwise.
    pub rewrites: Rewrites,
}

impl Default for Options {
    fn default() -> Self {
        Self { precision: Precision::F32, rewrites: Rewrites::ALL }
    }
}

/// Weights ready to use, and the network they belong to.
#[derive(Debug)]
pub struct Model {
    container: Container,
    network: Network,
    options: Options,
    path: Option<PathBuf>,
}

impl Model {
    /// Maps a model file and checks all of it: checksum, network, and that every weight is there in its size.
    ///
    /// The file must not be changed while it is open; replacing it by renaming another over it is fine.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if it cannot be mapped; [`ErrorKind::Format`] and what is wrong otherwise.
    pub fn open(path: &Path) -> Result<Self> {
        Self::of_file(Container::open(path)?, path)
    }

    /// Copies a model file into memory and checks the copy as [`Model::open`] does. What was checked is what runs,
    /// whatever happens to the file; the weights are not shared with other processes.
    ///
    /// # Errors
    /// As [`Model::open`]; [`ErrorKind::TooLarge`] if the system has no memory for it.
    pub fn read(path: &Path) -> Result<Self> {
        Self::of_file(Container::read(path)?, path)
    }

    fn of_file(container: Container, path: &Path) -> Result<Self> {
        let mut model = Self::new(container).map_err(|e| e.in_file(path))?;
        model.path = Some(path.to_owned());
        Ok(model)
    }

    /// A model from bytes in memory, such as one built into a program. They are copied if they do not start on a multiple
    /// of 4 ([`Container::from_bytes`]).
    ///
    /// # Errors
    /// As [`Model::read`].
    pub fn from_bytes(bytes: impl Into<std::borrow::Cow<'static, [u8]>>) -> Result<Self> {
        Self::new(Container::from_bytes(bytes)?)
    }

    fn new(container: Container) -> Result<Self> {
        let get = |key: &str| {
            container.metadata().get(key).map(String::as_str).ok_or_else(|| {
                Error::format(format!("the metadata key \"{key}\" is missing, expected a voxcast model"))
            })
        };
        let format = get("format")?;
        if format != FORMAT {
            return Err(Error::format(format!("metadata key \"format\": found \"{format}\", expected \"{FORMAT}\"")));
        }
        let network = Network::from_json(get("network")?)?;
        let precision = get("precision")?;
        let precision = Precision::parse(precision).ok_or_else(|| {
            Error::format(format!("metadata key \"precision\": found \"{precision}\", expected f32 or f16"))
        })?;
        let flag = |key: &str| match get(key)? {
            "folded" => Ok(true),
            "kept" => Ok(false),
            other => Err(Error::format(format!("metadata key \"{key}\": found \"{other}\", expected folded or kept"))),
        };
        // A model without the key has direct sums.
        let winograd = match container.metadata().get("winograd").map(String::as_str) {
            None => false,
            Some("used") => true,
            Some(other) => {
                let message = format!("metadata key \"winograd\": found \"{other}\", expected used or no such key");
                return Err(Error::format(message));
            }
        };
        let rewrites = Rewrites { batch_norm: flag("batch_norm")?, projection: flag("projection")?, winograd };
        if rewrites.projection && !rewrites.batch_norm {
            return Err(Error::format("the projection is folded but the batch norms are not"));
        }
        let model = Self { container, network, options: Options { precision, rewrites }, path: None };
        for (name, part) in stored_parts(&model.network, rewrites) {
            model.check(&name, &part)?;
        }
        Ok(model)
    }

    fn check(&self, name: &str, part: &Part) -> Result<()> {
        let precision = self.options.precision;
        let Some((dtype, shape, _)) = self.container.tensor(name) else {
            return Err(Error::format(format!("tensor \"{name}\" is missing")));
        };
        let expected = (Dtype::from(part.element(precision)), part.stored_len(precision));
        if dtype != expected.0 || shape != [expected.1] {
            return Err(Error::format(format!(
                "tensor \"{name}\": found {dtype:?} of shape {shape:?}, expected {:?} of shape [{}]",
                expected.0, expected.1
            )));
        }
        self.part(name, part).map(drop)
    }

    /// The bytes of a stored part, without the padding after it.
    fn part(&self, name: &str, part: &Part) -> Result<&[u8]> {
        let size = part.element(self.options.precision).bytes();
        let bytes = self.container.tensor(name).map(|(_, _, bytes)| bytes);
        bytes
            .filter(|bytes| (bytes.as_ptr() as usize).is_multiple_of(size))
            .and_then(|bytes| bytes.get(..part.len * size))
            .ok_or_else(|| Error::format(format!("tensor \"{name}\" is missing, short or not aligned")))
    }

    /// The network.
    pub fn network(&self) -> &Network {
        &self.network
    }

    /// How it is stored.
    pub fn options(&self) -> Options {
        self.options
    }

    /// The file it was opened from.
    pub fn path(&self) -> Option<&Path> {
        self.path.as_deref()
    }

    /// Writes the model to `path`, as it is, by way of a temporary file beside it.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if the system refuses.
    pub fn save(&self, path: &Path) -> Result<()> {
        let tensors = self.contents().map(|(name, dtype, shape, bytes)| {
            let shape = shape.to_vec();
            Tensor { name, dtype, shape, data: Data::Bytes(bytes) }
        });
        crate::file::container::write(path, tensors.collect(), self.metadata(), LAYOUT)
    }

    /// The bytes of the file.
    pub fn bytes(&self) -> &[u8] {
        self.container.bytes()
    }

    /// How many bytes the file has.
    pub fn file_size(&self) -> usize {
        self.bytes().len()
    }

    /// The file's checksum.
    pub fn checksum(&self) -> Option<u64> {
        self.container.checksum()
    }

    /// The self-test that the model carries, if any.
    ///
    /// # Errors
    /// [`ErrorKind::Format`] if it is malformed.
    pub fn self_test(&self) -> Result<Option<SelfTest>> {
        let Some(text) = self.container.metadata().get(selftest::KEY) else { return Ok(None) };
        let malformed = |e: serde_json::Error| {
            let error = Error::format(format!("metadata key \"{}\": {e}", selftest::KEY));
            match &self.path {
                Some(path) => error.in_file(path),
                None => error,
            }
        };
        serde_json::from_str(text).map(Some).map_err(malformed)
    }

    /// What the file says of itself.
    pub(crate) fn metadata(&self) -> &BTreeMap<String, String> {
        self.container.metadata()
    }

    /// Name, element type, dimensions and bytes of the stored tensors, in file order.
    pub(crate) fn contents(&self) -> impl Iterator<Item = (String, Dtype, &[usize], &[u8])> + '_ {
        self.container.names().into_iter().filter_map(|name| {
            let (dtype, shape, bytes) = self.container.tensor(&name)?;
            Some((name, dtype, shape, bytes))
        })
    }

    /// Names, element types and lengths of the stored tensors, in file order.
    pub fn tensors(&self) -> impl Iterator<Item = (String, Dtype, usize)> + '_ {
        self.container.names().into_iter().filter_map(|name| {
            let (dtype, shape, _) = self.container.tensor(&name)?;
            Some((name, dtype, shape.iter().product()))
        })
    }

    /// The graph that runs: every rewrite the model has weights for, or, with `unfolded`, without the projection fold.
    pub fn graph(&self, unfolded: bool, results: Results) -> Graph {
        let rewrites = self.options.rewrites;
        Graph::build(&self.network, results)
            .rewritten(Rewrites { projection: rewrites.projection && !unfolded, ..rewrites })
    }

    /// Where the stored parts of `operation` lie, in the order of its description.
    ///
    /// # Errors
    /// None for operations of this model's graphs: [`Model::open`] has seen all of them.
    pub(crate) fn part_refs(&self, graph: &Graph, operation: &Operation) -> Result<Vec<PartRef>> {
        let data = self.container.bytes();
        parts(graph, operation)
            .iter()
            .map(|part| {
                let name = format!("{}.{}", operation.name, part.suffix);
                self.check(&name, part)?;
                let bytes = self.part(&name, part)?;
                let start = bytes.as_ptr() as usize - data.as_ptr() as usize;
                Ok(PartRef { bytes: start..start + bytes.len(), element: part.element(self.options.precision) })
            })
            .collect()
    }

    /// The elements of a part that [`Model::part_refs`] found. Costs nothing and allocates nothing.
    pub(crate) fn resolve(&self, part: &PartRef) -> Elements<'_> {
        Elements::new(part.element, &self.container.bytes()[part.bytes.clone()])
    }
}

/// Where a stored part lies in its model.
#[derive(Clone, Debug)]
pub(crate) struct PartRef {
    bytes: std::ops::Range<usize>,
    element: Element,
}

/// What `operation` stores.
pub(crate) fn parts(graph: &Graph, operation: &Operation) -> Vec<Part> {
    operation.op.description().parts(&graph.site(operation))
}

/// The graphs that a model of these rewrites can run, the fastest first.
pub(crate) fn graphs(network: &Network, rewrites: Rewrites) -> Vec<Graph> {
    let mut graphs = vec![Graph::build(network, Results::ALL).rewritten(rewrites)];
    if rewrites.projection {
        graphs.push(Graph::build(network, Results::ALL).rewritten(Rewrites { projection: false, ..rewrites }));
    }
    graphs
}

/// Full name and part of everything a model stores, in file order.
pub(crate) fn stored_parts(network: &Network, rewrites: Rewrites) -> Vec<(String, Part)> {
    let mut seen = BTreeSet::new();
    let mut list = vec![];
    for graph in graphs(network, rewrites) {
        for operation in graph.operations.iter().filter(|o| seen.insert(o.name.clone())) {
            list.extend(parts(&graph, operation).into_iter().map(|p| (format!("{}.{}", operation.name, p.suffix), p)));
        }
    }
    list
}

/// A stored tensor, to be written.
pub(crate) fn tensor<'a>(name: String, part: &Part, precision: Precision, data: Data<'a>) -> Tensor<'a> {
    Tensor { name, dtype: Dtype::from(part.element(precision)), shape: vec![part.stored_len(precision)], data }
}

/// Writes the bytes of a model, such as one built into a program, to `path`, by way of a temporary file beside it.
///
/// # Errors
/// [`ErrorKind::Io`] if the system refuses; [`ErrorKind::Format`] for bytes that are no model.
pub fn write_bytes(path: &Path, bytes: &'static [u8]) -> Result<()> {
    Model::from_bytes(bytes)?.save(path)
}

/// A model file's metadata.
pub(crate) fn metadata(network: &Network, options: Options) -> BTreeMap<String, String> {
    let flag = |folded: bool| if folded { "folded" } else { "kept" }.to_owned();
    let mut metadata = BTreeMap::from([
        ("format".to_owned(), FORMAT.to_owned()),
        ("network".to_owned(), network.to_json()),
        ("precision".to_owned(), options.precision.name().to_owned()),
        ("batch_norm".to_owned(), flag(options.rewrites.batch_norm)),
        ("projection".to_owned(), flag(options.rewrites.projection)),
    ]);
    if options.rewrites.winograd {
        metadata.insert("winograd".to_owned(), "used".to_owned());
    }
    metadata
}

/// How model tensors lie in their file.
pub(crate) const LAYOUT: Layout = Layout::Aligned;

/// Refuses options that contradict themselves.
pub(crate) fn check_options(options: Options) -> Result<()> {
    if options.rewrites.projection && !options.rewrites.batch_norm {
        return Err(Error::new(ErrorKind::Unsupported, "the projection can only be folded when batch norms are"));
    }
    Ok(())
}

#[cfg(test)]
mod tests;

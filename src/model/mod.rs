//! A model: weights in the layout that the kernels read, with the network they belong to, mapped and used in place.
//!
//! The file is described in `docs/format.md`. It holds no graph: the operations follow from the network's parameters, so
//! a file can hold wrong numbers but cannot change what runs.

#[cfg(feature = "import")]
pub mod checkpoint;
mod form;
pub mod import;
pub mod ranges;
pub mod seeded;
pub mod selftest;
mod transform;
pub mod unpacked;

pub use transform::use_winograd;

use crate::base::error::{Error, Result};
use crate::file::container::{Container, Data, Layout, Tensor};
use crate::graph::parts::{Part, Precision};
use crate::graph::{Element, Elements, Graph, Operation, Quantisation, Results, Rewrites, Temperature};
pub(crate) use crate::model::form::{Form, parts, quantisation, stored};
use crate::model::selftest::SelfTest;
use crate::network::Network;
use safetensors::Dtype;
use std::collections::BTreeMap;
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
    form: Form,
    path: Option<PathBuf>,
}

impl Model {
    /// Maps a model file and checks all of it: checksum, network, and that every weight is there in its size.
    ///
    /// The file must not be changed while it is open; replacing it by renaming another over it is fine.
    ///
    /// # Errors
    /// [`ErrorKind::Io`](crate::ErrorKind::Io) if it cannot be mapped; [`ErrorKind::Format`](crate::ErrorKind::Format) and what is wrong otherwise.
    pub fn open(path: &Path) -> Result<Self> {
        Self::of_file(Container::open(path)?, path)
    }

    /// Copies a model file into memory and checks the copy as [`Model::open`] does. What was checked is what runs,
    /// whatever happens to the file; the weights are not shared with other processes.
    ///
    /// # Errors
    /// As [`Model::open`]; [`ErrorKind::TooLarge`](crate::ErrorKind::TooLarge) if the system has no memory for it.
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
        let form = Form::read(container.metadata())?;
        let model = Self { container, form, path: None };
        for graph in model.form.graphs()? {
            model.check_graph(&graph)?;
        }
        Ok(model)
    }

    /// Checks that everything that `graph` stores is there, and is what kernels take for granted.
    fn check_graph(&self, graph: &Graph) -> Result<()> {
        for operation in &graph.operations {
            let refs = self.part_refs(graph, operation)?;
            let parts: Vec<Elements<'_>> = refs.iter().map(|part| self.resolve(part)).collect();
            let bad = |e: String| Error::format(format!("operation \"{}\": {e}", operation.name));
            operation.op.description().verify(&graph.site(operation), &parts).map_err(bad)?;
        }
        Ok(())
    }

    fn check(&self, name: &str, part: &Part) -> Result<()> {
        let precision = self.form.options.precision;
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
        let size = part.element(self.form.options.precision).bytes();
        let bytes = self.container.tensor(name).map(|(_, _, bytes)| bytes);
        bytes
            .filter(|bytes| (bytes.as_ptr() as usize).is_multiple_of(size))
            .and_then(|bytes| bytes.get(..part.len * size))
            .ok_or_else(|| Error::format(format!("tensor \"{name}\" is missing, short or not aligned")))
    }

    /// The network.
    pub fn network(&self) -> &Network {
        &self.form.network
    }

    /// How it is stored.
    pub fn options(&self) -> Options {
        self.form.options
    }

    /// What makes its graph one of 8-bit integers; none for floating point.
    pub fn quantisation(&self) -> Option<&Quantisation> {
        self.form.quantisation.as_ref()
    }

    /// The file it was opened from.
    pub fn path(&self) -> Option<&Path> {
        self.path.as_deref()
    }

    /// The temperature of the softmax that says how sure the network is ([`Occupancy::confidence`]): 1 unless one was
    /// fitted.
    ///
    /// [`Occupancy::confidence`]: crate::Occupancy::confidence
    pub fn temperature(&self) -> Temperature {
        self.form.temperature
    }

    /// Writes the model to `path`, as it is, by way of a temporary file beside it.
    ///
    /// # Errors
    /// [`ErrorKind::Io`](crate::ErrorKind::Io) if the system refuses.
    pub fn save(&self, path: &Path) -> Result<()> {
        self.save_with(path, self.metadata())
    }

    /// [`Model::save`] with another temperature. Weights and self-test stay as they are: a temperature changes neither classes
    /// nor logits.
    ///
    /// # Errors
    /// As [`Model::save`].
    pub fn save_with_temperature(&self, temperature: Temperature, path: &Path) -> Result<()> {
        let mut metadata = self.metadata().clone();
        match temperature == Temperature::ONE {
            true => metadata.remove(form::TEMPERATURE),
            false => metadata.insert(form::TEMPERATURE.to_owned(), temperature.to_string()),
        };
        self.save_with(path, &metadata)
    }

    /// Writes the model with this metadata.
    pub(crate) fn save_with(&self, path: &Path, metadata: &BTreeMap<String, String>) -> Result<()> {
        crate::file::container::write(path, self.stored(), metadata, LAYOUT)
    }

    /// The bytes that [`Model::save_with`] writes.
    pub(crate) fn to_bytes_with(&self, metadata: &BTreeMap<String, String>) -> Result<Vec<u8>> {
        crate::file::container::to_bytes(self.stored(), metadata, LAYOUT)
    }

    fn stored(&self) -> Vec<Tensor<'_>> {
        let tensor = |(name, dtype, shape, bytes): (_, _, &[usize], _)| Tensor {
            name,
            dtype,
            shape: shape.to_vec(),
            data: Data::Bytes(bytes),
        };
        self.contents().map(tensor).collect()
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
    /// [`ErrorKind::Format`](crate::ErrorKind::Format) if it is malformed.
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

    /// The graph that runs: every rewrite the model has weights for, or, with `unfolded`, without the projection fold. A
    /// model of int8 has no other graph than the one that runs.
    pub fn graph(&self, unfolded: bool, results: Results) -> Graph {
        let graph = self.form.graph(unfolded, results);
        graph.unwrap_or_else(|e| unreachable!("opening the model has built all of its graphs: {e}"))
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
                Ok(PartRef { bytes: start..start + bytes.len(), element: part.element(self.form.options.precision) })
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

/// A stored tensor, to be written.
pub(crate) fn tensor<'a>(name: String, part: &Part, precision: Precision, data: Data<'a>) -> Tensor<'a> {
    Tensor { name, dtype: Dtype::from(part.element(precision)), shape: vec![part.stored_len(precision)], data }
}

/// Writes the bytes of a model, such as one built into a program, to `path`, by way of a temporary file beside it.
///
/// # Errors
/// [`ErrorKind::Io`](crate::ErrorKind::Io) if the system refuses; [`ErrorKind::Format`](crate::ErrorKind::Format) for bytes that are no model.
pub fn write_bytes(path: &Path, bytes: &'static [u8]) -> Result<()> {
    Model::from_bytes(bytes)?.save(path)
}

/// How model tensors lie in their file.
pub(crate) const LAYOUT: Layout = Layout::Aligned;

#[cfg(test)]
mod tests;

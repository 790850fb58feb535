//! What a model file says of itself, from which the graph follows.

use crate::base::error::{Error, ErrorKind, Result};
use crate::graph::parts::{Part, Precision};
use crate::graph::{Graph, Operation, Quantisation, Results, Rewrites, Scale, Temperature};
use crate::model::{FORMAT, Options};
use crate::network::Network;
use serde::de::DeserializeOwned;
use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};

/// Metadata keys of an int8 model.
const SCALES: &str = "scales";
const KEEP_F32: &str = "keep_f32";

/// Metadata key of a model whose convolutions, transposed ones too, use Winograd's minimal filtering where shapes make it worth while.
const WINOGRAD: &str = "winograd";
/// What it says: also of what the choice covers, for a file has the weights that the choice asks for.
const WINOGRAD_USED: &str = "conv, deconv";

/// Metadata key of a model whose temperature is not 1.
pub(crate) const TEMPERATURE: &str = "temperature";

/// Everything from which a model's graphs follow.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Form {
    pub(crate) network: Network,
    pub(crate) options: Options,
    /// There if and only if the precision is int8.
    pub(crate) quantisation: Option<Quantisation>,
    /// Of the softmax that says how sure it is.
    pub(crate) temperature: Temperature,
}

impl Form {
    /// That of a model in floating point.
    ///
    /// # Errors
    /// Options that contradict themselves, int8 among them: it needs scales.
    pub(crate) fn floating(network: &Network, options: Options) -> Result<Self> {
        if options.precision == Precision::I8 {
            let message = "int8 needs the ranges of tensors, expected f32 or f16 where there are none";
            return Err(Error::new(ErrorKind::Unsupported, message));
        }
        Self { network: network.clone(), options, quantisation: None, temperature: Temperature::ONE }.checked()
    }

    /// That of a model in 8-bit integers.
    ///
    /// # Errors
    /// Rewrites that keep batch norms, and whatever [`Graph::quantise`] refuses.
    pub(crate) fn integers(network: &Network, rewrites: Rewrites, quantisation: Quantisation) -> Result<Self> {
        let options = Options { precision: Precision::I8, rewrites: Rewrites { winograd: false, ..rewrites } };
        let (network, quantisation) = (network.clone(), Some(quantisation));
        Self { network, options, quantisation, temperature: Temperature::ONE }.checked()
    }

    fn checked(self) -> Result<Self> {
        let Rewrites { batch_norm, projection, .. } = self.options.rewrites;
        if projection && !batch_norm {
            return Err(Error::new(ErrorKind::Unsupported, "the projection can only be folded when batch norms are"));
        }
        self.network.check()?;
        self.graph(false, Results::ALL)?;
        Ok(self)
    }

    /// Reads it from a model file's metadata.
    pub(crate) fn read(metadata: &BTreeMap<String, String>) -> Result<Self> {
        let get = |key: &str| {
            metadata.get(key).map(String::as_str).ok_or_else(|| {
                Error::format(format!("the metadata key \"{key}\" is missing, expected a voxcast model"))
            })
        };
        let wrong = |key: &str, found: &str, expected: &str| {
            Error::format(format!("metadata key \"{key}\": found \"{found}\", expected {expected}"))
        };
        let format = get("format")?;
        if format != FORMAT {
            return Err(wrong("format", format, &format!("\"{FORMAT}\"")));
        }
        let network = Network::from_json(get("network")?)?;
        let name = get("precision")?;
        let precision = Precision::ALL.into_iter().find(|precision| precision.name() == name);
        let precision = precision.ok_or_else(|| wrong("precision", name, "f32, f16 or int8"))?;
        let flag = |key: &str| match get(key)? {
            "folded" => Ok(true),
            "kept" => Ok(false),
            other => Err(wrong(key, other, "folded or kept")),
        };
        // A model without the key has direct sums.
        let winograd = match metadata.get(WINOGRAD).map(String::as_str) {
            None => false,
            Some(WINOGRAD_USED) => true,
            Some(other) => {
                return Err(wrong(WINOGRAD, other, &format!("\"{WINOGRAD_USED}\" or no such key; import it anew")));
            }
        };
        let rewrites = Rewrites { batch_norm: flag("batch_norm")?, projection: flag("projection")?, winograd };
        if rewrites.projection && !rewrites.batch_norm {
            return Err(Error::format("the projection is folded but the batch norms are not"));
        }
        let quantisation = match precision {
            Precision::F32 | Precision::F16 => None,
            Precision::I8 => {
                Some(Quantisation { keep_f32: json(KEEP_F32, get(KEEP_F32)?)?, scales: json(SCALES, get(SCALES)?)? })
            }
        };
        let temperature = match metadata.get(TEMPERATURE) {
            None => Temperature::ONE,
            Some(text) => text
                .parse()
                .map_err(|e: Error| Error::format(format!("metadata key \"{TEMPERATURE}\": {}", e.message())))?,
        };
        let form = Self { network, options: Options { precision, rewrites }, quantisation, temperature };
        form.graph(false, Results::ALL).map_err(|e| Error::format(e.message().to_owned()))?;
        Ok(form)
    }

    /// A model file's metadata.
    pub(crate) fn metadata(&self) -> BTreeMap<String, String> {
        let flag = |folded: bool| if folded { "folded" } else { "kept" }.to_owned();
        let Options { precision, rewrites } = self.options;
        let mut metadata = BTreeMap::from([
            ("format".to_owned(), FORMAT.to_owned()),
            ("network".to_owned(), self.network.to_json()),
            ("precision".to_owned(), precision.name().to_owned()),
            ("batch_norm".to_owned(), flag(rewrites.batch_norm)),
            ("projection".to_owned(), flag(rewrites.projection)),
        ]);
        if rewrites.winograd {
            metadata.insert(WINOGRAD.to_owned(), WINOGRAD_USED.to_owned());
        }
        if let Some(Quantisation { keep_f32, scales }) = &self.quantisation {
            metadata.insert(KEEP_F32.to_owned(), serde_json::to_string(keep_f32).unwrap_or_default());
            metadata.insert(SCALES.to_owned(), serde_json::to_string(scales).unwrap_or_default());
        }
        if self.temperature != Temperature::ONE {
            metadata.insert(TEMPERATURE.to_owned(), self.temperature.to_string());
        }
        metadata
    }

    /// The graph that runs, or, with `unfolded`, the one without the projection fold, which int8 lacks.
    ///
    /// # Errors
    /// Those of [`Graph::quantise`], and a scale that it lacks.
    pub(crate) fn graph(&self, unfolded: bool, results: Results) -> Result<Graph> {
        let rewrites = self.options.rewrites;
        let projection = rewrites.projection && (!unfolded || self.quantisation.is_some());
        let graph = Graph::build(&self.network, results).rewritten(Rewrites { projection, ..rewrites });
        match &self.quantisation {
            None => Ok(graph),
            Some(quantisation) => graph.quantise(&quantisation.keep_f32, &mut |name| quantisation.scale(name)),
        }
    }

    /// The graphs that the model can run, the fastest first.
    ///
    /// # Errors
    /// As [`Form::graph`].
    pub(crate) fn graphs(&self) -> Result<Vec<Graph>> {
        let mut graphs = vec![self.graph(false, Results::ALL)?];
        if self.options.rewrites.projection && self.quantisation.is_none() {
            graphs.push(self.graph(true, Results::ALL)?);
        }
        Ok(graphs)
    }
}

/// The value of a metadata key that is JSON.
fn json<T: DeserializeOwned>(key: &str, text: &str) -> Result<T> {
    serde_json::from_str(text).map_err(|e| Error::format(format!("metadata key \"{key}\": {e}")))
}

/// What makes `network` one of 8-bit integers, with these operations kept in f32 and these scales: those of `scale` that
/// its graph asks for.
///
/// # Errors
/// Those of [`Graph::quantise`] and of `scale`.
pub(crate) fn quantisation(
    network: &Network,
    rewrites: Rewrites,
    keep_f32: &[String],
    scale: &dyn Fn(&str) -> Result<Scale>,
) -> Result<Quantisation> {
    let scales = RefCell::new(BTreeMap::new());
    // Integers are summed directly.
    let graph = Graph::build(network, Results::ALL).rewritten(Rewrites { winograd: false, ..rewrites });
    graph.quantise(keep_f32, &mut |name| {
        let scale = scale(name)?;
        scales.borrow_mut().insert(name.to_owned(), scale);
        Ok(scale)
    })?;
    Ok(Quantisation { keep_f32: keep_f32.to_vec(), scales: scales.into_inner() })
}

/// What `operation` stores.
pub(crate) fn parts(graph: &Graph, operation: &Operation) -> Vec<Part> {
    operation.op.description().parts(&graph.site(operation))
}

/// Graph and operation, by number, of everything that a model of these graphs stores, in file order: each name once.
pub(crate) fn stored(graphs: &[Graph]) -> Vec<(usize, usize)> {
    let mut seen = BTreeSet::new();
    let mut list = vec![];
    for (g, graph) in graphs.iter().enumerate() {
        for (o, operation) in graph.operations.iter().enumerate() {
            if seen.insert(operation.name.as_str()) && !parts(graph, operation).is_empty() {
                list.push((g, o));
            }
        }
    }
    list
}

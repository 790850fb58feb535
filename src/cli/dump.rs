//! `--dump`: stages under the names and in the layout of the golden cases (channels first, as PyTorch has them).

use super::frame;
use safetensors::Dtype;
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;
use voxcast::container::{self, Data, Layout};
use voxcast::graph::{Element, Elements, Graph, Results, Rewrites, Section, Space, Tensor};
use voxcast::network::Grid;
use voxcast::session::Event;
use voxcast::{Error, ErrorKind, Network, Result, Rig};

/// Stages being collected.
pub struct Dump {
    /// Names asked for.
    wanted: Vec<String>,
    stages: BTreeMap<String, Stage>,
}

struct Stage {
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Vec<u8>,
}

/// Names of the matrices of level index `level`.
fn matrix_names(level: usize) -> [String; 4] {
    let name = |kind: &str, part: &str| format!("level{}.csr_{kind}.{part}", level + 1);
    [name("volume", "ptr"), name("volume", "col"), name("bev", "ptr"), name("bev", "col")]
}

impl Dump {
    /// Collects `stages`, a comma-separated list, or everything.
    ///
    /// # Errors
    /// If a name is not a stage of the network.
    pub fn new(stages: Option<&str>, network: &Network) -> Result<Self> {
        let full = Graph::build(network, Results::ALL);
        let mut known: Vec<String> = full.stages().map(str::to_owned).collect();
        known.extend((0..3).flat_map(matrix_names));
        known.push("classes".to_owned());
        let wanted: Vec<String> = match stages {
            None => known.clone(),
            Some(list) => list.split(',').map(|s| s.trim().to_owned()).collect(),
        };
        let folded = Graph::build(network, Results::ALL).rewritten(Rewrites::ALL);
        let operations: Vec<&String> = full.operations.iter().chain(&folded.operations).map(|o| &o.name).collect();
        if let Some(bad) = wanted.iter().find(|w| !known.contains(w) && !operations.contains(w)) {
            let message =
                format!("--stages: no stage \"{bad}\", expected an operation's name or some of {}", known.join(", "));
            return Err(Error::new(ErrorKind::Unsupported, message));
        }
        Ok(Self { wanted, stages: BTreeMap::new() })
    }

    /// Whether a stage is wanted that the projection fold removes.
    pub fn needs_unfolded(&self, network: &Network) -> bool {
        let [full, folded] = [Rewrites { projection: false, ..Rewrites::ALL }, Rewrites::ALL].map(|rewrites| {
            let graph = Graph::build(network, Results::ALL).rewritten(rewrites);
            graph.stages().map(str::to_owned).collect::<Vec<_>>()
        });
        self.wanted.iter().any(|w| full.contains(w) && !folded.contains(w))
    }

    /// Whether logits of level 1, 2 or 3 are wanted.
    pub fn needs_coarse_heads(&self) -> bool {
        ["logits.lvl1", "logits.lvl2", "logits.lvl3"].iter().any(|s| self.wants(s))
    }

    /// Whether `stage` is wanted.
    pub fn wants(&self, stage: &str) -> bool {
        self.wanted.iter().any(|w| w == stage)
    }

    /// Keeps the event's stage if it is wanted.
    pub fn observe(&mut self, graph: &Graph, event: &Event<'_>) {
        let names = [event.operation.stage.as_deref(), Some(event.operation.name.as_str())];
        let Some(name) = names.into_iter().flatten().find(|name| self.wants(name)) else { return };
        let operation = event.operation;
        let tensor = graph.tensor(operation.result());
        let empty = || Stage { dtype: dumped(tensor).into(), shape: vec![], bytes: vec![] };
        let stage = self.stages.entry(name.to_owned()).or_insert_with(empty);
        if tensor.section == Section::Head {
            // Channels last, as the result is.
            stage.shape = tensor.extent.iter().copied().chain([tensor.channels]).collect();
            stage.bytes = event.output.bytes().to_vec();
            return;
        }
        let batch = event.camera.map_or(1, |camera| camera + 1);
        let extent = match tensor.space {
            Space::Volume => &tensor.extent[..],
            Space::Image | Space::Plane => &tensor.extent[1..],
        };
        // What the operation has written: of branches side by side its own, of an 8-bit image three of four.
        let channels = operation.first_channel..operation.first_channel + operation.channels;
        stage.shape = [batch, channels.len()].into_iter().chain(extent.iter().copied()).collect();
        match (event.output.get::<i8>(), tensor.scale) {
            (Some(integers), Some(scale)) => {
                let values: Vec<f32> = integers.iter().map(|&q| f32::from(q) * scale.step()).collect();
                let elements = Elements::new(Element::F32, bytemuck::cast_slice(&values));
                stage.bytes.extend(channels_first(elements, tensor.channels, channels));
            }
            _ => stage.bytes.extend(channels_first(event.output, tensor.channels, channels)),
        }
    }

    /// Adds matrices and classes and writes all of it to `directory/stages.safetensors`.
    pub fn finish(mut self, directory: &Path, rig: &Rig, grid: Grid, classes: &[u8]) -> Result<()> {
        for level in 0..3 {
            let matrices = rig.level(level);
            let parts = [matrices.volume.ptr, matrices.volume.col, matrices.bev.ptr, matrices.bev.col];
            for (name, words) in matrix_names(level).into_iter().zip(parts) {
                if self.wants(&name) {
                    let bytes = words.iter().flat_map(|&n| i64::from(n).to_le_bytes()).collect();
                    self.stages.insert(name, Stage { dtype: Dtype::I64, shape: vec![words.len()], bytes });
                }
            }
        }
        if self.wants("classes") {
            let stage = Stage { dtype: Dtype::U8, shape: grid.size.to_vec(), bytes: classes.to_vec() };
            self.stages.insert("classes".to_owned(), stage);
        }
        frame::create_directory(directory)?;
        let tensors = self.stages.iter().map(|(name, stage)| container::Tensor {
            name: name.clone(),
            dtype: stage.dtype,
            shape: stage.shape.clone(),
            data: Data::Bytes(&stage.bytes),
        });
        container::write(&directory.join("stages.safetensors"), tensors.collect(), &BTreeMap::new(), Layout::Packed)
    }
}

/// The type of the elements that stand for a tensor in a dump: 8-bit integers with a scale become the numbers that they
/// stand for.
fn dumped(tensor: &Tensor) -> Element {
    if tensor.scale.is_some() { Element::F32 } else { tensor.element }
}

/// The bytes of some channels of `[rows, channels]` as `[channels, rows]`.
fn channels_first(elements: Elements<'_>, channels: usize, wanted: Range<usize>) -> Vec<u8> {
    let size = elements.element().bytes();
    let rows = elements.len() / channels.max(1);
    let mut out = vec![0; rows * wanted.len() * size];
    for (row, pixel) in elements.bytes().chunks_exact(channels * size).enumerate() {
        for (channel, element) in pixel.chunks_exact(size).enumerate().filter(|(channel, _)| wanted.contains(channel)) {
            let at = ((channel - wanted.start) * rows + row) * size;
            out[at..at + size].copy_from_slice(element);
        }
    }
    out
}

//! `--dump`: stages under the names and in the layout of the golden cases (channels first, as PyTorch has them).

use safetensors::Dtype;
use std::collections::BTreeMap;
use std::path::Path;
use voxcast::container::{self, Data, Layout, Tensor};
use voxcast::graph::{Graph, Op, Rewrites};
use voxcast::session::Event;
use voxcast::{Error, ErrorKind, Network, Result, Rig};

/// Stages being collected.
pub struct Dump {
    /// Names asked for.
    wanted: Vec<String>,
    stages: BTreeMap<String, Stage>,
}

#[derive(Default)]
struct Stage {
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
        let full = Graph::build(network, true);
        let mut known: Vec<String> = full.stages().map(str::to_owned).collect();
        known.extend((0..3).flat_map(matrix_names));
        known.push("classes".to_owned());
        let wanted: Vec<String> = match stages {
            None => known.clone(),
            Some(list) => list.split(',').map(|s| s.trim().to_owned()).collect(),
        };
        let folded = Graph::build(network, true).rewritten(Rewrites::ALL);
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
            let graph = Graph::build(network, true).rewritten(rewrites);
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
        let tensor = graph.tensor(event.operation.output);
        let stage = self.stages.entry(name.to_owned()).or_default();
        if matches!(event.operation.op, Op::Head { .. }) {
            stage.shape = tensor.extent.iter().copied().chain([tensor.channels]).collect();
            stage.bytes = bytemuck::cast_slice(event.output).to_vec();
            return;
        }
        let batch = event.camera.map_or(1, |camera| camera + 1);
        let plane = tensor.extent[0] == 1 && (event.camera.is_some() || !is_volume(name));
        let extent = if plane { &tensor.extent[1..] } else { &tensor.extent[..] };
        stage.shape = [batch, tensor.channels].into_iter().chain(extent.iter().copied()).collect();
        stage.bytes.extend_from_slice(bytemuck::cast_slice(&channels_first(event.output, tensor.channels)));
    }

    /// Adds matrices and classes and writes all of it to `directory/stages.safetensors`.
    pub fn finish(mut self, directory: &Path, rig: &Rig, grid: [usize; 3], classes: &[u8]) -> Result<()> {
        for level in 0..3 {
            let matrices = rig.level(level);
            let parts = [matrices.volume.ptr, matrices.volume.col, matrices.bev.ptr, matrices.bev.col];
            for (name, numbers) in matrix_names(level).into_iter().zip(parts) {
                if self.wants(&name) {
                    let bytes = numbers.iter().flat_map(|&n| i64::from(n).to_le_bytes()).collect();
                    self.stages.insert(name, Stage { shape: vec![numbers.len()], bytes });
                }
            }
        }
        if self.wants("classes") {
            self.stages.insert("classes".to_owned(), Stage { shape: grid.to_vec(), bytes: classes.to_vec() });
        }
        std::fs::create_dir_all(directory).map_err(|e| Error::io(directory, "create", &e))?;
        let tensors = self.stages.iter().map(|(name, stage)| Tensor {
            name: name.clone(),
            dtype: match name.as_str() {
                "classes" => Dtype::U8,
                name if name.contains(".csr_") => Dtype::I64,
                _ => Dtype::F32,
            },
            shape: stage.shape.clone(),
            data: Data::Bytes(&stage.bytes),
        });
        container::write(&directory.join("stages.safetensors"), tensors.collect(), &BTreeMap::new(), Layout::Packed)
    }
}

/// Whether the result is a volume even when it is one voxel wide.
fn is_volume(name: &str) -> bool {
    let parts = ["volume", "fused", "conv3d", "up_sample", "refine", "combine_coeff"];
    parts.iter().any(|part| name.contains(part))
}

/// `[rows, channels]` to `[channels, rows]`.
fn channels_first(values: &[f32], channels: usize) -> Vec<f32> {
    let rows = values.len() / channels.max(1);
    let mut out = vec![0.0; values.len()];
    for (row, values) in values.chunks_exact(channels).enumerate() {
        for (c, &value) in values.iter().enumerate() {
            out[c * rows + row] = value;
        }
    }
    out
}

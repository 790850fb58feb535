//! `voxcast inspect`

use super::terminal::tell;
use super::{ThreadCount, terminal};
use clap::Args;
use std::path::PathBuf;
use voxcast::container::Container;
use voxcast::graph::{Element, Graph, Operation, Results, Tensor};
use voxcast::{Error, Model, Network, Result, Rig, Session, SessionOptions};

/// Say what is in a model or a rig: shapes, precisions, sizes, the memory a session takes, checksum.
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  voxcast inspect model.safetensors
  voxcast inspect model.safetensors --plan --cameras 1 --threads 4
  voxcast inspect int8.safetensors --operations    (which operations compute in f32?)
  voxcast inspect rig.safetensors --json")]
pub struct Inspect {
    /// A model or a rig
    file: PathBuf,
    /// Cameras that a model's session is sized for [default: as the network says]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=64))]
    cameras: Option<u16>,
    /// Also print every operation of a model: kind, elements read and written, shape, bytes, work
    #[arg(long)]
    operations: bool,
    /// Also print where every tensor of a model lies in the arena
    #[arg(long)]
    plan: bool,
    /// Also print every stored tensor of a model
    #[arg(long)]
    tensors: bool,
    /// Print as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    threads: ThreadCount,
}

impl Inspect {
    pub fn run(self) -> Result<()> {
        let container = Container::open(&self.file)?;
        let format = container.metadata().get("format").cloned().unwrap_or_default();
        let is_rig = format.starts_with("voxcast-rig") || container.tensor("level1.volume.ptr").is_some();
        if is_rig { self.rig(&container) } else { self.model() }
    }

    fn model(&self) -> Result<()> {
        let model = Model::open(&self.file)?;
        let network = model.network();
        let options = SessionOptions { threads: self.threads.threads()?, ..SessionOptions::default() };
        let cameras = self.cameras.map_or(network.cameras, usize::from);
        let graph = model.graph(false, Results::default());
        let memory = Session::memory(&model, cameras, &options).map_err(|e| e.in_file(&self.file))?;
        let parameters: usize = model.tensors().map(|(_, _, len)| len).sum();
        let work = |count: fn(&Graph, &Operation) -> u64| {
            let of = |i: usize| {
                let times = if i < graph.camera_operations { cameras as u64 } else { 1 };
                count(&graph, &graph.operations[i]).saturating_mul(times)
            };
            (0..graph.operations.len()).map(of).fold(0, u64::saturating_add)
        };
        let (multiply_adds, executed) = (work(Graph::multiply_adds), work(Graph::executed_multiply_adds));
        let rewrites = model.options().rewrites;
        let kept = kept(&model, &graph);
        let operations: Vec<Row<'_>> =
            graph.operations.iter().map(|operation| Row::new(&model, &graph, operation)).collect();
        if self.json {
            let value = serde_json::json!({
                "kind": "model",
                "network": network,
                "precision": model.options().precision.name(),
                "kept_f32": kept,
                "batch_norm_folded": rewrites.batch_norm,
                "projection_folded": rewrites.projection,
                "winograd_used": rewrites.winograd,
                "temperature": model.temperature().value(),
                "stored_numbers": parameters,
                "file_bytes": model.file_size(),
                "checksum": model.checksum().map(|c| format!("{c:016x}")),
                "cameras": cameras,
                "threads": options.threads.count(),
                "arena_bytes": memory.arena,
                "output_bytes": memory.output,
                "session_bytes": memory.total(),
                "multiply_adds": multiply_adds,
                "executed_multiply_adds": executed,
                "operations": operations.iter().enumerate().map(|(i, row)| serde_json::json!({
                    "name": row.operation.name,
                    "kind": row.operation.op.description().kind(),
                    "per_camera": i < graph.camera_operations,
                    "reads": row.reads(&graph),
                    "writes": row.tensor.element.name(),
                    "scale": row.tensor.scale.map(|scale| scale.step()),
                    "output_bytes": row.tensor.bytes(),
                    "weight_bytes": row.weight_bytes,
                    "multiply_adds": graph.multiply_adds(row.operation),
                    "executed_multiply_adds": graph.executed_multiply_adds(row.operation),
                })).collect::<Vec<_>>(),
            });
            tell!("{value:#}")?;
            return Ok(());
        }
        let [x, y, z] = network.output_grid();
        tell!("model      {}", self.file.display())?;
        tell!("checksum   {:016x}", model.checksum().unwrap_or_default())?;
        tell!(
            "weights    {} numbers, {} (batch norms {}, projection {}, {})",
            parameters,
            model.options().precision.name(),
            if rewrites.batch_norm { "folded" } else { "kept" },
            if rewrites.projection { "folded" } else { "kept" },
            if rewrites.winograd { "Winograd where it pays" } else { "direct sums" }
        )?;
        if let Some(quantisation) = model.quantisation() {
            let asked = match quantisation.keep_f32.is_empty() {
                true => String::new(),
                false => format!(", by name: {}", quantisation.keep_f32.join(",")),
            };
            tell!(
                "int8       {} tensors with a scale; in f32: {} operations{asked}",
                quantisation.scales.len(),
                kept.len()
            )?;
        }
        tell!("confidence softmax at temperature {}", model.temperature())?;
        tell!("file       {}", terminal::bytes(model.file_size()))?;
        tell!("images     {} x {} (height x width, padded)", network.image[0], network.image[1])?;
        tell!("output     {x} x {y} x {z} voxels, {} classes", network.classes)?;
        tell!(
            "work       {:.1} GMAC a frame of {cameras} cameras, of which {:.1} are executed",
            multiply_adds as f64 / 1e9,
            executed as f64 / 1e9
        )?;
        tell!(
            "session    {} bytes for {cameras} cameras and {} threads: arena {}, output {}",
            memory.total(),
            options.threads.count(),
            memory.arena,
            memory.output
        )?;
        tell!("network    {}", network.to_json())?;
        if self.operations {
            for (i, row) in operations.iter().enumerate() {
                tell!(
                    "{:>4} {:60} {:18} {:>8} {:>3} {:?} x {:<5} {:>9} weights {:>9} {:>8.3} GMAC {:>8.3} executed{}",
                    i,
                    row.operation.name,
                    row.operation.op.description().kind(),
                    row.reads(&graph),
                    row.tensor.element.name(),
                    row.tensor.extent,
                    row.tensor.channels,
                    terminal::bytes(row.tensor.bytes()),
                    terminal::bytes(row.weight_bytes),
                    graph.multiply_adds(row.operation) as f64 / 1e9,
                    graph.executed_multiply_adds(row.operation) as f64 / 1e9,
                    if i < graph.camera_operations { " per camera" } else { "" }
                )?;
            }
        }
        if self.plan {
            terminal::write(format_args!("{}", voxcast::plan::Plan::new(&graph, cameras, options.threads.count())?))?;
        }
        if self.tensors {
            for (name, dtype, len) in model.tensors() {
                tell!("{name:70} {dtype:?} {len}")?;
            }
        }
        Ok(())
    }

    fn rig(&self, container: &Container) -> Result<()> {
        let network = container.metadata().get("network").ok_or_else(|| {
            Error::format("a plain rig names no network; `voxcast run` checks it against the model").in_file(&self.file)
        })?;
        let network = Network::from_json(network).map_err(|e| e.in_file(&self.file))?;
        let cameras = container.metadata().get("cameras").and_then(|c| c.parse().ok()).unwrap_or(network.cameras);
        let rig = Rig::open(&self.file, &network, cameras)?;
        let levels: Vec<_> = (0..3).map(|i| rig.level(i)).collect();
        if self.json {
            let value = serde_json::json!({
                "kind": "rig",
                "cameras": rig.cameras(),
                "file_bytes": container.bytes().len(),
                "checksum": container.checksum().map(|c| format!("{c:016x}")),
                "levels": levels.iter().map(|l| serde_json::json!({
                    "volume": {"rows": l.volume.ptr.len() - 1, "entries": l.volume.col.len()},
                    "bev": {"rows": l.bev.ptr.len() - 1, "entries": l.bev.col.len()},
                })).collect::<Vec<_>>(),
            });
            tell!("{value:#}")?;
            return Ok(());
        }
        tell!("rig        {}", self.file.display())?;
        tell!("checksum   {:016x}", container.checksum().unwrap_or_default())?;
        tell!("file       {}", terminal::bytes(container.bytes().len()))?;
        tell!("cameras    {}", rig.cameras())?;
        for (i, level) in levels.iter().enumerate() {
            for (name, matrix) in [("volume", level.volume), ("bev", level.bev)] {
                let empty = matrix.ptr.windows(2).filter(|w| w[0] == w[1]).count();
                tell!(
                    "level {}    {name:6} {} rows, {} empty, {} entries",
                    i + 1,
                    matrix.ptr.len() - 1,
                    empty,
                    matrix.col.len()
                )?;
            }
        }
        Ok(())
    }
}

/// What is told of an operation.
struct Row<'a> {
    operation: &'a Operation,
    /// What it writes; of a head the logits, if there are any.
    tensor: &'a Tensor,
    /// Of its stored parts.
    weight_bytes: usize,
}

impl<'a> Row<'a> {
    fn new(model: &Model, graph: &'a Graph, operation: &'a Operation) -> Self {
        let precision = model.options().precision;
        let parts = operation.op.description().parts(&graph.site(operation));
        let weight_bytes = parts.iter().map(|part| part.stored_len(precision) * part.element(precision).bytes()).sum();
        Self { operation, tensor: graph.tensor(operation.result()), weight_bytes }
    }

    /// Types of what it reads, each once.
    fn reads(&self, graph: &Graph) -> String {
        let mut names: Vec<&str> = self.operation.reads().map(|id| graph.tensor(id).element.name()).collect();
        names.dedup();
        names.join(" ")
    }
}

/// Operations of an int8 model that compute in f32, conversions not counted.
fn kept<'a>(model: &Model, graph: &'a Graph) -> Vec<&'a str> {
    let in_f32 = |o: &&Operation| {
        let [read, written] = [o.inputs[0], o.output()].map(|id| graph.tensor(id).element);
        read == Element::F32 && written != Element::I8
    };
    let operations = graph.operations.iter().filter(in_f32).map(|operation| operation.name.as_str());
    if model.quantisation().is_some() { operations.collect() } else { vec![] }
}

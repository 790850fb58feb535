//! Checkpoint to model: folds batch norms and the projection in f64, packs, and writes what the kernels read.

use crate::base::error::{Error, ErrorKind, Result};
use crate::file::container::{self, Data, Tensor};
use crate::graph::{ConvNames, Graph, Op, Operation, Recipe};
#[cfg(feature = "import")]
use crate::model::checkpoint::Checkpoint;
use crate::model::parts::{Part, Precision, parts};
use crate::model::{self, Options};
use crate::network::Network;
use half::f16;
use std::cell::RefCell;
use std::collections::BTreeSet;
use std::path::Path;
use voxcast_kernels::LANES;
use voxcast_kernels::deconv3d::kernel_tap;
use voxcast_kernels::panels::{pack, packed_len};
use voxcast_kernels::window_attention::Shape;

/// Added to a batch norm's variance (the published networks' value).
const EPSILON: f64 = 1e-5;

/// Where weights come from, by the names of published checkpoints.
pub trait Source {
    /// The tensor `name` in row-major order. It must have this shape and finite elements.
    ///
    /// # Errors
    /// Naming the tensor, if it is missing, has another shape or holds a number that is not finite.
    fn tensor(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>>;
}

#[cfg(feature = "import")]
impl Source for Checkpoint {
    fn tensor(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>> {
        let Some(tensor) = self.get(name) else {
            return Err(Error::format(format!("tensor \"{name}\" is missing, expected shape {shape:?}")));
        };
        if tensor.shape() != shape {
            return Err(Error::mismatch(format!(
                "tensor \"{name}\" has shape {:?}, the network expects {shape:?}",
                tensor.shape()
            )));
        }
        tensor.to_f64()
    }
}

/// Makes a model of the weights that `source` has and writes it to `path`, by way of a temporary file beside it. `progress` is told how
/// many of how many tensors are done.
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
    let list = Conversion::new(source, network, options)?;
    container::write(path, list.tensors(progress), &model::metadata(network, options), model::LAYOUT)
}

/// Makes a model of the weights that `source` has, in memory: the bytes that [`import`] would write.
///
/// # Errors
/// Those of [`import`] that are not about the file; [`ErrorKind::TooLarge`] if the system has no memory for it.
pub fn import_to_bytes(
    source: &dyn Source,
    network: &Network,
    options: Options,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Vec<u8>> {
    let list = Conversion::new(source, network, options)?;
    container::to_bytes(list.tensors(progress), &model::metadata(network, options), model::LAYOUT)
}

/// Everything that goes into a model, in file order.
struct Conversion<'a> {
    source: &'a dyn Source,
    graphs: Vec<Graph>,
    /// Graph and operation of each operation that stores something.
    operations: Vec<(usize, usize)>,
    precision: Precision,
    /// The values of the operation whose parts are being written.
    current: RefCell<(usize, Vec<Vec<f32>>)>,
}

impl<'a> Conversion<'a> {
    fn new(source: &'a dyn Source, network: &Network, options: Options) -> Result<Self> {
        network.check()?;
        model::check_options(options)?;
        let graphs = model::graphs(network, options.rewrites);
        let mut seen = BTreeSet::new();
        let mut operations = vec![];
        for (g, graph) in graphs.iter().enumerate() {
            for (o, operation) in graph.operations.iter().enumerate() {
                if seen.insert(operation.name.clone()) && !parts(graph, operation).is_empty() {
                    operations.push((g, o));
                }
            }
        }
        let current = RefCell::new((usize::MAX, vec![]));
        Ok(Self { source, graphs, operations, precision: options.precision, current })
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
                tensors.push(model::tensor(name, &part, self.precision, Data::Make(Box::new(make))));
            }
        }
        tensors
    }

    /// The bytes of part `i` of operation `index`.
    fn part(&self, index: usize, i: usize, name: &str, part: &Part) -> Result<Vec<u8>> {
        let mut current = self.current.borrow_mut();
        if current.0 != index {
            let (graph, operation) = self.operation(index);
            let importer = Importer { source: self.source, graph };
            *current = (index, importer.evaluate(operation)?);
        }
        encode(name, part, &current.1[i], self.precision)
    }
}

/// The bytes of a stored tensor.
fn encode(name: &str, part: &Part, values: &[f32], precision: Precision) -> Result<Vec<u8>> {
    if let Some(bad) = values.iter().find(|v| !v.is_finite()) {
        return Err(Error::format(format!("tensor \"{name}\": folding gives {bad}, expected finite numbers")));
    }
    let len = part.stored_len(precision);
    if part.width(precision) == 2 {
        let mut out = vec![f16::ZERO; len];
        for (to, &from) in out.iter_mut().zip(values) {
            *to = f16::from_f32(from);
            if !to.is_finite() {
                return Err(Error::new(
                    ErrorKind::Unsupported,
                    format!("tensor \"{name}\": {from} does not fit half precision, expected at most 65504; use f32"),
                ));
            }
        }
        return Ok(bytemuck::cast_slice(&out).to_vec());
    }
    let mut out = values.to_vec();
    out.resize(len, 0.0);
    Ok(bytemuck::cast_slice(&out).to_vec())
}

/// A convolution in f64: weights `[outputs, inputs * taps]` in the checkpoint's order, one bias per output.
struct Dense {
    weight: Vec<f64>,
    bias: Vec<f64>,
}

struct Importer<'a> {
    source: &'a dyn Source,
    graph: &'a Graph,
}

impl Importer<'_> {
    /// The values of every part of `operation`.
    fn evaluate(&self, operation: &Operation) -> Result<Vec<Vec<f32>>> {
        let channels = operation.channels;
        let x_channels = operation.inputs.first().map_or(0, |&x| self.graph.tensor(x).channels);
        match (&operation.op, &operation.recipe) {
            (Op::Conv { geometry } | Op::DeformConv { geometry }, recipe) => {
                let dense = self.conv(recipe, geometry.kernel, x_channels, channels)?;
                Ok(vec![pack_conv(&dense.weight, x_channels, channels), padded(&dense.bias)])
            }
            (Op::Deconv, Recipe::Conv(names)) => self.deconv(names, x_channels, channels),
            (Op::Depthwise { side }, Recipe::Conv(names)) => {
                let dense = self.dense(names, &[channels, 1, *side, *side], channels)?;
                Ok(vec![pack_taps(&dense.weight, side * side, channels), padded(&dense.bias)])
            }
            (Op::BatchNorm, Recipe::BatchNorm(prefix)) => {
                let (scale, shift) = self.norm(prefix, channels)?;
                Ok(vec![padded(&scale), padded(&shift)])
            }
            (Op::Gather { .. }, Recipe::Bias(names)) => {
                let fpn = self.graph.network.fpn;
                let bias = self.dense(names, &branch_shape(names, channels, fpn), channels)?.bias;
                Ok(vec![padded(&bias)])
            }
            (Op::Gate, Recipe::Conv(names)) => {
                let dense = self.dense(names, &[1, channels, 1, 1, 1], 1)?;
                Ok(vec![padded(&dense.weight), padded(&dense.bias)])
            }
            (Op::WindowAttention { shape }, Recipe::Attention(prefix)) => self.attention(prefix, shape),
            (Op::Head { .. }, Recipe::Head(prefix)) => {
                let mut values = vec![];
                for (layer, columns) in [(0, x_channels), (2, x_channels), (4, channels)] {
                    let names = ConvNames { prefix: format!("{prefix}.{layer}"), bias: true, norm: None };
                    let dense = self.dense(&names, &[columns, x_channels], columns)?;
                    values.push(pack_conv(&dense.weight, x_channels, columns));
                    values.push(padded(&dense.bias));
                }
                Ok(values)
            }
            (op, recipe) => unreachable!("{op:?} never has the recipe {recipe:?}"),
        }
    }

    fn conv(&self, recipe: &Recipe, kernel: [usize; 3], inputs: usize, outputs: usize) -> Result<Dense> {
        let [d, h, w] = kernel;
        match recipe {
            Recipe::Conv(names) if names.prefix.starts_with("view_transformer") && is_volume(&names.prefix) => {
                self.dense(names, &[outputs, inputs, d, h, w], outputs)
            }
            Recipe::Conv(names) => self.dense(names, &[outputs, inputs, h, w], outputs),
            Recipe::Projection { pixel, volume, bev } => {
                let (fpn, branch) = (inputs, outputs / 2);
                let taps = h * w;
                let pixel = self.dense(pixel, &[fpn, inputs, h, w], fpn)?;
                let mut weight = Vec::with_capacity(outputs * inputs * taps);
                let mut bias = Vec::with_capacity(outputs);
                for names in [volume, bev] {
                    let one = self.dense(names, &branch_shape(names, branch, fpn), branch)?.weight;
                    weight.extend(matmul(&one, &pixel.weight, branch, fpn, inputs * taps));
                    bias.extend(matmul(&one, &pixel.bias, branch, fpn, 1));
                }
                Ok(Dense { weight, bias })
            }
            recipe => unreachable!("a convolution never has the recipe {recipe:?}"),
        }
    }

    fn deconv(&self, names: &ConvNames, inputs: usize, outputs: usize) -> Result<Vec<Vec<f32>>> {
        let raw = self.tensor(&format!("{}.weight", names.prefix), &[inputs, outputs, 4, 4, 4])?;
        let mut bias = self.tensor(&format!("{}.bias", names.prefix), &[outputs])?;
        let scale = self.fold(names, &mut bias)?;
        let size = packed_len(8 * inputs, outputs);
        let mut weight = vec![0.0; 8 * size];
        for (parity, out) in weight.chunks_exact_mut(size).enumerate() {
            let element = |k: usize, n: usize| {
                let (tap, c) = (k / inputs, k % inputs);
                let at = (0..3).fold(c * outputs + n, |at, axis| {
                    let bit = 2 - axis;
                    at * 4 + kernel_tap(parity >> bit & 1, tap >> bit & 1)
                });
                (raw[at] * scale[n]) as f32
            };
            pack(8 * inputs, outputs, element, out);
        }
        Ok(vec![weight, padded(&bias)])
    }

    fn attention(&self, prefix: &str, shape: &Shape) -> Result<Vec<Vec<f32>>> {
        let Shape { channels, heads, key_dim, .. } = *shape;
        let share = shape.part();
        let (mut qkv, mut qkv_bias, mut dw, mut dw_bias) = (vec![], vec![], vec![], vec![]);
        let conv_bn = |name: &str| ConvNames {
            prefix: format!("{prefix}.{name}.c"),
            bias: false,
            norm: Some(format!("{prefix}.{name}.bn")),
        };
        for head in 0..heads {
            let dense = self.dense(&conv_bn(&format!("qkvs.{head}")), &[3 * key_dim, share, 1, 1], 3 * key_dim)?;
            qkv.extend(pack_conv(&dense.weight, share, 3 * key_dim));
            qkv_bias.extend(padded(&dense.bias));
            let dense = self.dense(&conv_bn(&format!("dws.{head}")), &[key_dim, 1, 5, 5], key_dim)?;
            dw.extend(pack_taps(&dense.weight, 25, key_dim));
            dw_bias.extend(padded(&dense.bias));
        }
        let positions = self.tensor(&format!("{prefix}.attention_biases"), &[heads, shape.side() * shape.side()])?;
        let proj = self.dense(&conv_bn("proj.1"), &[channels, heads * key_dim, 1, 1], channels)?;
        Ok(vec![
            qkv,
            qkv_bias,
            dw,
            dw_bias,
            positions.iter().map(|&v| v as f32).collect(),
            pack_conv(&proj.weight, heads * key_dim, channels),
            padded(&proj.bias),
        ])
    }

    /// Weights of shape `shape` (outputs first) and bias, with the norm folded in.
    fn dense(&self, names: &ConvNames, shape: &[usize], outputs: usize) -> Result<Dense> {
        let mut weight = self.tensor(&format!("{}.weight", names.prefix), shape)?;
        let mut bias = match names.bias {
            true => self.tensor(&format!("{}.bias", names.prefix), &[outputs])?,
            false => vec![0.0; outputs],
        };
        let scale = self.fold(names, &mut bias)?;
        let per_output = weight.len() / outputs;
        for (row, scale) in weight.chunks_exact_mut(per_output).zip(scale) {
            row.iter_mut().for_each(|w| *w *= scale);
        }
        Ok(Dense { weight, bias })
    }

    /// The factor of each output's weights; `bias` becomes the folded one.
    fn fold(&self, names: &ConvNames, bias: &mut [f64]) -> Result<Vec<f64>> {
        let Some(prefix) = &names.norm else { return Ok(vec![1.0; bias.len()]) };
        let (scale, shift) = self.norm(prefix, bias.len())?;
        for ((b, scale), shift) in bias.iter_mut().zip(&scale).zip(&shift) {
            *b = *b * scale + shift;
        }
        Ok(scale)
    }

    /// A batch norm as scale and shift.
    fn norm(&self, prefix: &str, channels: usize) -> Result<(Vec<f64>, Vec<f64>)> {
        let part = |name: &str| self.tensor(&format!("{prefix}.{name}"), &[channels]);
        let (gamma, beta, mean, variance) =
            (part("weight")?, part("bias")?, part("running_mean")?, part("running_var")?);
        if let Some(i) = variance.iter().position(|&v| v < 0.0) {
            return Err(Error::format(format!(
                "tensor \"{prefix}.running_var\": element [{i}] is {}, expected a variance of at least 0",
                variance[i]
            )));
        }
        let scale: Vec<f64> = gamma.iter().zip(&variance).map(|(g, v)| g / (v + EPSILON).sqrt()).collect();
        let shift = beta.iter().zip(&mean).zip(&scale).map(|((b, m), s)| b - m * s).collect();
        Ok((scale, shift))
    }

    fn tensor(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>> {
        self.source.tensor(name, shape)
    }
}

/// Whether a convolution of the view transformer is three-dimensional.
fn is_volume(prefix: &str) -> bool {
    ["down_conv3d", "refine_lvl"].iter().any(|part| prefix.contains(part))
}

/// Checkpoint shape of the first 1x1 convolution of a branch.
fn branch_shape(names: &ConvNames, outputs: usize, inputs: usize) -> Vec<usize> {
    let mut shape = vec![outputs, inputs, 1, 1];
    shape.extend(is_volume(&names.prefix).then_some(1));
    shape
}

/// `a` [rows, inner] times `b` [inner, columns].
fn matmul(a: &[f64], b: &[f64], rows: usize, inner: usize, columns: usize) -> Vec<f64> {
    let mut out = vec![0.0; rows * columns];
    for (a, out) in a.chunks_exact(inner).zip(out.chunks_exact_mut(columns)) {
        for (&a, b) in a.iter().zip(b.chunks_exact(columns)) {
            out.iter_mut().zip(b).for_each(|(out, b)| *out += a * b);
        }
    }
    out
}

/// Weights `[outputs, inputs, taps]` to panels with k running over (tap, input).
fn pack_conv(weight: &[f64], inputs: usize, outputs: usize) -> Vec<f32> {
    let depth = weight.len() / outputs;
    let taps = depth / inputs;
    let mut out = vec![0.0; packed_len(depth, outputs)];
    pack(depth, outputs, |k, n| weight[n * depth + k % inputs * taps + k / inputs] as f32, &mut out);
    out
}

/// Depthwise weights `[channels, taps]` to `[taps, channels padded to 16]`.
fn pack_taps(weight: &[f64], taps: usize, channels: usize) -> Vec<f32> {
    let mut out = vec![];
    for tap in 0..taps {
        let row: Vec<f64> = (0..channels).map(|c| weight[c * taps + tap]).collect();
        out.extend(padded(&row));
    }
    out
}

/// As f32, with zeros up to a multiple of 16.
fn padded(values: &[f64]) -> Vec<f32> {
    let mut out: Vec<f32> = values.iter().map(|&v| v as f32).collect();
    out.resize(values.len().next_multiple_of(LANES), 0.0);
    out
}

#[cfg(test)]
mod tests;

//! A whole network: the operations of [`Graph::build`], unrewritten, one after the other, with the checkpoint's weights.

use crate::gpu::{Buffer, Gpu};
use crate::ops::{self, HeadWeights, Matrix, Norm, Tensor, Walk};
use crate::{Failure, projection};
use safetensors::Dtype;
use std::collections::BTreeMap;
use voxcast::graph::{self, Graph, Op, Operation, Recipe, Scope};
use voxcast::import::Source;
use voxcast::{Network, Scene};

/// Side of an attention window, at most (SPEC of EfficientViT, arXiv 2305.07027).
const WINDOW: usize = 7;

/// A named result in the layout of the golden cases: channels first, a leading 1 or the cameras; logits channels last.
#[derive(Clone, Debug, PartialEq)]
pub struct Stage {
    /// Its name.
    pub name: String,
    /// Type of its elements.
    pub dtype: Dtype,
    /// Dimensions, outermost first.
    pub shape: Vec<usize>,
    /// Its elements, little-endian.
    pub bytes: Vec<u8>,
}

impl Stage {
    /// Its numbers, if they are f32.
    pub fn floats(&self) -> Vec<f32> {
        self.bytes.as_chunks().0.iter().map(|&b| f32::from_le_bytes(b)).collect()
    }
}

/// The two matrices of each level: voxels, then cells of the bird's-eye view.
pub type Matrices = [[Matrix; 2]; 3];

/// Runs `network` on `scene` and returns every stage, the matrices and the classes. Without `matrices` its own are used.
///
/// # Errors
/// A tensor that `weights` lacks or has in another shape; a scene of another size.
pub fn run(
    gpu: &Gpu,
    network: &Network,
    weights: &dyn Source,
    scene: &Scene,
    matrices: Option<Matrices>,
) -> Result<Vec<Stage>, Failure> {
    scene.check(network)?;
    let matrices = matrices.unwrap_or_else(|| projection::matrices(gpu, network, &scene.lidar2img));
    let graph = Graph::build(network, true);
    let mut walk = Run { gpu, graph: &graph, weights, matrices: &matrices, frame: BTreeMap::new(), stages: vec![] };
    let mut features: Vec<BTreeMap<usize, Tensor>> = vec![];
    for image in &scene.images {
        let mut tensors = BTreeMap::new();
        for operation in &graph.operations[..graph.camera_operations] {
            if operation.op == Op::Normalise {
                let image = ops::normalise(gpu, &image.bgr, [image.height, image.width], network.image);
                walk.keep(operation, &image, true);
                tensors.insert(operation.output.0, image);
            } else {
                walk.operation(operation, &mut tensors, &[], true)?;
            }
        }
        tensors.retain(|&id, _| graph.tensors[id].scope == Scope::Features);
        features.push(tensors);
    }
    let mut tensors = std::mem::take(&mut walk.frame);
    for operation in &graph.operations[graph.camera_operations..] {
        walk.operation(operation, &mut tensors, &features, false)?;
    }
    let mut stages = walk.stages;
    for (level, pair) in matrices.iter().enumerate() {
        for (matrix, kind) in pair.iter().zip(["volume", "bev"]) {
            for (numbers, part) in [(&matrix.ptr, "ptr"), (&matrix.col, "col")] {
                stages.push(Stage {
                    name: format!("level{}.csr_{kind}.{part}", level + 1),
                    dtype: Dtype::I64,
                    shape: vec![numbers.len()],
                    bytes: numbers.iter().flat_map(|&n| i64::from(n).to_le_bytes()).collect(),
                });
            }
        }
    }
    Ok(stages)
}

struct Run<'a> {
    gpu: &'a Gpu,
    graph: &'a Graph,
    weights: &'a dyn Source,
    matrices: &'a Matrices,
    frame: BTreeMap<usize, Tensor>,
    stages: Vec<Stage>,
}

impl Run<'_> {
    fn operation(
        &mut self,
        operation: &Operation,
        tensors: &mut BTreeMap<usize, Tensor>,
        features: &[BTreeMap<usize, Tensor>],
        camera: bool,
    ) -> Result<(), Failure> {
        let input = |i: usize| &tensors[&operation.inputs[i].0];
        let mut y = match operation.op {
            Op::Gather { level, matrix, first_channel: 0, bias: false } => {
                let maps: Vec<&Tensor> = features.iter().map(|f| &f[&operation.inputs[0].0]).collect();
                let index = usize::from(matrix == graph::Matrix::Bev);
                let extent = self.graph.tensor(operation.output).extent;
                ops::gather(self.gpu, &self.matrices[level][index], &maps, extent)
            }
            Op::Head { level } => return self.head(operation, level, input(0)),
            _ => self.compute(operation, &input)?,
        };
        let residual = operation.residual.map(|r| (&tensors[&r.tensor.0], r.after));
        if let Some((residual, false)) = residual {
            y = ops::add(self.gpu, &y, residual);
        }
        if operation.relu {
            y = ops::relu(self.gpu, &y);
        }
        if let Some((residual, true)) = residual {
            y = ops::add(self.gpu, &y, residual);
        }
        let output = self.graph.tensor(operation.output);
        if operation.channels == output.channels {
            tensors.insert(operation.output.0, y.clone());
        } else {
            // Branches side by side in one tensor.
            let wide = tensors.entry(operation.output.0).or_insert_with(|| Tensor {
                extent: output.extent,
                channels: output.channels,
                buffer: self.gpu.zeros(output.len()),
            });
            wide.write(self.gpu, operation.first_channel, &y);
        }
        self.keep(operation, &y, camera);
        Ok(())
    }

    /// The operation itself, without what follows it.
    fn compute<'t>(&self, operation: &Operation, input: &dyn Fn(usize) -> &'t Tensor) -> Result<Tensor, Failure> {
        let gpu = self.gpu;
        let channels = operation.channels;
        Ok(match &operation.op {
            Op::Conv { geometry } => {
                let x = input(0);
                let walk = Walk {
                    kernel: geometry.kernel,
                    stride: geometry.stride,
                    dilation: geometry.dilation,
                    padding: geometry.padding,
                };
                let Recipe::Conv(names) = &operation.recipe else { return Err(foreign(operation)) };
                let [d, h, w] = geometry.kernel;
                // The published modules are Conv3d here and Conv2d elsewhere.
                let solid = ["down_conv3d", "refine_lvl"].iter().any(|part| names.prefix.contains(part));
                let shape = if solid { vec![channels, x.channels, d, h, w] } else { vec![channels, x.channels, h, w] };
                let weight = self.load(&format!("{}.weight", names.prefix), &shape)?;
                let bias = match names.bias {
                    true => Some(self.load(&format!("{}.bias", names.prefix), &[channels])?),
                    false => None,
                };
                ops::conv(gpu, x, &walk, &weight, bias.as_ref())
            }
            Op::DeformConv { .. } => {
                let x = input(0);
                let weight = self.load(&format!("{}.weight", operation.name), &[channels, x.channels, 3, 3])?;
                ops::deform_conv(gpu, x, input(1), &weight)
            }
            Op::Depthwise { side } => {
                let x = input(0);
                let weight = self.load(&format!("{}.weight", operation.name), &[channels, 1, *side, *side])?;
                ops::depthwise(gpu, x, *side, [x.extent[1], x.extent[2]], &weight)
            }
            Op::BatchNorm => {
                let x = input(0).slice(gpu, operation.first_channel, channels);
                ops::batch_norm(gpu, &x, &self.norm(&operation.name, channels)?)
            }
            Op::MaxPool { side, stride, padding } => ops::max_pool(gpu, input(0), *side, *stride, *padding),
            Op::UpsampleAdd => {
                let x = input(0);
                ops::add(gpu, x, &ops::upsample(gpu, input(1), [x.extent[1], x.extent[2]]))
            }
            Op::Deconv => {
                let x = input(0);
                let weight = self.load(&format!("{}.weight", operation.name), &[x.channels, channels, 4, 4, 4])?;
                ops::deconv(gpu, x, &weight, &self.load(&format!("{}.bias", operation.name), &[channels])?)
            }
            Op::WindowAttention { shape } => self.attention(&operation.name, input(0), shape.heads, shape.key_dim)?,
            Op::Gate => {
                let weight = self.load(&format!("{}.weight", operation.name), &[1, channels, 1, 1, 1])?;
                let bias = self.load(&format!("{}.bias", operation.name), &[1])?;
                ops::gate(gpu, input(0), input(1), &weight, &bias)
            }
            Op::GlobalMean => ops::mean(gpu, input(0)),
            Op::Broadcast => ops::broadcast(gpu, input(0), self.graph.tensor(operation.output).extent),
            Op::Normalise | Op::Gather { .. } | Op::Head { .. } => return Err(foreign(operation)),
        })
    }

    fn attention(&self, prefix: &str, x: &Tensor, heads: usize, dim: usize) -> Result<Tensor, Failure> {
        let side = WINDOW.min(x.extent[1]);
        let offsets = format!("{prefix}.attention_biases");
        let offsets =
            Tensor { extent: [1, side, side], channels: heads, buffer: self.load(&offsets, &[heads, side * side])? };
        let part = x.channels / heads;
        let pair = |name: &str, shape: &[usize]| -> Result<(Buffer, Norm), Failure> {
            let weight = self.load(&format!("{prefix}.{name}.c.weight"), shape)?;
            Ok((weight, self.norm(&format!("{prefix}.{name}.bn"), shape[0])?))
        };
        let weights = (0..heads)
            .map(|i| {
                Ok(HeadWeights {
                    qkv: pair(&format!("qkvs.{i}"), &[3 * dim, part, 1, 1])?,
                    query: pair(&format!("dws.{i}"), &[dim, 1, 5, 5])?,
                    offsets: offsets.slice(self.gpu, i, 1).buffer,
                })
            })
            .collect::<Result<Vec<_>, Failure>>()?;
        let proj = pair("proj.1", &[x.channels, heads * dim, 1, 1])?;
        Ok(ops::window_attention(self.gpu, x, WINDOW, &weights, &proj))
    }

    fn head(&mut self, operation: &Operation, level: usize, x: &Tensor) -> Result<(), Failure> {
        let layer = |i: usize, outputs: usize| -> Result<[Buffer; 2], Failure> {
            let weight = self.load(&format!("{}.{i}.weight", operation.name), &[outputs, x.channels])?;
            Ok([weight, self.load(&format!("{}.{i}.bias", operation.name), &[outputs])?])
        };
        let layers = [layer(0, x.channels)?, layer(2, x.channels)?, layer(4, operation.channels)?];
        let (logits, classes) = ops::head(self.gpu, x, &layers);
        if let Some(name) = &operation.stage {
            let shape = x.extent.into_iter().chain([operation.channels]).collect();
            let bytes = floats(&self.gpu.read::<f32>(&logits));
            self.stages.push(Stage { name: name.clone(), dtype: Dtype::F32, shape, bytes });
        }
        if level == 0 {
            self.stages.push(Stage {
                name: "classes".to_owned(),
                dtype: Dtype::U8,
                shape: x.extent.to_vec(),
                bytes: self.gpu.read::<u32>(&classes).iter().map(|&c| c as u8).collect(),
            });
        }
        Ok(())
    }

    /// Reads a stage back. Those of cameras follow one another.
    fn keep(&mut self, operation: &Operation, tensor: &Tensor, camera: bool) {
        let Some(name) = &operation.stage else { return };
        let bytes = floats(&self.gpu.read::<f32>(&tensor.buffer));
        if let Some(stage) = self.stages.iter_mut().find(|s| s.name == *name) {
            stage.shape[0] += 1;
            stage.bytes.extend(bytes);
            return;
        }
        let solid = ["volume", "fused"].iter().any(|part| name.contains(part));
        let extent = if camera || !solid { &tensor.extent[1..] } else { &tensor.extent[..] };
        let shape = [1, tensor.channels].into_iter().chain(extent.iter().copied()).collect();
        self.stages.push(Stage { name: name.clone(), dtype: Dtype::F32, shape, bytes });
    }

    fn norm(&self, prefix: &str, channels: usize) -> Result<Norm, Failure> {
        let part = |name: &str| self.load(&format!("{prefix}.{name}"), &[channels]);
        Ok(Norm {
            gamma: part("weight")?,
            beta: part("bias")?,
            mean: part("running_mean")?,
            variance: part("running_var")?,
        })
    }

    fn load(&self, name: &str, shape: &[usize]) -> Result<Buffer, Failure> {
        let numbers: Vec<f32> = self.weights.tensor(name, shape)?.into_iter().map(|v| v as f32).collect();
        Ok(self.gpu.upload(&numbers))
    }
}

fn foreign(operation: &Operation) -> Failure {
    Failure(format!("{}: {:?} is no operation of an unrewritten graph", operation.name, operation.op))
}

fn floats(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

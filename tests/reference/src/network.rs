//! A whole network: the operations of [`Graph::build`], unrewritten, one after the other, with the checkpoint's weights.

use crate::gpu::{Buffer, Gpu};
use crate::ops::{self, HeadWeights, Matrix, Norm, Tensor};
use crate::{Failure, projection};
use safetensors::Dtype;
use std::collections::BTreeMap;
use voxcast::graph::ops::{Gather, Shader};
use voxcast::graph::{self, Graph, Lifetime, Op, Operation, Results, Scope, Space};
use voxcast::import::Source;
use voxcast::scene::Image;
use voxcast::{Network, Scene};

/// Side of an attention window, at most (EfficientViT, arXiv 2305.07027).
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
    let graph = Graph::build(network, Results::ALL);
    let loader = Loader { gpu, weights };
    let mut run = Run { gpu, graph: &graph, loader, matrices: &matrices, stages: Stages::default() };
    walk(&graph, scene, &mut |operation, image, tensors, features| {
        let Some(image) = image.filter(|_| matches!(operation.op, Op::Normalise(_))) else {
            return run.operation(operation, tensors, features);
        };
        let image = ops::normalise(gpu, &image.bgr, [image.height, image.width], network.image);
        run.stages.keep(&graph, operation, &image, Dtype::F32, floats(&gpu.read(&image.buffer)));
        tensors.insert(operation.output().0, image);
        Ok(())
    })?;
    Ok(run.stages.with(&matrices))
}

/// Tensors by number.
pub(crate) type Tensors = BTreeMap<usize, Tensor>;

/// What [`walk`] calls: with the operation, a camera's image in its pass, the pass's or the frame's tensors, and those that
/// each camera's pass left.
pub(crate) type Step<'a> = dyn FnMut(&Operation, Option<&Image>, &mut Tensors, &[Tensors]) -> Result<(), Failure> + 'a;

/// Calls `step` for every operation, in the order in which they run: all of a camera's pass for each image, then the frame's.
///
/// # Errors
/// The first of `step`.
pub(crate) fn walk(graph: &Graph, scene: &Scene, step: &mut Step<'_>) -> Result<(), Failure> {
    let mut features: Vec<Tensors> = vec![];
    for image in &scene.images {
        let mut tensors = Tensors::new();
        for operation in &graph.operations[..graph.camera_operations] {
            step(operation, Some(image), &mut tensors, &[])?;
        }
        tensors.retain(|&id, _| graph.tensors[id].lifetime == Lifetime::Camera);
        features.push(tensors);
    }
    let mut tensors = Tensors::new();
    for operation in &graph.operations[graph.camera_operations..] {
        step(operation, None, &mut tensors, &features)?;
    }
    Ok(())
}

/// Named results, in running order.
#[derive(Default)]
pub(crate) struct Stages(Vec<Stage>);

impl Stages {
    /// Keeps the result of `operation` if it has a name. Those of cameras follow one another.
    pub(crate) fn keep(&mut self, graph: &Graph, operation: &Operation, tensor: &Tensor, dtype: Dtype, bytes: Vec<u8>) {
        let Some(name) = &operation.stage else { return };
        if let Some(stage) = self.0.iter_mut().find(|s| s.name == *name) {
            stage.shape[0] += 1;
            stage.bytes.extend(bytes);
            return;
        }
        let extent = match graph.tensor(operation.output()).space {
            Space::Volume => &tensor.extent[..],
            Space::Image | Space::Plane => &tensor.extent[1..],
        };
        let shape = [1, tensor.channels].into_iter().chain(extent.iter().copied()).collect();
        self.0.push(Stage { name: name.clone(), dtype, shape, bytes });
    }

    /// Keeps what a head gave for the voxels of `extent`: logits `[voxels, classes]`, and of the last head the classes.
    pub(crate) fn keep_head(
        &mut self,
        graph: &Graph,
        operation: &Operation,
        extent: [usize; 3],
        logits: &[f32],
        largest: &[u32],
    ) {
        if let Some(name) = &operation.stage {
            let shape = extent.into_iter().chain([logits.len() / largest.len()]).collect();
            self.0.push(Stage { name: name.clone(), dtype: Dtype::F32, shape, bytes: floats(logits) });
        }
        if graph.tensor(operation.output()).scope == Scope::Output {
            let bytes = largest.iter().map(|&c| c as u8).collect();
            self.0.push(Stage { name: "classes".to_owned(), dtype: Dtype::U8, shape: extent.to_vec(), bytes });
        }
    }

    /// All of them, and the matrices.
    pub(crate) fn with(self, matrices: &Matrices) -> Vec<Stage> {
        let mut stages = self.0;
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
        stages
    }
}

/// Puts the result of `operation` among `tensors`: whole, or as some channels of a wide one.
pub(crate) fn place(gpu: &Gpu, graph: &Graph, operation: &Operation, y: &Tensor, tensors: &mut Tensors) {
    let output = graph.tensor(operation.output());
    if operation.channels == output.channels {
        tensors.insert(operation.output().0, y.clone());
    } else {
        // Branches side by side in one tensor.
        let wide = tensors.entry(operation.output().0).or_insert_with(|| Tensor {
            extent: output.extent,
            channels: output.channels,
            buffer: gpu.zeros(output.len()),
        });
        wide.write(gpu, operation.first_channel, y);
    }
}

/// The features that a gather reads, of every camera.
pub(crate) fn maps<'t>(operation: &Operation, features: &'t [Tensors]) -> Vec<&'t Tensor> {
    features.iter().map(|tensors| &tensors[&operation.inputs[0].0]).collect()
}

/// The matrix of a level.
pub(crate) fn matrix(matrices: &Matrices, level: usize, kind: graph::Matrix) -> &Matrix {
    &matrices[level][usize::from(kind == graph::Matrix::Bev)]
}

struct Run<'a> {
    gpu: &'a Gpu,
    graph: &'a Graph,
    loader: Loader<'a>,
    matrices: &'a Matrices,
    stages: Stages,
}

impl Run<'_> {
    fn operation(&mut self, operation: &Operation, tensors: &mut Tensors, features: &[Tensors]) -> Result<(), Failure> {
        let input = |i: usize| &tensors[&operation.inputs[i].0];
        let mut y = match (&operation.op, operation.op.description().shader(&self.graph.site(operation))) {
            (_, Some(shader)) => self.shader(operation, &shader, &input)?,
            (Op::WindowAttention(attention), None) => {
                self.loader.attention(&operation.name, input(0), attention.shape.heads, attention.shape.key_dim)?
            }
            (&Op::Gather(Gather { level, matrix: kind, first_channel: 0 }), None) => {
                let extent = self.graph.tensor(operation.output()).extent;
                ops::gather(self.gpu, matrix(self.matrices, level, kind), &maps(operation, features), extent)
            }
            (Op::Head(head), None) => return self.head(operation, head.classes, input(0)),
            (op, None) => {
                let message = format!("{}: {op:?} has no shader and is not composed of others", operation.name);
                return Err(Failure(message));
            }
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
        place(self.gpu, self.graph, operation, &y, tensors);
        let bytes = floats(&self.gpu.read(&y.buffer));
        self.stages.keep(self.graph, operation, &y, Dtype::F32, bytes);
        Ok(())
    }

    /// The operation itself, without what follows it: the shader that its description names.
    fn shader<'t>(
        &self,
        operation: &Operation,
        shader: &Shader,
        input: &dyn Fn(usize) -> &'t Tensor,
    ) -> Result<Tensor, Failure> {
        let gpu = self.gpu;
        let in_place = operation.op.description().in_place();
        let mut buffers = vec![];
        for i in 0..operation.inputs.len() {
            let x = input(i);
            // What works in place on some channels of a wide tensor reads only those.
            let whole = in_place != Some(i) || x.channels == operation.channels;
            let part = (!whole).then(|| x.slice(gpu, operation.first_channel, operation.channels));
            buffers.push(part.as_ref().unwrap_or(x).buffer.clone());
        }
        for (name, shape) in &shader.weights {
            buffers.push(match name {
                Some(name) => self.loader.load(name, shape)?,
                None => gpu.zeros(1),
            });
        }
        let words: Vec<u32> = shader.shape.iter().map(|&v| u32::try_from(v).expect("shapes fit 32 bits")).collect();
        let extent = self.graph.tensor(operation.output()).extent;
        let buffers: Vec<&Buffer> = buffers.iter().collect();
        let len = extent.iter().product::<usize>() * operation.channels;
        Ok(Tensor { extent, channels: operation.channels, buffer: gpu.run(shader.name, &words, &buffers, len) })
    }

    fn head(&mut self, operation: &Operation, classes: usize, x: &Tensor) -> Result<(), Failure> {
        let layer = |i: usize, outputs: usize| -> Result<[Buffer; 2], Failure> {
            let weight = self.loader.load(&format!("{}.{i}.weight", operation.name), &[outputs, x.channels])?;
            Ok([weight, self.loader.load(&format!("{}.{i}.bias", operation.name), &[outputs])?])
        };
        let layers = [layer(0, x.channels)?, layer(2, x.channels)?, layer(4, classes)?];
        let (logits, largest) = ops::head(self.gpu, x, &layers);
        let (logits, largest) = (self.gpu.read::<f32>(&logits), self.gpu.read::<u32>(&largest));
        self.stages.keep_head(self.graph, operation, x.extent, &logits, &largest);
        Ok(())
    }
}

/// The checkpoint's weights.
#[derive(Clone, Copy)]
pub(crate) struct Loader<'a> {
    pub(crate) gpu: &'a Gpu,
    pub(crate) weights: &'a dyn Source,
}

impl Loader<'_> {
    /// Cascaded attention with the weights of `prefix`.
    pub(crate) fn attention(&self, prefix: &str, x: &Tensor, heads: usize, dim: usize) -> Result<Tensor, Failure> {
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

pub(crate) fn floats(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

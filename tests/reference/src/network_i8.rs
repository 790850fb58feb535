//! A whole network in 8-bit integers: the operations of a model's graph, one after the other, with the integers that the model
//! stores, which are taken apart as docs/format.md says. What the graph keeps in f32 has the checkpoint's weights.

use crate::gpu::{Buffer, Gpu};
use crate::network::{Loader, Matrices, Stage, Stages, Tensors, floats, maps, matrix, place, walk};
use crate::ops::{Tensor, Walk};
use crate::ops_i8::{self as ops, Columns};
use crate::{Failure, projection};
use safetensors::Dtype;
use voxcast::container::Container;
use voxcast::graph::{Element, Graph, Op, Operation, Results};
use voxcast::import::Source;
use voxcast::scene::Image;
use voxcast::{Model, Scene};

/// Columns of a panel of packed weights, and k that lie side by side in it.
const PANEL: usize = 16;
const GROUP: usize = 4;

/// Runs `model` on `scene` and returns every stage, the matrices and the classes. Stages are integers, but for logits and what
/// stays in f32. Without `matrices` the reference's own are used.
///
/// # Errors
/// A part that the model lacks, an operation that has no shader in integers and is no window attention, a scene of another
/// size.
pub fn run(
    gpu: &Gpu,
    model: &Model,
    weights: &dyn Source,
    scene: &Scene,
    matrices: Option<Matrices>,
) -> Result<Vec<Stage>, Failure> {
    let network = model.network();
    scene.check(network)?;
    let matrices = matrices.unwrap_or_else(|| projection::matrices(gpu, network, &scene.lidar2img));
    let graph = model.graph(false, Results::ALL);
    let parts = Container::from_bytes(model.bytes().to_vec())?;
    let loader = Loader { gpu, weights };
    let mut run = Run { gpu, graph: &graph, parts, loader, matrices: &matrices, stages: Stages::default() };
    walk(&graph, scene, &mut |operation, image, tensors, features| run.operation(operation, image, tensors, features))?;
    Ok(run.stages.with(&matrices))
}

struct Run<'a> {
    gpu: &'a Gpu,
    graph: &'a Graph,
    parts: Container,
    loader: Loader<'a>,
    matrices: &'a Matrices,
    stages: Stages,
}

impl Run<'_> {
    fn operation(
        &mut self,
        operation: &Operation,
        image: Option<&Image>,
        tensors: &mut Tensors,
        features: &[Tensors],
    ) -> Result<(), Failure> {
        if let Op::HeadI8(head) = &operation.op {
            return self.head(operation, head.classes, &tensors[&operation.inputs[0].0]);
        }
        let y = self.result(operation, image, tensors, features)?;
        place(self.gpu, self.graph, operation, &y, tensors);
        let numbers = || self.gpu.read::<i32>(&y.buffer);
        let (dtype, bytes) = match self.graph.tensor(operation.output()).element {
            Element::I8 => (Dtype::I8, numbers().into_iter().map(|v| (v as i8).cast_unsigned()).collect()),
            Element::I32 => (Dtype::I32, numbers().into_iter().flat_map(i32::to_le_bytes).collect()),
            _ => (Dtype::F32, floats(&self.gpu.read(&y.buffer))),
        };
        self.stages.keep(self.graph, operation, &y, dtype, bytes);
        Ok(())
    }

    fn result(
        &self,
        operation: &Operation,
        image: Option<&Image>,
        tensors: &Tensors,
        features: &[Tensors],
    ) -> Result<Tensor, Failure> {
        let gpu = self.gpu;
        let input = |i: usize| &tensors[&operation.inputs[i].0];
        let output = self.graph.tensor(operation.output());
        let channels = operation.channels;
        Ok(match &operation.op {
            Op::NormaliseI8(_) => {
                let image = image.ok_or_else(|| Failure(format!("{}: no camera's image", operation.name)))?;
                let factors = [self.part(operation, "factors")?, self.part(operation, "offsets")?];
                let [_, height, width] = output.extent;
                let factors = factors.map(|part| part[..3].to_vec()).concat();
                ops::normalise(gpu, &image.bgr, [image.height, image.width], [height, width], &factors)
            }
            Op::ConvI8(conv) => {
                let g = &conv.geometry;
                let walk = Walk { kernel: g.kernel, stride: g.stride, dilation: g.dilation, padding: g.padding };
                let weight = self.weight(operation, "weight", g.kernel.iter().product(), g.channels, channels)?;
                let wide = output.element == Element::I32;
                ops::conv(gpu, input(0), &walk, &weight, &self.columns(operation, tensors)?, wide)
            }
            Op::DeformConvI8(conv) => {
                let g = &conv.geometry;
                let weight = self.weight(operation, "weight", g.kernel.iter().product(), g.channels, channels)?;
                ops::deform_conv(gpu, input(0), input(1), &weight, &self.columns(operation, tensors)?)
            }
            Op::DepthwiseI8(depthwise) => {
                let (weight, padded) = (self.part(operation, "weight")?, channels.next_multiple_of(PANEL));
                let taps = depthwise.side * depthwise.side;
                let weight: Vec<i32> = (0..channels * taps).map(|i| weight[i % taps * padded + i / taps]).collect();
                let columns = self.columns(operation, tensors)?;
                let residual = columns.residual.is_some();
                ops::depthwise(gpu, input(0), depthwise.side, &gpu.upload(&weight), &columns.numbers, residual)
            }
            Op::MaxPoolI8(pool) => ops::max_pool(gpu, input(0), pool.side, pool.stride, pool.padding),
            Op::UpsampleAddI8(_) => {
                let factors = self.part(operation, "factors")?;
                ops::upsample_add(gpu, input(0), input(1), [factors[0], factors[1]])
            }
            Op::GatherI8(gather) => {
                let maps: Vec<Tensor> = maps(operation, features)
                    .into_iter()
                    .map(|map| map.slice(gpu, gather.first_channel, channels))
                    .collect();
                let maps: Vec<&Tensor> = maps.iter().collect();
                let bias = match self.part(operation, "bias") {
                    Ok(bias) => bias[..channels].to_vec(),
                    Err(_) => vec![0; channels],
                };
                let (factor, matrix) =
                    (self.part(operation, "factor")?[0], matrix(self.matrices, gather.level, gather.matrix));
                ops::gather(gpu, matrix, &maps, output.extent, factor, &bias, operation.relu)
            }
            Op::DeconvI8(_) => {
                let weight = self.deconv_weight(operation, input(0).channels)?;
                ops::deconv(gpu, input(0), &weight, &self.columns(operation, tensors)?)
            }
            Op::GateI8(_) => {
                let weight = gpu.upload(&self.part(operation, "weight")?[..channels]);
                let (logit, factors) = (self.part(operation, "logit")?, self.part(operation, "factors")?);
                ops::gate(gpu, input(0), input(1), &weight, [logit[0], logit[1], factors[0], factors[1]])
            }
            Op::GlobalMeanI8(_) => ops::mean(gpu, input(0), self.part(operation, "factor")?[0]),
            Op::BroadcastI8(_) => ops::broadcast(gpu, input(0), output.extent),
            Op::Quantise(_) => {
                let scale = output.scale.ok_or_else(|| Failure(format!("{}: no scale", operation.name)))?;
                ops::quantise(gpu, input(0), 1.0 / scale.step())
            }
            Op::Dequantise(_) => {
                let scale = self.graph.tensor(operation.inputs[0]).scale;
                let scale = scale.ok_or_else(|| Failure(format!("{}: no scale", operation.name)))?;
                ops::dequantise(gpu, input(0), scale.step())
            }
            Op::WindowAttention(attention) => {
                let shape = &attention.shape;
                self.loader.attention(&operation.name, input(0), shape.heads, shape.key_dim)?
            }
            op => return Err(Failure(format!("{}: {op:?} has no shader in integers", operation.name))),
        })
    }

    fn head(&mut self, operation: &Operation, classes: usize, x: &Tensor) -> Result<(), Failure> {
        let gpu = self.gpu;
        let layer = |i: usize, outputs: usize| -> Result<[Buffer; 2], Failure> {
            let weight = self.weight(operation, &format!("{i}.weight"), 1, x.channels, outputs)?;
            let bias = self.part(operation, &format!("{i}.bias"))?[..outputs].to_vec();
            let multiplier = match i {
                2 => vec![0; outputs],
                _ => self.part(operation, &format!("{i}.multiplier"))?[..outputs].to_vec(),
            };
            Ok([weight, gpu.upload(&[bias, multiplier].concat())])
        };
        let layers = [layer(0, x.channels)?, layer(1, x.channels)?, layer(2, classes)?];
        let (sums, largest) = ops::head(gpu, x, &layers);
        let scale = self.stored(&format!("{}.2.scale", operation.name), Dtype::F32)?;
        let scale = f32::from_le_bytes(*scale.first_chunk().expect("one number"));
        let sums = Tensor { extent: x.extent, channels: classes, buffer: sums };
        let logits = gpu.read::<f32>(&ops::dequantise(gpu, &sums, scale).buffer);
        self.stages.keep_head(self.graph, operation, x.extent, &logits, &gpu.read::<u32>(&largest));
        Ok(())
    }

    /// What `operation`'s sums start from and become.
    fn columns(&self, operation: &Operation, tensors: &Tensors) -> Result<Columns, Failure> {
        let column = |name: &str| Ok::<_, Failure>(self.part(operation, name)?[..operation.channels].to_vec());
        let joins = match operation.residual {
            Some(_) => column("residual")?,
            None => vec![0; operation.channels],
        };
        Ok(Columns {
            numbers: self.gpu.upload(&[column("bias")?, column("multiplier")?, joins].concat()),
            residual: operation.residual.map(|r| (tensors[&r.tensor.0].clone(), r.after)),
            relu: operation.relu,
        })
    }

    /// Packed weights of `taps * inputs` x `outputs`, k over (tap, input), as `[outputs, inputs, taps]`.
    fn weight(
        &self,
        operation: &Operation,
        name: &str,
        taps: usize,
        inputs: usize,
        outputs: usize,
    ) -> Result<Buffer, Failure> {
        let packed = self.part(operation, name)?;
        let at = |i: usize| {
            let (n, c, tap) = (i / (inputs * taps), i / taps % inputs, i % taps);
            packed[place_of((taps * inputs).next_multiple_of(4), tap * inputs + c, n)]
        };
        Ok(self.gpu.upload(&(0..outputs * inputs * taps).map(at).collect::<Vec<_>>()))
    }

    /// Eight packed matrices, one per output parity, as `[inputs, outputs, 4, 4, 4]`.
    fn deconv_weight(&self, operation: &Operation, inputs: usize) -> Result<Buffer, Failure> {
        let (packed, outputs, depth) = (self.part(operation, "weight")?, operation.channels, 8 * inputs);
        let matrix = depth * outputs.next_multiple_of(PANEL);
        let at = |i: usize| {
            let (c, n) = (i / (64 * outputs), i / 64 % outputs);
            // On an axis, tap 3 - p - 2t of the kernel belongs to parity p and tap t.
            let axes = [i / 16 % 4, i / 4 % 4, i % 4].map(|tap| [(3 - tap) % 2, (3 - tap) / 2]);
            let [parity, tap] = [0, 1].map(|part| axes.iter().fold(0, |number, axis| number * 2 + axis[part]));
            packed[parity * matrix + place_of(depth, tap * inputs + c, n)]
        };
        Ok(self.gpu.upload(&(0..64 * inputs * outputs).map(at).collect::<Vec<_>>()))
    }

    /// A stored part of integers.
    fn part(&self, operation: &Operation, suffix: &str) -> Result<Vec<i32>, Failure> {
        let name = format!("{}.{suffix}", operation.name);
        if let Ok(bytes) = self.stored(&name, Dtype::I8) {
            return Ok(bytes.iter().map(|&b| i32::from(b.cast_signed())).collect());
        }
        let bytes = self.stored(&name, Dtype::I32)?;
        Ok(bytes.as_chunks().0.iter().map(|&b| i32::from_le_bytes(b)).collect())
    }

    fn stored(&self, name: &str, dtype: Dtype) -> Result<&[u8], Failure> {
        match self.parts.tensor(name) {
            Some((found, _, bytes)) if found == dtype => Ok(bytes),
            found => Err(Failure(format!("\"{name}\": found {:?}, expected {dtype:?}", found.map(|f| f.0)))),
        }
    }
}

/// Where element (`k`, `n`) of a packed matrix of `depth` rows is stored.
fn place_of(depth: usize, k: usize, n: usize) -> usize {
    ((n / PANEL * (depth / GROUP) + k / GROUP) * PANEL + n % PANEL) * GROUP + k % GROUP
}

//! Graph-to-graph functions that keep the result and lessen the work.

use super::matrices::Matrix;
use super::operation::{Graph, Operation};
use super::ops::{BatchNorm, Conv, Deconv, Gather, Op, Winograd, WinogradDeconv};
use super::recipe::{ConvNames, Recipe};
use super::tensor::TensorId;
use voxcast_kernels::conv::Geometry;
use voxcast_kernels::winograd::{Reads, Shape};

impl Graph {
    /// Moves every batch norm into the convolution whose result it reads: scale into the weights, shift into the bias.
    #[must_use]
    pub fn fold_batch_norm(mut self) -> Self {
        let mut kept: Vec<Operation> = Vec::with_capacity(self.operations.len());
        let mut camera_operations = 0;
        for (index, operation) in std::mem::take(&mut self.operations).into_iter().enumerate() {
            let producer = kept.last_mut().filter(|p| {
                operation.op == Op::BatchNorm(BatchNorm)
                    && operation.inputs == [p.output()]
                    && operation.first_channel == p.first_channel
                    && matches!(&p.recipe, Recipe::Conv(names) if names.norm.is_none())
            });
            match producer {
                Some(producer) => {
                    if let (Recipe::Conv(names), Recipe::Module(norm)) = (&mut producer.recipe, operation.recipe) {
                        names.norm = Some(norm);
                    }
                    for &TensorId(output) in &operation.outputs {
                        if self.tensors[output].name == operation.name {
                            self.tensors[output].name.clone_from(&producer.name);
                        }
                    }
                    producer.outputs = operation.outputs;
                    producer.relu = operation.relu;
                    producer.residual = operation.residual;
                    producer.stage = operation.stage;
                }
                None => kept.push(operation),
            }
            if index < self.camera_operations {
                camera_operations = kept.len();
            }
        }
        self.operations = kept;
        self.camera_operations = camera_operations;
        self
    }

    /// Replaces pyramid convolution, mean, and the first 1x1 convolution of both branches by one convolution with the
    /// channels of both branches, and means over those channels. Nothing non-linear lies between them. The pixels' bias
    /// goes through the mean (an empty row gets none of it), the branches' biases are added after it.
    ///
    /// The pyramid's features and the gathered ones no longer exist, so their stages lose their names.
    #[must_use]
    pub fn fold_projection(mut self) -> Self {
        for level in 0..3 {
            self.fold_level(level);
        }
        self
    }

    /// Computes convolutions, transposed ones too, by Winograd's minimal filtering where [`Shape::best`] and
    /// [`Shape::best_deconv3d`] say so: from their shapes alone, and from whether every camera's pass reads the weights. What they
    /// read and write, and all that surrounds them, stays. Nothing that folds convolutions may come after it.
    #[must_use]
    pub fn use_winograd(mut self) -> Self {
        for (index, operation) in self.operations.iter_mut().enumerate() {
            let reads = if index < self.camera_operations { Reads::PerCamera } else { Reads::PerFrame };
            let filtered: Option<Op> = match operation.op {
                Op::Conv(Conv { geometry }) => {
                    Shape::best(&geometry, operation.channels, reads).map(|shape| Winograd { geometry, shape }.into())
                }
                Op::Deconv(Deconv) => {
                    let x = &self.tensors[operation.inputs[0].0];
                    Shape::best_deconv3d(x.extent, x.channels, operation.channels, reads)
                        .map(|shape| WinogradDeconv { shape }.into())
                }
                _ => None,
            };
            if let Some(op) = filtered {
                operation.op = op;
            }
        }
        self
    }

    fn fold_level(&mut self, level: usize) {
        let Some((volume, bev)) = self.branch(level, Matrix::Volume).zip(self.branch(level, Matrix::Bev)) else {
            return;
        };
        let features = self.operations[volume.gather].inputs[0];
        let Some(pixel) = self.operations.iter().position(|o| o.output() == features) else { return };
        let Recipe::Conv(pixel_names) = self.operations[pixel].recipe.clone() else { return };
        let channels = self.operations[volume.conv].channels;
        let inputs = self.tensor(features).channels;

        let operation = &mut self.operations[pixel];
        operation.name = format!("{}.projected", pixel_names.prefix);
        operation.channels = 2 * channels;
        operation.stage = None;
        operation.recipe =
            Recipe::Projection { pixel: pixel_names, volume: volume.names.clone(), bev: bev.names.clone() };
        self.tensors[features.0].channels = 2 * channels;

        for (branch, first) in [(&volume, 0), (&bev, channels)] {
            let conv = self.operations[branch.conv].clone();
            let gather = &mut self.operations[branch.gather];
            if let Op::Gather(gather) = &mut gather.op {
                gather.first_channel = first;
            }
            let section = self.tensors[gather.output().0].section;
            self.tensors[conv.output().0].section = section;
            gather.outputs = conv.outputs;
            gather.channels = channels;
            gather.relu = conv.relu;
            gather.stage = conv.stage;
            gather.recipe = Recipe::Bias { names: branch.names.clone(), inputs };
        }
        let mut gone = [volume.conv, bev.conv];
        gone.sort_unstable();
        for index in gone.into_iter().rev() {
            self.operations.remove(index);
        }
    }

    /// A gather and the 1x1 convolution that alone reads it.
    fn branch(&self, level: usize, matrix: Matrix) -> Option<Branch> {
        let gather = self.operations.iter().position(
            |o| matches!(o.op, Op::Gather(Gather { level: l, matrix: m, .. }) if l == level && m == matrix && o.recipe == Recipe::None),
        )?;
        let rows = self.operations[gather].output();
        let conv = self.only_reader(rows)?;
        match (&self.operations[conv].op, &self.operations[conv].recipe) {
            (Op::Conv(Conv { geometry: Geometry { kernel: [1, 1, 1], .. } }), Recipe::Conv(names)) => {
                Some(Branch { gather, conv, names: names.clone() })
            }
            _ => None,
        }
    }

    fn only_reader(&self, tensor: TensorId) -> Option<usize> {
        let mut readers = (0..self.operations.len()).filter(|&i| self.operations[i].reads().any(|t| t == tensor));
        readers.next().filter(|_| readers.next().is_none())
    }
}

struct Branch {
    gather: usize,
    conv: usize,
    names: ConvNames,
}

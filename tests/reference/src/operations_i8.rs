//! The table of single operations on 8-bit tensors, computed by the shaders.

use crate::gpu::{Buffer, Gpu};
use crate::operations::table_i8::{After, Case, Kind, table};
use crate::ops::{Matrix, Tensor, Walk};
use crate::ops_i8::{self as ops, Columns};

/// Every case's name and result, channels first; a head's are its sums, channels last, and its classes.
pub fn results(gpu: &Gpu) -> Vec<(String, Vec<i32>)> {
    table().iter().map(|case| (case.name.clone(), Run { gpu, case }.result())).collect()
}

struct Run<'a> {
    gpu: &'a Gpu,
    case: &'a Case,
}

impl Run<'_> {
    fn tensor(&self, what: &str, extent: [usize; 3], channels: usize, signed: bool) -> Tensor {
        let len = extent.iter().product::<usize>() * channels;
        self.of(extent, channels, &self.case.elements(what, len, signed))
    }

    fn of(&self, extent: [usize; 3], channels: usize, values: &[i32]) -> Tensor {
        Tensor { extent, channels, buffer: self.gpu.upload(values) }
    }

    fn weights(&self, what: &str, len: usize) -> Buffer {
        self.gpu.upload(&self.case.elements(what, len, true))
    }

    fn numbers(&self, what: &str, depth: usize, outputs: usize) -> Buffer {
        let columns = self.case.columns(what, depth, outputs);
        self.gpu.upload(&[columns.bias, columns.multiplier, columns.residual].concat())
    }

    fn columns(&self, depth: usize, outputs: usize, after: After, output: [usize; 3]) -> Columns {
        Columns {
            numbers: self.numbers("columns", depth, outputs),
            residual: after.adds().then(|| (self.tensor("residual", output, outputs, true), after == After::ReluAdd)),
            relu: after.relu(),
        }
    }

    fn result(&self) -> Vec<i32> {
        let (gpu, case) = (self.gpu, self.case);
        let y = match case.kind {
            Kind::Normalise { height, width } => {
                let padded = [height.next_multiple_of(32), width.next_multiple_of(32)];
                let factors = [case.integers("factors", 3, 4 << 20, false), case.integers("offsets", 3, 1 << 30, true)];
                ops::normalise(gpu, &case.bytes(height * width * 3), [height, width], padded, &factors.concat())
            }
            Kind::Conv(conv) => {
                let (stride, dilation, padding) = conv.axes();
                let walk = Walk { kernel: conv.kernel, stride, dilation, padding };
                let depth = conv.inputs * conv.kernel.iter().product::<usize>();
                let x = self.tensor("x", conv.extent, conv.inputs, conv.signed);
                let columns = self.columns(depth, conv.outputs, conv.after, conv.output());
                ops::conv(gpu, &x, &walk, &self.weights("weight", conv.outputs * depth), &columns, conv.wide)
            }
            Kind::DeformConv { height, width, inputs, outputs, reach, after } => {
                let extent = [1, height, width];
                let offsets = self.of(extent, 27, &case.offsets(height * width, reach));
                let columns = self.columns(9 * inputs, outputs, after, extent);
                let weight = self.weights("weight", outputs * inputs * 9);
                ops::deform_conv(gpu, &self.tensor("x", extent, inputs, true), &offsets, &weight, &columns)
            }
            Kind::Depthwise { height, width, channels, side, residual } => {
                let x = self.tensor("x", [1, height, width], channels, true);
                let numbers = self.numbers("columns", side * side, channels);
                ops::depthwise(gpu, &x, side, &self.weights("weight", channels * side * side), &numbers, residual)
            }
            Kind::MaxPool { height, width, channels } => {
                ops::max_pool(gpu, &self.tensor("x", [1, height, width], channels, true), 3, 2, 1)
            }
            Kind::UpsampleAdd { low, size, channels } => {
                let small = self.tensor("low", [1, low[0], low[1]], channels, true);
                let factors = case.integers("factors", 2, i16::MAX.into(), false);
                let x = self.tensor("x", [1, size[0], size[1]], channels, true);
                ops::upsample_add(gpu, &x, &small, [factors[0], factors[1]])
            }
            Kind::Gather { rows, cameras, pixels, channels, ends } => {
                let (ptr, col) = case.matrix(rows, cameras * pixels);
                let features: Vec<Tensor> =
                    (0..cameras).map(|i| self.tensor(&format!("camera {i}"), [1, 1, pixels], channels, true)).collect();
                let features: Vec<&Tensor> = features.iter().collect();
                let factor = case.integers("factor", 1, 2 << 21, false)[0];
                let bias = if ends { case.integers("bias", channels, 1 << 30, true) } else { vec![0; channels] };
                ops::gather(gpu, &Matrix { ptr, col }, &features, [1, 1, rows.len()], factor, &bias, ends)
            }
            Kind::Deconv { extent, inputs, outputs, after } => {
                let columns = self.columns(8 * inputs, outputs, after, extent.map(|v| 2 * v));
                let weight = self.weights("weight", inputs * outputs * 64);
                ops::deconv(gpu, &self.tensor("x", extent, inputs, true), &weight, &columns)
            }
            Kind::Gate { columns: [x, y], depth, channels } => {
                let columns = case.columns("columns", channels, 1);
                let factor = |what, high| case.integers(what, 1, high, false)[0];
                let [own, other] = [factor("own factor", 4 << 21), factor("bev factor", 4 << 11)];
                let scalars = [columns.bias[0], columns.multiplier[0], own, other];
                let volume = self.tensor("volume", [x, y, depth], channels, true);
                let bev = self.tensor("bev", [1, x, y], channels, true);
                ops::gate(gpu, &volume, &bev, &self.weights("weight", channels), scalars)
            }
            Kind::GlobalMean { positions, channels } => {
                let factor = case.integers("factor", 1, 4 << 24, false)[0];
                ops::mean(gpu, &self.tensor("x", [1, 1, positions], channels, true), factor)
            }
            Kind::Broadcast { positions, channels } => {
                ops::broadcast(gpu, &self.tensor("x", [1; 3], channels, true), [1, 1, positions])
            }
            Kind::Head { voxels, channels, classes } => return self.head(voxels, channels, classes),
            Kind::Quantise { len } => {
                let x = Tensor::new(gpu, [1, 1, len], 1, &case.numbers("x", len));
                ops::quantise(gpu, &x, 64.0)
            }
            Kind::Dequantise { len } => {
                // Its numbers are kept as their bits.
                ops::dequantise(gpu, &self.tensor("x", [1, 1, len], 1, true), 0.037)
            }
        };
        gpu.read(&y.buffer)
    }

    fn head(&self, voxels: usize, channels: usize, classes: usize) -> Vec<i32> {
        let layer = |i: usize, outputs: usize| {
            let columns = self.case.columns(&format!("{i}.columns"), channels, outputs);
            let weight = self.weights(&format!("{i}.weight"), outputs * channels);
            [weight, self.gpu.upload(&[columns.bias, columns.multiplier].concat())]
        };
        let layers = [layer(0, channels), layer(1, channels), layer(2, classes)];
        let (sums, classes) = ops::head(self.gpu, &self.tensor("x", [1, 1, voxels], channels, true), &layers);
        [self.gpu.read::<i32>(&sums), self.gpu.read(&classes)].concat()
    }
}

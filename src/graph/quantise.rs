//! The rewrite from a folded graph to one that computes in 8-bit integers.
//!
//! Which operations stay in floating point follows from the network and a list of names, by the rules of
//! [`Graph::quantise`]; `docs/int8.md` tells them to users.

use super::element::Element;
use super::hidden::hidden_layers;
use super::operation::{Graph, Operation};
use super::ops::{
    BroadcastI8, ConvI8, DeconvI8, DeformConvI8, DepthwiseI8, Dequantise, GateI8, GatherI8, GlobalMeanI8, HeadI8,
    MaxPoolI8, NormaliseI8, Op, Quantise, UpsampleAddI8,
};
use super::recipe::Recipe;
use super::scale::Scale;
use super::tensor::{Lifetime, Tensor, TensorId};
use crate::base::error::{Error, ErrorKind, Result};
use std::collections::BTreeMap;
use voxcast_kernels::matmul::int8::layout::GROUP;

/// What makes a folded graph one of 8-bit integers.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Quantisation {
    /// Operations that stay in floating point, by name, or by the start of names up to a dot.
    pub keep_f32: Vec<String>,
    /// The scales of tensors by name; [`Graph::quantise`] asks for those that it needs.
    pub scales: BTreeMap<String, Scale>,
}

impl Quantisation {
    /// The scale of tensor `name`.
    ///
    /// # Errors
    /// [`ErrorKind::Format`] if there is none.
    pub fn scale(&self, name: &str) -> Result<Scale> {
        let missing = || Error::format(format!("tensor \"{name}\": its scale is missing"));
        self.scales.get(name).copied().ok_or_else(missing)
    }
}

impl Graph {
    /// Makes operations read, sum and write 8-bit integers, with conversions wherever floating point begins or ends.
    ///
    /// In floating point stay: window attention, for its softmax; operations that `keep_f32` names; products whose input's
    /// channels are no multiple of 4; with a deformable convolution its offsets and the reverse; with one of several
    /// operations that fill one tensor side by side all of them; and operations without weights of their own (pooling,
    /// sums of maps, gathers) where all that they read is in floating point. The camera's image follows the first
    /// convolution.
    ///
    /// `scale` gives a tensor's scale by the tensor's name. A max-pool's result has the scale of what it reads, and what
    /// is broadcast that of the tensor in which it goes.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] for a name in `keep_f32` that no operation has, and for a graph with batch norms of
    /// their own or convolutions by minimal filtering; those of `scale`.
    pub fn quantise(mut self, keep_f32: &[String], scale: &mut dyn FnMut(&str) -> Result<Scale>) -> Result<Self> {
        let kept = self.kept(keep_f32)?;
        let scaled = self.scaled_as();
        for (index, &kept) in kept.iter().enumerate() {
            let output = self.operations[index].output();
            if kept || matches!(self.operations[index].op, Op::Head(_)) {
                continue;
            }
            if self.is_offsets(index) {
                self.tensors[output.0].element = Element::I32;
                continue;
            }
            if self.tensors[output.0].element != Element::I8 {
                let step = self.coarse_enough(index, &scaled, scale)?;
                let tensor = &mut self.tensors[output.0];
                (tensor.element, tensor.scale) = (Element::I8, Some(step));
            }
        }
        let signed = self.signed();
        for (index, &kept) in kept.iter().enumerate() {
            if !kept {
                self.operations[index].op = self.in_integers(&self.operations[index], &signed, scale)?;
            }
        }
        self.convert(&kept, &scaled, scale)?;
        Ok(self)
    }

    /// For each operation, whether it stays in floating point.
    fn kept(&self, names: &[String]) -> Result<Vec<bool>> {
        let named = |operation: &Operation, name: &str| {
            operation.name.strip_prefix(name).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
        };
        if let Some(name) = names.iter().find(|name| !self.operations.iter().any(|o| named(o, name))) {
            let message = format!(
                "no operation \"{name}\" to be kept in f32, expected one that inspect --operations lists, or its start"
            );
            return Err(Error::new(ErrorKind::Unsupported, message));
        }
        if let Some(other) =
            self.operations.iter().find(|o| matches!(o.op, Op::BatchNorm(_) | Op::Winograd(_) | Op::WinogradDeconv(_)))
        {
            let message = format!(
                "operation \"{}\": only networks with folded batch norms and direct convolutions run in integers",
                other.name
            );
            return Err(Error::new(ErrorKind::Unsupported, message));
        }
        let product = |op: &Op| matches!(op, Op::Conv(_) | Op::DeformConv(_) | Op::Deconv(_) | Op::Head(_));
        let on_image = |o: &Operation| o.inputs.iter().any(|&x| self.is_image(x));
        let mut kept: Vec<bool> = Vec::with_capacity(self.operations.len());
        for operation in &self.operations {
            let odd = product(&operation.op)
                && !on_image(operation)
                && !self.tensor(operation.inputs[0]).channels.is_multiple_of(GROUP);
            let attention = matches!(operation.op, Op::WindowAttention(_));
            kept.push(attention || odd || names.iter().any(|name| named(operation, name)));
        }
        let writers = self.writers();
        let together = self.together(&writers);
        loop {
            let before = kept.clone();
            for group in &together {
                if group.iter().any(|&index| kept[index]) {
                    group.iter().for_each(|&index| kept[index] = true);
                }
            }
            for (index, operation) in self.operations.iter().enumerate() {
                let floating = |id: TensorId| writers[id.0].iter().all(|&writer| kept[writer]);
                let weightless =
                    matches!(operation.op, Op::MaxPool(_) | Op::UpsampleAdd(_) | Op::Gather(_) | Op::GlobalMean(_));
                kept[index] |= weightless && operation.reads().all(floating);
            }
            if kept == before {
                return Ok(kept);
            }
        }
    }

    /// The operations that write each tensor.
    fn writers(&self) -> Vec<Vec<usize>> {
        let mut writers = vec![vec![]; self.tensors.len()];
        for (index, operation) in self.operations.iter().enumerate() {
            operation.outputs.iter().for_each(|id| writers[id.0].push(index));
        }
        writers
    }

    /// Operations of which all stay in floating point if one does.
    fn together(&self, writers: &[Vec<usize>]) -> Vec<Vec<usize>> {
        let mut groups: Vec<Vec<usize>> = writers.iter().filter(|w| w.len() > 1).cloned().collect();
        for (index, operation) in self.operations.iter().enumerate() {
            if matches!(operation.op, Op::DeformConv(_)) {
                groups.push([&writers[operation.inputs[1].0][..], &[index]].concat());
            }
            if operation.inputs.iter().any(|&x| self.is_image(x)) {
                groups.push([&writers[operation.inputs[0].0][..], &[index]].concat());
            }
        }
        groups
    }

    /// Whether tensor `id` is the normalised image.
    fn is_image(&self, id: TensorId) -> bool {
        self.operations.iter().any(|o| matches!(o.op, Op::Normalise(_)) && o.output() == id)
    }

    /// Whether operation `index` computes the offsets of a deformable convolution.
    fn is_offsets(&self, index: usize) -> bool {
        let output = self.operations[index].output();
        self.operations.iter().any(|o| matches!(o.op, Op::DeformConv(_)) && o.inputs[1] == output)
    }

    /// For each tensor, the one whose scale it has.
    fn scaled_as(&self) -> Vec<TensorId> {
        let mut scaled: Vec<TensorId> = self.ids().collect();
        for operation in &self.operations {
            match operation.op {
                Op::MaxPool(_) => scaled[operation.output().0] = scaled[operation.inputs[0].0],
                Op::Broadcast(_) => scaled[operation.inputs[0].0] = operation.output(),
                _ => {}
            }
        }
        scaled
    }

    /// The scale of what operation `index` writes: the tensor's, made coarser where the operation cannot write so fine a
    /// one, beside the scale of what it reads.
    fn coarse_enough(
        &self,
        index: usize,
        scaled: &[TensorId],
        scale: &mut dyn FnMut(&str) -> Result<Scale>,
    ) -> Result<Scale> {
        let operation = &self.operations[index];
        let mut of = |id: TensorId| match self.tensor(id).scale {
            Some(scale) => Ok(scale),
            None => scale(&self.tensor(scaled[id.0]).name),
        };
        let mut step = of(scaled[operation.output().0])?;
        let ratio = match operation.op {
            Op::Normalise(_) => {
                let least = Scale::try_from(NormaliseI8::LEAST_STEP)?;
                return Ok(if step < least { least } else { step });
            }
            Op::UpsampleAdd(_) => UpsampleAddI8::MOST_RATIO,
            Op::Gather(_) => GatherI8::MOST_RATIO,
            Op::Gate(_) => GateI8::MOST_RATIO,
            Op::GlobalMean(_) => GlobalMeanI8::MOST_RATIO,
            _ => return Ok(step),
        };
        for &input in &operation.inputs {
            let least = Scale::try_from((of(input)?.wide() / ratio) as f32)?;
            step = if step < least { least } else { step };
        }
        Ok(step)
    }

    /// For each tensor, whether it may hold negative numbers.
    fn signed(&self) -> Vec<bool> {
        let mut signed = vec![false; self.tensors.len()];
        for operation in &self.operations {
            let read = operation.inputs.iter().any(|id| signed[id.0]);
            let may = match (&operation.op, operation.residual) {
                (Op::MaxPool(_) | Op::GlobalMean(_) | Op::Broadcast(_) | Op::UpsampleAdd(_) | Op::Gate(_), _) => read,
                (_, Some(residual)) if residual.after => !operation.relu || signed[residual.tensor.0],
                _ => !operation.relu,
            };
            signed[operation.output().0] |= may;
        }
        signed
    }

    /// What computes `operation` in integers. `signed` says which tensors may hold negative numbers.
    fn in_integers(
        &self,
        operation: &Operation,
        signed: &[bool],
        scale: &mut dyn FnMut(&str) -> Result<Scale>,
    ) -> Result<Op> {
        let signed = operation.inputs.first().is_some_and(|x| signed[x.0]);
        Ok(match operation.op.clone() {
            Op::Normalise(_) => NormaliseI8.into(),
            Op::Conv(conv) => ConvI8 { geometry: conv.geometry, signed }.into(),
            Op::DeformConv(conv) => DeformConvI8 { geometry: conv.geometry, signed }.into(),
            Op::Depthwise(depthwise) => DepthwiseI8 { side: depthwise.side }.into(),
            Op::MaxPool(pool) => MaxPoolI8 { side: pool.side, stride: pool.stride, padding: pool.padding }.into(),
            Op::UpsampleAdd(_) => UpsampleAddI8.into(),
            Op::Gather(gather) => {
                GatherI8 { level: gather.level, matrix: gather.matrix, first_channel: gather.first_channel }.into()
            }
            Op::Deconv(_) => DeconvI8 { signed }.into(),
            Op::Gate(_) => GateI8.into(),
            Op::GlobalMean(_) => GlobalMeanI8.into(),
            Op::Broadcast(_) => BroadcastI8.into(),
            Op::Head(head) => {
                let [first, second] = hidden_layers(&operation.name);
                let hidden = [scale(&first)?, scale(&second)?];
                HeadI8 { classes: head.classes, signed, hidden, confidence: head.confidence }.into()
            }
            other => unreachable!("{other:?} stays in floating point"),
        })
    }

    /// Puts a conversion after the last writer of each tensor that is read in the other form, and lets those readers read
    /// its result.
    fn convert(
        &mut self,
        kept: &[bool],
        scaled: &[TensorId],
        scale: &mut dyn FnMut(&str) -> Result<Scale>,
    ) -> Result<()> {
        let writers = self.writers();
        let mut after: BTreeMap<usize, Vec<Operation>> = BTreeMap::new();
        for id in self.ids() {
            let Some(&writer) = writers[id.0].last() else { continue };
            let integer = match self.tensor(id).element {
                Element::I8 => true,
                Element::F32 => false,
                Element::F16 | Element::U8 | Element::I32 => continue,
            };
            let reads = |index: usize| self.operations[index].reads().any(|read| read == id);
            let (others, same): (Vec<usize>, Vec<usize>) =
                (0..kept.len()).filter(|&index| reads(index)).partition(|&index| kept[index] == integer);
            if others.is_empty() {
                continue;
            }
            let source = self.tensor(id).clone();
            let (op, suffix): (Op, _) = if integer { (Dequantise.into(), "f32") } else { (Quantise.into(), "i8") };
            let (element, step) = match integer {
                true => (Element::F32, None),
                false => (Element::I8, Some(scale(&self.tensor(scaled[id.0]).name)?)),
            };
            let name = format!("{}.{suffix}", source.name);
            let (channels, lifetime) = (source.channels, source.lifetime);
            if same.is_empty() && lifetime == Lifetime::Camera {
                // Only the converted features are kept from frame to frame.
                self.tensors[id.0].lifetime = Lifetime::Pass;
            }
            self.tensors.push(Tensor { name: name.clone(), element, scale: step, ..source });
            let converted = TensorId(self.tensors.len() - 1);
            for index in others {
                let operation = &mut self.operations[index];
                operation.inputs.iter_mut().filter(|read| **read == id).for_each(|read| *read = converted);
                operation.residual.iter_mut().filter(|r| r.tensor == id).for_each(|r| r.tensor = converted);
            }
            after.entry(writer).or_default().push(Operation {
                name,
                op,
                inputs: vec![id],
                outputs: vec![converted],
                first_channel: 0,
                channels,
                relu: false,
                residual: None,
                recipe: Recipe::None,
                stage: None,
            });
        }
        let mut operations = Vec::with_capacity(self.operations.len());
        let mut camera_operations = self.camera_operations;
        for (index, operation) in std::mem::take(&mut self.operations).into_iter().enumerate() {
            operations.push(operation);
            for conversion in after.remove(&index).unwrap_or_default() {
                camera_operations += usize::from(index < self.camera_operations);
                operations.push(conversion);
            }
        }
        (self.operations, self.camera_operations) = (operations, camera_operations);
        Ok(())
    }
}

#[cfg(test)]
mod tests;

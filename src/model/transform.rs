//! A model to the same model with Winograd's minimal filtering, for those whose checkpoint is not at hand.

use super::form::Form;
use super::{LAYOUT, Model, Options, parts, stored, tensor};
use crate::base::error::{Error, ErrorKind, Result};
use crate::file::container::{self, Data, Tensor};
use crate::graph::ops::{Op, Winograd, WinogradDeconv, transformed};
use crate::graph::parts::Part;
use crate::graph::{Elements, Operation, Rewrites};
use crate::model::import::encode;
use std::cell::RefCell;
use std::path::Path;
use std::rc::Rc;
use voxcast_kernels::Panels;
use voxcast_kernels::panels::{packed_index, packed_len};

/// Writes `model` to `path` with convolutions computed by Winograd's minimal filtering where their shapes make it worth
/// while, by way of a temporary file beside `path`. Weights are transformed in f64, from the numbers that the model has; all
/// others stay as they are. A self-test is left out, for the bits are others. `progress` is told how many of how many operations
/// are done.
///
/// # Errors
/// [`ErrorKind::Unsupported`] for a model that has Winograd's weights already, and for one of int8; failed writes.
pub fn use_winograd(model: &Model, path: &Path, progress: &mut dyn FnMut(usize, usize)) -> Result<()> {
    let Options { precision, rewrites } = model.options();
    if rewrites.winograd {
        return Err(Error::new(ErrorKind::Unsupported, "the model uses Winograd's minimal filtering already"));
    }
    let options = Options { precision, rewrites: Rewrites { winograd: true, ..rewrites } };
    let form = Form { temperature: model.temperature(), ..Form::floating(model.network(), options)? };
    let graphs = form.graphs()?;
    let operations = stored(&graphs).into_iter().map(|(g, o)| (&graphs[g], &graphs[g].operations[o]));
    let operations: Vec<_> = operations.map(|(graph, operation)| (operation, parts(graph, operation))).collect();
    let total = operations.len();
    let progress = Rc::new(RefCell::new(progress));
    let mut tensors: Vec<Tensor<'_>> = vec![];
    for (index, (operation, parts)) in operations.iter().enumerate() {
        let last = parts.len() - 1;
        for (i, part) in parts.iter().enumerate() {
            let progress = progress.clone();
            let make = move || {
                if i == last {
                    (progress.borrow_mut())(index + 1, total);
                }
                made(model, operation, part, i)
            };
            let name = format!("{}.{}", operation.name, part.suffix);
            tensors.push(tensor(name, part, precision, Data::Make(Box::new(make))));
        }
    }
    container::write(path, tensors, &form.metadata(), LAYOUT)
}

/// The bytes of part `i` of an operation: the model's own, or its direct weights transformed.
fn made(model: &Model, operation: &Operation, part: &Part, i: usize) -> Result<Vec<u8>> {
    let precision = model.options().precision;
    let name = |suffix: &str| format!("{}.{suffix}", operation.name);
    let bytes = |name: &str| model.container.tensor(name).expect("checked when the model was opened").2;
    match &operation.op {
        Op::Winograd(Winograd { shape, .. }) | Op::WinogradDeconv(WinogradDeconv { shape }) if i == 0 => {
            let depth = shape.direct_depth();
            let part_len = packed_len(depth, shape.columns);
            let weights = Elements::new(precision.element(), bytes(&name("weight"))).panels();
            let weight = |part, k, n| {
                let at = part * part_len + packed_index(depth, k, n);
                match weights {
                    Panels::F32(weights) => f64::from(weights[at]),
                    Panels::F16(weights) => f64::from(weights[at]),
                }
            };
            encode(&name(part.suffix), part, &transformed(shape, weight), precision)
        }
        _ => Ok(bytes(&name(part.suffix)).to_vec()),
    }
}

//! What a checkpoint's pickle may build: storages and tensors, where Python's machine would call something.

use super::globals::{self, Callable};
use super::tensor::Element;
use crate::base::error::{ErrorKind, Result};
use crate::file::pickle::{Id, Machine, Text, Value, Vocabulary};

/// The vocabulary of checkpoints.
#[derive(Debug)]
pub(super) struct Torch;

/// What it builds.
#[derive(Debug)]
pub(super) enum Object {
    Storage(StorageRef),
    Tensor(TensorRef),
}

/// A storage that the pickle refers to.
#[derive(Clone, Copy, Debug)]
pub(super) struct StorageRef {
    pub(super) element: Element,
    /// Name of its entry under `data/`.
    pub(super) key: Text,
    /// Length in elements.
    pub(super) numel: u64,
}

/// A tensor as the pickle describes it. Only the types of the parts have been looked at.
#[derive(Clone, Copy, Debug)]
pub(super) struct TensorRef {
    /// An [`Object::Storage`].
    pub(super) storage: Id,
    /// That of the storage, unless that is untyped.
    pub(super) element: Element,
    pub(super) offset: i64,
    pub(super) size: Id,
    pub(super) stride: Id,
}

impl Vocabulary for Torch {
    type Object = Object;
    type Callable = Callable;

    const ALLOWED: &'static str = "a checkpoint may only build tensors and plain containers";

    fn kind(object: &Object) -> &'static str {
        match object {
            Object::Storage(_) => "a storage",
            Object::Tensor(_) => "a tensor",
        }
    }

    fn callable(module: &str, name: &str) -> Option<Callable> {
        globals::callable(module, name)
    }

    fn call(machine: &mut Machine<'_, Self>, callable: Callable, name: &str, args: &[Id]) -> Result<Id> {
        let wrong = |machine: &Machine<'_, Self>| machine.wrong_arguments(name);
        let value = match callable {
            Callable::Inert => Value::Inert("an object"),
            Callable::OrderedDict => machine.ordered_dict(args)?.ok_or_else(|| wrong(machine))?,
            Callable::Size => match args[..] {
                [size] if machine.sequence(size).is_some() => return Ok(size),
                _ => return Err(wrong(machine)),
            },
            Callable::Parameter => match args[..] {
                [data, ..] if matches!(machine.get(data), Value::Object(Object::Tensor(_))) => return Ok(data),
                _ => return Err(wrong(machine)),
            },
            Callable::Tensor | Callable::TensorV3 => {
                refuse_marks(machine, callable, args)?;
                tensor(machine, callable, args).ok_or_else(|| wrong(machine))?
            }
            Callable::FromType => {
                let [function, class, args, ..] = args[..] else { return Err(wrong(machine)) };
                let (callable, function) = machine.callable(function)?;
                if !matches!(callable, Callable::Tensor | Callable::TensorV3) {
                    return Err(machine.refusal(&function));
                }
                let &Value::Global { module, name: class } = machine.get(class) else { return Err(wrong(machine)) };
                if !machine.name_of(module, class).is_some_and(|(m, n)| globals::is_plain_tensor(m, n)) {
                    let class = machine.quote(module, class);
                    let what = format!(
                        "a tensor of class {class}, expected a plain one: its elements may mean something else"
                    );
                    return Err(machine.error_of(ErrorKind::Unsupported, what));
                }
                let Value::Tuple(args) = machine.get(args) else { return Err(wrong(machine)) };
                refuse_marks(machine, callable, args)?;
                tensor(machine, callable, args).ok_or_else(|| wrong(machine))?
            }
            Callable::GetAttr => {
                let [object, attribute] = args[..] else { return Err(machine.refusal(name)) };
                let (&Value::Global { module, name: class }, Value::Str(_)) =
                    (machine.get(object), machine.get(attribute))
                else {
                    return Err(machine.refusal(name));
                };
                if !machine.name_of(module, class).is_some_and(|(m, n)| globals::is_history_buffer(m, n)) {
                    return Err(machine.refusal(name));
                }
                Value::Inert("a function")
            }
        };
        machine.make(value)
    }

    /// `('storage', class, key, location, numel)`, and in files without a zip None behind it, or what the storage is a part
    /// of.
    fn persistent(machine: &Machine<'_, Self>, id: Id) -> Result<Object> {
        let wrong = "a persistent id, expected ('storage', class, key, location, length)";
        let Value::Tuple(parts) = machine.get(id) else { return Err(machine.error(wrong)) };
        let &[tag, class, key, location, numel, ref view @ ..] = &**parts else { return Err(machine.error(wrong)) };
        match view {
            [] => {}
            &[view] if matches!(machine.get(view), Value::None) => {}
            _ => return Err(machine.error_of(ErrorKind::Unsupported, "a storage that is a part of another")),
        }
        let (&Value::Str(tag), &Value::Global { module, name }, &Value::Str(key), Value::Str(_), &Value::Int(numel)) =
            (machine.get(tag), machine.get(class), machine.get(key), machine.get(location), machine.get(numel))
        else {
            return Err(machine.error(wrong));
        };
        if machine.text(tag) != b"storage" || numel < 0 {
            return Err(machine.error(wrong));
        }
        let element = machine.name_of(module, name).and_then(|(m, n)| globals::storage(m, n)).ok_or_else(|| {
            machine.error_of(ErrorKind::Unsupported, format!("a storage of class {}", machine.quote(module, name)))
        })?;
        Ok(Object::Storage(StorageRef { element, key, numel: numel as u64 }))
    }

    /// An attribute of a tensor is of no interest.
    fn set_state(machine: &mut Machine<'_, Self>, object: Id, _state: Id) -> Result<()> {
        match machine.get(object) {
            Value::Object(Object::Tensor(_)) => Ok(()),
            other => Err(machine.error(format!("sets the state of {}", other.kind()))),
        }
    }
}

/// Refuses a tensor that is marked as the negative or the conjugate of what is stored.
fn refuse_marks(machine: &Machine<'_, Torch>, callable: Callable, args: &[Id]) -> Result<()> {
    let metadata = args.get(if callable == Callable::TensorV3 { 7 } else { 6 });
    match metadata.map(|&id| machine.get(id)) {
        None | Some(Value::None) => Ok(()),
        Some(Value::Dict(marks)) if marks.is_empty() => Ok(()),
        Some(_) => {
            let what = "a tensor whose elements are marked to be negated or conjugated, expected them as they are; save a clone()";
            Err(machine.error_of(ErrorKind::Unsupported, what))
        }
    }
}

/// `(storage, offset, size, stride, requires_grad, hooks, element type)`, as many of them as `callable` needs.
fn tensor(machine: &Machine<'_, Torch>, callable: Callable, args: &[Id]) -> Option<Value<Torch>> {
    let &[storage, offset, size, stride, ..] = args else { return None };
    let (Value::Object(Object::Storage(typed)), &Value::Int(offset)) = (machine.get(storage), machine.get(offset))
    else {
        return None;
    };
    machine.sequence(size)?;
    machine.sequence(stride)?;
    let element = match callable {
        Callable::Tensor => typed.element,
        Callable::TensorV3 => {
            let &Value::Global { module, name } = machine.get(*args.get(6)?) else { return None };
            let (module, name) = machine.name_of(module, name)?;
            globals::dtype(module, name)?
        }
        _ => return None,
    };
    Some(Value::Object(Object::Tensor(TensorRef { storage, element, offset, size, stride })))
}

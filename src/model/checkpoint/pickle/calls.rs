//! What the machine does where Python's would call something.

use super::{Id, Machine, TensorRef, Text, Value, sequence, slice};
use crate::base::error::{Error, ErrorKind, Result};
use crate::model::checkpoint::globals::{self, Callable};

impl<'a> Machine<'a> {
    /// Module and name, where they are text.
    pub(super) fn name_of(&self, module: Text, name: Text) -> Option<(&'a str, &'a str)> {
        let text = |t| std::str::from_utf8(slice(self.bytes, t)).ok();
        Some((text(module)?, text(name)?))
    }

    /// `"module.name"`, shortened where it is longer than any real one.
    pub(super) fn quote(&self, module: Text, name: Text) -> String {
        let short = |t: Text| {
            let bytes = slice(self.bytes, t);
            String::from_utf8_lossy(&bytes[..bytes.len().min(100)]).into_owned()
        };
        format!("{:?}", format!("{}.{}", short(module), short(name)))
    }

    /// Pushes what stands for `callee(*args)`, or refuses it by name.
    pub(super) fn push_call(&mut self, callee: Id, args: Id) -> Result<()> {
        let id = self.call(callee, args)?;
        self.stack.push(id);
        Ok(())
    }

    fn call(&mut self, callee: Id, args: Id) -> Result<Id> {
        let (callable, name) = self.callable(callee)?;
        let parts = match self.get(args) {
            Value::Tuple(parts) => parts,
            other => return Err(self.error(format!("calls {name} with {}, expected a tuple", other.kind()))),
        };
        // No construction looks at more; the arguments of inert objects may be many and are not copied.
        let parts = parts[..parts.len().min(8)].to_vec();
        let wrong = |this: &Self| this.error(format!("calls {name} with arguments that it does not take"));
        let value = match callable {
            Callable::Inert => Value::Inert("an object"),
            Callable::OrderedDict => self.ordered_dict(&parts)?.ok_or_else(|| wrong(self))?,
            Callable::Size => match parts[..] {
                [size] if sequence(&self.values, size).is_some() => return Ok(size),
                _ => return Err(wrong(self)),
            },
            Callable::Parameter => match parts[..] {
                [data, ..] if matches!(self.get(data), Value::Tensor(_)) => return Ok(data),
                _ => return Err(wrong(self)),
            },
            Callable::Tensor | Callable::TensorV3 => {
                self.refuse_marks(callable, &parts)?;
                self.tensor(callable, &parts).ok_or_else(|| wrong(self))?
            }
            Callable::FromType => {
                let [function, class, args, ..] = parts[..] else { return Err(wrong(self)) };
                let (callable, function) = self.callable(function)?;
                if !matches!(callable, Callable::Tensor | Callable::TensorV3) {
                    return Err(self.refusal(&function));
                }
                let &Value::Global { module, name: class } = self.get(class) else { return Err(wrong(self)) };
                if !self.name_of(module, class).is_some_and(|(m, n)| globals::is_plain_tensor(m, n)) {
                    let class = self.quote(module, class);
                    let what = format!(
                        "a tensor of class {class}, expected a plain one: its elements may mean something else"
                    );
                    return Err(self.error_of(ErrorKind::Unsupported, what));
                }
                let Value::Tuple(parts) = self.get(args) else { return Err(wrong(self)) };
                let parts = parts[..parts.len().min(8)].to_vec();
                self.refuse_marks(callable, &parts)?;
                self.tensor(callable, &parts).ok_or_else(|| wrong(self))?
            }
            Callable::GetAttr => {
                let [object, attribute] = parts[..] else { return Err(self.refusal(&name)) };
                let (&Value::Global { module, name: class }, Value::Str(_)) = (self.get(object), self.get(attribute))
                else {
                    return Err(self.refusal(&name));
                };
                if !self.name_of(module, class).is_some_and(|(m, n)| globals::is_history_buffer(m, n)) {
                    return Err(self.refusal(&name));
                }
                Value::Inert("a function")
            }
        };
        self.make(value)
    }

    fn refusal(&self, name: &str) -> Error {
        self.error(format!("calls {name}; a checkpoint may only build tensors and plain containers"))
    }

    /// What calling `callee` stands for, and its quoted name.
    fn callable(&self, callee: Id) -> Result<(Callable, String)> {
        let &Value::Global { module, name } = self.get(callee) else {
            return Err(self.refusal(self.get(callee).kind()));
        };
        let quoted = self.quote(module, name);
        match self.name_of(module, name).and_then(|(m, n)| globals::callable(m, n)) {
            Some(callable) => Ok((callable, quoted)),
            None => Err(self.refusal(&quoted)),
        }
    }

    /// `OrderedDict()` or `OrderedDict([(key, value), ...])`; `None` for other arguments.
    fn ordered_dict(&mut self, args: &[Id]) -> Result<Option<Value>> {
        let pairs = match args {
            [] => return Ok(Some(Value::Dict(Vec::new()))),
            &[pairs] => pairs,
            _ => return Ok(None),
        };
        let Some(pairs) = sequence(&self.values, pairs) else { return Ok(None) };
        // One list can be copied again and again by few instructions; no pickler does so.
        let copied = self.copied + pairs.len();
        if copied > self.bytes.len() {
            return Err(self.error_of(ErrorKind::TooLarge, "copies more pairs than it has bytes"));
        }
        let mut dict = Vec::with_capacity(pairs.len());
        for &pair in pairs {
            let Some(&[key, value]) = sequence(&self.values, pair) else { return Ok(None) };
            dict.push((key, value));
        }
        self.copied = copied;
        Ok(Some(Value::Dict(dict)))
    }

    /// Refuses a tensor that is marked as the negative or the conjugate of what is stored.
    fn refuse_marks(&self, callable: Callable, args: &[Id]) -> Result<()> {
        let metadata = args.get(if callable == Callable::TensorV3 { 7 } else { 6 });
        match metadata.map(|&id| self.get(id)) {
            None | Some(Value::None) => Ok(()),
            Some(Value::Dict(marks)) if marks.is_empty() => Ok(()),
            Some(_) => {
                let what = "a tensor whose elements are marked to be negated or conjugated, expected them as they are; save a clone()";
                Err(self.error_of(ErrorKind::Unsupported, what))
            }
        }
    }

    /// `(storage, offset, size, stride, requires_grad, hooks, element type)`, as many of them as `callable` needs.
    fn tensor(&self, callable: Callable, args: &[Id]) -> Option<Value> {
        let &[storage, offset, size, stride, ..] = args else { return None };
        let (Value::Storage(typed), &Value::Int(offset)) = (self.get(storage), self.get(offset)) else { return None };
        sequence(&self.values, size)?;
        sequence(&self.values, stride)?;
        let element = match callable {
            Callable::Tensor => typed.element,
            Callable::TensorV3 => {
                let &Value::Global { module, name } = self.get(*args.get(6)?) else { return None };
                let (module, name) = self.name_of(module, name)?;
                globals::dtype(module, name)?
            }
            _ => return None,
        };
        Some(Value::Tensor(TensorRef { storage, element, offset, size, stride }))
    }
}

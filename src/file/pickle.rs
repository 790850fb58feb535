//! A pickle machine (protocols 2 to 5) that builds plain values and what its [`Vocabulary`] knows, and can do nothing else.
//!
//! Where Python's machine would import and call, this one asks the vocabulary, a closed list of constructions that are
//! performed here or skipped; any other name is refused. A name that is only *mentioned* is kept as a name, for nothing here
//! can resolve it.
//!
//! Values lie in one vector and refer to each other by index, so that neither deep nor cyclic data costs any stack, here
//! or when they are dropped. An instruction makes a few values at most, each stack slot is moved into at most one
//! container, and strings stay in the input: memory is a small multiple of the input's length, whatever lengths it
//! declares.

#[cfg(feature = "eval")]
pub(crate) mod numpy;

use crate::base::error::{Error, ErrorKind, Result};
use std::fmt::Debug;

/// Most values that are built. A tensor takes about twenty, so this is room for some 400,000 of them.
const MAX_VALUES: usize = 1 << 23;

/// Longest input; positions are 32 bits.
const MAX_BYTES: usize = 1 << 30;

/// A value, as an index into those of its [`Pickle`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct Id(u32);

/// Some bytes of the input.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Text {
    start: u32,
    len: u32,
}

/// What a pickle may call, and what that builds.
pub(crate) trait Vocabulary: Sized + Debug {
    /// What calls and persistent ids build, beside plain values.
    type Object: Debug;

    /// What can be called.
    type Callable;

    /// What may be built, for the message that something else is refused.
    const ALLOWED: &'static str;

    /// The word for an object in messages.
    fn kind(object: &Self::Object) -> &'static str;

    /// What `module.name` stands for where it is called; `None` for everything that is refused.
    fn callable(module: &str, name: &str) -> Option<Self::Callable>;

    /// The value that stands for `callable(*args)`, which messages call `name`. Of many arguments only the first
    /// [`MAX_ARGUMENTS`] are given.
    fn call(machine: &mut Machine<'_, Self>, callable: Self::Callable, name: &str, args: &[Id]) -> Result<Id>;

    /// The object of a persistent id, which no call builds.
    fn persistent(machine: &Machine<'_, Self>, id: Id) -> Result<Self::Object> {
        let _ = id;
        Err(machine.error("a persistent id, which only its writer can resolve"))
    }

    /// Sets the state of an object that it built.
    fn set_state(machine: &mut Machine<'_, Self>, object: Id, state: Id) -> Result<()>;
}

/// Most arguments that a vocabulary sees: no construction looks at more.
pub(crate) const MAX_ARGUMENTS: usize = 8;

/// What a pickle can build.
#[derive(Debug)]
pub(crate) enum Value<V: Vocabulary> {
    None,
    Bool(bool),
    Int(i64),
    #[cfg_attr(not(feature = "eval"), expect(dead_code, reason = "checkpoints have no use for floats"))]
    Float(f64),
    Str(Text),
    #[cfg_attr(not(feature = "eval"), expect(dead_code, reason = "nor for bytes"))]
    Bytes(Text),
    Tuple(Box<[Id]>),
    List(Vec<Id>),
    /// In order of insertion; a key may come again, and hashing is left to those who look.
    Dict(Vec<(Id, Id)>),
    Global {
        module: Text,
        name: Text,
    },
    Object(V::Object),
    /// Something that is never looked into, with the word for it.
    Inert(&'static str),
}

impl<V: Vocabulary> Value<V> {
    /// The word for it in messages.
    pub(crate) fn kind(&self) -> &'static str {
        match self {
            Value::None => "None",
            Value::Bool(_) => "a bool",
            Value::Int(_) => "an int",
            Value::Float(_) => "a float",
            Value::Str(_) => "a string",
            Value::Bytes(_) => "bytes",
            Value::Tuple(_) => "a tuple",
            Value::List(_) => "a list",
            Value::Dict(_) => "a dict",
            Value::Global { .. } => "a class or function",
            Value::Object(object) => V::kind(object),
            Value::Inert(what) => what,
        }
    }
}

/// What a pickle built.
pub(crate) struct Pickle<'a, V: Vocabulary> {
    bytes: &'a [u8],
    values: Vec<Value<V>>,
    root: Id,
}

impl<'a, V: Vocabulary> Pickle<'a, V> {
    /// Runs the pickle that fills `bytes`, which messages call `what`.
    pub(crate) fn parse(bytes: &'a [u8], what: &'static str) -> Result<Self> {
        if bytes.len() > MAX_BYTES {
            let message = format!("{what} has {} bytes, expected at most {MAX_BYTES}", bytes.len());
            return Err(Error::new(ErrorKind::TooLarge, message));
        }
        let (pickle, used) = Self::parse_first(bytes, what)?;
        if used != bytes.len() {
            let rest = bytes.len() - used;
            return Err(Error::format(format!("{what}, byte {used}: stops {rest} bytes before the end of the entry")));
        }
        Ok(pickle)
    }

    /// Runs the pickle that `bytes` begin with, and says how many of them it takes.
    pub(crate) fn parse_first(bytes: &'a [u8], what: &'static str) -> Result<(Self, usize)> {
        let mut machine = Machine::new(&bytes[..bytes.len().min(MAX_BYTES)], what);
        while machine.step()? {}
        let root = machine.pop()?;
        if !machine.stack.is_empty() || !machine.marks.is_empty() {
            return Err(machine.error("stops with more than one value on its stack"));
        }
        let used = machine.at;
        Ok((Self { bytes, values: machine.values, root }, used))
    }

    /// Every object that was built, as often as it was.
    #[cfg(feature = "import")]
    pub(crate) fn objects(&self) -> impl Iterator<Item = &V::Object> {
        self.values.iter().filter_map(|value| match value {
            Value::Object(object) => Some(object),
            _ => None,
        })
    }

    /// Where the value is that the pickle is of.
    #[cfg(feature = "eval")]
    pub(crate) fn root_id(&self) -> Id {
        self.root
    }

    /// The value that the pickle is of.
    pub(crate) fn root(&self) -> &Value<V> {
        self.get(self.root)
    }

    pub(crate) fn get(&self, id: Id) -> &Value<V> {
        &self.values[id.0 as usize]
    }

    /// The bytes of a string.
    pub(crate) fn text(&self, text: Text) -> &'a [u8] {
        slice(self.bytes, text)
    }

    /// The elements of a tuple or list.
    pub(crate) fn sequence(&self, id: Id) -> Option<&[Id]> {
        sequence(&self.values, id)
    }

    /// What a dict has under `name`: as in Python, the last of equal keys counts.
    pub(crate) fn under(&self, dict: &[(Id, Id)], name: &str) -> Option<Id> {
        let is_it = |id| matches!(self.get(id), Value::Str(text) if self.text(*text) == name.as_bytes());
        dict.iter().rev().find(|(key, _)| is_it(*key)).map(|&(_, value)| value)
    }
}

fn slice(bytes: &[u8], text: Text) -> &[u8] {
    &bytes[text.start as usize..][..text.len as usize]
}

fn sequence<V: Vocabulary>(values: &[Value<V>], id: Id) -> Option<&[Id]> {
    match &values[id.0 as usize] {
        Value::Tuple(ids) => Some(ids),
        Value::List(ids) => Some(ids),
        _ => None,
    }
}

/// Immutable values that every machine starts with, so that naming them costs nothing.
const NONE: Id = Id(0);
const EMPTY: Id = Id(1);
const FALSE: Id = Id(2);
const TRUE: Id = Id(3);

pub(crate) struct Machine<'a, V: Vocabulary> {
    bytes: &'a [u8],
    /// What messages call the pickle.
    what: &'static str,
    /// Position of the next byte to read.
    at: usize,
    /// Position of the instruction that runs.
    op_at: usize,
    values: Vec<Value<V>>,
    stack: Vec<Id>,
    /// Heights of the stack where marks lie.
    marks: Vec<usize>,
    memo: Vec<Id>,
    /// Pairs that `OrderedDict(list)` copied.
    copied: usize,
}

impl<'a, V: Vocabulary> Machine<'a, V> {
    fn new(bytes: &'a [u8], what: &'static str) -> Self {
        // Together with its place on the stack this is what one byte of input can cost, up to `MAX_VALUES` times.
        const { assert!(size_of::<Value<V>>() <= 32) };
        let values = vec![Value::None, Value::Tuple(Box::default()), Value::Bool(false), Value::Bool(true)];
        let (stack, marks, memo) = (Vec::new(), Vec::new(), Vec::new());
        Self { bytes, what, at: 0, op_at: 0, values, stack, marks, memo, copied: 0 }
    }

    pub(crate) fn error(&self, what: impl std::fmt::Display) -> Error {
        self.error_of(ErrorKind::Format, what)
    }

    pub(crate) fn error_of(&self, kind: ErrorKind, what: impl std::fmt::Display) -> Error {
        Error::new(kind, format!("{}, byte {}: {what}", self.what, self.op_at))
    }

    pub(crate) fn get(&self, id: Id) -> &Value<V> {
        &self.values[id.0 as usize]
    }

    // Input.

    fn take(&mut self, len: u64) -> Result<Text> {
        let rest = self.bytes.len() - self.at;
        if len > rest as u64 {
            return Err(self.error(format!("declares {len} bytes, {rest} are left")));
        }
        let text = Text { start: self.at as u32, len: len as u32 };
        self.at += len as usize;
        Ok(text)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N]> {
        match self.bytes[self.at..].first_chunk() {
            Some(array) => {
                self.at += N;
                Ok(*array)
            }
            None => Err(self.error("ends in the middle of an instruction")),
        }
    }

    fn u8(&mut self) -> Result<u64> {
        self.array().map(|[b]| u64::from(b))
    }

    fn u32(&mut self) -> Result<u64> {
        self.array().map(|b| u64::from(u32::from_le_bytes(b)))
    }

    fn u64(&mut self) -> Result<u64> {
        self.array().map(u64::from_le_bytes)
    }

    fn line(&mut self) -> Result<Text> {
        let Some(len) = self.bytes[self.at..].iter().position(|&b| b == b'\n') else {
            return Err(self.error("a name without an end"));
        };
        let text = self.take(len as u64)?;
        self.at += 1;
        Ok(text)
    }

    // Stack.

    fn push(&mut self, value: Value<V>) -> Result<()> {
        let id = self.make(value)?;
        self.stack.push(id);
        Ok(())
    }

    pub(crate) fn make(&mut self, value: Value<V>) -> Result<Id> {
        if self.values.len() >= MAX_VALUES {
            return Err(self.error_of(ErrorKind::TooLarge, format!("builds more than {MAX_VALUES} values")));
        }
        self.values.push(value);
        Ok(Id(self.values.len() as u32 - 1))
    }

    /// Puts a value in the place of another.
    #[cfg(feature = "eval")]
    pub(crate) fn set(&mut self, id: Id, value: Value<V>) {
        self.values[id.0 as usize] = value;
    }

    /// Whether there is something above the topmost mark.
    fn has_top(&self) -> bool {
        self.stack.len() > self.marks.last().copied().unwrap_or(0)
    }

    fn pop(&mut self) -> Result<Id> {
        if !self.has_top() {
            return Err(self.error("takes a value from an empty stack"));
        }
        self.stack.pop().ok_or_else(|| self.error("takes a value from an empty stack"))
    }

    fn top(&self) -> Result<Id> {
        let top = self.stack.last().filter(|_| self.has_top());
        top.copied().ok_or_else(|| self.error("looks at an empty stack"))
    }

    fn pop_to_mark(&mut self) -> Result<Vec<Id>> {
        let mark = self.marks.pop().ok_or_else(|| self.error("no mark on the stack"))?;
        Ok(self.stack.split_off(mark))
    }

    fn pop_tuple(&mut self, len: usize) -> Result<Id> {
        let mut ids = [NONE; 3];
        for id in ids[..len].iter_mut().rev() {
            *id = self.pop()?;
        }
        self.make(Value::Tuple(ids[..len].into()))
    }

    // Instructions, by what they are about.

    /// Runs one instruction; false after the last.
    fn step(&mut self) -> Result<bool> {
        self.op_at = self.at;
        let [op] = self.array()?;
        match op {
            b'.' => return Ok(false),
            0x80 => {
                let version = self.u8()?;
                if !(2..=5).contains(&version) {
                    return Err(self.error_of(ErrorKind::Unsupported, format!("protocol {version}, expected 2 to 5")));
                }
            }
            0x95 => {
                // A frame only says how far to read ahead.
                let len = self.u64()?;
                let rest = self.bytes.len() - self.at;
                if len > rest as u64 {
                    return Err(self.error(format!("a frame of {len} bytes, {rest} are left")));
                }
            }
            b'(' => self.marks.push(self.stack.len()),
            b'0' if !self.has_top() && self.marks.pop().is_some() => {}
            b'0' => drop(self.pop()?),
            b'1' => drop(self.pop_to_mark()?),
            b'2' => self.stack.push(self.top()?),
            b'q' | b'r' | 0x94 | b'h' | b'j' => self.memo_op(op)?,
            b'N' => self.stack.push(NONE),
            0x88 => self.stack.push(TRUE),
            0x89 => self.stack.push(FALSE),
            b')' => self.stack.push(EMPTY),
            0x85..=0x87 => {
                let id = self.pop_tuple(usize::from(op - 0x84))?;
                self.stack.push(id);
            }
            b'K' | b'M' | b'J' | 0x8a | 0x8b | b'G' => self.scalar(op)?,
            b'X' | 0x8c | 0x8d | b'U' | b'T' | b'C' | b'B' | 0x8e | 0x96 => self.string(op)?,
            b't' | b']' | b'l' | b'}' | b'd' | 0x8f | 0x91 => self.container(op)?,
            b'a' | b'e' | b's' | b'u' | 0x90 => self.fill(op)?,
            b'Q' => self.persistent()?,
            b'c' | 0x93 | b'i' | b'o' | 0x81 | 0x92 | b'R' | b'b' | 0x82..=0x84 => self.object(op)?,
            _ => return Err(self.error(format!("instruction {op:#04x}, expected one of protocols 2 to 5"))),
        }
        Ok(true)
    }

    fn memo_op(&mut self, op: u8) -> Result<()> {
        let index = match op {
            0x94 => self.memo.len() as u64,
            b'q' | b'h' => self.u8()?,
            _ => self.u32()?,
        } as usize;
        if matches!(op, b'h' | b'j') {
            let id = self.memo.get(index).copied();
            self.stack.push(id.ok_or_else(|| self.error(format!("reads memo {index}, which was not written")))?);
            return Ok(());
        }
        // Every pickler numbers from 0 upwards without gaps.
        let top = self.top()?;
        if index > self.memo.len() {
            return Err(self.error(format!("writes memo {index}, the next one is {}", self.memo.len())));
        }
        match self.memo.get_mut(index) {
            Some(old) => *old = top,
            None => self.memo.push(top),
        }
        Ok(())
    }

    fn scalar(&mut self, op: u8) -> Result<()> {
        let value = match op {
            b'K' => Value::Int(self.u8()? as i64),
            b'M' => Value::Int(i64::from(u16::from_le_bytes(self.array()?))),
            b'J' => Value::Int(i64::from(i32::from_le_bytes(self.array()?))),
            b'G' => Value::Float(f64::from_be_bytes(self.array()?)),
            _ => {
                let len = if op == 0x8a { self.u8()? } else { self.u32()? };
                let text = self.take(len)?;
                long(slice(self.bytes, text)).map_or(Value::Inert("a long int"), Value::Int)
            }
        };
        self.push(value)
    }

    fn string(&mut self, op: u8) -> Result<()> {
        let len = match op {
            0x8c | b'U' | b'C' => self.u8()?,
            b'X' | b'T' | b'B' => self.u32()?,
            _ => self.u64()?,
        };
        let text = self.take(len)?;
        self.push(match op {
            b'C' | b'B' | 0x8e | 0x96 => Value::Bytes(text),
            _ => Value::Str(text),
        })
    }

    fn container(&mut self, op: u8) -> Result<()> {
        let value = match op {
            b't' => Value::Tuple(self.pop_to_mark()?.into()),
            b']' => Value::List(Vec::new()),
            b'l' => Value::List(self.pop_to_mark()?),
            b'}' => Value::Dict(Vec::new()),
            b'd' => {
                let items = self.pop_to_mark()?;
                Value::Dict(self.pairs(&items)?)
            }
            0x8f => Value::Inert("a set"),
            _ => {
                self.pop_to_mark()?;
                Value::Inert("a set")
            }
        };
        self.push(value)
    }

    fn pairs(&self, items: &[Id]) -> Result<Vec<(Id, Id)>> {
        let (pairs, odd) = items.as_chunks::<2>();
        if !odd.is_empty() {
            return Err(self.error("a key without its value"));
        }
        Ok(pairs.iter().map(|&[key, value]| (key, value)).collect())
    }

    /// Puts values into a container.
    fn fill(&mut self, op: u8) -> Result<()> {
        let items = match op {
            b'a' => vec![self.pop()?],
            b's' => {
                let value = self.pop()?;
                vec![self.pop()?, value]
            }
            _ => self.pop_to_mark()?,
        };
        let target = self.top()?.0 as usize;
        let pairs = if matches!(op, b's' | b'u') { self.pairs(&items)? } else { Vec::new() };
        match (&mut self.values[target], op) {
            (Value::List(list), b'a' | b'e') => list.extend(items),
            (Value::Dict(dict), b's' | b'u') => dict.extend(pairs),
            (Value::Inert(_), _) => {}
            (other, _) => {
                let kind = other.kind();
                return Err(self.error(format!("instruction {op:#04x} adds to {kind}")));
            }
        }
        Ok(())
    }

    fn persistent(&mut self) -> Result<()> {
        let id = self.pop()?;
        let object = V::persistent(self, id)?;
        self.push(Value::Object(object))
    }

    // Calls.

    /// The bytes of a string.
    pub(crate) fn text(&self, text: Text) -> &'a [u8] {
        slice(self.bytes, text)
    }

    /// Module and name, where they are text.
    pub(crate) fn name_of(&self, module: Text, name: Text) -> Option<(&'a str, &'a str)> {
        let text = |t| std::str::from_utf8(slice(self.bytes, t)).ok();
        Some((text(module)?, text(name)?))
    }

    /// `"module.name"`, shortened where it is longer than any real one.
    pub(crate) fn quote(&self, module: Text, name: Text) -> String {
        let short = |t: Text| {
            let bytes = slice(self.bytes, t);
            String::from_utf8_lossy(&bytes[..bytes.len().min(100)]).into_owned()
        };
        format!("{:?}", format!("{}.{}", short(module), short(name)))
    }

    /// That `name` may not be called.
    pub(crate) fn refusal(&self, name: &str) -> Error {
        self.error(format!("calls {name}; {}", V::ALLOWED))
    }

    /// That `name` may be called, but not so.
    pub(crate) fn wrong_arguments(&self, name: &str) -> Error {
        self.error(format!("calls {name} with arguments that it does not take"))
    }

    /// The elements of a tuple or list.
    #[cfg(feature = "import")]
    pub(crate) fn sequence(&self, id: Id) -> Option<&[Id]> {
        sequence(&self.values, id)
    }

    /// Pushes what stands for `callee(*args)`, or refuses it by name.
    fn push_call(&mut self, callee: Id, args: Id) -> Result<()> {
        let (callable, name) = self.callable(callee)?;
        let args = match self.get(args) {
            // The arguments of inert objects may be many and are not copied.
            Value::Tuple(args) => args[..args.len().min(MAX_ARGUMENTS)].to_vec(),
            other => return Err(self.error(format!("calls {name} with {}, expected a tuple", other.kind()))),
        };
        let id = V::call(self, callable, &name, &args)?;
        self.stack.push(id);
        Ok(())
    }

    /// What calling `callee` stands for, and its quoted name.
    pub(crate) fn callable(&self, callee: Id) -> Result<(V::Callable, String)> {
        let &Value::Global { module, name } = self.get(callee) else {
            return Err(self.refusal(self.get(callee).kind()));
        };
        let quoted = self.quote(module, name);
        match self.name_of(module, name).and_then(|(m, n)| V::callable(m, n)) {
            Some(callable) => Ok((callable, quoted)),
            None => Err(self.refusal(&quoted)),
        }
    }

    /// `OrderedDict()` or `OrderedDict([(key, value), ...])`; `None` for other arguments.
    pub(crate) fn ordered_dict(&mut self, args: &[Id]) -> Result<Option<Value<V>>> {
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

    fn object(&mut self, op: u8) -> Result<()> {
        match op {
            b'c' => {
                let value = Value::Global { module: self.line()?, name: self.line()? };
                self.push(value)
            }
            0x93 => {
                let (name, module) = (self.pop()?, self.pop()?);
                let (&Value::Str(module), &Value::Str(name)) = (self.get(module), self.get(name)) else {
                    return Err(self.error("a class whose name is not a string"));
                };
                self.push(Value::Global { module, name })
            }
            b'i' => {
                let class = Value::Global { module: self.line()?, name: self.line()? };
                let class = self.make(class)?;
                let args = self.pop_to_mark()?;
                let args = self.make(Value::Tuple(args.into()))?;
                self.push_call(class, args)
            }
            b'o' => {
                let parts = self.pop_to_mark()?;
                let Some((&class, args)) = parts.split_first() else {
                    return Err(self.error("an object without a class"));
                };
                let args = self.make(Value::Tuple(args.into()))?;
                self.push_call(class, args)
            }
            b'R' | 0x81 => {
                let (args, class) = (self.pop()?, self.pop()?);
                self.push_call(class, args)
            }
            0x92 => {
                let (_keywords, args, class) = (self.pop()?, self.pop()?, self.pop()?);
                self.push_call(class, args)
            }
            b'b' => {
                let state = self.pop()?;
                let target = self.top()?;
                match self.get(target) {
                    // An attribute of a dict (such as a state dict's versions), or the state of what is inert.
                    Value::Dict(_) | Value::Inert(_) => Ok(()),
                    Value::Object(_) => V::set_state(self, target, state),
                    other => Err(self.error(format!("sets the state of {}", other.kind()))),
                }
            }
            _ => {
                let code = match op {
                    0x82 => self.u8()?,
                    0x83 => u64::from(u16::from_le_bytes(self.array()?)),
                    _ => self.u32()?,
                };
                Err(self.error(format!("names extension {code}, which only the writer's Python can resolve")))
            }
        }
    }
}

/// A little-endian two's complement integer, where it fits.
fn long(bytes: &[u8]) -> Option<i64> {
    if bytes.len() > 8 {
        return None;
    }
    let negative = bytes.last().is_some_and(|b| b & 0x80 != 0);
    let mut all = [if negative { 0xff } else { 0 }; 8];
    all[..bytes.len()].copy_from_slice(bytes);
    Some(i64::from_le_bytes(all))
}

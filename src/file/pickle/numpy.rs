//! Pickles of plain values and NumPy's arrays, such as `numpy.save` writes for arrays of objects.

use super::{Id, Machine, Pickle, Text, Value, Vocabulary};
use crate::base::error::Result;

/// The vocabulary of plain values and arrays.
#[derive(Debug)]
pub(crate) struct NumPy;

/// What it builds.
#[derive(Debug)]
pub(crate) enum Object {
    /// A type of elements by its code, such as `f8`, and whether they are big-endian.
    Dtype { code: Text, swapped: bool },
    /// An array before its state is set.
    Empty,
    /// An array, of which only the types of the parts have been looked at.
    Array(Array),
}

/// The parts of an array.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Array {
    /// A tuple of lengths.
    shape: Id,
    /// An [`Object::Dtype`].
    dtype: Id,
    /// Whether the first axis is the fastest.
    fortran: bool,
    /// Bytes; of an array of objects, a list.
    data: Id,
}

/// What may be called.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Callable {
    /// `collections.OrderedDict`.
    OrderedDict,
    /// `numpy.dtype(code, align, copy)`.
    Dtype,
    /// `_reconstruct(numpy.ndarray, (0,), b"b")`: an array whose state follows.
    Reconstruct,
    /// `_frombuffer(bytes, dtype, shape, order)`: an array.
    FromBuffer,
    /// `scalar(dtype, bytes)`: a number.
    Scalar,
}

impl Vocabulary for NumPy {
    type Object = Object;
    type Callable = Callable;

    const ALLOWED: &'static str = "expected plain values and NumPy's arrays alone";

    fn kind(object: &Object) -> &'static str {
        match object {
            Object::Dtype { .. } => "a type of elements",
            Object::Empty | Object::Array(_) => "an array",
        }
    }

    fn callable(module: &str, name: &str) -> Option<Callable> {
        // NumPy 2 has moved its parts below `_core`.
        Some(match (module, name) {
            ("collections", "OrderedDict") => Callable::OrderedDict,
            ("numpy", "dtype") => Callable::Dtype,
            ("numpy.core.multiarray" | "numpy._core.multiarray", "_reconstruct") => Callable::Reconstruct,
            ("numpy.core.multiarray" | "numpy._core.multiarray", "scalar") => Callable::Scalar,
            ("numpy.core.numeric" | "numpy._core.numeric", "_frombuffer") => Callable::FromBuffer,
            _ => return None,
        })
    }

    fn call(machine: &mut Machine<'_, Self>, callable: Callable, name: &str, args: &[Id]) -> Result<Id> {
        let made = match callable {
            Callable::OrderedDict => machine.ordered_dict(args)?,
            Callable::Dtype => match args {
                [code, ..] => match *machine.get(*code) {
                    Value::Str(code) => Some(Value::Object(Object::Dtype { code, swapped: false })),
                    _ => None,
                },
                [] => None,
            },
            Callable::Reconstruct => is_ndarray(machine, args.first()).then_some(Value::Object(Object::Empty)),
            Callable::FromBuffer => match *args {
                [data, dtype, shape, order] => match machine.get(order) {
                    Value::Str(order) => array(machine, [shape, dtype, data], machine.text(*order) == b"F"),
                    _ => None,
                },
                _ => None,
            },
            Callable::Scalar => match *args {
                [dtype, data] => scalar(machine, dtype, data).map(Value::Float),
                _ => None,
            },
        };
        let made = made.ok_or_else(|| machine.wrong_arguments(name))?;
        machine.make(made)
    }

    /// Of a type `(version, byte order, ...)`; of an array `(version, shape, type, Fortran order, data)`.
    fn set_state(machine: &mut Machine<'_, Self>, object: Id, state: Id) -> Result<()> {
        let wrong = |machine: &Machine<'_, Self>| {
            let kind = machine.get(object).kind();
            machine.error(format!("sets the state of {kind} to what is none"))
        };
        let Value::Tuple(state) = machine.get(state) else { return Err(wrong(machine)) };
        let made = match (machine.get(object), &**state) {
            (&Value::Object(Object::Dtype { code, .. }), &[_, order, ..]) => match machine.get(order) {
                Value::Str(order) => {
                    let swapped = machine.text(*order) == b">";
                    Some(Value::Object(Object::Dtype { code, swapped }))
                }
                _ => None,
            },
            (Value::Object(Object::Empty), &[_, shape, dtype, fortran, data]) => match *machine.get(fortran) {
                Value::Bool(fortran) => array(machine, [shape, dtype, data], fortran),
                _ => None,
            },
            _ => None,
        };
        let made = made.ok_or_else(|| wrong(machine))?;
        machine.set(object, made);
        Ok(())
    }
}

fn is_ndarray(machine: &Machine<'_, NumPy>, id: Option<&Id>) -> bool {
    match id.map(|id| machine.get(*id)) {
        Some(&Value::Global { module, name }) => machine.name_of(module, name) == Some(("numpy", "ndarray")),
        _ => false,
    }
}

fn array(machine: &Machine<'_, NumPy>, [shape, dtype, data]: [Id; 3], fortran: bool) -> Option<Value<NumPy>> {
    let is_array = matches!(machine.get(shape), Value::Tuple(_))
        && matches!(machine.get(dtype), Value::Object(Object::Dtype { .. }))
        && matches!(machine.get(data), Value::Bytes(_) | Value::List(_));
    is_array.then_some(Value::Object(Object::Array(Array { shape, dtype, fortran, data })))
}

fn scalar(machine: &Machine<'_, NumPy>, dtype: Id, data: Id) -> Option<f64> {
    let (&Value::Object(Object::Dtype { code, swapped: false }), &Value::Bytes(data)) =
        (machine.get(dtype), machine.get(data))
    else {
        return None;
    };
    match decode(machine.text(code), machine.text(data))?[..] {
        [number] => Some(number),
        _ => None,
    }
}

/// Little-endian elements of the type `code` as numbers; none for a type of which there are no numbers.
fn decode(code: &[u8], bytes: &[u8]) -> Option<Vec<f64>> {
    fn each<const N: usize>(bytes: &[u8], number: impl Fn([u8; N]) -> f64) -> Option<Vec<f64>> {
        let (elements, rest) = bytes.as_chunks::<N>();
        rest.is_empty().then(|| elements.iter().map(|&element| number(element)).collect())
    }
    match code {
        b"f8" => each(bytes, f64::from_le_bytes),
        b"f4" => each(bytes, |b| f64::from(f32::from_le_bytes(b))),
        b"i8" => each(bytes, |b| i64::from_le_bytes(b) as f64),
        b"i4" => each(bytes, |b| f64::from(i32::from_le_bytes(b))),
        b"i2" => each(bytes, |b| f64::from(i16::from_le_bytes(b))),
        b"u8" => each(bytes, |b| u64::from_le_bytes(b) as f64),
        b"u1" | b"b1" => each(bytes, |[b]| f64::from(b)),
        _ => None,
    }
}

impl Pickle<'_, NumPy> {
    /// The elements of a list, a tuple or an array of objects of one axis; none of anything else.
    pub(crate) fn elements(&self, id: Id) -> Option<&[Id]> {
        let Value::Object(Object::Array(array)) = self.get(id) else { return self.sequence(id) };
        let (Value::List(elements), [length]) = (self.get(array.data), self.sequence(array.shape)?) else {
            return None;
        };
        matches!(self.get(*length), Value::Int(n) if *n == elements.len() as i64).then_some(elements)
    }

    /// A matrix: an array of numbers, or rows of numbers.
    ///
    /// # Errors
    /// What was found, for a message.
    pub(crate) fn matrix<const R: usize, const C: usize>(&self, id: Id) -> std::result::Result<[[f64; C]; R], String> {
        let Value::Object(Object::Array(array)) = self.get(id) else { return self.rows(id) };
        let lengths = self.sequence(array.shape).unwrap_or_default().iter().map(|&n| match self.get(n) {
            &Value::Int(n) => Ok(n),
            other => Err(format!("a length that is {}", other.kind())),
        });
        let lengths = lengths.collect::<std::result::Result<Vec<i64>, String>>()?;
        if lengths != [R as i64, C as i64] {
            return Err(format!("an array of shape {lengths:?}"));
        }
        let (&Value::Object(Object::Dtype { code, swapped }), &Value::Bytes(bytes)) =
            (self.get(array.dtype), self.get(array.data))
        else {
            return Err("an array of objects".to_owned());
        };
        let code = self.text(code);
        let fits = !swapped && self.text(bytes).len() <= size_of::<f64>() * R * C;
        let numbers = if fits { decode(code, self.text(bytes)) } else { None };
        let shown = String::from_utf8_lossy(&code[..code.len().min(20)]);
        let Some(numbers) = numbers.filter(|numbers| numbers.len() == R * C) else {
            let order = if swapped { "big-endian " } else { "" };
            return Err(format!("{} bytes of {order}elements of type {shown:?}", self.text(bytes).len()));
        };
        let at = |row: usize, column: usize| if array.fortran { column * R + row } else { row * C + column };
        Ok(std::array::from_fn(|row| std::array::from_fn(|column| numbers[at(row, column)])))
    }

    fn rows<const R: usize, const C: usize>(&self, id: Id) -> std::result::Result<[[f64; C]; R], String> {
        let Some(rows) = self.sequence(id) else { return Err(self.get(id).kind().to_owned()) };
        let row = |&row: &Id| -> Option<[f64; C]> {
            let numbers = self.sequence(row)?.iter().map(|&number| match *self.get(number) {
                Value::Float(number) => Some(number),
                Value::Int(number) => Some(number as f64),
                _ => None,
            });
            numbers.collect::<Option<Vec<f64>>>()?.try_into().ok()
        };
        let read = rows.iter().take(R + 1).map(row).collect::<Option<Vec<_>>>();
        read.and_then(|rows| rows.try_into().ok())
            .ok_or_else(|| format!("{} rows that are not of {C} numbers", rows.len()))
    }
}

//! What a pickle may name and "call": a closed list, none of which runs anything.

use super::tensor::{Dtype, Element};

/// What the pickle machine does where Python would call a function or a class.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Callable {
    /// `collections.OrderedDict`: a dict.
    OrderedDict,
    /// `torch.Size(tuple)`: the tuple.
    Size,
    /// `(storage, offset, size, stride, ...)`: a tensor of the storage's element type.
    Tensor,
    /// The same with an element type as the seventh argument, over an untyped storage.
    TensorV3,
    /// `(tensor, ...)`: the tensor.
    Parameter,
    /// `(function, class, arguments, state)`: a tensor that `function`, one of the two above, builds from `arguments`.
    FromType,
    /// `getattr(HistoryBuffer, "mean")`, which mmengine's log buffers contain: inert. Any other is refused.
    GetAttr,
    /// An object whose arguments and state are skipped.
    Inert,
}

/// Classes and constructors of plain data that training loops leave beside the weights.
///
/// Being here means that *nothing* is done: the object becomes an opaque value, its arguments and state are dropped.
const INERT: &[(&str, &[&str])] = &[
    ("_codecs", &["encode"]),
    ("addict.addict", &["Dict"]),
    ("argparse", &["Namespace"]),
    ("builtins", &["bytearray", "bytes", "complex", "frozenset", "object", "range", "set", "slice", "xrange"]),
    ("collections", &["Counter", "defaultdict", "deque"]),
    ("datetime", &["date", "datetime", "time", "timedelta", "timezone"]),
    ("mmcv.utils.config", &["Config", "ConfigDict"]),
    ("mmengine.config.config", &["Config", "ConfigDict"]),
    ("mmengine.logging.history_buffer", &["HistoryBuffer"]),
    ("numpy", &["dtype", "ndarray"]),
    ("numpy._core.multiarray", &["_reconstruct", "scalar"]),
    ("numpy._core.numeric", &["_frombuffer"]),
    ("numpy.core.multiarray", &["_reconstruct", "scalar"]),
    ("numpy.core.numeric", &["_frombuffer"]),
    ("pathlib", &["Path", "PosixPath", "PurePath", "PurePosixPath", "PureWindowsPath", "WindowsPath"]),
    ("pathlib._local", &["Path", "PosixPath", "PurePath", "PurePosixPath", "PureWindowsPath", "WindowsPath"]),
    ("torch", &["Generator", "device"]),
    ("torch.serialization", &["_get_layout"]),
];

/// What calling `module.name` stands for, or `None` for everything that is refused.
pub(super) fn callable(module: &str, name: &str) -> Option<Callable> {
    Some(match (modern(module), name) {
        ("collections", "OrderedDict") => Callable::OrderedDict,
        ("torch", "Size") => Callable::Size,
        ("torch._utils", "_rebuild_tensor" | "_rebuild_tensor_v2") => Callable::Tensor,
        ("torch._utils", "_rebuild_tensor_v3") => Callable::TensorV3,
        ("torch._utils", "_rebuild_parameter" | "_rebuild_parameter_with_state") => Callable::Parameter,
        ("torch._tensor", "_rebuild_from_type_v2") => Callable::FromType,
        ("builtins", "getattr") => Callable::GetAttr,
        (module, name) => {
            let (_, names) = INERT.iter().find(|(m, _)| *m == module)?;
            names.contains(&name).then_some(Callable::Inert)?
        }
    })
}

/// Whether `module.name` is the class whose functions [`Callable::GetAttr`] may name.
pub(super) fn is_history_buffer(module: &str, name: &str) -> bool {
    (module, name) == ("mmengine.logging.history_buffer", "HistoryBuffer")
}

/// Whether `module.name` is a class of tensors whose elements are what is stored.
pub(super) fn is_plain_tensor(module: &str, name: &str) -> bool {
    matches!((module, name), ("torch", "Tensor") | ("torch.nn.parameter", "Parameter" | "Buffer"))
}

/// The name since Python 3 of a module that protocol 2 writes by its old one.
fn modern(module: &str) -> &str {
    match module {
        "__builtin__" => "builtins",
        "copy_reg" => "copyreg",
        other => other,
    }
}

/// The element type of a storage class: `torch.FloatStorage` and its kin, or bytes for `torch.storage.UntypedStorage`.
pub(super) fn storage(module: &str, name: &str) -> Option<Element> {
    let (dtype, size) = match (module, name) {
        ("torch", "DoubleStorage") => (Dtype::F64, 8),
        ("torch", "FloatStorage") => (Dtype::F32, 4),
        ("torch", "HalfStorage") => (Dtype::F16, 2),
        ("torch", "BFloat16Storage") => (Dtype::Bf16, 2),
        ("torch", "LongStorage") => (Dtype::I64, 8),
        ("torch", "IntStorage") => (Dtype::I32, 4),
        ("torch", "ShortStorage") => (Dtype::I16, 2),
        ("torch", "CharStorage") => (Dtype::I8, 1),
        ("torch", "ByteStorage") => (Dtype::U8, 1),
        ("torch", "BoolStorage") => (Dtype::Bool, 1),
        ("torch", "ComplexDoubleStorage") => (Dtype::Other, 16),
        ("torch", "ComplexFloatStorage") => (Dtype::Other, 8),
        ("torch", "QInt32Storage") => (Dtype::Other, 4),
        ("torch", "QInt8Storage" | "QUInt8Storage" | "QUInt4x2Storage" | "QUInt2x4Storage") => (Dtype::Other, 1),
        ("torch.storage" | "torch", "UntypedStorage") => (Dtype::U8, 1),
        _ => return None,
    };
    Some(Element { dtype, size })
}

/// The element type that a `torch.dtype` names.
pub(super) fn dtype(module: &str, name: &str) -> Option<Element> {
    let (dtype, size) = match (module, name) {
        ("torch", "float64" | "double") => (Dtype::F64, 8),
        ("torch", "float32" | "float") => (Dtype::F32, 4),
        ("torch", "float16" | "half") => (Dtype::F16, 2),
        ("torch", "bfloat16") => (Dtype::Bf16, 2),
        ("torch", "int64" | "long") => (Dtype::I64, 8),
        ("torch", "int32" | "int") => (Dtype::I32, 4),
        ("torch", "int16" | "short") => (Dtype::I16, 2),
        ("torch", "int8") => (Dtype::I8, 1),
        ("torch", "uint64") => (Dtype::U64, 8),
        ("torch", "uint32") => (Dtype::U32, 4),
        ("torch", "uint16") => (Dtype::U16, 2),
        ("torch", "uint8") => (Dtype::U8, 1),
        ("torch", "bool") => (Dtype::Bool, 1),
        ("torch", "complex128") => (Dtype::Other, 16),
        ("torch", "complex64") => (Dtype::Other, 8),
        ("torch", "complex32") => (Dtype::Other, 4),
        ("torch", name) if name.starts_with("float8_") => (Dtype::Other, 1),
        _ => return None,
    };
    Some(Element { dtype, size })
}

"""Whether the int8 convolutions and products of general runtimes are exact on this CPU.

Not part of the test suite: it needs some gigabytes of packages. In a virtual environment:

    pip install -r tests/peers/requirements.txt
    python tests/peers/int8_exactness.py

Each engine gets the same small problems: 64 input channels, 8 outputs, extreme but valid operands (activations at the end
of their range, weights of +-127), as its own quantised operators take them. The exact sum is computed in 64-bit integers. A
row of the table (Markdown, on standard output) says by how many steps of the output an engine is off at worst. The output's
scale is the one that just holds the exact sums, so an exact engine is off by at most one step (its rounding).
"""

import os
import platform
import tempfile
from collections.abc import Callable

import numpy as np

CHANNELS, OUTPUTS, SIDE = 64, 8, 6

Problem = tuple[str, np.ndarray, np.ndarray]
"""Name, activations [CHANNELS, SIDE, SIDE] as int64, weights [OUTPUTS, CHANNELS, 3, 3] as int64."""


def problems(unsigned: bool) -> list[Problem]:
    """Activations 0..255 (or 0..127, or -127..127) against weights whose products do not cancel."""
    random = np.random.default_rng(1)
    shape, weights = (CHANNELS, SIDE, SIDE), (OUTPUTS, CHANNELS, 3, 3)
    ones = np.ones(weights, np.int64)
    signs = np.where(random.random(weights) < 0.75, 127, -127)
    seven = [
        ("0..127, weights 127", np.full(shape, 127), 127 * ones),
        ("0..127, weights +-127", random.integers(96, 128, shape), signs),
    ]
    if unsigned:
        full = [
            ("0..255, weights 127", np.full(shape, 255), 127 * ones),
            ("0..255, weights +-127", random.integers(192, 256, shape), signs),
        ]
    else:
        full = [("+-127, weights +-127", np.where(random.random(shape) < 0.75, 127, -127), signs)]
    return seven + full


def exact(x: np.ndarray, w: np.ndarray) -> np.ndarray:
    """[OUTPUTS, SIDE - 2, SIDE - 2], without padding."""
    windows = np.lib.stride_tricks.sliding_window_view(x, (3, 3), axis=(1, 2))
    return np.einsum("chwij,ncij->nhw", windows, w)


def scale_of(sums: np.ndarray) -> float:
    """Of a signed 8-bit output that just holds `sums`."""
    return float(np.abs(sums).max()) / 127


def onnx_runtime(x: np.ndarray, w: np.ndarray, scale: float) -> np.ndarray:
    """QLinearConv, u8 activations, s8 weights."""
    import onnx
    import onnxruntime
    from onnx import TensorProto, helper

    def constant(name: str, value: np.ndarray) -> onnx.TensorProto:
        return onnx.numpy_helper.from_array(value, name)

    constants = [
        constant("xs", np.float32(1)), constant("xz", np.uint8(0)), constant("w", w.astype(np.int8)),
        constant("ws", np.float32(1)), constant("wz", np.int8(0)), constant("ys", np.float32(scale)),
        constant("yz", np.uint8(128)),
    ]
    node = helper.make_node("QLinearConv", ["x", "xs", "xz", "w", "ws", "wz", "ys", "yz"], ["y"])
    ends = [helper.make_tensor_value_info("x", TensorProto.UINT8, (1, *x.shape))], [
        helper.make_tensor_value_info("y", TensorProto.UINT8, None)
    ]
    graph = helper.make_graph([node], "convolution", *ends, initializer=constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 19)], ir_version=9)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    (y,) = session.run(None, {"x": x[None].astype(np.uint8)})
    return y[0].astype(np.int64) - 128


def openvino(x: np.ndarray, w: np.ndarray, scale: float) -> np.ndarray:
    """A convolution between FakeQuantize operations, which the CPU plugin runs in int8."""
    import openvino as ov
    from openvino import opset13 as op

    high = 255.0 if x.min() >= 0 else 127.0
    low = 0.0 if x.min() >= 0 else -128.0
    parameter = op.parameter([1, *x.shape], np.float32)
    quantised = op.fake_quantize(parameter, np.float32(low), np.float32(high), np.float32(low), np.float32(high), 256)
    weights = op.multiply(op.convert(op.constant(w.astype(np.int8)), np.float32), op.constant(np.float32(1)))
    y = op.convolution(quantised, weights, [1, 1], [0, 0], [0, 0], [1, 1])
    ends = [np.float32(-128 * scale), np.float32(127 * scale)]
    y = op.fake_quantize(y, *ends, *ends, 256)
    # Without an operation that takes bytes behind it the output would stay in f32.
    model = ov.Model([op.max_pool(y, [1, 1], [1, 1], [0, 0], [0, 0], [1, 1]).output(0)], [parameter])
    compiled = ov.Core().compile_model(model, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    operations = [operation.get_rt_info() for operation in compiled.get_runtime_model().get_ops()]
    convolutions = [info for info in operations if info["layerType"].astype(str) == "Convolution"]
    kinds = {info["runtimePrecision"].astype(str) for info in convolutions}
    if not kinds <= {"u8", "i8"}:
        raise RuntimeError(f"the convolution ran in {kinds}")
    y = next(iter(compiled(x[None].astype(np.float32)).values()))[0]
    return np.rint(y / scale).astype(np.int64)


def pytorch(engine: str) -> Callable[[np.ndarray, np.ndarray, float], np.ndarray]:
    """quantized::conv2d, quint8 activations, qint8 weights per channel."""

    def run(x: np.ndarray, w: np.ndarray, scale: float) -> np.ndarray:
        import torch

        torch.backends.quantized.engine = engine
        x = torch.from_numpy(x[None].astype(np.float32))
        x = torch.quantize_per_tensor(x, 1.0, 0, torch.quint8)
        scales, zeros = torch.ones(len(w), dtype=torch.float64), torch.zeros(len(w), dtype=torch.int64)
        w = torch.quantize_per_channel(torch.from_numpy(w.astype(np.float32)), scales, zeros, 0, torch.qint8)
        y = torch.ao.nn.quantized.functional.conv2d(x, w, torch.zeros(w.shape[0]), scale=scale, zero_point=128)
        return y.int_repr()[0].numpy().astype(np.int64) - 128

    return run


def mnn(x: np.ndarray, w: np.ndarray, scale: float) -> np.ndarray:
    """A convolution of MNN's own int8 operator, converted from a graph of QuantizeLinear and DequantizeLinear."""
    import MNN
    import _tools  # Of the package MNN. MNN.tools installs other packages when it is imported.
    import onnx
    from onnx import TensorProto, helper

    def constant(name: str, value: np.ndarray) -> onnx.TensorProto:
        return onnx.numpy_helper.from_array(value, name)

    constants = [
        constant("one", np.float32(1)), constant("zero", np.int8(0)), constant("w", w.astype(np.int8)),
        constant("ones", np.ones(len(w), np.float32)), constant("zeros", np.zeros(len(w), np.int8)),
        constant("scale", np.float32(scale)),
    ]
    nodes = [
        helper.make_node("QuantizeLinear", ["x", "one", "zero"], ["xq"], axis=0),
        helper.make_node("DequantizeLinear", ["xq", "one", "zero"], ["xd"], axis=0),
        helper.make_node("DequantizeLinear", ["w", "ones", "zeros"], ["wd"], axis=0),
        helper.make_node("Conv", ["xd", "wd"], ["c"], kernel_shape=[3, 3]),
        helper.make_node("QuantizeLinear", ["c", "scale", "zero"], ["cq"], axis=0),
        helper.make_node("DequantizeLinear", ["cq", "scale", "zero"], ["y"], axis=0),
    ]
    ends = [helper.make_tensor_value_info("x", TensorProto.FLOAT, (1, *x.shape))], [
        helper.make_tensor_value_info("y", TensorProto.FLOAT, (1, len(w), SIDE - 2, SIDE - 2))
    ]
    graph = helper.make_graph(nodes, "convolution", *ends, initializer=constants)
    with tempfile.TemporaryDirectory() as directory:
        source, converted = os.path.join(directory, "a.onnx"), os.path.join(directory, "a.mnn")
        onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 19)], ir_version=9), source)
        _tools.mnnconvert(["mnnconvert", "-f", "ONNX", "--modelFile", source, "--MNNModel", converted, "--bizCode", "x"])
        net = MNN.nn.load_module_from_file(converted, ["x"], ["y"], shape_mutable=False)
        given = MNN.expr.placeholder([1, *x.shape], MNN.expr.NCHW, MNN.expr.float)
        given.write(np.ascontiguousarray(x[None], np.float32))
        results = net.onForward([given])
        if not results:
            raise RuntimeError("the converted graph does not run")
        y = results[0].read()
    return np.rint(np.array(y)[0] / scale).astype(np.int64)


ENGINES: list[tuple[str, str, bool, Callable[[np.ndarray, np.ndarray, float], np.ndarray]]] = [
    ("ONNX Runtime, QLinearConv", "onnxruntime", True, onnx_runtime),
    ("OpenVINO, u8 activations", "openvino", True, openvino),
    ("OpenVINO, i8 activations", "openvino", False, openvino),
    ("PyTorch, x86", "torch", True, pytorch("x86")),
    ("PyTorch, fbgemm", "torch", True, pytorch("fbgemm")),
    ("PyTorch, qnnpack", "torch", True, pytorch("qnnpack")),
    ("MNN", "MNN", False, mnn),
]
"""Name, package, whether activations are unsigned, and the call."""


def main() -> None:
    from importlib.metadata import version

    with open("/proc/cpuinfo") as file:
        flags = next(line for line in file if line.startswith("flags")).split()
    names = [name for name in ("avx2", "avx_vnni", "avx512_vnni") if name in flags]
    print(f"{platform.machine()}: {', '.join(names)}\n")
    print("| engine | version | operands | off by at worst, in steps of 254 |")
    print("|---|---|---|---:|")
    for name, package, unsigned, run in ENGINES:
        for what, x, w in problems(unsigned):
            sums = exact(x, w)
            scale = scale_of(sums)
            want = np.clip(np.rint(sums / scale), -127, 127).astype(np.int64)
            try:
                off = str(int(np.abs(run(x, w, scale) - want).max()))
            except (RuntimeError, ValueError, ImportError) as error:
                off = f"not run: {str(error).splitlines()[0][:80]}"
            print(f"| {name} | {version(package)} | {what} | {off} |", flush=True)


if __name__ == "__main__":
    main()

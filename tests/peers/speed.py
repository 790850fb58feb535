"""How long voxcast and general runtimes take for the same network, in turns, on this machine.

Not part of the test suite: it needs some gigabytes of packages and an idle machine. In a virtual environment:

    pip install -r tests/peers/requirements.txt
    cargo build --release && python tests/peers/speed.py target/release/voxcast

The network is `nuscenes-200` without deformable stages (PyTorch has no such operator), weights drawn, images of 256 x 704 unless
asked otherwise. With `--deformable` stages 3 and 4 are deformable as published, and the peer is ONNX Runtime with its operator
`DeformConv`. The modules of `train/` are exported to ONNX in two halves: backbone and pyramid of one camera, and everything
after the gather. OpenVINO's int8 is quantised by NNCF, with window attention left in floating point, as here. Every candidate runs
with two threads in a process of its own; rounds go through all candidates in turn. The table (Markdown, on standard output)
has medians over the rounds of each process's median, in seconds. `--int8` compares int8 with int8.
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

THREADS, REPEAT = 2, 3
HALVES = {"image": "image half, one camera", "volume": "everything after the gather"}
NETWORK = {
    "depths": [3, 4, 23, 3],
    "width": 64,
    "dcn": [False] * 4,
    "fpn": 512,
    "channels": [32, 64, 128, 256],
    "key_dims": [8, 16, 32],
    "bounds": [[-50, 50], [-50, 50], [-5, 3]],
    "classes": 17,
    "grids": [[100, 100, 8], [50, 50, 4], [25, 25, 2]],
    "samples": [4, 5, 6],
}


def deform(backbone, stages: list[bool]) -> None:
    """Makes the 3x3 convolutions of `stages` deformable, in place: DCNv2, exported as ONNX's DeformConv. They cannot run."""
    import torch
    from torch import nn

    class Operator(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x, weight, offsets, bias, mask):
            return torch.zeros_like(x)

        @staticmethod
        def symbolic(g, x, weight, offsets, bias, mask):
            attributes = {"kernel_shape_i": [3, 3], "pads_i": [1, 1, 1, 1], "strides_i": [1, 1]}
            return g.op("DeformConv", x, weight, offsets, bias, mask, **attributes).setType(x.type())

    class Deformable(nn.Module):
        def __init__(self, plain: nn.Conv2d) -> None:
            super().__init__()
            self.weight = plain.weight
            self.conv_offset = nn.Conv2d(plain.in_channels, 27, 3, 1, 1)
            # Offsets of a fraction of a pixel, as trained ones are.
            nn.init.normal_(self.conv_offset.weight, std=1e-3)
            nn.init.zeros_(self.conv_offset.bias)
            self.register_buffer("bias", torch.zeros(plain.out_channels), persistent=False)

        def forward(self, x):
            first, second, mask = torch.chunk(self.conv_offset(x), 3, 1)
            return Operator.apply(x, self.weight, torch.cat((first, second), 1), self.bias, mask.sigmoid())

    for layer, deformed in enumerate(stages, 1):
        for block in getattr(backbone, f"layer{layer}") if deformed else []:
            block.conv2 = Deformable(block.conv2)


def export(directory: Path) -> None:
    """Writes checkpoint.safetensors and the halves as ONNX."""
    import torch
    from safetensors.torch import save_file
    from torch import nn

    sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "train"))
    from voxcast_train.network import Bottleneck, InverseMatrixVT3D, Network, initialise

    wanted = json.loads((directory / "network.json").read_text())
    (directory / "plain.json").write_text(json.dumps(wanted | {"dcn": [False] * 4}))
    network = Network.load(directory / "plain.json")
    torch.manual_seed(1)
    model = InverseMatrixVT3D(network).eval()
    initialise(model)
    # Untrained norms do nothing: activations must not grow from block to block, or int8 has no steps for them.
    with torch.no_grad():
        model.img_backbone.conv1.weight.mul_(0.02)
        for block in model.img_backbone.modules():
            if isinstance(block, Bottleneck):
                block.bn3.weight.fill_(0.2)
    deform(model.img_backbone, wanted["dcn"])
    state = model.state_dict()
    state = {name: value.contiguous() for name, value in state.items() if not name.endswith("num_batches_tracked")}
    save_file(state, directory / "checkpoint.safetensors")

    class Image(nn.Module):
        def __init__(self):
            super().__init__()
            self.model = model

        def forward(self, x):
            return tuple(self.model.img_neck(self.model.img_backbone(x)))

    class Volume(nn.Module):
        def __init__(self):
            super().__init__()
            self.model = model

        def forward(self, *means):
            view, volumes = self.model.view_transformer, []
            for level, volume, plane in zip(view.imvts, means[::2], means[1::2]):
                volume, plane = level.down_conv3d(volume), level.xy_conv(plane)
                plane = level.aspp_xy(level.bev_attn_layer(plane))
                volumes.append(volume + level.combine_coeff(volume).sigmoid() * plane.unsqueeze(-1))
            r2 = view.refine_lvl2(volumes[1] + view.up_sample3(view.refine_lvl3(volumes[2])))
            r1 = view.refine_lvl1(volumes[0] + view.up_sample2(r2))
            return self.model.occ_head.mlp_occ_lvl0(view.fine(r1).permute(0, 2, 3, 4, 1))

    image = torch.randn(1, 3, *network.image)
    means = [torch.randn(1, network.fpn, *grid[:axes]) for grid in network.grids for axes in (3, 2)]
    with torch.no_grad():
        for half, module, inputs in (("image", Image(), [image]), ("volume", Volume(), means)):
            torch.onnx.export(module, tuple(inputs), str(directory / f"{half}.onnx"), opset_version=19, dynamo=False)


def quantise(directory: Path) -> None:
    """Writes the halves in int8 for OpenVINO."""
    import nncf
    import numpy as np
    import openvino as ov

    random = np.random.default_rng(0)
    for half in HALVES:
        model = ov.Core().read_model(directory / f"{half}.onnx")
        inputs = {i.any_name: np.abs(random.standard_normal(list(i.shape))).astype(np.float32) for i in model.inputs}
        attention = nncf.IgnoredScope(patterns=[".*attn.*"], validate=False)
        model = nncf.quantize(model, nncf.Dataset([inputs]), subset_size=1, ignored_scope=attention)
        ov.save_model(model, directory / f"{half}.int8.xml", compress_to_fp16=False)


def time_peer(engine: str, path: str) -> None:
    """Prints the median of some runs after one that is not counted."""
    import numpy as np

    random = np.random.default_rng(0)

    def draw(shape):
        return random.standard_normal([int(v) for v in shape]).astype(np.float32)

    if engine == "ONNX Runtime":
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = THREADS
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        named = {value.name: draw(value.shape) for value in session.get_inputs()}

        def run():
            session.run(None, named)

    elif engine == "OpenVINO":
        import openvino as ov

        hints = {"INFERENCE_NUM_THREADS": THREADS, "PERFORMANCE_HINT": "LATENCY", "INFERENCE_PRECISION_HINT": "f32"}
        compiled = ov.Core().compile_model(path, "CPU", hints)
        inputs = [draw(value.shape) for value in compiled.inputs]

        def run():
            compiled(inputs)

    else:
        import MNN
        import onnx

        graph = onnx.load(path, load_external_data=False).graph
        names = [[value.name for value in values] for values in (graph.input, graph.output)]
        runtime = MNN.nn.create_runtime_manager(({"precision": "high", "backend": "CPU", "numThread": THREADS},))
        converted = str(Path(path).with_suffix(".mnn"))
        network = MNN.nn.load_module_from_file(converted, *names, runtime_manager=runtime, shape_mutable=False)
        inputs = []
        for value in graph.input:
            shape = [dimension.dim_value for dimension in value.type.tensor_type.shape.dim]
            inputs.append(MNN.expr.placeholder(shape, MNN.expr.NCHW, MNN.expr.float))
            inputs[-1].write(draw(shape))

        def run():
            for output in network.onForward(inputs):
                output.read()

    seconds = []
    for _ in range(REPEAT + 1):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    print(statistics.median(seconds[1:]))


def time_voxcast(program: str, directory: Path) -> dict[str, float]:
    """Seconds of both halves."""
    command = [program, "profile", "--model", "model.safetensors", "--rig", "rig.safetensors", "scene", "--by", "part"]
    command += ["--repeat", str(REPEAT), "--threads", str(THREADS), "--json"]
    report = json.loads(subprocess.run(command, cwd=directory, check=True, stdout=subprocess.PIPE).stdout)
    rows = {row["name"]: row["seconds"] for row in report["rows"]}
    image = sum(seconds for name, seconds in rows.items() if name.startswith(("image", "backbone", "pyramid")))
    gather = sum(seconds for name, seconds in rows.items() if name.endswith("gather"))
    cameras = len(json.loads((directory / "scene" / "calibration.json").read_text())["cameras"])
    return {"image": image / cameras, "volume": sum(rows.values()) - image - gather}


def prepare(program: str, directory: Path, size: list[int], int8: bool, deformable: bool) -> None:
    """Writes everything that candidates read."""

    def run(*command):
        subprocess.run(command, cwd=directory, check=True, stdout=sys.stderr)

    (directory / "network.json").write_text(json.dumps(NETWORK | {"image": size, "dcn": [False, False, deformable, deformable]}))
    export(directory)
    run(program, "synth", "--network", "network.json", "--seed", "7", "-o", "scene")
    precision = ["--precision", "int8", "--calibrate", "scene"] if int8 else []
    run(program, "import", "checkpoint.safetensors", "--network", "network.json", *precision, "-o", "model.safetensors")
    run(program, "rig", "scene", "--model", "model.safetensors", "-o", "rig.safetensors")
    if int8:
        quantise(directory)
    if int8 or deformable:
        return
    import MNN  # noqa: F401, first
    import _tools

    # Not by the command `mnnconvert`, which would install packages.
    for half in HALVES:
        files = ["--modelFile", str(directory / f"{half}.onnx"), "--MNNModel", str(directory / f"{half}.mnn")]
        _tools.mnnconvert(["mnnconvert", "-f", "ONNX", *files, "--bizCode", "speed"])


def measure(program: str, directory: Path, rounds: int, peers: dict[str, str]) -> None:
    """Takes turns with `peers`, of each of which the ending of its files is given, and prints the table."""
    seconds: dict[tuple[str, str], list[float]] = {}
    for turn in range(rounds):
        print(f"round {turn + 1} of {rounds}", file=sys.stderr)
        for half, value in time_voxcast(program, directory).items():
            seconds.setdefault(("voxcast", half), []).append(value)
        for engine, suffix in peers.items():
            for half in HALVES:
                command = [sys.executable, __file__, "--peer", engine, str(directory / f"{half}{suffix}")]
                printed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
                seconds.setdefault((engine, half), []).append(float(printed.split()[-1]))
    medians = {key: statistics.median(values) for key, values in seconds.items()}
    engines = ["voxcast", *peers]
    print("| what | " + " | ".join(engines) + " |")
    print("|---|" + "---:|" * len(engines))
    for half, name in HALVES.items():
        ours = medians["voxcast", half]
        cells = [f"{ours:.3f}"] + [f"{medians[e, half]:.3f} ({ours / medians[e, half]:.2f})" for e in peers]
        print(f"| {name} | " + " | ".join(cells) + " |")


def main() -> None:
    parser = argparse.ArgumentParser(description="Time voxcast and its peers on the same network, in turns.")
    parser.add_argument("program", help="the voxcast program, built for release")
    parser.add_argument("--image", default="256x704", help="height x width of the images, multiples of 32")
    parser.add_argument("--rounds", type=int, default=5)
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--int8", action="store_true", help="compare int8 with int8")
    kind.add_argument("--deformable", action="store_true", help="with deformable stages 3 and 4, which ONNX Runtime has too")
    options = parser.parse_args()
    peers = {"ONNX Runtime": ".onnx", "OpenVINO": ".onnx", "MNN": ".onnx"}
    if options.int8:
        peers = {"OpenVINO": ".int8.xml"}
    elif options.deformable:
        peers = {"ONNX Runtime": ".onnx"}
    with tempfile.TemporaryDirectory() as temporary:
        directory, program = Path(temporary), str(Path(options.program).resolve())
        prepare(program, directory, [int(v) for v in options.image.split("x")], options.int8, options.deformable)
        measure(program, directory, options.rounds, peers)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--peer"]:
        time_peer(*sys.argv[2:4])
    else:
        main()

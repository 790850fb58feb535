"""How a network does across rigs: on the plain one, on rings whose mounting is off, and without one of the cameras.

    python -m voxcast_train.across --network network.json --checkpoint checkpoint.safetensors --voxcast ../target/release/voxcast \\
        --work DIR --first 1000000 --count 200 -o across.json

Frames are drawn into DIR. Each jittered ring has every camera turned by just `--degrees` about a random axis and moved by just
`--metres`; none of them is one that training has seen.
"""

import argparse
import json
import sys
from pathlib import Path

import torch

from . import rigs
from .data import Frames
from .errors import InputError
from .evaluate import evaluate, evaluate_masked, load_model
from .files import replace
from .metrics import Confusion
from .network import InverseMatrixVT3D, Network
from .program import Program
from .rig import Rig, Rigs

RINGS = 4
"""Jittered rings, which share the frames."""

SEED = 777_000
"""Of the first of them."""


def across(model: InverseMatrixVT3D, network_path: Path, work: Path, voxcast: Program, first: int, count: int, device: torch.device,
           degrees: float = 1.0, metres: float = 0.05) -> dict:  # fmt: skip
    """Reports by name: "plain"; "jittered"; and "without CAMERA" with, for comparison over the same voxels, "with CAMERA"."""
    network, model = model.network, model.to(device)
    voxcast.make_set(work / "held-out", first, count, network_path)
    names, lidar2img = rigs.read_set(work / "held-out")
    rigs.make(work / "plain", names, lidar2img, network, network_path, voxcast)
    plain = load_rig(work / "plain", network, device)
    frames = Frames([work / "held-out"], network, pixels=False, limit=count)
    whole, masked = evaluate_masked(model, plain, frames, device)
    reports = {"plain": whole.report()}
    confusion = Confusion(network)
    for ring in range(RINGS):
        share = count // RINGS + (ring < count % RINGS)
        if share == 0:
            continue
        directory = work / f"jittered-{ring}"
        moved = rigs.jittered(lidar2img, degrees, metres, SEED + ring, whole=True)
        calibration = rigs.make(directory, names, moved, network, network_path, voxcast)
        voxcast.make_set(directory / "set", first + ring * (count // RINGS + 1), share, network_path, calibration)
        of_ring = Frames([directory / "set"], network, pixels=False, limit=share)
        confusion.counts += evaluate(model, load_rig(directory, network, device), of_ring, device).counts
    reports["jittered"] = confusion.report()
    for name, (without, with_it) in zip(names, masked):
        reports[f"without {name}"] = without.report()
        reports[f"with {name}"] = with_it.report()
    return reports


def load_rig(directory: Path, network: Network, device: torch.device) -> Rig:
    return Rigs([Rig.load(directory / "rig.safetensors", network)], device).select(0)


def summary(reports: dict) -> str:
    """A Markdown table: IoU and mIoU of all voxels for each rig; of masked cameras, mIoU of the voxels that others see."""
    lines = ["| | IoU | mIoU | mIoU near | mIoU seen by others, with the camera |", "|---|---:|---:|---:|---:|"]
    for name, report in reports.items():
        if name.startswith("with "):
            continue
        cells = [report["all"]["iou"], report["all"]["miou"], report["near"]["miou"]]
        seen = "-"
        if name.startswith("without "):
            before = reports["with " + name.removeprefix("without ")]
            seen = f"{report['seen']['miou']:.1f}, {before['seen']['miou']:.1f}"
        lines.append(f"| {name} | " + " | ".join(f"{cell:.1f}" for cell in cells) + f" | {seen} |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(prog="voxcast_train.across", description="Score a network across rigs.")
    parser.add_argument("--network", required=True, type=Path)
    parser.add_argument("--checkpoint", required=True, help="of voxcast_train.export, or a model of voxcast import")
    parser.add_argument("--voxcast", required=True, type=Path)
    parser.add_argument("--work", required=True, type=Path, help="receives the frames; a set that is there already stays")
    parser.add_argument("--first", type=int, default=1_000_000, help="seed of the first frame")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--degrees", type=float, default=1.0)
    parser.add_argument("--metres", type=float, default=0.05)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("-o", "--output", help="JSON with every number")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    try:
        model = load_model(Network.load(options.network), options.checkpoint)
        options.work.mkdir(parents=True, exist_ok=True)
        reports = across(model, options.network, options.work, Program(options.voxcast), options.first, options.count,
                         torch.device(options.device), options.degrees, options.metres)  # fmt: skip
        if options.output:
            text = json.dumps({"frames": options.count, **reports}, indent=1) + "\n"
            replace(options.output, lambda temporary: Path(temporary).write_text(text))
    except (InputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(summary(reports))
    return 0


if __name__ == "__main__":
    sys.exit(main())

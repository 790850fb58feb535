"""Evaluates exported weights on sets of frames, beside the per-voxel majority of the training set.

    python -m voxcast_train.evaluate --network network.json --checkpoint checkpoint.safetensors --rig rig.safetensors \\
        --set held-out/ --train-set train/ -o quality.json
"""

import argparse
import json
import sys
from pathlib import Path

import torch
from safetensors.torch import load_file

from .data import Frames
from .errors import InputError
from .files import replace
from .metrics import Confusion, table
from .network import InverseMatrixVT3D, Network
from .rig import Rig


@torch.no_grad()
def evaluate(model: InverseMatrixVT3D, rig: Rig, frames: Frames, device: torch.device, precision: str = "f32") -> Confusion:
    """Runs every frame, one at a time, in evaluation mode, and leaves the model in that mode."""
    model.eval()
    confusion = Confusion(model.network)
    for number in range(len(frames)):
        batch = frames.batch([number])
        with torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16"):
            logits = model(batch["images"].to(device), rig)[0]
        confusion.add(logits[0].argmax(-1).cpu(), batch["labels"][0][0], batch["visible"][0])
    return confusion


def evaluate_majority(majority: torch.Tensor, frames: Frames) -> Confusion:
    """The same grid for every frame."""
    confusion = Confusion(frames.network)
    for labels, visible in zip(frames.columns["labels0"], frames.columns["visible"]):
        confusion.add(majority, labels, visible)
    return confusion


def model_of(network: Network, weights: dict) -> InverseMatrixVT3D:
    """A model with these weights, in evaluation mode. Raises InputError for names or shapes that do not fit."""
    model = InverseMatrixVT3D(network)
    own = model.state_dict()
    missing = [name for name in own if name not in weights and not name.endswith("num_batches_tracked")]
    wrong = [name for name in weights if name not in own or own[name].shape != weights[name].shape]
    if missing or wrong:
        raise InputError(f"not weights of this network: {missing[:3]} are missing, {wrong[:3]} do not fit")
    model.load_state_dict(weights, strict=False)
    return model.eval()


def load_model(network: Network, checkpoint) -> InverseMatrixVT3D:
    """A model with the weights of an exported checkpoint. Raises InputError naming the file."""
    try:
        return model_of(network, load_file(checkpoint))
    except InputError as error:
        raise InputError(f"{checkpoint}: {error}") from error


def main() -> int:
    parser = argparse.ArgumentParser(prog="voxcast_train.evaluate", description="IoU and mIoU of exported weights.")
    parser.add_argument("--network", required=True)
    parser.add_argument("--checkpoint", required=True, help="as voxcast_train.export writes it")
    parser.add_argument("--rig", required=True)
    parser.add_argument("--set", required=True, action="append", help="a set of frames; may be given again")
    parser.add_argument("--train-set", action="append", help="the set that the image-blind baseline is made from")
    parser.add_argument("--limit", type=int, help="the first so many frames")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("-o", "--output", help="JSON with every number")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    try:
        network = Network.load(options.network)
        device = torch.device(options.device)
        frames = Frames(options.set, network, pixels=False, limit=options.limit)
        model = load_model(network, options.checkpoint).to(device)
        rig = Rig.load(options.rig, network).to(device)
        reports = {"network": evaluate(model, rig, frames, device).report()}
        if options.train_set:
            majority = Frames(options.train_set, network, pixels=False).majority()
            reports["majority"] = evaluate_majority(majority, frames).report()
        if options.output:
            text = json.dumps({"frames": len(frames), **reports}, indent=1) + "\n"
            replace(options.output, lambda temporary: Path(temporary).write_text(text))
    except (InputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"{len(frames)} frames\n\n{table(reports)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

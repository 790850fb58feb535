"""Evaluates exported weights on sets of frames, beside the per-voxel majority of the training set.

    python -m voxcast_train.evaluate --network network.json --checkpoint checkpoint.safetensors --rig rig.safetensors \\
        --set held-out/ --train-set train/ -o quality.json
"""

import argparse
import json
import sys
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import load_file

from .data import Frames
from .errors import InputError
from .files import replace
from .metrics import Confusion, table
from .network import InverseMatrixVT3D, Network
from .rig import Rig, Rigs
from .unpack import unpack


GPU_BATCH = 10
"""Frames that a GPU evaluates at once."""


def batches(frames: Frames, device: torch.device):
    """Numbers of the frames that are evaluated at once."""
    size = GPU_BATCH if device.type == "cuda" else 1
    for first in range(0, len(frames), size):
        yield list(range(first, min(first + size, len(frames))))


@torch.no_grad()
def evaluate(model: InverseMatrixVT3D, rig: Rig, frames: Frames, device: torch.device, precision: str = "f32") -> Confusion:
    """Runs every frame in evaluation mode and leaves the model in that mode."""
    model.eval()
    confusion = Confusion(model.network)
    for numbers in batches(frames, device):
        batch = frames.batch(numbers)
        with torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16"):
            logits = model(batch["images"].to(device), rig)[0]
        for number, predicted in enumerate(logits.argmax(-1).cpu()):
            confusion.add(predicted, batch["labels"][0][number], batch["visible"][number])
    return confusion


@torch.no_grad()
def evaluate_masked(model: InverseMatrixVT3D, rig: Rig, frames: Frames, device: torch.device) -> tuple:
    """As `evaluate`; and for each camera two confusions, without it and with it, of which "seen" are those visible voxels that the
    other cameras have in their images. Images go through the image half once."""
    model.eval()
    network = model.network
    whole, masked = Confusion(network), []
    for camera in range(network.cameras):
        others = (torch.arange(network.cameras, device=device) != camera).float()
        masked.append((others, covered_by(rig, network, others), Confusion(network), Confusion(network)))
    for numbers in batches(frames, device):
        batch = frames.batch(numbers)
        pyramid = model.pyramid(batch["images"].to(device))

        def predictions(kept):
            kept = None if kept is None else kept.expand(len(numbers), -1)
            return model.occ_head(model.volumes(pyramid, rig, len(numbers), kept), (0,))[0].argmax(-1).cpu()

        of_whole = predictions(None)
        rows = list(zip(batch["labels"][0], batch["visible"] != 0))
        for predicted, (labels, visible) in zip(of_whole, rows):
            whole.add(predicted, labels, visible)
        for others, covered, without, with_it in masked:
            for predicted, before, (labels, visible) in zip(predictions(others), of_whole, rows):
                without.add(predicted, labels, visible & covered)
                with_it.add(before, labels, visible & covered)
    return whole, [(without, with_it) for _, _, without, with_it in masked]


def covered_by(rig: Rig, network: Network, kept: torch.Tensor) -> torch.Tensor:
    """bool [X, Y, Z], which voxels of level 0 lie in one of level 1 that a kept camera has pixels of."""
    covered = (rig.levels[0][0].shares @ kept > 1e-6).view(network.grids[0])
    for axis in range(3):
        covered = covered.repeat_interleave(2, axis)
    return covered.cpu()


def evaluate_majority(majority: torch.Tensor, frames: Frames) -> Confusion:
    """The same grid for every frame."""
    confusion = Confusion(frames.network)
    for labels, visible in zip(frames.columns["labels0"], frames.columns["visible"]):
        confusion.add(majority, labels, visible)
    return confusion


def fitting(model: InverseMatrixVT3D, weights: dict, path) -> dict:
    """The weights, if they are a model's: InputError for names or shapes that do not fit, naming the file."""
    own = model.state_dict()
    missing = [name for name in own if name not in weights and not name.endswith("num_batches_tracked")]
    wrong = [name for name in weights if name not in own or own[name].shape != weights[name].shape]
    if missing or wrong:
        raise InputError(f"{path}: not weights of this network: {missing[:3]} are missing, {wrong[:3]} do not fit")
    return weights


def load_weights(model: InverseMatrixVT3D, path) -> bool:
    """Fills a model with the weights of an exported checkpoint, or of a model file of `voxcast import`, and says whether it was
    the latter, whose batch norms do nothing (`unpack`). Raises InputError naming the file."""
    with safe_open(path, "pt") as file:
        packed = "format" in (file.metadata() or {})
    if packed:
        unpack(path, model)
    else:
        model.load_state_dict(fitting(model, load_file(path), path), strict=False)
    return packed


def load_model(network: Network, path) -> InverseMatrixVT3D:
    """A model with the weights of a file, as `load_weights` takes them, in evaluation mode."""
    model = InverseMatrixVT3D(network)
    load_weights(model, path)
    return model.eval()


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
        rig = Rigs([Rig.load(options.rig, network)], device).select(0)
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

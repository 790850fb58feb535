"""Shifts the logits of each class so that mIoU on a set of frames is highest.

    python -m voxcast_train.calibrate --network network.json --checkpoint checkpoint.safetensors --rig rig.safetensors \\
        --set tune/ -o calibrated.safetensors

The losses settle how sure the network must be before it names a class, and not where IoU is highest. One number per class, added
to the bias of the last layer, corrects that; nothing else changes. Fit it to frames that are neither trained on nor
reported.
"""

import argparse
import sys

import torch
from torch import Tensor

from .data import Frames
from .errors import InputError
from .evaluate import load_model
from .export import export
from .losses import IGNORED
from .metrics import scores
from .network import InverseMatrixVT3D, Network
from .rig import Rig, Rigs

BIAS = "occ_head.mlp_occ_lvl0.4.bias"

ROUNDS = ((8.0, 1.0), (4.0, 0.5), (1.0, 0.25), (0.5, 0.25))
"""Each round tries, for every class in turn, shifts up to so far from the present one, so far apart."""


def miou_of(predicted: Tensor, labels: Tensor, classes: int) -> float:
    confusion = torch.bincount(labels * classes + predicted, minlength=classes * classes)
    return scores(confusion.view(classes, classes))["miou"]


def fit_shifts(logits: Tensor, labels: Tensor) -> tuple:
    """Shifts [K] for logits [V, K] by coordinate ascent, and the mIoU in percent before and after."""
    classes = logits.shape[1]
    shifts = torch.zeros(classes, device=logits.device)
    before = best = miou_of(logits.argmax(1), labels, classes)
    for reach, apart in ROUNDS:
        for c in range(1, classes):
            others = logits + shifts
            mine = others[:, c].clone()
            others[:, c] = -torch.inf
            highest, runner_up = others.max(1)
            present = shifts[c].item()
            for move in torch.arange(-reach, reach + apart, apart).tolist():
                predicted = torch.where(mine + move > highest, c, runner_up)
                value = miou_of(predicted, labels, classes)
                if value > best:
                    best, shifts[c] = value, present + move
    return shifts.cpu(), before, best


@torch.no_grad()
def collect(model: InverseMatrixVT3D, rig: Rig, frames: Frames, device: torch.device) -> tuple:
    """Logits [V, K] and labels [V] of all voxels of all frames that are not ignored, on the device."""
    model = model.to(device).eval()
    logits, labels = [], []
    for number in range(len(frames)):
        batch = frames.batch([number])
        of_frame = model(batch["images"].to(device), rig)[0].flatten(0, -2)
        truth = batch["labels"][0].flatten().long().to(device)
        counted = truth != IGNORED
        logits.append(of_frame[counted])
        labels.append(truth[counted])
    return torch.cat(logits), torch.cat(labels)


def calibrated(model: InverseMatrixVT3D, rig: Rig, frames: Frames, device: torch.device) -> dict:
    """A model's weights with the shifts that suit these frames; prints what they change. `rig` is on the device."""
    logits, labels = collect(model, rig, frames, device)
    shifts, before, after = fit_shifts(logits, labels)
    print(f"mIoU of {len(frames)} frames: {before:.2f}, with shifts {after:.2f}")
    print("shifts: " + " ".join(f"{shift:+.2f}" for shift in shifts.tolist()), flush=True)
    weights = {name: tensor.cpu() for name, tensor in model.state_dict().items()}
    return {**weights, BIAS: weights[BIAS].float() + shifts}


def main() -> int:
    parser = argparse.ArgumentParser(prog="voxcast_train.calibrate", description="Shift the logits of each class.")
    parser.add_argument("--network", required=True)
    parser.add_argument("--checkpoint", required=True)
    parser.add_argument("--rig", required=True)
    parser.add_argument("--set", required=True, action="append")
    parser.add_argument("--limit", type=int, help="the first so many frames; each takes some 6 MB")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("-o", "--output", required=True, help="the checkpoint to write")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    try:
        network = Network.load(options.network)
        frames = Frames(options.set, network, pixels=False, limit=options.limit)
        device = torch.device(options.device)
        rig = Rigs([Rig.load(options.rig, network)], device).select(0)
        export(calibrated(load_model(network, options.checkpoint), rig, frames, device), options.output)
    except (InputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())

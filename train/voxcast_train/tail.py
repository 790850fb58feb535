"""Trains the last stage alone: what makes the classes of level 0 out of the volume of level 1.

    python -m voxcast_train.tail --network network.json --checkpoint checkpoint.safetensors --rig rig.safetensors --set DIR \\
        --steps 400 -o better.safetensors

Most of a network's time goes into what comes before. That is run once for every frame, and its result is kept; a step then
takes a tenth of a whole one's time, which makes it something that a CPU can do. Batch norms keep their statistics. Use frames that
nothing was trained on: the volumes of others are better than those of new streets are.
"""

import argparse
import math
import sys
import time

import torch
from torch import Tensor, nn

from .config import Phase, Tail
from .data import Frames, kept_cameras, order
from .errors import InputError
from .evaluate import load_model
from .export import export
from .losses import level_losses
from .network import InverseMatrixVT3D, Network
from .rig import Rig, Rigs

STAGE = ("view_transformer.up_sample1.", "view_transformer.refine_lvl0.", "occ_head.mlp_occ_lvl0.")

PHASE = Phase(focal=2.0, lovasz=3.0, geometric=0.5, semantic=0.2, class_power=0.1)
"""Weights of the losses: those of the end of a run."""

DECAY = 0.99
"""Of the running average of the weights, which is what is kept."""


@torch.no_grad()
def coarse_volumes(model: InverseMatrixVT3D, rig: Rig, frames: Frames, masked: float, device: torch.device) -> Tensor:
    """Volumes [frames, C, X, Y, Z] of level 1, f16; of a share of the frames without one of the cameras."""
    volumes = []
    for number in range(len(frames)):
        images = frames.batch([number])["images"].to(device)
        kept = kept_cameras(1, model.network.cameras, masked, device) if masked > 0 else None
        volumes.append(model.view_transformer.coarse(model.pyramid(images), rig, 1, kept)[0].half())
    return torch.cat(volumes)


def train_tail(model: InverseMatrixVT3D, rig: Rig, frames: Frames, tail: Tail, device: torch.device, seed: int = 0) -> None:
    """Changes the weights of the last stage of `model` in place. `rig` is on the device."""
    from .train import class_weights  # which itself needs nothing from here

    torch.manual_seed(seed)
    model.to(device).eval()
    volumes = coarse_volumes(model, rig, frames, tail.masked, device)
    labels = frames.columns["labels0"]
    weights = class_weights(frames.class_counts(), PHASE.class_power).to(device)
    parameters = [p for name, p in model.named_parameters() if name.startswith(STAGE)]
    for parameter in parameters:
        parameter.requires_grad_(True)
    optimiser = torch.optim.AdamW(parameters, lr=tail.learning_rate, weight_decay=1e-4, fused=True)
    average = [p.detach().clone() for p in parameters]
    started, shown = time.monotonic(), []
    for step in range(tail.steps):
        numbers = order(seed, len(frames), tail.batch, step)
        fine = model.view_transformer.fine(volumes[numbers].float())
        logits = model.occ_head((fine,), (0,))[0]
        losses = level_losses(logits, labels[numbers].to(device), weights, tail.lovasz_voxels)
        total = sum(getattr(PHASE, name) * loss for name, loss in losses.items())
        warm = min(1.0, (step + 1) / 20)
        for group in optimiser.param_groups:
            group["lr"] = tail.learning_rate * warm * 0.5 * (1.0 + math.cos(math.pi * step / tail.steps))
        optimiser.zero_grad(set_to_none=True)
        total.backward()
        nn.utils.clip_grad_norm_(parameters, 10.0, foreach=True)
        optimiser.step()
        with torch.no_grad():
            torch._foreach_lerp_(average, parameters, 1.0 - min(DECAY, (1.0 + step) / (10.0 + step)))
        shown.append({name: float(loss.detach()) for name, loss in losses.items()})
        if len(shown) == 20 or step + 1 == tail.steps:
            means = "  ".join(f"{name} {sum(row[name] for row in shown) / len(shown):.3f}" for name in shown[0])
            print(f"tail {step + 1}/{tail.steps}  {means}  {(time.monotonic() - started) / (step + 1):.2f} s a step", flush=True)
            shown = []
    with torch.no_grad():
        for parameter, value in zip(parameters, average):
            parameter.copy_(value)


def main() -> int:
    parser = argparse.ArgumentParser(prog="voxcast_train.tail", description="Train the last stage of a network alone.")
    parser.add_argument("--network", required=True)
    parser.add_argument("--checkpoint", required=True, help="of voxcast_train.export")
    parser.add_argument("--rig", required=True)
    parser.add_argument("--set", required=True, action="append", help="a set of frames; may be given again")
    parser.add_argument("--limit", type=int, help="the first so many frames; each takes some 3 MB")
    parser.add_argument("--steps", type=int, default=Tail.steps)
    parser.add_argument("--batch", type=int, default=Tail.batch)
    parser.add_argument("--learning-rate", type=float, default=Tail.learning_rate)
    parser.add_argument("--masked", type=float, default=Tail.masked, help="share of the frames that lose a camera")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("-o", "--output", required=True, help="the checkpoint to write")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    try:
        network, device = Network.load(options.network), torch.device(options.device)
        frames = Frames(options.set, network, pixels=False, limit=options.limit)
        rig = Rigs([Rig.load(options.rig, network)], device).select(0)
        model = load_model(network, options.checkpoint)
        tail = Tail(steps=options.steps, batch=options.batch, learning_rate=options.learning_rate, masked=options.masked)
        train_tail(model, rig, frames, tail, device, options.seed)
        export(model.state_dict(), options.output, half=True)
    except (InputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())

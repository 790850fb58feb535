"""Trains the end of a network alone: the last stage, which makes the classes of level 0 out of the volume of level 1, or, with
`--volumes`, everything behind the gather.

    python -m voxcast_train.tail --network network.json --checkpoint checkpoint.safetensors --rig rig.safetensors --set DIR \\
        --steps 400 -o better.safetensors

Most of a network's time goes into what comes before. That is run once for every frame, and its result is kept; a step then
takes a tenth of a whole one's time, or a third, which makes it something that a CPU can do. Batch norms keep their statistics. Use
frames that nothing was trained on: what the network makes of others is better than what it makes of new streets.

With `--state`, the position of the run is saved there, and the averaged weights so far in the output, every few minutes. Started again,
it takes the steps that an uninterrupted run would have taken.
"""

import argparse
import math
import sys
import time
from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor, nn

from .config import Phase, Tail
from .data import Frames, kept_cameras, order
from .errors import InputError
from .evaluate import load_model
from .export import export
from .files import replace
from .losses import level_losses
from .network import InverseMatrixVT3D, Network
from .rig import Rig, Rigs

STAGE = ("view_transformer.up_sample1.", "view_transformer.refine_lvl0.", "occ_head.mlp_occ_lvl0.")
"""How parameters of the last stage begin."""

VOLUMES = ("view_transformer.", "occ_head.mlp_occ_lvl0.")
"""And those of everything behind the gather."""

PHASE = Phase(focal=2.0, lovasz=3.0, geometric=0.5, semantic=0.2, class_power=0.1)
"""Weights of the losses: those of the end of a run."""

SAVE_SECONDS = 180.0
"""Between two savings."""


@torch.no_grad()
def inputs_of(model: InverseMatrixVT3D, rig: Rig, frames: Frames, tail: Tail, device: torch.device) -> Tensor:
    """What the trained part is given of each frame, f16: the volume [C, X, Y, Z] of level 1 or all that is gathered, one row after
    the other [rows, C]; of a share of the frames without one of the cameras."""
    view = model.view_transformer
    rows = []
    for number in range(len(frames)):
        images = frames.batch([number])["images"].to(device)
        kept = kept_cameras(1, model.network.cameras, tail.masked, device) if tail.masked > 0 else None
        with torch.autocast(device.type, torch.bfloat16, enabled=tail.precision == "bf16"):
            gathered = view.gather(model.pyramid(images), rig, 1, kept)
            row = torch.cat([mean for means in gathered for mean in means], 1) if tail.volumes else view.coarse(gathered)[0]
        if number == 0:
            rows = torch.empty((len(frames), *row.shape[1:]), dtype=torch.float16, device=device)
        rows[number] = row[0]
    return rows


def logits_of(model: InverseMatrixVT3D, inputs: Tensor, tail: Tail) -> Tensor:
    """Logits of level 0 from a batch of `inputs_of`."""
    view, volume = model.view_transformer, inputs.float()
    if tail.volumes:
        means = volume.split([count for x, y, z in model.network.grids for count in (x * y * z, x * y)], 1)
        volume = view.coarse(list(zip(means[::2], means[1::2])))[0]
    return model.occ_head((view.fine(volume),), (0,))[0]


class Run:
    """Parameters that are trained, their running average and the optimiser; and where they are saved, if anywhere."""

    def __init__(self, parameters: list, tail: Tail, identity: dict, state: Path | None):
        self.parameters, self.identity, self.state = parameters, identity, state
        self.optimiser = torch.optim.AdamW(parameters, lr=tail.learning_rate, weight_decay=1e-4, fused=True)
        self.average = [p.detach().clone() for p in parameters]
        self.step, self.seconds = 0, 0.0
        if state is not None and state.exists():
            self._load()

    def _load(self) -> None:
        saved = torch.load(self.state, map_location=self.average[0].device, weights_only=True)
        found = saved["identity"]
        for key, value in self.identity.items():
            if value != found.get(key):
                raise InputError(f"{self.state}: {key}: found {found.get(key)}, expected {value}; remove it to start anew")
        self.step, self.seconds = saved["step"], saved["seconds"]
        self.optimiser.load_state_dict(saved["optimiser"])
        with torch.no_grad():
            torch._foreach_copy_(self.parameters, saved["parameters"])
            torch._foreach_copy_(self.average, saved["average"])

    def save(self) -> None:
        values = {"parameters": [p.detach() for p in self.parameters], "average": self.average, "optimiser": self.optimiser.state_dict()}
        values |= {"identity": self.identity, "step": self.step, "seconds": self.seconds}
        replace(self.state, lambda temporary: torch.save(values, temporary))


def train_tail(model: InverseMatrixVT3D, sets: list, tail: Tail, device: torch.device, seed: int = 0, state: Path | None = None,
               output: Path | None = None, save_seconds: float = SAVE_SECONDS) -> int:  # fmt: skip
    """Changes the weights of the end of `model` in place. `sets` are pairs of a rig, which is on the device, and the frames that were
    drawn for it. With `state`, the run is saved there every so many seconds and continued from there, and the averaged weights are
    written to `output`. Returns the number of steps. Raises InputError for the state of another run."""
    from .train import class_weights  # which itself needs nothing from here

    torch.manual_seed(seed)
    model.to(device).eval().requires_grad_(False)
    named = {name: p for name, p in model.named_parameters() if name.startswith(VOLUMES if tail.volumes else STAGE)}
    labels = torch.cat([frames.columns["labels0"] for _, frames in sets])
    identity = {key: value for key, value in asdict(tail).items() if key not in ("steps", "minutes")}
    run = Run(list(named.values()), tail, {**identity, "frames": len(labels), "seed": seed}, state)
    inputs = torch.cat([inputs_of(model, rig, frames, tail, device) for rig, frames in sets])
    weights = class_weights(sum(frames.class_counts() for _, frames in sets), PHASE.class_power).to(device)
    for parameter in run.parameters:
        parameter.requires_grad_(True)

    def position() -> float:
        return run.step / tail.steps if tail.minutes is None else run.seconds / (60.0 * tail.minutes)

    def save() -> None:
        run.save()
        if output is not None:
            export({**model.state_dict(), **dict(zip(named, run.average))}, output, half=True)

    started, saved, shown = time.monotonic() - run.seconds, run.seconds, []
    while (done := position()) < 1.0:
        # Of the step alone, so that an interrupted run goes on as it would have.
        torch.manual_seed(seed * 1_000_003 + run.step)
        numbers = order(seed, len(labels), tail.batch, run.step)
        with torch.autocast(device.type, torch.bfloat16, enabled=tail.precision == "bf16"):
            logits = logits_of(model, inputs[numbers], tail)
        losses = level_losses(logits, labels[numbers].to(device), weights, tail.lovasz_voxels)
        total = sum(getattr(PHASE, name) * loss for name, loss in losses.items())
        warm = min(1.0, (run.step + 1) / 20)
        for group in run.optimiser.param_groups:
            group["lr"] = tail.learning_rate * warm * 0.5 * (1.0 + math.cos(math.pi * done))
        run.optimiser.zero_grad(set_to_none=True)
        total.backward()
        nn.utils.clip_grad_norm_(run.parameters, 10.0, foreach=True)
        run.optimiser.step()
        with torch.no_grad():
            torch._foreach_lerp_(run.average, run.parameters, 1.0 - min(tail.average, (1.0 + run.step) / (10.0 + run.step)))
        shown.append({name: float(loss.detach()) for name, loss in losses.items()})
        run.step += 1
        run.seconds = time.monotonic() - started
        done = position()
        if len(shown) == 20 or done >= 1.0:
            means = "  ".join(f"{name} {sum(row[name] for row in shown) / len(shown):.3f}" for name in shown[0])
            print(f"tail {run.step}, {100 * min(done, 1.0):.0f} %  {means}  {run.seconds / run.step:.2f} s a step", flush=True)
            shown = []
        if state is not None and (run.seconds - saved >= save_seconds or done >= 1.0):
            save()
            saved = run.seconds
    with torch.no_grad():
        torch._foreach_copy_(run.parameters, run.average)
    return run.step


def main() -> int:
    parser = argparse.ArgumentParser(prog="voxcast_train.tail", description="Train the end of a network alone.")
    parser.add_argument("--network", required=True)
    parser.add_argument("--checkpoint", required=True, help="of voxcast_train.export")
    parser.add_argument("--rig", required=True, action="append", help="given again: one for each --set, in the same order")
    parser.add_argument("--set", required=True, action="append", help="a set of frames; may be given again")
    parser.add_argument("--limit", type=int, help="the first so many frames of each set; each takes some 3 MB")
    parser.add_argument("--volumes", action="store_true", help="train everything behind the gather, not the last stage alone")
    parser.add_argument("--steps", type=int, default=Tail.steps)
    parser.add_argument("--minutes", type=float, help="time to train for, instead of steps")
    parser.add_argument("--batch", type=int, default=Tail.batch)
    parser.add_argument("--learning-rate", type=float, default=Tail.learning_rate)
    parser.add_argument("--average", type=float, default=Tail.average, help="decay of the running average, which is what is kept")
    parser.add_argument("--lovasz-voxels", type=int, default=Tail.lovasz_voxels, help="those that Lovasz-softmax sees of a batch")
    parser.add_argument("--masked", type=float, default=Tail.masked, help="share of the frames that lose a camera")
    parser.add_argument("--precision", choices=("f32", "bf16"), default=Tail.precision)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--state", type=Path, help="where the run is saved, and continued from")
    parser.add_argument("-o", "--output", required=True, type=Path, help="the checkpoint to write")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    try:
        network, device = Network.load(options.network), torch.device(options.device)
        if len(options.rig) not in (1, len(options.set)):
            raise InputError(f"--rig: found {len(options.rig)}, expected one, or one for each of the {len(options.set)} sets")
        loaded = [Rigs([Rig.load(path, network)], device).select(0) for path in options.rig]
        sets = [Frames([path], network, pixels=False, limit=options.limit) for path in options.set]
        model = load_model(network, options.checkpoint)
        tail = Tail(steps=options.steps, minutes=options.minutes, batch=options.batch, learning_rate=options.learning_rate,
                    masked=options.masked, lovasz_voxels=options.lovasz_voxels, volumes=options.volumes,
                    precision=options.precision, average=options.average)  # fmt: skip
        pairs = list(zip(loaded * len(sets) if len(loaded) == 1 else loaded, sets))
        train_tail(model, pairs, tail, device, options.seed, options.state, options.output)
        export(model.state_dict(), options.output, half=True)
    except (InputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())

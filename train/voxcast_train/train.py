"""Trains a network.

    python -m voxcast_train.train --config edge/config.json --work DIR --from MODEL

DIR holds `train/` and `tune/` (sets of `voxcast synth`) and `rig.safetensors`. The run writes `state.pt` (everything needed to
continue), `log.jsonl` and `curve.png` there. Started again, it continues where the last saved state was; every random draw
follows from the seed and the number of the step, so the steps are those that an uninterrupted run would have taken.
"""

import argparse
import json
import math
import sys
import time
from pathlib import Path

import torch
from torch import nn

from .auxiliary import AuxiliaryHeads
from .config import Config
from .data import Frames, augment, order
from .errors import InputError
from .evaluate import evaluate
from .files import replace
from .losses import LEVEL_WEIGHTS, level_losses
from .network import InverseMatrixVT3D, initialise
from .plot import draw_curve
from .rig import Rig
from .unpack import restore_norms, unpack
from .workers import Worker, run_workers

FINAL_AUXILIARY = 0.2

START_FRAMES = 16
"""Frames that the statistics of batch norms are measured on when training starts from a model."""


def rate(config: Config, step: int) -> float:
    """Learning rate of a step over the peak."""
    warm = min(1.0, (step + 1 - config.warmed_from(step)) / max(1, config.warm_up))
    return warm * 0.5 * (1.0 + math.cos(math.pi * min(1.0, step / config.steps)))


def class_weights(counts: torch.Tensor, power: float) -> torch.Tensor:
    """count^-power, scaled to a mean of 1 over the classes that occur; 1 for those that do not."""
    weights = counts.clamp(min=1).double() ** -power
    occurs = counts > 0
    weights = weights / weights[occurs].mean()
    return torch.where(occurs, weights, torch.ones_like(weights)).float()


def normalised_biases(model: nn.Module) -> set:
    """Names of the biases of convolutions that a batch norm follows."""
    names = set()
    for prefix, module in model.named_modules():
        if isinstance(module, nn.Sequential):
            for (name, layer), following in zip(module.named_children(), list(module.children())[1:]):
                if isinstance(following, (nn.BatchNorm2d, nn.BatchNorm3d)) and getattr(layer, "bias", None) is not None:
                    names.add(f"{prefix}.{name}.bias")
    return names


class Training:
    """Model, optimiser and position of a run."""

    def __init__(self, config: Config, rig: Rig, device: torch.device, worker: Worker):
        torch.manual_seed(config.seed)
        self.config, self.device, self.worker = config, device, worker
        self.batch = config.batch // worker.count
        network = config.load_network()
        self.model = InverseMatrixVT3D(network)
        initialise(self.model)
        for module in self.model.modules():
            if isinstance(module, (nn.BatchNorm2d, nn.BatchNorm3d)):
                module.momentum = config.momentum
        self.heads = AuxiliaryHeads(network)
        self.model.to(device)
        self.heads.to(device)
        self.average = InverseMatrixVT3D(network).to(device).requires_grad_(False)
        self.average.load_state_dict(self.model.state_dict())
        # Tensors of the two that correspond; loading a state fills them in place.
        averaged, trained = self.average.state_dict(), self.model.state_dict()
        names = [name for name, tensor in averaged.items() if tensor.is_floating_point()]
        self.averaged, self.trained = ([tensors[name] for name in names] for tensors in (averaged, trained))
        self.rig = rig.to(device)
        self.optimiser = self._optimiser()
        self.step = 0
        self.seconds = 0.0

    def _optimiser(self) -> torch.optim.Optimizer:
        config = self.config
        groups = {}
        # A batch norm takes away what the bias before it adds; left in, Adam would follow the rounding of its gradient.
        redundant = normalised_biases(self.model)
        for owner, module in (("model", self.model), ("heads", self.heads)):
            for name, parameter in module.named_parameters():
                if name in redundant:
                    parameter.requires_grad_(False)
                    continue
                backbone = owner == "model" and name.startswith("img_backbone.")
                # Scales, shifts and biases are not decayed.
                groups.setdefault((backbone, parameter.ndim > 1), []).append(parameter)
        options = [
            {
                "params": parameters,
                "factor": config.backbone_factor if backbone else 1.0,
                "weight_decay": config.weight_decay if decayed else 0.0,
            }
            for (backbone, decayed), parameters in groups.items()
        ]
        return torch.optim.AdamW(options, lr=config.learning_rate, fused=True)

    def autocast(self):
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.config.precision == "bf16")

    def take_step(self, frames: Frames, counts: torch.Tensor) -> dict:
        """One batch: forward, backward, update. Returns the losses of this worker's part as numbers.

        `counts` are the voxels of each class over all frames of all workers.
        """
        config, worker = self.config, self.worker
        torch.manual_seed((config.seed * 1_000_003 + self.step) * worker.count + worker.rank)
        batch = frames.batch(order(config.seed, len(frames), self.batch, self.step))
        images = augment(batch["images"]).to(self.device)
        phase = config.phase(self.step)
        truth = [batch[name].to(self.device) for name in ("pixel_class", "pixel_depth")]
        with self.autocast():
            pyramid = self.model.pyramid(images)
            auxiliary = {f"pixel_{name}": loss for name, loss in self.heads.pixels.losses(pyramid, *truth).items()}
            if phase.volumes:
                volumes = self.model.volumes(pyramid, self.rig, self.batch)
                auxiliary["voxel_place"] = self.heads.places.loss(volumes[1:])
                logits = self.model.occ_head(volumes, range(4))
        parts = dict(auxiliary)
        total = self.auxiliary_weight() * sum(auxiliary.values())
        if phase.volumes:
            weights = class_weights(counts, phase.class_power).to(self.device)
            for level, level_weight in enumerate(LEVEL_WEIGHTS):
                losses = level_losses(logits[level], batch["labels"][level].to(self.device), weights, config.lovasz_voxels)
                total = total + level_weight * sum(getattr(phase, name) * loss for name, loss in losses.items())
                parts.update({f"{name}{level}": loss for name, loss in losses.items()})
        for group in self.optimiser.param_groups:
            group["lr"] = config.learning_rate * group["factor"] * rate(config, self.step)
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()
        parameters = [p for group in self.optimiser.param_groups for p in group["params"] if p.grad is not None]
        worker.average_gradients(parameters)
        norm = nn.utils.clip_grad_norm_(parameters, config.clip)
        if not bool(norm.isfinite()):
            raise InputError(f"step {self.step}: the gradient is not finite; lower the learning rate")
        self.optimiser.step()
        self._update_average()
        self.step += 1
        values = {"total": total, "gradient": norm, **parts}
        return {name: float(value.detach()) for name, value in values.items()}

    def row(self, kind: str, **values) -> dict:
        """A line of the log."""
        return {"kind": kind, "step": self.step, "seconds": round(self.seconds, 1), **values}

    def auxiliary_weight(self) -> float:
        done = min(1.0, self.step / self.config.steps)
        return self.config.auxiliary * (1.0 - (1.0 - FINAL_AUXILIARY) * done)

    def _update_average(self) -> None:
        # Early on the average would remember the start for too long.
        decay = min(self.config.average, (1.0 + self.step) / (10.0 + self.step))
        with torch.no_grad():
            torch._foreach_lerp_(self.averaged, self.trained, 1.0 - decay)

    def start_from(self, path: Path, frames: Frames) -> None:
        """Takes the weights of a model file. Raises InputError if it belongs to another network."""
        unpack(path, self.model)
        with torch.no_grad():
            images = frames.batch(list(range(min(START_FRAMES, len(frames)))))["images"].to(self.device)
            restore_norms(self.model, lambda: self.model(images, self.rig, range(4)))
        self.worker.copy_first([*self.model.parameters(), *self.model.buffers()])
        self.average.load_state_dict(self.model.state_dict())

    def save(self, path: Path) -> None:
        state = {
            "identity": self.config.identity(),
            "step": self.step,
            "seconds": self.seconds,
            "model": self.model.state_dict(),
            "heads": self.heads.state_dict(),
            "average": self.average.state_dict(),
            "optimiser": self.optimiser.state_dict(),
        }
        replace(path, lambda temporary: torch.save(state, temporary))

    def load(self, path: Path) -> None:
        """Continues from a saved state. Raises InputError if it belongs to another config."""
        state = torch.load(path, map_location=self.device, weights_only=True)
        mine, found = self.config.identity(), state["identity"]
        for key in mine:
            if mine[key] != found.get(key):
                raise InputError(f'{path}: "{key}": found {found.get(key)}, expected {mine[key]} of the config; remove it to start anew')
        self.step, self.seconds = state["step"], state["seconds"]
        self.model.load_state_dict(state["model"])
        self.heads.load_state_dict(state["heads"])
        self.average.load_state_dict(state["average"])
        self.optimiser.load_state_dict(state["optimiser"])


class Log:
    """One JSON object a line: {"kind": "train" | "evaluate" | "sets", "step", ...}."""

    def __init__(self, path: Path, step: int):
        self.path = path
        rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
        # Rows after the saved state belong to steps that will be taken again.
        self.rows = [row for row in rows if row["step"] <= step]
        text = "".join(json.dumps(row) + "\n" for row in self.rows)
        replace(path, lambda temporary: temporary.write_text(text))

    def add(self, row: dict) -> None:
        self.rows.append(row)
        with self.path.open("a") as file:
            file.write(json.dumps(row) + "\n")


def mean_of(rows: list) -> dict:
    """Means by name, each over the rows that have it."""
    names = {name: [row[name] for row in rows if name in row] for row in rows for name in row}
    return {name: round(sum(values) / len(values), 6) for name, values in names.items()}


def run(config: Config, work: Path, device: torch.device, start: Path | None = None) -> None:
    """Trains until the last step, from the saved state if there is one, else from the weights of the model file `start`,
    else from nothing."""
    run_workers(config.workers, run_worker, (config, work, device, start))


def run_worker(config: Config, work: Path, device: torch.device, start: Path | None, worker: Worker) -> None:
    torch.set_num_threads(config.threads)
    network = config.load_network()
    rig = Rig.load(work / "rig.safetensors", network)
    training = Training(config, rig, device, worker)
    state = work / "state.pt"
    if state.exists():
        training.load(state)
    share = (worker.rank, worker.count)
    frames = Frames([work / "train"], network, True, config.train.count, share)
    tuning = Frames([work / "tune"], network, False, config.tune.count, share)
    if frames.available != config.train.count:
        raise InputError(f"{work / 'train'}: found {frames.available} frames, expected {config.train.count} of the config")
    if config.after is not None and start is None and not state.exists():
        raise InputError(f'"after": the run starts from the model of {config.after}; give it with --from')
    if start is not None and not state.exists():
        training.start_from(start, frames)
    counts = worker.sum(frames.class_counts())
    log = Log(work / "log.jsonl", training.step) if worker.first else None
    if worker.first:
        print(f"{frames.available} frames, {config.steps} steps of {config.batch}, from step {training.step}", flush=True)
    recent, started = [], time.monotonic() - training.seconds
    while training.step < config.steps:
        worker.check()
        recent.append(training.take_step(frames, counts))
        training.seconds = time.monotonic() - started
        step = training.step
        last = step == config.steps
        if step % config.log_every == 0 or last:
            if worker.first:
                log.add(training.row("train", rate=rate(config, step - 1), **mean_of(recent)))
                report_progress(config, training, log.rows[-1])
            recent = []
        if step % config.evaluate_every == 0 or last:
            confusion = evaluate(training.average, rig, tuning, device, config.precision)
            worker.sum(confusion.counts)
            training.seconds = time.monotonic() - started
            if worker.first:
                report = confusion.report()
                log.add(training.row("evaluate", **report))
                print(f"step {step}: tuning IoU {report['all']['iou']:.2f}, mIoU {report['all']['miou']:.2f}", flush=True)
                draw_curve(log.rows, work / "curve.png")
        if worker.first and (step % config.save_every == 0 or last):
            training.save(state)


def report_progress(config: Config, training: Training, row: dict) -> None:
    left = (config.steps - training.step) * training.seconds / training.step
    shown = ("total", "focal0", "lovasz0", "geometric0", "semantic0", "pixel_class", "pixel_depth", "pixel_place", "voxel_place")
    losses = "  ".join(f"{name} {row[name]:.3f}" for name in shown if name in row)
    print(
        f"step {training.step}/{config.steps}  {losses}  gradient {row['gradient']:.2f}  "
        f"{training.seconds / training.step:.3f} s a step, {left / 60.0:.0f} min left",
        flush=True,
    )


def main() -> int:
    parser = argparse.ArgumentParser(prog="voxcast_train.train", description="Train a network.")
    parser.add_argument("--config", required=True, help="the run's JSON, beside its network.json")
    parser.add_argument("--work", required=True, type=Path, help="holds train/, tune/ and rig.safetensors; receives the results")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--from", dest="start", type=Path, metavar="MODEL", help="start from the weights of a model file")
    options = parser.parse_args()
    try:
        run(Config.load(options.config), options.work, torch.device(options.device), options.start)
    except (InputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())

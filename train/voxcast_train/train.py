"""Trains a network.

    python -m voxcast_train.train --config edge/config.json --work DIR --from MODEL
    python -m voxcast_train.train --config edge/gpu.json --work DIR --from CHECKPOINT --voxcast ../target/release/voxcast --minutes 8

DIR holds `train/` and `tune/` (sets of `voxcast synth`) and `rig.safetensors`; where frames are drawn beside the training,
`tune/` and `rigs/NN` instead. The run writes `state.pt` (everything needed to continue), `average.safetensors` (the averaged
weights, for `voxcast import`), `log.jsonl` and `curve.png` there. Started again, it continues where the last saved state was. With
frames drawn before, every random draw follows from the seed and the number of the step, so the steps are those that an
uninterrupted run would have taken.

A step is one function of tensors whose shapes never change. On a GPU it is recorded once and replayed as a CUDA graph, since
launching its few thousand kernels one by one takes longer than running them.
"""

import argparse
import json
import math
import os
import sys
import time
from dataclasses import replace as changed
from pathlib import Path

import torch
from torch import nn

from .auxiliary import AuxiliaryHeads
from .config import Config
from .data import Frames, augment, kept_cameras, order
from .drawing import Drawing, Pool
from .errors import InputError
from .evaluate import evaluate, load_weights
from .export import export
from .files import replace
from .losses import LEVEL_WEIGHTS, level_losses
from .network import InverseMatrixVT3D, initialise
from .plot import draw_curve
from .program import Program
from .rig import Rig, Rigs
from .unpack import restore_norms
from .workers import Worker, run_workers

FINAL_AUXILIARY = 0.2

START_FRAMES = 16
"""Frames that the statistics of batch norms are measured on when training starts from a model."""


LOSSES = ("focal", "lovasz", "geometric", "semantic")

WARM_UP = 3
"""Steps that are taken before one is recorded, so that every library has chosen its algorithms."""


def rate(config: Config, step: float) -> float:
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

    def __init__(self, config: Config, rigs: Rigs, device: torch.device, worker: Worker):
        torch.manual_seed(config.seed)
        torch.backends.cudnn.benchmark = True
        self.config, self.device, self.worker = config, device, worker
        self.batch = config.batch // worker.count
        network = config.load_network()
        self.network = network
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
        self.rigs = rigs
        self.optimiser = self._optimiser()
        self.step = 0
        self.seconds = 0.0
        # What changes from step to step, as tensors on the device: a recorded step reads them when it is replayed.
        self.controls = {
            "auxiliary": torch.zeros((), device=device),
            "losses": torch.zeros(len(LOSSES), device=device),
            "classes": torch.ones(network.classes, device=device),
            "follow": torch.zeros((), device=device),
            "rig": torch.zeros(1, dtype=torch.int64, device=device),
        }
        self.class_counts = torch.ones(network.classes)
        # Names of a step's losses, with and without volumes, and of the last one's.
        self.names, self.last_names = {}, []
        self.recorded = {}
        self.failed_recording = False

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
        self.optimiser = torch.optim.AdamW(options, lr=config.learning_rate, fused=True, capturable=self.device.type == "cuda")
        self._place_rates()
        return self.optimiser

    def _place_rates(self) -> None:
        """On a GPU the rates are tensors there, for recorded steps."""
        if self.device.type == "cuda":
            for group in self.optimiser.param_groups:
                group["lr"] = torch.tensor(float(group["lr"]), device=self.device)

    def autocast(self):
        # A cast of a weight that is kept between steps would be an old one when a recorded step is replayed.
        bf16 = self.config.precision == "bf16"
        return torch.autocast(self.device.type, torch.bfloat16, enabled=bf16, cache_enabled=self.device.type != "cuda")

    @property
    def position(self) -> float:
        """Where in the plan the run is, from 0 to `steps`: the step, or the share of the time that is over."""
        config = self.config
        if config.minutes is None:
            return self.step
        return config.steps * min(1.0, self.seconds / (60.0 * config.minutes))

    @property
    def done(self) -> bool:
        return self.position >= self.config.steps

    def take_step(self, frames, rig: int = 0) -> torch.Tensor:
        """One batch of `frames`, a `Frames` or a `Pool`: forward, backward, update. Returns, on the device, the losses of this
        worker's part, by `names` of the phase; nothing waits for them."""
        phase = self.config.phase(self.position)
        self._set_controls(phase, rig)
        volumes = phase.volumes
        if isinstance(frames, Pool):
            values = self._replay(frames, volumes)
        else:
            config, worker = self.config, self.worker
            torch.manual_seed((config.seed * 1_000_003 + self.step) * worker.count + worker.rank)
            batch = frames.batch(order(config.seed, len(frames), self.batch, self.step))
            values = self._compute(batch, volumes)
        self.last_names = self.names[volumes]
        self.step += 1
        return values

    def _set_controls(self, phase, rig: int) -> None:
        config, controls = self.config, self.controls
        if self.worker.count == 1 and self.device.type == "cuda":
            to = {"dtype": torch.float32, "pin_memory": True}
        else:
            to = {"dtype": torch.float32}
        weights = class_weights(self.class_counts, phase.class_power)
        values = [self.auxiliary_weight(), *(getattr(phase, name) for name in LOSSES), self.follow(), *weights.tolist()]
        values = torch.tensor(values, **to).to(self.device, non_blocking=True)
        k = 1 + len(LOSSES)
        for name, part in (("auxiliary", values[0]), ("losses", values[1:k]), ("follow", values[k]), ("classes", values[k + 1 :])):
            controls[name].copy_(part)
        controls["rig"].fill_(rig)
        for group in self.optimiser.param_groups:
            value = config.learning_rate * group["factor"] * rate(config, self.position)
            if isinstance(group["lr"], torch.Tensor):
                group["lr"].fill_(value)
            else:
                group["lr"] = value

    def follow(self) -> float:
        """Share by which the average moves towards the weights. Early on it would remember the start for too long."""
        return 1.0 - min(self.config.average, (1.0 + self.step) / (10.0 + self.step))

    def _compute(self, batch: dict, volumes: bool) -> torch.Tensor:
        """Everything a step does, as a function of the batch and the controls."""
        config, controls = self.config, self.controls
        images = augment(batch["images"].to(self.device))
        truth = [batch[name].to(self.device) for name in ("pixel_class", "pixel_depth")]
        count, cameras = images.shape[:2]
        with self.autocast():
            pyramid = self.model.pyramid(images)
            auxiliary = {f"pixel_{name}": loss for name, loss in self.heads.pixels.losses(pyramid, *truth).items()}
            if volumes:
                kept = kept_cameras(count, cameras, config.masked, self.device) if config.masked > 0 else None
                rig = self.rigs.select(controls["rig"])
                features = self.model.volumes(pyramid, rig, count, kept)
                auxiliary["voxel_place"] = self.heads.places.loss(features[1:])
                logits = self.model.occ_head(features, range(4))
        parts = dict(auxiliary)
        total = controls["auxiliary"] * sum(auxiliary.values())
        if volumes:
            for level, level_weight in enumerate(LEVEL_WEIGHTS):
                labels = batch["labels"][level].to(self.device)
                losses = level_losses(logits[level], labels, controls["classes"], config.lovasz_voxels)
                total = total + level_weight * sum(controls["losses"][n] * losses[name] for n, name in enumerate(LOSSES))
                parts.update({f"{name}{level}": loss for name, loss in losses.items()})
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()
        parameters = [p for group in self.optimiser.param_groups for p in group["params"] if p.grad is not None]
        self.worker.average_gradients(parameters)
        norm = nn.utils.clip_grad_norm_(parameters, config.clip, foreach=True)
        # The optimiser leaves the weights alone if the gradient is not finite. The run ends when that is seen.
        self.optimiser.found_inf = (~norm.isfinite()).float()
        self.optimiser.step()
        with torch.no_grad():
            moves = torch._foreach_sub(self.trained, self.averaged)
            torch._foreach_mul_(moves, controls["follow"])
            torch._foreach_add_(self.averaged, moves)
        values = {"total": total, "gradient": norm, **parts}
        self.names[volumes] = list(values)
        return torch.stack([value.detach().float() for value in values.values()])

    def _compute_of(self, pool: Pool, volumes: bool) -> torch.Tensor:
        return self._compute(pool.batch(self.controls["rig"], self.batch), volumes)

    def _replay(self, pool: Pool, volumes: bool) -> torch.Tensor:
        """A step with frames of a pool; from the fourth one of its kind on, recorded on a GPU."""
        if self.device.type != "cuda" or self.failed_recording:
            return self._compute_of(pool, volumes)
        taken, graph, values = self.recorded.get(volumes, (0, None, None))
        if graph is not None:
            graph.replay()
            # The next replay overwrites it.
            return values.clone()
        if taken < WARM_UP:
            self.recorded[volumes] = (taken + 1, None, None)
            side = torch.cuda.Stream()
            side.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(side):
                values = self._compute_of(pool, volumes)
            torch.cuda.current_stream().wait_stream(side)
            return values
        self.optimiser.zero_grad(set_to_none=True)
        graph = torch.cuda.CUDAGraph()
        with pool.device_lock:
            torch.cuda.synchronize()
            try:
                with torch.cuda.graph(graph, capture_error_mode="thread_local"):
                    values = self._compute_of(pool, volumes)
            except RuntimeError as error:
                print(f"a step could not be recorded, they are launched one by one: {error}", flush=True)
                self.failed_recording = True
                torch.cuda.synchronize()
                return self._compute_of(pool, volumes)
        self.recorded[volumes] = (taken, graph, values)
        graph.replay()
        return values.clone()

    def row(self, kind: str, **values) -> dict:
        """A line of the log."""
        return {"kind": kind, "step": self.step, "seconds": round(self.seconds, 1), **values}

    def auxiliary_weight(self) -> float:
        done = min(1.0, self.position / self.config.steps)
        return self.config.auxiliary * (1.0 - (1.0 - FINAL_AUXILIARY) * done)

    def start_from(self, path: Path, images: torch.Tensor) -> None:
        """Takes the weights of a model file, whose batch norms are measured on `images`, or of a checkpoint with the published
        names. Raises InputError if it belongs to another network."""
        if load_weights(self.model, path):
            with torch.no_grad():
                restore_norms(self.model, lambda: self.model(images.to(self.device), self.rigs.select(0), range(4)))
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
        self._place_rates()


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


class Recent:
    """Losses of the steps since the last line of the log, still on the device."""

    def __init__(self):
        self.rows = []

    def add(self, names: list, values: torch.Tensor) -> None:
        self.rows.append((names, values))

    def means(self) -> dict:
        """Means by name, each over the steps that have it. Waits for the device, and forgets them."""
        by_name = {}
        for names, values in self.rows:
            for name, value in zip(names, values.tolist()):
                by_name.setdefault(name, []).append(value)
        self.rows = []
        return {name: round(sum(values) / len(values), 6) for name, values in by_name.items()}


def run(config: Config, work: Path, device: torch.device, start: Path | None = None, program: Program | None = None) -> None:
    """Trains to the end of the plan, from the saved state if there is one, else from the weights of the model file or
    checkpoint `start`, else from nothing."""
    run_workers(config.workers, run_worker, (config, work, device, start, program))


def rig_directories(work: Path) -> list:
    return sorted((work / "rigs").glob("[0-9][0-9]"))


def run_worker(config: Config, work: Path, device: torch.device, start: Path | None, program: Program | None, worker: Worker) -> None:
    torch.set_num_threads(config.threads)
    network = config.load_network()
    beside = config.drawn == "beside"
    paths = [directory / "rig.safetensors" for directory in rig_directories(work)] if beside else [work / "rig.safetensors"]
    if beside and program is None:
        raise InputError('"drawn": frames are drawn beside the training; name the program with --voxcast')
    if not paths:
        raise InputError(f"{work / 'rigs'}: no rigs there")
    rigs = Rigs([Rig.load(path, network) for path in paths], device)
    training = Training(config, rigs, device, worker)
    state = work / "state.pt"
    if state.exists():
        training.load(state)
    elif config.after is not None and start is None:
        raise InputError(f'"after": the run starts from the model of {config.after}; give it with --from')
    share = (worker.rank, worker.count)
    tuning = Frames([work / "tune"], network, False, config.tune.count, share)
    pool = None
    try:
        if beside:
            frames = pool = start_pool(config, work, program, device, len(paths))
            print(f"{pool.filled} frames are there, up to {config.train.count} will be", flush=True)
        else:
            frames = Frames([work / "train"], network, True, config.train.count, share)
            if frames.available != config.train.count:
                raise InputError(f"{work / 'train'}: found {frames.available} frames, expected {config.train.count} of the config")
        if start is not None and not state.exists():
            images = pool.columns["images"] if beside else frames.columns["images"]
            training.start_from(start, images[: min(START_FRAMES, pool.filled if beside else len(frames))])
        training.class_counts = worker.sum(frames.class_counts()).cpu()
        loop(config, work, training, frames, tuning, worker)
    finally:
        if pool is not None:
            pool.stop()


def start_pool(config: Config, work: Path, program: Program, device: torch.device, rigs: int) -> Pool:
    """Starts drawing, and waits until there are enough frames to begin with."""
    calibrations = [None] + [directory / "calibration.json" for directory in rig_directories(work)[1:]]
    drawers = config.drawers or max(1, (os.cpu_count() or 1) - 2)
    drawing = Drawing(program, config.directory / config.network, work / "drawn", calibrations, rig_order(config), config.train.first,
                      config.train.count, drawers)  # fmt: skip
    pool = Pool(config.load_network(), drawing, rigs, config.train.count, device)
    try:
        pool.wait_for(min(config.ready, config.train.count))
    except BaseException:
        pool.stop()
        raise
    return pool


def rig_order(config: Config) -> list:
    """Numbers of rigs so that, going round and round, the jittered ones get their share, evenly mixed."""
    if config.jitter is None or config.jitter.rigs == 0:
        return [0]
    jitter = config.jitter
    of_each = [(1.0 - jitter.share), *[jitter.share / jitter.rigs] * jitter.rigs]
    length = max(2 * (jitter.rigs + 1), round(jitter.rigs / max(jitter.share, 1e-3)))
    order, owed = [], [0.0] * len(of_each)
    for _ in range(length):
        owed = [o + share for o, share in zip(owed, of_each)]
        most = owed.index(max(owed))
        owed[most] -= 1.0
        order.append(most)
    return order + [rig for rig in range(len(of_each)) if rig not in order]


def loop(config: Config, work: Path, training: Training, frames, tuning: Frames, worker: Worker) -> None:
    beside, timed = isinstance(frames, Pool), config.minutes is not None
    log = Log(work / "log.jsonl", training.step) if worker.first else None
    plan = f"{config.minutes:g} minutes" if timed else f"{config.steps} steps"
    if worker.first:
        print(f"{plan} of {config.batch} frames a step, from step {training.step}", flush=True)
    rigs_in_turn = rig_order(config)
    recent, started = Recent(), time.monotonic() - training.seconds
    saved = evaluated = training.seconds
    while not training.done:
        worker.check()
        if beside and frames.take() and training.step % 200 == 0:
            training.class_counts = frames.class_counts().cpu()
        values = training.take_step(frames, rigs_in_turn[training.step % len(rigs_in_turn)])
        recent.add(training.last_names, values)
        training.seconds = time.monotonic() - started
        step, last = training.step, training.done
        if step % config.log_every == 0 or last:
            means = recent.means()
            # The numbers above came from the device, so that all steps up to here are done.
            training.seconds = time.monotonic() - started
            last = training.done
            if not math.isfinite(means["gradient"]):
                raise InputError(f"step {step}: the gradient is not finite; lower the learning rate")
            if worker.first:
                extra = {"frames": frames.filled} if beside else {}
                log.add(training.row("train", rate=rate(config, training.position), **extra, **means))
                report_progress(config, training, log.rows[-1])
        due = training.seconds - evaluated >= config.evaluate_seconds if timed else step % config.evaluate_every == 0
        if due or last:
            confusion = evaluate(training.average, training.rigs.select(0), tuning, training.device, config.precision)
            worker.sum(confusion.counts)
            training.seconds = time.monotonic() - started
            evaluated = training.seconds
            if worker.first:
                report = confusion.report()
                log.add(training.row("evaluate", **report))
                print(
                    f"step {step}: tuning IoU {report['all']['iou']:.2f}, mIoU {report['all']['miou']:.2f}, "
                    f"near {report['near']['miou']:.2f}",
                    flush=True,
                )
        due = training.seconds - saved >= config.save_seconds if timed else step % config.save_every == 0
        if worker.first and (due or last):
            training.save(work / "state.pt")
            export(training.average.state_dict(), work / "average.safetensors", half=True)
            saved = training.seconds
            if not timed or last:
                draw_curve(log.rows, work / "curve.png")


def report_progress(config: Config, training: Training, row: dict) -> None:
    share = max(training.position / config.steps, 1e-9)
    left = training.seconds / share * (1.0 - share)
    shown = ("total", "focal0", "lovasz0", "geometric0", "semantic0", "pixel_class", "pixel_depth", "pixel_place", "voxel_place")
    losses = "  ".join(f"{name} {row[name]:.3f}" for name in shown if name in row)
    frames = f"{row['frames']} frames  " if "frames" in row else ""
    end = "" if config.minutes is not None else f"/{config.steps}"
    print(
        f"step {training.step}{end}  {frames}{losses}  gradient {row['gradient']:.2f}  "
        f"{training.seconds / training.step:.3f} s a step, {left / 60.0:.0f} min left",
        flush=True,
    )


def main() -> int:
    parser = argparse.ArgumentParser(prog="voxcast_train.train", description="Train a network.")
    parser.add_argument("--config", required=True, help="the run's JSON, beside its network.json")
    parser.add_argument("--work", required=True, type=Path, help="holds train/, tune/ and rig.safetensors; receives the results")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--from", dest="start", type=Path, metavar="FILE", help="start from the weights of a model or checkpoint")
    parser.add_argument("--voxcast", type=Path, help="the program, for frames that are drawn beside the training")
    parser.add_argument("--minutes", type=float, help="time to train for, instead of the config's")
    options = parser.parse_args()
    try:
        config = Config.load(options.config)
        if options.minutes is not None:
            config = changed(config, minutes=options.minutes)
        program = None if options.voxcast is None else Program(options.voxcast)
        run(config, options.work, torch.device(options.device), options.start, program)
    except (InputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())

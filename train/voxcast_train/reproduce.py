"""From seeds to a model: makes the sets, builds the rigs, trains, calibrates, exports, imports, evaluates, also across rigs.

    python -m voxcast_train.reproduce --config edge/config.json --work DIR --voxcast ../target/release/voxcast

A run that starts from another one's model (`"after"`) finds that in DIR/first/model.safetensors, or makes it there; `--from` gives
it another model or checkpoint to start from.
What DIR already holds is kept, so a run that was interrupted goes on. DIR needs about 2 MB a frame.
"""

import argparse
import json
import sys
from dataclasses import replace as changed
from pathlib import Path

import torch

from . import rigs
from .across import across, load_rig, summary
from .calibrate import calibrated
from .config import Config
from .data import Frames
from .errors import InputError
from .evaluate import evaluate_majority, load_model
from .export import export
from .files import replace
from .metrics import table
from .network import InverseMatrixVT3D
from .program import Program
from .rig import Rig, Rigs
from .tail import train_tail
from .train import run


def train_model(config: Config, work: Path, voxcast: Program, device: torch.device, start: Path | None = None) -> int:
    """Makes a config's sets and rigs in `work`, trains, and writes checkpoint.safetensors and model.safetensors there; first, in
    `work`/first, the run that it starts from, unless `start` is given. Returns the number of steps."""
    work.mkdir(parents=True, exist_ok=True)
    if config.after is not None and start is None:
        start = work / "first" / "model.safetensors"
        if not start.exists():
            train_model(Config.load(config.directory / config.after), work / "first", voxcast, device)
    network_path = config.directory / config.network
    network = config.load_network()
    voxcast.make_set(work / "tune", config.tune.first, config.tune.count, network_path)
    names, lidar2img = rigs.read_set(work / "tune")
    if config.drawn == "beside":
        make_rigs(config, work, names, lidar2img, voxcast)
        plain = work / "rigs" / "00"
    else:
        voxcast.make_set(work / "train", config.train.first, config.train.count, network_path)
        plain = work
        rigs.make(plain, names, lidar2img, network, network_path, voxcast)
    run(config, work, device, start, voxcast)
    state = torch.load(work / "state.pt", map_location="cpu", weights_only=True)
    rig = Rigs([Rig.load(plain / "rig.safetensors", network)], device).select(0)
    model = InverseMatrixVT3D(network)
    model.load_state_dict(state["average"])
    if config.tail is not None:
        sets = tail_sets(config, work, names, lidar2img, rig, voxcast, device)
        train_tail(model, sets, config.tail, device, config.seed, work / "tail.pt")
    tuning = Frames([work / "tune"], network, pixels=False, limit=config.tune.count)
    weights = calibrated(model, rig, tuning, device) if config.shifts else model.state_dict()
    export(weights, work / "checkpoint.safetensors", half=True)
    voxcast("import", work / "checkpoint.safetensors", "--network", network_path, "--precision", "f16", "--exact", "-o",
            work / "model.safetensors")  # fmt: skip
    return state["step"]


def tail_sets(config: Config, work: Path, names: list, lidar2img: torch.Tensor, plain: Rig, voxcast: Program, device: torch.device) -> list:
    """Rigs of a tail and the frames drawn for each, the plain one first; the others lie in `work`/tail-NN."""
    tail, network, network_path = config.tail, config.load_network(), config.directory / config.network
    sets = []
    for number in range(1 + (0 if tail.jitter is None else tail.jitter.rigs)):
        seeds, rig, calibration, directory = tail.seeds_of(number), plain, None, work / "tail"
        if number > 0:
            moved = rigs.jittered(lidar2img, tail.jitter.degrees, tail.jitter.metres, 1000 * config.seed + number)
            calibration = rigs.make(work / f"tail-{number:02}", names, moved, network, network_path, voxcast)
            rig, directory = load_rig(calibration.parent, network, device), calibration.parent / "set"
        voxcast.make_set(directory, seeds.first, seeds.count, network_path, calibration)
        sets.append((rig, Frames([directory], network, pixels=False)))
    return sets


def make_rigs(config: Config, work: Path, names: list, lidar2img: torch.Tensor, voxcast: Program) -> None:
    """The rigs of a run, the plain one first."""
    count = 0 if config.jitter is None else config.jitter.rigs
    for number in range(count + 1):
        directory = work / "rigs" / f"{number:02}"
        if (directory / "rig.safetensors").exists():
            continue
        moved = lidar2img
        if number > 0:
            moved = rigs.jittered(lidar2img, config.jitter.degrees, config.jitter.metres, 1000 * config.seed + number)
        rigs.make(directory, names, moved, config.load_network(), config.directory / config.network, voxcast)


def reproduce(config: Config, work: Path, voxcast: Program, device: torch.device, start: Path | None = None) -> dict:
    """Everything that the module's text says. Returns the reports of the held-out set by name."""
    steps = train_model(config, work, voxcast, device, start)
    network = config.load_network()
    network_path = config.directory / config.network
    model = load_model(network, work / "checkpoint.safetensors")
    seeds = config.held_out
    reports = across(model, network_path, work, voxcast, seeds.first, seeds.count, device)
    # Where frames were drawn beside the training, the tuning set has to do for what is most frequent.
    known = work / ("tune" if config.drawn == "beside" else "train")
    majority = Frames([known], network, pixels=False).majority()
    held_out = Frames([work / "held-out"], network, pixels=False, limit=seeds.count)
    reports["majority"] = evaluate_majority(majority, held_out).report()
    text = json.dumps({"frames": seeds.count, "steps": steps, **reports}, indent=1) + "\n"
    replace(work / "quality.json", lambda temporary: temporary.write_text(text))
    return reports


def main() -> int:
    parser = argparse.ArgumentParser(prog="voxcast_train.reproduce", description="From seeds to a model.")
    parser.add_argument("--config", required=True)
    parser.add_argument("--work", required=True, type=Path)
    parser.add_argument("--voxcast", required=True, type=Path, help="the program, built with --release")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--minutes", type=float, help="time to train for, instead of the config's")
    parser.add_argument("--from", dest="start", type=Path, metavar="FILE", help="start from the weights of a model or checkpoint")
    options = parser.parse_args()
    try:
        config = Config.load(options.config)
        if options.minutes is not None:
            config = changed(config, minutes=options.minutes)
        device = torch.device(options.device)
        reports = reproduce(config, options.work, Program(options.voxcast), device, options.start)
    except (InputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(table({name: reports[name] for name in ("plain", "majority")}))
    print()
    print(summary({name: report for name, report in reports.items() if name != "majority"}))
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""From seeds to a model: makes the sets, builds the rig, trains, calibrates, exports, imports, evaluates.

    python -m voxcast_train.reproduce --config edge/config.json --work DIR --voxcast ../target/release/voxcast

A run that starts from another one's model (`"after"`) finds that in DIR/first/model.safetensors, or makes it there.
What DIR already holds is kept, so a run that was interrupted goes on. DIR needs about 2 MB a frame.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import torch

from .calibrate import calibrated
from .config import Config, Seeds
from .data import Frames
from .errors import InputError
from .evaluate import evaluate, evaluate_majority, load_model
from .export import export
from .files import replace
from .metrics import table
from .rig import Rig
from .train import run


class Program:
    """The `voxcast` that makes frames, rig and model."""

    def __init__(self, path: Path):
        self.path = path

    def __call__(self, *arguments) -> None:
        command = [str(self.path), *map(str, arguments)]
        print("+", " ".join(command), flush=True)
        try:
            subprocess.run(command, check=True)
        except subprocess.CalledProcessError as error:
            raise InputError(f"{' '.join(command)}: exit status {error.returncode}") from error

    def make_set(self, directory: Path, seeds: Seeds, network: Path) -> None:
        """Writes the frames of these seeds, unless they are there."""
        if len(list(directory.glob("[0-9]*.safetensors"))) < seeds.count:
            self("synth", "--set", directory, "--seed", seeds.first, "--count", seeds.count, "--network", network, "--pixels")


def train_model(config: Config, work: Path, voxcast: Program, device: torch.device) -> int:
    """Makes a config's sets and rig in `work`, trains, and writes checkpoint.safetensors and model.safetensors there; first, in
    `work`/first, the run that it starts from. Returns the number of steps."""
    work.mkdir(parents=True, exist_ok=True)
    start = None
    if config.after is not None:
        start = work / "first" / "model.safetensors"
        if not start.exists():
            train_model(Config.load(config.directory / config.after), work / "first", voxcast, device)
    network_path = config.directory / config.network
    network = config.load_network()
    for name, seeds in (("train", config.train), ("tune", config.tune)):
        voxcast.make_set(work / name, seeds, network_path)
    first = next(iter(sorted((work / "train").glob("[0-9]*.safetensors"))))
    voxcast("rig", first, "--network", network_path, "-o", work / "rig.safetensors")
    run(config, work, device, start)
    state = torch.load(work / "state.pt", map_location="cpu", weights_only=True)
    rig = Rig.load(work / "rig.safetensors", network)
    tuning = Frames([work / "tune"], network, pixels=False, limit=config.tune.count)
    export(calibrated(state["average"], network, rig, tuning), work / "checkpoint.safetensors")
    voxcast("import", work / "checkpoint.safetensors", "--network", network_path, "--precision", "f16", "-o", work / "model.safetensors")
    return state["step"]


def reproduce(config: Config, work: Path, voxcast: Program, device: torch.device) -> dict:
    """Everything that the module's text says. Returns the reports of the held-out set by name."""
    steps = train_model(config, work, voxcast, device)
    network = config.load_network()
    voxcast.make_set(work / "held-out", config.held_out, config.directory / config.network)
    rig = Rig.load(work / "rig.safetensors", network)
    held_out = Frames([work / "held-out"], network, pixels=False, limit=config.held_out.count)
    majority = Frames([work / "train"], network, pixels=False, limit=config.train.count).majority()
    model = load_model(network, work / "checkpoint.safetensors").to(device)
    reports = {
        "network": evaluate(model, rig.to(device), held_out, device).report(),
        "majority": evaluate_majority(majority, held_out).report(),
    }
    text = json.dumps({"frames": len(held_out), "steps": steps, **reports}, indent=1) + "\n"
    replace(work / "quality.json", lambda temporary: temporary.write_text(text))
    return reports


def main() -> int:
    parser = argparse.ArgumentParser(prog="voxcast_train.reproduce", description="From seeds to a model.")
    parser.add_argument("--config", required=True)
    parser.add_argument("--work", required=True, type=Path)
    parser.add_argument("--voxcast", required=True, type=Path, help="the program, built with --release")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    options = parser.parse_args()
    try:
        reports = reproduce(Config.load(options.config), options.work, Program(options.voxcast), torch.device(options.device))
    except (InputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(table(reports))
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""What tests share: the program, and a set of drawn streets with labels that it writes."""

import json
import os
import subprocess
from pathlib import Path

import pytest

import voxcast

FRAMES = 12


@pytest.fixture(scope="session")
def program():
    """Runs the command line and returns what it prints. `python/tests/run` builds it and says where it is."""

    def run(*arguments: object) -> str:
        done = subprocess.run([os.environ["VOXCAST"], *map(str, arguments)], capture_output=True, text=True)
        assert done.returncode == 0, f"{arguments}: {done.stderr}"
        return done.stdout

    return run


@pytest.fixture(scope="session")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("voxcast")


@pytest.fixture(scope="session")
def model(place: Path) -> voxcast.Model:
    """The network that ships with voxcast, from a file."""
    voxcast.Model.shipped().save(place / "model.safetensors")
    return voxcast.Model.open(place / "model.safetensors")


@pytest.fixture(scope="session")
def scene(model: voxcast.Model) -> voxcast.Scene:
    return voxcast.Scene.street(model, 5)


@pytest.fixture(scope="session")
def rig(model: voxcast.Model, scene: voxcast.Scene) -> voxcast.Rig:
    return voxcast.Rig.build(model, scene)


@pytest.fixture(scope="session")
def heldout(place: Path, program) -> str:
    """A set of labelled streets, as `--data` names it."""
    program("synth", "--network", "edge", "--seed", 1_000_000, "--count", FRAMES, "--set", place / "heldout")
    return f"synthetic:{place / 'heldout'}"


@pytest.fixture(scope="session")
def scores(place: Path, program, model: voxcast.Model, heldout: str) -> dict:
    """What the command line says of the model on that set, losses too."""
    arguments = ["--model", model.path, "--data", heldout, "--losses", "--json", place / "scores.json"]
    program("eval", *arguments)
    return json.loads((place / "scores.json").read_text())

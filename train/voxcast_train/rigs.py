"""The rigs that a run trains for: the plain ring, and rings whose mounting is a little off.

What a voxel sees differs from rig to rig, and so do the matrices; both come from `voxcast`. Directory `rigs/NN` of a run holds
`calibration.json` and `rig.safetensors` of rig NN; rig 00 is the plain one.
"""

import json
import math
from pathlib import Path

import torch
from torch import Tensor

from .errors import InputError
from .files import replace


def direction(draw: torch.Generator) -> Tensor:
    """A unit vector of any direction."""
    while True:
        v = torch.rand(3, generator=draw, dtype=torch.float64) * 2.0 - 1.0
        length = float(v.norm())
        if 0.1 < length < 1.0:
            return v / length


def rotation(axis: Tensor, radians: float) -> Tensor:
    """[3, 3], by Rodrigues' formula."""
    x, y, z = axis.tolist()
    cross = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    return torch.eye(3, dtype=torch.float64) + math.sin(radians) * cross + (1.0 - math.cos(radians)) * cross @ cross


def jittered(lidar2img: Tensor, degrees: float, metres: float, seed: int, whole: bool = False) -> Tensor:
    """The rig [N, 4, 4] with each camera turned about a random axis and moved in a random direction: by up to so much, or with
    `whole` by just so much. Its lens stays: a camera K R (p - c) becomes K R Q (p - c - d)."""
    draw = torch.Generator().manual_seed(seed)
    moved = lidar2img.double().clone()
    for camera in moved:
        share = (1.0, 1.0) if whole else torch.rand(2, generator=draw).tolist()
        turn = rotation(direction(draw), math.radians(degrees) * share[0])
        shift = direction(draw) * (metres * share[1])
        place = -torch.linalg.solve(camera[:3, :3], camera[:3, 3])
        camera[:3, :3] = camera[:3, :3] @ turn
        camera[:3, 3] = -camera[:3, :3] @ (place + shift)
    return moved.float()


def read_set(directory: Path) -> tuple:
    """Names of the cameras and lidar2img [N, 4, 4] of a set of `voxcast synth`."""
    path = directory / "set.json"
    try:
        values = json.loads(path.read_text())
        return values["cameras"], torch.tensor(values["lidar2img"]).view(-1, 4, 4)
    except (OSError, KeyError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: {error}") from error


def write_calibration(path: Path, names: list, lidar2img: Tensor, image: tuple) -> None:
    """A calibration.json as `voxcast` reads it, of cameras that have no image files."""
    height, width = image
    cameras = [
        {"name": name, "file": f"{name}.png", "width": width, "height": height, "lidar2img": matrix.double().tolist()}
        for name, matrix in zip(names, lidar2img)
    ]
    replace(path, lambda temporary: temporary.write_text(json.dumps({"cameras": cameras}, indent=1) + "\n"))


def make(directory: Path, names: list, lidar2img: Tensor, network, network_path: Path, voxcast) -> Path:
    """Writes calibration.json and rig.safetensors of a rig. Returns the calibration's path."""
    directory.mkdir(parents=True, exist_ok=True)
    calibration = directory / "calibration.json"
    write_calibration(calibration, names, lidar2img, network.image)
    voxcast("rig", calibration, "--network", network_path, "-o", directory / "rig.safetensors")
    return calibration

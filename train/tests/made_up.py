"""A small network, and frames in the form of `voxcast synth --set --pixels` that need no renderer."""

import json
import math
from pathlib import Path

import torch
from safetensors.torch import save_file

NETWORK = {
    "depths": [1, 1, 1, 1],
    "width": 8,
    "dcn": [False] * 4,
    "block": "basic",
    "fpn": 16,
    "channels": [16, 16, 24, 32],
    "key_dims": [2, 3, 4],
    "bounds": [[-16, 16], [-24, 24], [-3, 5]],
    "classes": 5,
    "image": [64, 96],
    "grids": [[16, 20, 4], [8, 10, 2], [4, 5, 1]],
    "samples": [3, 2, 2],
    "cameras": 3,
}
"""Odd on purpose: X != Y, windows that need padding, one camera count for the whole of it."""


def write_network(directory: Path, **changes) -> Path:
    path = directory / "network.json"
    path.write_text(json.dumps({**NETWORK, **changes}))
    return path


def ring(cameras: int, height: int, width: int) -> torch.Tensor:
    """lidar2img of cameras that look outwards from a common centre, evenly spaced; x is ahead, z is up."""
    matrices = []
    for index in range(cameras):
        yaw = 2.0 * math.pi * index / cameras
        ahead = (math.cos(yaw), math.sin(yaw), 0.0)
        right = (math.sin(yaw), -math.cos(yaw), 0.0)
        rotation = torch.tensor([right, (0.0, 0.0, -1.0), ahead], dtype=torch.float64)
        place = torch.tensor([0.3, -0.1, 0.2], dtype=torch.float64)
        camera = torch.eye(4, dtype=torch.float64)
        camera[:3, :3], camera[:3, 3] = rotation, -rotation @ place
        focal = 0.6 * width
        intrinsic = torch.eye(4, dtype=torch.float64)
        intrinsic[:3, :3] = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        matrices.append(intrinsic @ camera)
    return torch.stack(matrices).float()


def frame(seed: int, network: dict = NETWORK) -> dict:
    """Noise; the lower half has one of four colours, which tells the class of everything that there is."""
    draw = torch.Generator().manual_seed(seed)
    cameras, (height, width) = network["cameras"], network["image"]
    grid = [2 * side for side in network["grids"][0]]
    kind = seed % (network["classes"] - 1) + 1
    colour = torch.tensor([[0, 0, 0], [160, 0, 0], [0, 160, 0], [0, 0, 160], [160, 160, 0]])[kind]
    images = torch.randint(0, 90, (cameras, height, width, 3), generator=draw)
    images[:, height // 2 :] += colour
    labels = torch.zeros(grid, dtype=torch.uint8)
    labels[:, : grid[1] // 2, :2] = kind
    labels[0, 0, 0] = 255
    visible = torch.randint(0, 2, grid, generator=draw, dtype=torch.uint8)
    pixel = torch.full((cameras, height, width), kind, dtype=torch.uint8)
    depth = (torch.rand((cameras, height, width), generator=draw) * 60 + 1).half()
    pixel[:, : height // 2], depth[:, : height // 2] = 255, math.inf
    return {
        "images": images.to(torch.uint8),
        "lidar2img": ring(cameras, height, width),
        "labels": labels,
        "visible": visible,
        "pixel.class": pixel,
        "pixel.depth": depth,
    }


def write_set(directory: Path, first: int, count: int) -> None:
    directory.mkdir()
    for seed in range(first, first + count):
        save_file(frame(seed), directory / f"{seed:09}.safetensors")

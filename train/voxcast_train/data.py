"""Sets of frames as `voxcast synth --set DIR --pixels` writes them, held in memory, and what is done to their images.

A frame is `NNNNNNNNN.safetensors` with

    images       u8  [N, H, W, 3]  BGR
    lidar2img    f32 [N, 4, 4]
    labels       u8  [X, Y, Z]     level 0; 0 is empty, 255 is ignored
    visible      u8  [X, Y, Z]     1 where a camera sees the voxel
    pixel.class  u8  [N, H, W]     255 is sky
    pixel.depth  f16 [N, H, W]     metres, +inf is sky
"""

from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors import safe_open
from torch import Tensor

from .errors import InputError
from .losses import IGNORED, pooled_labels
from .network import Network

DEPTH_BINS = 32
"""Bins of the auxiliary depth head, evenly spaced in the logarithm of the depth."""

DEPTH_RANGE = (1.0, 80.0)
"""Metres that the bins divide; nearer and farther pixels fall into the first and the last."""


def depth_bins(depth: Tensor) -> Tensor:
    """Depths in metres -> bins u8; IGNORED for sky."""
    near, far = (torch.tensor(limit).log() for limit in DEPTH_RANGE)
    position = (depth.float().log() - near) / (far - near) * DEPTH_BINS
    bins = position.nan_to_num(0.0, 0.0, 0.0).floor().clamp(0, DEPTH_BINS - 1)
    return torch.where(depth.isinf(), IGNORED, bins).to(torch.uint8)


class Frames:
    """All frames of one or several sets. Indexing with a list of numbers gives a batch."""

    def __init__(self, directories, network: Network, pixels: bool, limit: int | None = None, share=(0, 1)):
        """Reads every frame, or the first `limit`, in the order of the directories and of the file names; of these, with
        `share` (i, n), every n-th from the i-th on.

        With `pixels`, per-pixel classes and depths are kept at a quarter of the image's resolution: the centre of each
        4 x 4 cell. Raises InputError for a frame of another shape or calibration than the network's and the first one's.
        """
        paths = [path for directory in directories for path in sorted(Path(directory).glob("[0-9]*.safetensors"))][:limit]
        self.available = len(paths)
        paths = paths[share[0] :: share[1]]
        if not paths:
            raise InputError(f"{', '.join(map(str, directories))}: no frames there")
        self.network = network
        self.pixels = pixels
        self.paths = paths
        self.lidar2img = None
        # Rows are written in place: frames kept one by one between temporaries would leave the heap full of holes.
        self.columns = {}
        for number, path in enumerate(paths):
            for key, value in self._read(path).items():
                if number == 0:
                    self.columns[key] = torch.empty((len(paths), *value.shape), dtype=value.dtype)
                self.columns[key][number] = value

    def _read(self, path: Path) -> dict:
        network = self.network
        height, width = network.image
        with safe_open(path, "pt") as file:
            names = set(file.keys())
            needed = {"images", "lidar2img", "labels", "visible"} | ({"pixel.class", "pixel.depth"} if self.pixels else set())
            if missing := needed - names:
                raise InputError(f"{path}: no tensor {', '.join(sorted(missing))}")
            images, labels = file.get_tensor("images"), file.get_tensor("labels")
            expected = {"images": (network.cameras, height, width, 3), "labels": network.output_grid()}
            for name, tensor in (("images", images), ("labels", labels)):
                if tuple(tensor.shape) != expected[name]:
                    raise InputError(f"{path}: {name}: found {list(tensor.shape)}, expected {list(expected[name])}")
            lidar2img = file.get_tensor("lidar2img")
            if self.lidar2img is None:
                self.lidar2img = lidar2img
            elif not torch.equal(self.lidar2img, lidar2img):
                raise InputError(f"{path}: lidar2img: differs from that of {self.paths[0]}; one rig serves all frames")
            frame = {"images": images, "visible": file.get_tensor("visible")}
            for level, pooled in enumerate(pooled_labels(labels, network.classes)):
                frame[f"labels{level}"] = pooled
            if self.pixels:
                classes = file.get_tensor("pixel.class")[:, 2::4, 2::4]
                frame["pixel_class"] = torch.where(classes == 255, network.classes, classes)
                frame["pixel_depth"] = depth_bins(file.get_tensor("pixel.depth")[:, 2::4, 2::4])
        return frame

    def __len__(self) -> int:
        return len(self.paths)

    def batch(self, numbers) -> dict:
        """The frames of these numbers, stacked; level labels as a list under "labels"."""
        batch = {key: value[numbers] for key, value in self.columns.items()}
        batch["labels"] = [batch.pop(f"labels{level}") for level in range(4)]
        return batch

    def class_counts(self) -> Tensor:
        """Voxels of each class at level 0, over all frames."""
        counts = torch.zeros(256, dtype=torch.int64)
        for labels in self.columns["labels0"]:
            counts += torch.bincount(labels.flatten(), minlength=256)
        return counts[: self.network.classes]

    def majority(self) -> Tensor:
        """The most frequent class of each voxel of level 0, empty included: the best that can be said without an image."""
        grid = self.network.output_grid()
        counts = torch.zeros(self.network.classes, grid[0] * grid[1] * grid[2], dtype=torch.int32)
        for labels in self.columns["labels0"]:
            labels = labels.flatten().long()
            counted = (labels != IGNORED).int()
            counts.scatter_add_(0, torch.where(labels == IGNORED, 0, labels).unsqueeze(0), counted.unsqueeze(0))
        return counts.argmax(0).to(torch.uint8).view(grid)


def order(seed: int, frames: int, batch: int, step: int) -> list:
    """Frame numbers of a training step: every frame once per epoch, in an order that follows from the seed alone."""
    per_epoch = frames // batch
    epoch, index = divmod(step, per_epoch)
    draw = torch.Generator().manual_seed(seed * 1_000_003 + epoch)
    return torch.randperm(frames, generator=draw)[index * batch : (index + 1) * batch].tolist()


def augment(images: Tensor) -> Tensor:
    """Photometric changes, which leave the rig valid: u8 [B, N, H, W, 3] -> f32 in 0..255.

    Exposure, contrast and the colour of the light change per frame, and a little per camera; some frames get sensor noise,
    some are out of focus. The scene is never mirrored: the cameras of a rig are not exactly symmetric.
    """
    batch, cameras = images.shape[:2]
    x = images.float()

    def normal(*shape):
        return torch.randn(*shape)

    exposure = 0.35 * normal(batch, 1, 1, 1, 1) + 0.1 * normal(batch, cameras, 1, 1, 1)
    light = 0.08 * normal(batch, 1, 1, 1, 3) + 0.02 * normal(batch, cameras, 1, 1, 3)
    contrast = (0.2 * normal(batch, 1, 1, 1, 1)).exp()
    mean = x.mean((2, 3), keepdim=True)
    x = ((x - mean) * contrast + mean) * (exposure + light).exp()
    for frame in range(batch):
        kind = float(torch.rand(()))
        if kind < 0.25:
            x[frame] += normal(*x.shape[1:]) * (10.0 * float(torch.rand(())))
        elif kind < 0.4:
            planes = x[frame].permute(0, 3, 1, 2)
            share = float(torch.rand(()))
            soft = F.avg_pool2d(planes, 3, 1, 1, count_include_pad=False)
            x[frame] = torch.lerp(planes, soft, share).permute(0, 2, 3, 1)
    return x.clamp_(0.0, 255.0)

"""Sets of frames as `voxcast synth --set DIR --pixels` writes them, held in memory, and what is done to their images.

A frame is `NNNNNNNNN.safetensors` with

    images       u8  [N, H, W, 3]  BGR
    lidar2img    f32 [N, 4, 4]
    labels       u8  [X, Y, Z]     level 0; 0 is empty, 255 is ignored
    visible      u8  [X, Y, Z]     1 where a camera sees the voxel
    pixel.class  u8  [N, H, W]     255 is sky
    pixel.depth  f16 [N, H, W]     metres, +inf is sky
"""

import math
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
    near, far = (math.log(limit) for limit in DEPTH_RANGE)
    position = (depth.float().log() - near) / (far - near) * DEPTH_BINS
    bins = position.nan_to_num(0.0, 0.0, 0.0).floor().clamp(0, DEPTH_BINS - 1)
    return torch.where(depth.isinf(), IGNORED, bins).to(torch.uint8)


def read_frame(path: Path, network: Network, pixels: bool) -> dict:
    """The tensors of a frame's file by name, those of the pixels at a quarter of the resolution: the centre of each 4 x 4 cell.
    Raises InputError for a frame of another shape than the network's."""
    height, width = network.image
    with safe_open(path, "pt") as file:
        names = set(file.keys())
        needed = {"images", "lidar2img", "labels", "visible"} | ({"pixel.class", "pixel.depth"} if pixels else set())
        if missing := needed - names:
            raise InputError(f"{path}: no tensor {', '.join(sorted(missing))}")
        frame = {name: file.get_tensor(name) for name in needed}
    expected = {"images": (network.cameras, height, width, 3), "labels": network.output_grid()}
    for name, shape in expected.items():
        if tuple(frame[name].shape) != shape:
            raise InputError(f"{path}: {name}: found {list(frame[name].shape)}, expected {list(shape)}")
    for name in ("pixel.class", "pixel.depth") if pixels else ():
        frame[name] = frame[name][:, 2::4, 2::4].contiguous()
    return frame


def pool_frame(frame: dict, network: Network) -> dict:
    """What training wants of a frame's tensors, on their device: labels of all levels, classes and depth bins of pixels."""
    row = {"images": frame["images"], "visible": frame["visible"]}
    for level, pooled in enumerate(pooled_labels(frame["labels"], network.classes)):
        row[f"labels{level}"] = pooled
    if "pixel.class" in frame:
        classes = frame["pixel.class"]
        row["pixel_class"] = torch.where(classes == 255, network.classes, classes)
        row["pixel_depth"] = depth_bins(frame["pixel.depth"])
    return row


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
        frame = read_frame(path, self.network, self.pixels)
        lidar2img = frame["lidar2img"]
        if self.lidar2img is None:
            self.lidar2img = lidar2img
        elif not torch.equal(self.lidar2img, lidar2img):
            raise InputError(f"{path}: lidar2img: differs from that of {self.paths[0]}; one rig serves all frames of a set")
        return pool_frame(frame, self.network)

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


def noise(x: Tensor, share: Tensor) -> Tensor:
    """Of a sensor in the dark."""
    return x + torch.randn_like(x) * (10.0 * share)


def planes(x: Tensor) -> Tensor:
    """[F, N, H, W, C] -> [F * N, C, H, W]."""
    return x.flatten(0, 1).permute(0, 3, 1, 2)


def unplanes(x: Tensor, like: Tensor) -> Tensor:
    return x.permute(0, 2, 3, 1).reshape(like.shape)


def box(x: Tensor, size: int) -> Tensor:
    """Means over squares of so many pixels."""
    return F.avg_pool2d(x, size, 1, size // 2, count_include_pad=False)


def blur(x: Tensor, share: Tensor) -> Tensor:
    """Out of focus."""
    return torch.lerp(x, unplanes(box(planes(x), 3), x), share)


def rain(x: Tensor, share: Tensor) -> Tensor:
    """A grey veil, bright streaks, and drops on the lens through which everything is blurred."""
    frames, cameras, height, width, _ = x.shape
    x = torch.lerp(x, torch.full_like(x, 150.0), 0.3 * share)
    starts = (torch.rand(frames * cameras, 1, height, width, device=x.device) < 0.004).float()
    streaks = F.avg_pool2d(starts, (9, 1), 1, (4, 0)) * 9.0
    x = x + streaks.view(frames, cameras, height, width, 1) * (60.0 * share)
    cells = torch.rand(frames * cameras, 1, -(-height // 16), -(-width // 16), device=x.device)
    drops = F.interpolate((cells < 0.08).float(), size=(height, width), mode="bilinear")
    return torch.lerp(x, unplanes(box(planes(x), 7), x), drops.view(frames, cameras, height, width, 1) * share)


CHANGES = ((noise, 0.0, 0.25), (blur, 0.25, 0.4), (rain, 0.4, 0.5))
"""Functions of images [F, N, H, W, C] and of a strength from 0, which changes nothing, to 1, with the share of the frames that
each is for."""


def augment(images: Tensor) -> Tensor:
    """Photometric changes, which leave the rig valid: u8 [B, N, H, W, 3] -> f32 in 0..255.

    Exposure, contrast and the colour of the light change per frame, and a little per camera; some frames get sensor noise, some
    are out of focus, some are taken in rain. The scene is never mirrored: the cameras of a rig are not exactly symmetric.
    """
    batch, cameras = images.shape[:2]
    x = images.float()

    def normal(*shape):
        return torch.randn(*shape, device=images.device)

    exposure = 0.35 * normal(batch, 1, 1, 1, 1) + 0.1 * normal(batch, cameras, 1, 1, 1)
    light = 0.08 * normal(batch, 1, 1, 1, 3) + 0.02 * normal(batch, cameras, 1, 1, 3)
    contrast = (0.2 * normal(batch, 1, 1, 1, 1)).exp()
    mean = x.mean((2, 3), keepdim=True)
    x = ((x - mean) * contrast + mean) * (exposure + light).exp()
    kind, share = (torch.rand(batch, 1, 1, 1, 1, device=images.device) for _ in range(2))
    for change, first, end in CHANGES:
        strength = share * ((kind >= first) & (kind < end))
        if images.is_cuda:
            x = change(x, strength)
            continue
        # Here it would cost more to change all frames than to look which ones.
        for frame in strength.flatten().nonzero().flatten().tolist():
            x[frame : frame + 1] = change(x[frame : frame + 1], strength[frame : frame + 1])
    return x.clamp_(0.0, 255.0)


def kept_cameras(batch: int, cameras: int, share: float, device) -> Tensor:
    """f32 [B, N]: 1 for a camera that is there; of so large a share of the frames, one camera is masked."""
    lost = torch.randint(cameras, (batch, 1), device=device) == torch.arange(cameras, device=device)
    return 1.0 - (lost & (torch.rand(batch, 1, device=device) < share)).float()

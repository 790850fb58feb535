"""Heads that exist during training only: what each pixel shows, how far away it is and where it is; and where each voxel is.

A voxel grid says little to a backbone that starts from nothing, since hundreds of voxels share a pixel. The pixel heads tell
every level of the pyramid directly. A voxel gathers the same features as all others along a line of sight, so it can only
tell whether the surface that the features speak of is its own if it knows its distance. Nothing in the network says so but
the padding at the borders of images and grids; left to itself, it carries little of that inwards. The place heads ask for
it. None of them is part of the network, and none is exported.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .data import DEPTH_BINS
from .losses import IGNORED
from .network import Network

HIDDEN = 64


class PixelHeads(nn.Module):
    """Per pyramid level: class (sky is one more) and depth bin, at twice the level's resolution; and, linear in the features,
    row, column and logarithm of the depth."""

    def __init__(self, network: Network):
        super().__init__()
        self.classes = network.classes + 1
        outputs = 4 * (self.classes + DEPTH_BINS)
        # The pyramid has no norm: what a step of the heads does would depend on how large its features are.
        self.norms = nn.ModuleList(nn.BatchNorm2d(network.fpn, affine=False) for _ in range(3))
        self.heads = nn.ModuleList(
            nn.Sequential(nn.Conv2d(network.fpn, HIDDEN, 1), nn.ReLU(inplace=True), nn.Conv2d(HIDDEN, outputs, 1)) for _ in range(3)
        )
        self.linear = nn.ModuleList(nn.Conv2d(network.fpn, 3, 1) for _ in range(3))

    def losses(self, pyramid: list, classes: Tensor, depths: Tensor) -> dict:
        """Cross-entropies of class and depth and the squared error of the linear ones, averaged over pixels, then over levels.

        `classes` and `depths` are u8 [B, N, H / 4, W / 4]; coarser levels are taught by every second and fourth pixel.
        """
        of_class, of_depth, of_place = [], [], []
        for level, (head, linear, features) in enumerate(zip(self.heads, self.linear, pyramid)):
            step = 1 << level
            features = self.norms[level](features)
            truth, bins = (t.flatten(0, 1)[:, step // 2 :: step, step // 2 :: step].long() for t in (classes, depths))
            # [.., 4 * outputs, h, w] -> [.., outputs, 2h, 2w]
            logits = F.pixel_shuffle(head(features), 2).float()
            of_class.append(F.cross_entropy(logits[:, : self.classes], truth))
            counted = F.cross_entropy(logits[:, self.classes :], bins, ignore_index=IGNORED, reduction="sum")
            of_depth.append(counted / (bins != IGNORED).sum().clamp(min=1))
            of_place.append(self.error_of_place(linear(features).float(), bins[:, 1::2, 1::2]))
        levels = {"class": of_class, "depth": of_depth, "place": of_place}
        return {name: torch.stack(losses).mean() for name, losses in levels.items()}

    @staticmethod
    def error_of_place(found: Tensor, bins: Tensor) -> Tensor:
        """`found` [B, 3, h, w] against row and column, both -1 to 1, and the bins' centres, 0 to 2, where there is no sky."""
        _, _, height, width = found.shape
        rows = torch.linspace(-1.0, 1.0, height, device=found.device).view(1, height, 1)
        columns = torch.linspace(-1.0, 1.0, width, device=found.device).view(1, 1, width)
        solid = bins != IGNORED
        depth = (found[:, 2] - (bins + 0.5) * (2.0 / DEPTH_BINS)).square() * solid
        return (found[:, 0] - rows).square().mean() + (found[:, 1] - columns).square().mean() + depth.sum() / solid.sum().clamp(min=1)


class PlaceHeads(nn.Module):
    """Linear in the refined features of a voxel of levels 1 to 3: x, y, height, and the logarithm of the distance in the plane."""

    def __init__(self, network: Network):
        super().__init__()
        self.linear = nn.ModuleList(nn.Linear(channels, 4) for channels in network.channels[1:])
        for level, grid in enumerate(network.grids):
            self.register_buffer(f"places{level}", places(network.bounds, grid), persistent=False)

    def loss(self, volumes: list) -> Tensor:
        """Squared error, averaged over voxels, then over levels. `volumes` are those of levels 1 to 3."""
        errors = []
        for level, (linear, volume) in enumerate(zip(self.linear, volumes)):
            found = linear(volume.permute(0, 2, 3, 4, 1)).float()
            errors.append((found - getattr(self, f"places{level}")).square().sum(-1).mean())
        return torch.stack(errors).mean()


def places(bounds: tuple, grid: tuple) -> Tensor:
    """[X, Y, Z, 4]: x, y and z of the centres of voxels, -1 to 1 within the bounds, and log distance from the middle,
    of which a factor e is 1."""
    axes = [torch.linspace(-1.0 + 1.0 / n, 1.0 - 1.0 / n, n) for n in grid]
    x, y, z = torch.meshgrid(*axes, indexing="ij")
    (x0, x1), (y0, y1) = bounds[:2]
    distance = torch.sqrt((x * (x1 - x0) / 2).square() + (y * (y1 - y0) / 2).square())
    logarithm = (distance + 1.0).log() - math.log(25.0)
    return torch.stack((x, y, z, logarithm), -1)


class AuxiliaryHeads(nn.Module):
    """All of them."""

    def __init__(self, network: Network):
        super().__init__()
        self.pixels = PixelHeads(network)
        self.places = PlaceHeads(network)

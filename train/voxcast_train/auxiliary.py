"""Heads that exist during training only: what each pixel shows and how far away it is.

A voxel grid says little to a backbone that starts from nothing, since hundreds of voxels share a pixel. These heads tell every
level of the pyramid directly. They are not part of the network and are not exported.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .data import DEPTH_BINS
from .losses import IGNORED
from .network import Network

HIDDEN = 64


class PixelHeads(nn.Module):
    """Per pyramid level: class (sky is one more) and depth bin, at twice the level's resolution."""

    def __init__(self, network: Network):
        super().__init__()
        self.classes = network.classes + 1
        outputs = 4 * (self.classes + DEPTH_BINS)
        self.heads = nn.ModuleList(
            nn.Sequential(nn.Conv2d(network.fpn, HIDDEN, 1), nn.ReLU(inplace=True), nn.Conv2d(HIDDEN, outputs, 1)) for _ in range(3)
        )

    def losses(self, pyramid: list, classes: Tensor, depths: Tensor) -> tuple:
        """Cross-entropies of class and depth, averaged over pixels and then over levels.

        `classes` and `depths` are u8 [B, N, H / 4, W / 4]; coarser levels are taught by every second and fourth pixel.
        """
        of_class, of_depth = [], []
        for level, (head, features) in enumerate(zip(self.heads, pyramid)):
            step = 1 << level
            truth, bins = (t.flatten(0, 1)[:, step // 2 :: step, step // 2 :: step].long() for t in (classes, depths))
            # [.., 4 * outputs, h, w] -> [.., outputs, 2h, 2w]
            logits = F.pixel_shuffle(head(features), 2).float()
            of_class.append(F.cross_entropy(logits[:, : self.classes], truth))
            counted = F.cross_entropy(logits[:, self.classes :], bins, ignore_index=IGNORED, reduction="sum")
            of_depth.append(counted / (bins != IGNORED).sum().clamp(min=1))
        return torch.stack(of_class).mean(), torch.stack(of_depth).mean()

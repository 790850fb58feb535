"""Projection matrices from a rig file, and the gather: the mean of the feature pixels that a voxel sees.

Nothing is projected here. `voxcast rig` decides which pixels belong to which voxel, in training as at run time.
"""

import warnings
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor

from .errors import InputError


def compressed(ptr: Tensor, col: Tensor, values: Tensor, size: tuple) -> Tensor:
    """A sparse CSR tensor, checked."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta")
        return torch.sparse_csr_tensor(ptr, col, values, size, check_invariants=True)


class GatherMean(torch.autograd.Function):
    """y = A x for a sparse A whose rows sum to one, with the transposed matrix at hand for the backward pass."""

    @staticmethod
    def forward(ctx, x, matrix, transposed):
        ctx.transposed = transposed
        with torch.autocast(x.device.type, enabled=False):  # sparse products exist in f32 only
            return torch.sparse.mm(matrix, x)

    @staticmethod
    def backward(ctx, gradient):
        return torch.sparse.mm(ctx.transposed, gradient.contiguous()), None, None


class Matrix:
    """One 0/1 matrix as compressed rows, scaled so that a product with it is a mean. A row without entries gives 0."""

    def __init__(self, ptr: Tensor, col: Tensor, pixels: int):
        rows = len(ptr) - 1
        lengths = ptr[1:] - ptr[:-1]
        row = torch.repeat_interleave(torch.arange(rows), lengths)
        values = (1.0 / lengths.clamp(min=1))[row].float()
        order = torch.argsort(col, stable=True)
        transposed_ptr = torch.zeros(pixels + 1, dtype=torch.int64)
        transposed_ptr[1:] = torch.bincount(col, minlength=pixels).cumsum(0)
        self.forward = compressed(ptr, col, values, (rows, pixels))
        self.backward = compressed(transposed_ptr, row[order], values[order], (pixels, rows))

    def to(self, device) -> "Matrix":
        self.forward, self.backward = self.forward.to(device), self.backward.to(device)
        return self

    def mean(self, features: Tensor, batch: int) -> Tensor:
        """Feature maps [B * N, C, h, w] -> f32 [B, rows, C]."""
        channels = features.shape[1]
        # [B, pixels, C] -> [pixels, B * C]: one product serves all frames.
        pixels = features.float().permute(0, 2, 3, 1).reshape(batch, -1, channels)
        columns = pixels.transpose(0, 1).reshape(-1, batch * channels)
        rows = GatherMean.apply(columns, self.forward, self.backward)
        return rows.view(-1, batch, channels).transpose(0, 1)


class Rig:
    """The six matrices of a rig: `levels[l]` is the pair (volume, bird's-eye view) of level l + 1."""

    def __init__(self, levels: list):
        self.levels = levels

    @staticmethod
    def load(path, network) -> "Rig":
        """Reads a rig and checks it against the network's sizes. Raises InputError with the tensor that is wrong."""
        tensors = load_file(Path(path))
        levels = []
        for index in range(3):
            x, y, z = network.grids[index]
            height, width = network.feature_size(index)
            pixels = network.cameras * height * width
            pair = []
            for name, rows in ((f"level{index + 1}.volume", x * y * z), (f"level{index + 1}.bev", x * y)):
                try:
                    ptr, col = (tensors[f"{name}.{part}"].to(torch.int64) for part in ("ptr", "col"))
                except KeyError as error:
                    raise InputError(f"{path}: no tensor {error}") from error
                if len(ptr) != rows + 1 or (len(col) and int(col.max()) >= pixels):
                    raise InputError(f"{path}: {name}: found {len(ptr) - 1} rows, expected {rows}, of columns below {pixels}")
                pair.append(Matrix(ptr, col, pixels))
            levels.append(tuple(pair))
        return Rig(levels)

    def to(self, device) -> "Rig":
        for pair in self.levels:
            for matrix in pair:
                matrix.to(device)
        return self

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

    def __init__(self, ptr: Tensor, col: Tensor, pixels: int, cameras: int):
        rows = len(ptr) - 1
        lengths = ptr[1:] - ptr[:-1]
        row = torch.repeat_interleave(torch.arange(rows), lengths)
        values = (1.0 / lengths.clamp(min=1))[row].float()
        order = torch.argsort(col, stable=True)
        transposed_ptr = torch.zeros(pixels + 1, dtype=torch.int64)
        transposed_ptr[1:] = torch.bincount(col, minlength=pixels).cumsum(0)
        self.forward = compressed(ptr, col, values, (rows, pixels))
        self.backward = compressed(transposed_ptr, row[order], values[order], (pixels, rows))
        self.shares = torch.zeros(rows, cameras)
        """Part of each row's pixels that each camera has."""
        self.shares.view(-1).index_add_(0, row * cameras + col // (pixels // cameras), values)
        self.counts = lengths.float()
        """Pixels of each row."""

    def to(self, device) -> "Matrix":
        for name in ("forward", "backward", "shares", "counts"):
            setattr(self, name, getattr(self, name).to(device))
        return self

    def columns(self, features: Tensor, batch: int, kept: Tensor | None) -> Tensor:
        """Feature maps [B * N, C, h, w] -> [pixels, B * C], so that one product serves all frames; 0 where `kept` [B, N] is."""
        pixels = features.permute(0, 2, 3, 1).reshape(batch, -1, features.shape[1])
        if kept is not None:
            parts = pixels.unflatten(1, (kept.shape[1], -1))
            pixels = (parts * kept.to(parts.dtype)[:, :, None, None]).flatten(1, 2)
        return pixels.transpose(0, 1).reshape(pixels.shape[1], -1)

    def product(self, columns: Tensor) -> Tensor:
        """The means of columns, f32."""
        return GatherMean.apply(columns.float(), self.forward, self.backward)

    def mean(self, features: Tensor, batch: int, kept: Tensor | None = None) -> Tensor:
        """Feature maps [B * N, C, h, w] -> f32 [B, rows, C]. Cameras that `kept` [B, N] has a 0 for are masked: the mean
        is over the pixels of the others, and 0 where there are none, as at run time."""
        rows = self.product(self.columns(features, batch, kept))
        rows = rows.view(rows.shape[0], batch, -1).transpose(0, 1)
        if kept is None:
            return rows
        share = kept @ self.shares.t()
        # Sums of shares that are 0 but for rounding belong to rows that no kept camera sees.
        return rows * torch.where(share > 1e-6, 1.0 / share.clamp(min=1e-6), 0.0).unsqueeze(-1)


class DenseMatrix(Matrix):
    """A matrix for GPUs, with a value for every pixel: there a dense product in bf16, whose zeros and ones are exact, takes a
    fraction of a sparse one's time. `ones` [rows, pixels] and `counts` [rows], the pixels of each row."""

    def __init__(self, ones: Tensor, counts: Tensor, shares: Tensor):
        self.ones, self.counts, self.shares = ones, counts, shares

    def product(self, columns: Tensor) -> Tensor:
        return (self.ones @ columns.to(self.ones.dtype)).float() / self.counts.clamp(min=1).unsqueeze(1)


class Rigs:
    """Several rigs of one network on one device. `select` gives one of them."""

    def __init__(self, rigs: list, device: torch.device):
        self.dense = device.type == "cuda"
        self.count = len(rigs)
        if not self.dense:
            self.rigs = [rig.to(device) for rig in rigs]
            return
        self.levels = []
        for level in range(3):
            pair = []
            for part in range(2):
                matrices = [rig.levels[level][part] for rig in rigs]
                ones = torch.stack([(m.forward.to(device).to_dense() > 0).to(torch.bfloat16) for m in matrices])
                pair.append((ones, *(torch.stack([getattr(m, name) for m in matrices]).to(device) for name in ("counts", "shares"))))
            self.levels.append(pair)

    def select(self, number) -> "Rig":
        """The rig of a number; on a GPU that is a tensor [1] there, so that a recorded step can use another each time."""
        if not self.dense:
            return self.rigs[int(number)]
        number = torch.as_tensor(number, device=self.levels[0][0][0].device).view(1)
        return Rig([tuple(DenseMatrix(*(t.index_select(0, number)[0] for t in part)) for part in pair) for pair in self.levels])


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
                pair.append(Matrix(ptr, col, pixels, network.cameras))
            levels.append(tuple(pair))
        return Rig(levels)

    def to(self, device) -> "Rig":
        for pair in self.levels:
            for matrix in pair:
                matrix.to(device)
        return self

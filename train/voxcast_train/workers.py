"""Several processes that train one model together, each on its own frames."""

import os
import tempfile
from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor

from .errors import InputError


class Worker:
    """One of `count` processes; `rank` 0 writes files and prints."""

    def __init__(self, rank: int = 0, count: int = 1):
        self.rank, self.count = rank, count
        self.parent = os.getppid()

    @property
    def first(self) -> bool:
        return self.rank == 0

    def check(self) -> None:
        """Raises InputError if the process that started the workers is gone: nobody else would stop them."""
        if self.count > 1 and os.getppid() != self.parent:
            raise InputError("the process that started this worker is gone")

    def sum(self, tensor: Tensor) -> Tensor:
        """The sum over all workers, in place."""
        if self.count > 1:
            dist.all_reduce(tensor)
        return tensor

    def copy_first(self, tensors) -> None:
        """Replaces tensors by those of the first worker."""
        if self.count > 1:
            for tensor in tensors:
                dist.broadcast(tensor.detach(), 0)

    def average_gradients(self, parameters: list) -> None:
        """Replaces each gradient by its mean over all workers, in one exchange."""
        if self.count == 1:
            return
        gradients = [p.grad for p in parameters]
        flat = self.sum(torch.cat([gradient.flatten() for gradient in gradients])) / self.count
        for gradient, part in zip(gradients, flat.split([gradient.numel() for gradient in gradients])):
            gradient.copy_(part.view_as(gradient))


def start(rank: int, count: int, store: str, work, arguments: tuple) -> None:
    dist.init_process_group("gloo", init_method=f"file://{store}", rank=rank, world_size=count)
    try:
        work(*arguments, Worker(rank, count))
    finally:
        dist.destroy_process_group()


def run_workers(count: int, work, arguments: tuple) -> None:
    """Calls `work(*arguments, worker)` in `count` processes, or here if it is one. Raises InputError if one fails."""
    if count == 1:
        work(*arguments, Worker())
        return
    with tempfile.TemporaryDirectory() as directory:
        store = str(Path(directory) / "store")
        try:
            torch.multiprocessing.spawn(start, (count, store, work, arguments), nprocs=count)
        except torch.multiprocessing.ProcessRaisedException as error:
            raise InputError(f"a worker failed: {str(error).strip().splitlines()[-1]}") from error

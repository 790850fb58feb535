"""Checkpoints to models, from files or from memory."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping
from typing import Any, Literal

import numpy

from . import _native


def import_checkpoint(
    checkpoint: str | os.PathLike[str] | Mapping[str, Any] | Any,
    network: str | os.PathLike[str] | Mapping[str, Any] | Any,
    output: str | os.PathLike[str] | None = None,
    *,
    precision: Literal["f32", "f16"] = "f32",
    fold: Literal["all", "batch-norm", "none"] = "all",
    exact: bool = False,
    self_test: bool = True,
    threads: int | None = None,
) -> _native.Model:
    """Turns a checkpoint into a model: batch norms and the projection folded in float64, weights packed.

    checkpoint: a .pth or .safetensors file; or a `torch.nn.Module` of the training code; or its state dict; or any mapping
        of the published names to arrays. A .pth is read without executing anything.
    network: "nuscenes-200", "nuscenes-256", "semantickitti-256", "edge", a network.json; or its keys as a mapping or a
        dataclass, such as `voxcast_train.network.Network`.
    output: the file to write; without one the model stays in memory.
    precision: how weights are stored. fold: "batch-norm" keeps the pyramid's features, "none" batch norms and direct sums
        too. exact: every convolution is a direct sum, none Winograd's minimal filtering.
    self_test: record what the model must give, for `Model.selftest`. Only a file has one.

    Raises FormatError or MismatchError naming the tensor that is missing, of another shape, or not finite.
    """
    text = _network(network)
    target = None if output is None else os.fspath(output)
    wish = (text, target, precision, fold, exact, self_test, threads)
    if isinstance(checkpoint, (str, os.PathLike)):
        return _native.import_file(os.fspath(checkpoint), wish)
    if not isinstance(checkpoint, Mapping) and not hasattr(checkpoint, "state_dict"):
        found = type(checkpoint).__name__
        raise TypeError(f"checkpoint: found {found}, expected a file, a module, or a mapping of names to arrays")
    state = checkpoint if isinstance(checkpoint, Mapping) else checkpoint.state_dict()
    return _native.import_tensors(_tensors(state), wish)


def _network(network: Any) -> str:
    """The network as JSON."""
    if isinstance(network, (str, os.PathLike)):
        return _native.network_json(os.fspath(network))
    if dataclasses.is_dataclass(network) and not isinstance(network, type):
        network = dataclasses.asdict(network)
    if not isinstance(network, Mapping):
        raise TypeError(f"network: found {type(network).__name__}, expected a name, a file, a mapping or a dataclass")
    return json.dumps(dict(network))


def _tensors(state: Mapping[str, Any]) -> dict[str, numpy.ndarray[Any, Any]]:
    """The floating-point tensors of a state dict as float32 or float64 arrays. Others, such as counters, are left out."""
    tensors = {}
    for name, tensor in state.items():
        # PyTorch's; bfloat16 is not known to NumPy.
        if hasattr(tensor, "detach"):
            if not tensor.is_floating_point():
                continue
            tensor = tensor.detach().cpu()
            tensor = (tensor if str(tensor.dtype) in ("torch.float32", "torch.float64") else tensor.float()).numpy()
        array = numpy.asarray(tensor)
        if array.dtype.kind == "f":
            tensors[name] = array if array.dtype in (numpy.float32, numpy.float64) else array.astype(numpy.float32)
    return tensors

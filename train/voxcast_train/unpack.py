"""Reads a voxcast model file back into weights that can be trained.

A model has its batch norms folded and its matrices packed (docs/format.md). Unpacked, every convolution has its folded weights,
and the batch norm behind it only adds the folded bias. That is the model's function in evaluation mode. Training
normalises by the statistics of the batch, so `restore_norms` then measures what every batch norm sees and gives it the scale
and shift that undo the normalisation. The function stays, and training goes on from it.
"""

import json
from pathlib import Path

import torch
from safetensors import safe_open
from torch import Tensor, nn

from .errors import InputError
from .network import HEADS, CascadedGroupAttention, InverseMatrixVT3D, OccupancyHead

LANES = 16
"""Columns of a packed panel."""

EPSILON = 1e-5
"""That of every batch norm of the network."""


def unpanelled(packed: Tensor, rows: int, columns: int) -> Tensor:
    """Packed panels, perhaps with padding behind them -> [rows, columns]."""
    panels = -(-columns // LANES)
    packed = packed[: panels * rows * LANES].view(panels, rows, LANES)
    return packed.transpose(0, 1).reshape(rows, panels * LANES)[:, :columns].contiguous()


def unlaned(stored: Tensor, rows: int, columns: int) -> Tensor:
    """Rows that are each padded to full lanes -> [rows, columns]."""
    padded = -(-columns // LANES) * LANES
    return stored[: rows * padded].view(rows, padded)[:, :columns]


class Packed:
    """The tensors of a model file."""

    def __init__(self, path: Path):
        self.path = path
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != "voxcast-model-1":
                raise InputError(f"{path}: format: found {metadata.get('format')}, expected voxcast-model-1")
            if metadata.get("batch_norm") != "folded":
                raise InputError(f"{path}: batch_norm: found {metadata.get('batch_norm')}, expected folded")
            if "winograd" in metadata:
                raise InputError(f"{path}: winograd: found {metadata['winograd']}, expected direct sums, as import --exact makes them")
            self.network = json.loads(metadata["network"])
            self.tensors = {name: file.get_tensor(name) for name in file.keys()}

    def __getitem__(self, name: str) -> Tensor:
        try:
            return self.tensors[name].float()
        except KeyError as error:
            raise InputError(f"{self.path}: no tensor {error}") from error

    def convolution(self, name: str, like: Tensor) -> Tensor:
        """Weights [out, in, taps...] of the convolution `name`, shaped as `like`."""
        outputs, inputs, *taps = like.shape
        matrix = unpanelled(self[f"{name}.weight"], like.numel() // outputs, outputs)
        return matrix.view(*taps, inputs, outputs).permute(-1, -2, *range(len(taps))).reshape(like.shape)

    def depthwise(self, name: str, like: Tensor) -> Tensor:
        channels, _, *taps = like.shape
        return unlaned(self[f"{name}.weight"], like.numel() // channels, channels).t().reshape(like.shape)

    def transposed(self, name: str, like: Tensor) -> Tensor:
        """Weights [in, out, 4, 4, 4] from the eight products, one per parity of the output voxel."""
        inputs, outputs = like.shape[:2]
        weight = torch.empty_like(like)
        padded = -(-outputs // LANES) * LANES
        parts = self[f"{name}.weight"][: 64 * inputs * padded].view(2, 2, 2, -1)
        for d in range(2):
            for h in range(2):
                for w in range(2):
                    taps = unpanelled(parts[d, h, w], 8 * inputs, outputs).view(2, 2, 2, inputs, outputs).permute(3, 4, 0, 1, 2)
                    # Tap 3 - p - 2t of each axis, t = 0 and 1.
                    at_d, at_h, at_w = (torch.tensor([3 - p, 1 - p]) for p in (d, h, w))
                    weight[:, :, at_d[:, None, None], at_h[:, None], at_w] = taps
        return weight

    def bias(self, name: str, channels: int) -> Tensor:
        return self[f"{name}.bias"][:channels]


def norms_of(model: nn.Module) -> dict:
    """Names of the convolutions that a batch norm follows, and of that norm."""
    norms = {}
    for name, module in model.named_modules():
        if isinstance(module, (nn.BatchNorm2d, nn.BatchNorm3d)):
            parent, _, own = name.rpartition(".")
            before = {"bn": "c", "bn1": "conv1", "bn2": "conv2", "bn3": "conv3"}.get(own) or str(int(own) - 1)
            norms[f"{parent}.{before}"] = name
    return norms


@torch.no_grad()
def unpack(path, model: InverseMatrixVT3D) -> None:
    """Fills a model with the weights of a model file. Raises InputError if it belongs to another network."""
    packed = Packed(Path(path))
    network = model.network
    for key in ("depths", "width", "dcn", "block", "fpn", "channels", "key_dims", "classes", "grids"):
        mine = json.loads(json.dumps(getattr(network, key)))
        if packed.network.get(key) != mine:
            raise InputError(f"{path}: {key}: found {packed.network.get(key)}, expected {mine} of the network")
    try:
        fill_all(packed, model)
    except RuntimeError as error:
        raise InputError(f"{path}: a tensor has not the length that the network asks for: {error}") from error


def fill_all(packed: Packed, model: InverseMatrixVT3D) -> None:
    norms = norms_of(model)
    for name, module in model.named_modules():
        if isinstance(module, CascadedGroupAttention):
            unpack_attention(packed, name, module)
        if isinstance(module, OccupancyHead):
            unpack_head(packed, name, module)
    for name, module in model.named_modules():
        if not isinstance(module, (nn.Conv2d, nn.Conv3d, nn.ConvTranspose3d)) or ".mixer.m.attn." in name:
            continue
        channels = module.out_channels
        if name.endswith(".combine_coeff"):
            module.weight.copy_(packed[f"{name}.weight"][: module.in_channels].view_as(module.weight))
            module.bias.copy_(packed[f"{name}.bias"][:1])
            continue
        if isinstance(module, nn.ConvTranspose3d):
            weight = packed.transposed(name, module.weight)
        elif module.groups > 1:
            weight = packed.depthwise(name, module.weight)
        else:
            weight = packed.convolution(name, module.weight)
        if name not in norms:
            module.weight.copy_(weight)
            if module.bias is not None:
                module.bias.copy_(packed.bias(name, channels))
            continue
        fill(module, model.get_submodule(norms[name]), weight, packed.bias(name, channels))


def fill(convolution: nn.Module, norm: nn.Module, weight: Tensor, bias: Tensor) -> None:
    """Sets a convolution and the norm behind it. The weights keep the spread that they have in a new model, for which learning
    rates are chosen; the norm's scale makes up for it."""
    scale = convolution.weight.std() / weight.std().clamp(min=1e-8)
    convolution.weight.copy_(weight * scale)
    if convolution.bias is not None:
        convolution.bias.zero_()
    norm.running_mean.zero_()
    norm.running_var.fill_(1.0 - EPSILON)
    norm.weight.fill_(1.0 / scale)
    norm.bias.copy_(bias)


def unpack_attention(packed: Packed, name: str, attention: CascadedGroupAttention) -> None:
    width = attention.key_dim
    channels = attention.proj[1].c.out_channels
    share = channels // HEADS
    padded = -(-3 * width // LANES) * LANES
    qkv = packed[f"{name}.qkv.weight"][: HEADS * share * padded].view(HEADS, -1)
    qkv_bias = unlaned(packed[f"{name}.qkv.bias"], HEADS, 3 * width)
    query = unlaned(packed[f"{name}.query.weight"], HEADS * 25, width).view(HEADS, 25, width)
    query_bias = unlaned(packed[f"{name}.query.bias"], HEADS, width)
    for head in range(HEADS):
        first, depthwise = attention.qkvs[head], attention.dws[head]
        fill(first.c, first.bn, unpanelled(qkv[head], share, 3 * width).t().view_as(first.c.weight), qkv_bias[head])
        fill(depthwise.c, depthwise.bn, query[head].t().reshape(depthwise.c.weight.shape), query_bias[head])
    offsets = attention.attention_biases
    offsets.copy_(packed[f"{name}.offsets"][: offsets.numel()].view_as(offsets))
    last = attention.proj[1]
    weight = unpanelled(packed[f"{name}.proj.weight"], width * HEADS, channels).t().view_as(last.c.weight)
    fill(last.c, last.bn, weight, packed.bias(f"{name}.proj", channels))


def unpack_head(packed: Packed, name: str, head: OccupancyHead) -> None:
    for level_name, mlp in head.named_children():
        for stored, at in (("0", 0), ("1", 2), ("2", 4)):
            layer = mlp[at]
            weight = unpanelled(packed[f"{name}.{level_name}.{stored}.weight"], layer.in_features, layer.out_features)
            layer.weight.copy_(weight.t())
            layer.bias.copy_(packed.bias(f"{name}.{level_name}.{stored}", layer.out_features))


@torch.no_grad()
def restore_norms(model: InverseMatrixVT3D, forward) -> None:
    """Gives every batch norm the statistics of what `forward()` sends through it and the scale and shift that undo them.

    Norms that do nothing (`unpack`) must be in place. The model ends in training mode.
    """
    seen = {}

    def measure(module, inputs, _):
        x = inputs[0].float()
        axes = [0, *range(2, x.ndim)]
        seen[module] = (x.mean(axes), x.var(axes, unbiased=False))

    norms = [m for m in model.modules() if isinstance(m, (nn.BatchNorm2d, nn.BatchNorm3d))]
    hooks = [module.register_forward_hook(measure) for module in norms]
    model.eval()
    forward()
    for hook in hooks:
        hook.remove()
    for module in norms:
        mean, variance = seen[module]
        module.running_mean.copy_(mean)
        module.running_var.copy_(variance)
        module.bias.add_(mean * module.weight)
        module.weight.mul_((variance + module.eps).sqrt())
    model.train()

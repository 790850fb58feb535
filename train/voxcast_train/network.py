"""The network that `voxcast` runs, as PyTorch modules that can be trained.

Architecture and parameter names are those of published InverseMatrixVT3D checkpoints (arXiv 2401.12422), so that an exported
state dict is what `voxcast import` takes. Deformable stages (DCNv2) are refused: they need an operator beyond PyTorch.

Shapes: B frames of N cameras, feature maps [B * N, C, H, W], volumes [B, C, X, Y, Z], planes [B, C, X, Y].
"""

import json
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .errors import InputError
from .rig import Rig

HEADS = 8
"""Attention heads of the EfficientViT block (arXiv 2305.07027); fixed by the published architecture."""

MEAN_BGR = (103.530, 116.280, 123.675)
"""Subtracted from images in BGR order; there is no scaling."""


@dataclass(frozen=True)
class Network:
    """The keys of a `network.json`; docs/format.md says what each means."""

    depths: tuple
    width: int
    dcn: tuple
    fpn: int
    channels: tuple
    key_dims: tuple
    bounds: tuple
    classes: int
    image: tuple
    grids: tuple
    samples: tuple
    block: str = "bottleneck"
    strides: tuple = (8, 16, 32)
    sampling: str = "linspace"
    cameras: int = 6

    @staticmethod
    def load(path) -> "Network":
        """Reads a network.json. Raises InputError for what training cannot do; `voxcast import` checks the rest."""
        try:
            network = Network(**json.loads(Path(path).read_text()))
        except (TypeError, json.JSONDecodeError) as error:
            raise InputError(f"{path}: {error}") from error
        if any(network.dcn):
            raise InputError(f'{path}: "dcn": found {list(network.dcn)}, expected no deformable stage: they cannot be trained here')
        if any(kd * HEADS != c for kd, c in zip(network.key_dims, network.channels[1:])):
            raise InputError(f'{path}: "key_dims": found {list(network.key_dims)}, expected an eighth of "channels" from level 1 on')
        return network

    def output_grid(self) -> tuple:
        """Voxels along x, y, z of level 0."""
        return tuple(2 * side for side in self.grids[0])

    def feature_size(self, level: int) -> tuple:
        """Height and width of the feature maps at level index 0..2 (levels 1 to 3)."""
        return tuple(side // self.strides[level] for side in self.image)


# Backbone and neck -------------------------------------------------------------------------------------------------------


class Bottleneck(nn.Module):
    """1x1, 3x3, 1x1; the stride sits on the first 1x1 (the "caffe" style)."""

    expansion = 4

    def __init__(self, inputs, channels, stride):
        super().__init__()
        outputs = self.expansion * channels
        self.conv1 = nn.Conv2d(inputs, channels, 1, stride, bias=False)
        self.bn1 = nn.BatchNorm2d(channels)
        self.conv2 = nn.Conv2d(channels, channels, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels)
        self.conv3 = nn.Conv2d(channels, outputs, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(outputs)
        self.downsample = shortcut(inputs, outputs, stride)

    def forward(self, x):
        y = F.relu(self.bn1(self.conv1(x)), inplace=True)
        y = F.relu(self.bn2(self.conv2(y)), inplace=True)
        y = self.bn3(self.conv3(y))
        return F.relu(y + (x if self.downsample is None else self.downsample(x)), inplace=True)


class BasicBlock(nn.Module):
    """3x3, 3x3."""

    expansion = 1

    def __init__(self, inputs, channels, stride):
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, channels, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(channels)
        self.conv2 = nn.Conv2d(channels, channels, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels)
        self.downsample = shortcut(inputs, channels, stride)

    def forward(self, x):
        y = F.relu(self.bn1(self.conv1(x)), inplace=True)
        y = self.bn2(self.conv2(y))
        return F.relu(y + (x if self.downsample is None else self.downsample(x)), inplace=True)


def shortcut(inputs, outputs, stride):
    """The projection beside a residual block, or None where the shape stays."""
    if stride == 1 and inputs == outputs:
        return None
    return nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs))


class ResNet(nn.Module):
    """Images to C3, C4, C5 of strides 8, 16, 32 (He et al., arXiv 1512.03385)."""

    def __init__(self, network: Network):
        super().__init__()
        block = BasicBlock if network.block == "basic" else Bottleneck
        self.conv1 = nn.Conv2d(3, network.width, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(network.width)
        inputs = network.width
        self.outputs = []
        for stage, depth in enumerate(network.depths):
            channels = network.width << stage
            blocks = []
            for index in range(depth):
                blocks.append(block(inputs, channels, 2 if stage > 0 and index == 0 else 1))
                inputs = block.expansion * channels
            setattr(self, f"layer{stage + 1}", nn.Sequential(*blocks))
            self.outputs.append(inputs)

    def forward(self, x):
        x = F.max_pool2d(F.relu(self.bn1(self.conv1(x)), inplace=True), 3, 2, 1)
        x = self.layer1(x)
        c3 = self.layer2(x)
        c4 = self.layer3(c3)
        return c3, c4, self.layer4(c4)


class ConvModule(nn.Module):
    """A convolution under the name that mmcv gives it."""

    def __init__(self, *args, **kwargs):
        super().__init__()
        self.conv = nn.Conv2d(*args, **kwargs)

    def forward(self, x):
        return self.conv(x)


class Fpn(nn.Module):
    """Feature pyramid (arXiv 1612.03144) without norms and activations."""

    def __init__(self, inputs, channels):
        super().__init__()
        self.lateral_convs = nn.ModuleList(ConvModule(c, channels, 1) for c in inputs)
        self.fpn_convs = nn.ModuleList(ConvModule(channels, channels, 3, padding=1) for _ in inputs)

    def forward(self, features):
        maps = [conv(x) for conv, x in zip(self.lateral_convs, features)]
        for i in range(len(maps) - 1, 0, -1):
            maps[i - 1] = maps[i - 1] + F.interpolate(maps[i], size=maps[i - 1].shape[2:], mode="nearest")
        return [conv(x) for conv, x in zip(self.fpn_convs, maps)]


# Bird's-eye-view plane: EfficientViT block, then atrous pyramid -----------------------------------------------------------


class ConvNorm(nn.Sequential):
    def __init__(self, inputs, outputs, kernel=1, groups=1):
        super().__init__()
        self.add_module("c", nn.Conv2d(inputs, outputs, kernel, 1, kernel // 2, groups=groups, bias=False))
        self.add_module("bn", nn.BatchNorm2d(outputs))


class Residual(nn.Module):
    def __init__(self, inner):
        super().__init__()
        self.m = inner

    def forward(self, x):
        return x + self.m(x)


class FeedForward(nn.Module):
    def __init__(self, channels):
        super().__init__()
        self.pw1 = ConvNorm(channels, 2 * channels)
        self.pw2 = ConvNorm(2 * channels, channels)

    def forward(self, x):
        return self.pw2(F.relu(self.pw1(x), inplace=True))


class CascadedGroupAttention(nn.Module):
    """Each head sees its share of the channels plus the output of the head before it."""

    def __init__(self, channels, key_dim, side):
        super().__init__()
        self.key_dim = key_dim
        self.qkvs = nn.ModuleList(ConvNorm(channels // HEADS, 3 * key_dim) for _ in range(HEADS))
        self.dws = nn.ModuleList(ConvNorm(key_dim, key_dim, 5, groups=key_dim) for _ in range(HEADS))
        self.proj = nn.Sequential(nn.ReLU(), ConvNorm(key_dim * HEADS, channels))
        # Offsets (|dy|, |dx|) are numbered in the order in which pairs of points first show them: row-major.
        at = torch.arange(side)
        distance = (at.view(-1, 1) - at).abs()
        index = distance.view(side, 1, side, 1) * side + distance.view(1, side, 1, side)
        self.attention_biases = nn.Parameter(torch.zeros(HEADS, side * side))
        self.register_buffer("attention_bias_idxs", index.reshape(side * side, side * side))

    def forward(self, x):
        windows, _, height, width = x.shape
        outputs = []
        carried = None
        for head, share in enumerate(x.chunk(HEADS, 1)):
            share = share if carried is None else share + carried
            q, k, v = self.qkvs[head](share).split(self.key_dim, 1)
            q = self.dws[head](q)
            q, k, v = (t.flatten(2) for t in (q, k, v))
            scores = (q.transpose(1, 2) @ k) * self.key_dim**-0.5 + self.attention_biases[head][self.attention_bias_idxs]
            carried = (v @ scores.softmax(-1).transpose(1, 2)).view(windows, self.key_dim, height, width)
            outputs.append(carried)
        return self.proj(torch.cat(outputs, 1))


class WindowAttention(nn.Module):
    """Attention within windows of at most 7 x 7. Padding is zero before qkv's batch norm, so padded tokens take part."""

    def __init__(self, channels, key_dim, side):
        super().__init__()
        self.side = min(7, side)
        self.attn = CascadedGroupAttention(channels, key_dim, self.side)

    def forward(self, x):
        batch, channels, height, width = x.shape
        side = self.side
        if height <= side and width <= side:
            return self.attn(x)
        # Not by negative numbers: ONNX's division of integers rounds towards zero.
        rows, columns = (height + side - 1) // side, (width + side - 1) // side
        x = F.pad(x, (0, columns * side - width, 0, rows * side - height))
        x = x.reshape(batch, channels, rows, side, columns, side).permute(0, 2, 4, 1, 3, 5)
        x = self.attn(x.reshape(-1, channels, side, side)).reshape(batch, rows, columns, channels, side, side)
        x = x.permute(0, 3, 1, 4, 2, 5).reshape(batch, channels, rows * side, columns * side)
        return x[:, :, :height, :width]


class EfficientVitBlock(nn.Module):
    def __init__(self, channels, key_dim, side):
        super().__init__()
        self.dw0 = Residual(ConvNorm(channels, channels, 3, groups=channels))
        self.ffn0 = Residual(FeedForward(channels))
        self.mixer = Residual(WindowAttention(channels, key_dim, side))
        self.dw1 = Residual(ConvNorm(channels, channels, 3, groups=channels))
        self.ffn1 = Residual(FeedForward(channels))

    def forward(self, x):
        return self.ffn1(self.dw1(self.mixer(self.ffn0(self.dw0(x)))))


def conv_norm_relu(inputs, outputs, kernel=1, dilation=1, bias=False):
    conv = nn.Conv2d(inputs, outputs, kernel, padding=dilation * (kernel // 2), dilation=dilation, bias=bias)
    return [conv, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)]


class GlobalPool(nn.Sequential):
    def __init__(self, channels):
        super().__init__(nn.AdaptiveAvgPool2d(1), nn.Conv2d(channels, channels, 1, bias=False), nn.ReLU())

    def forward(self, x):
        return super().forward(x).expand_as(x)


class Aspp(nn.Module):
    """Atrous spatial pyramid pooling (arXiv 1706.05587)."""

    def __init__(self, channels, dilations):
        super().__init__()
        branches = [nn.Sequential(*conv_norm_relu(channels, channels))]
        branches += [nn.Sequential(*conv_norm_relu(channels, channels, 3, d)) for d in dilations]
        self.convs = nn.ModuleList([*branches, GlobalPool(channels)])
        self.project = nn.Sequential(*conv_norm_relu(len(self.convs) * channels, channels))

    def forward(self, x):
        return self.project(torch.cat([branch(x) for branch in self.convs], 1))


class BottleneckAspp(nn.Module):
    def __init__(self, channels):
        super().__init__()
        self.input_conv = nn.Sequential(*conv_norm_relu(channels, channels // 2))
        self.aspp = Aspp(channels // 2, (1, 6, 12, 18))
        self.out_conv = nn.Sequential(*conv_norm_relu(channels // 2, channels))

    def forward(self, x):
        return x + self.out_conv(self.aspp(self.input_conv(x)))


# Volumes ------------------------------------------------------------------------------------------------------------------


def conv3d_norm_relu(inputs, outputs, kernel):
    return [nn.Conv3d(inputs, outputs, kernel, padding=kernel // 2), nn.BatchNorm3d(outputs), nn.ReLU(inplace=True)]


class Level(nn.Module):
    """What one level gathers to a volume: volume branch, bird's-eye-view branch, gate."""

    def __init__(self, network: Network, index: int):
        super().__init__()
        channels = network.channels[index + 1]
        self.grid = network.grids[index]
        sizes = ((network.fpn, channels, 1), (channels, channels, 3), (channels, channels, 3))
        self.down_conv3d = nn.Sequential(*(m for size in sizes for m in conv3d_norm_relu(*size)))
        self.xy_conv = nn.Sequential(*(m for size in sizes for m in conv_norm_relu(*size, bias=True)))
        self.combine_coeff = nn.Conv3d(channels, 1, 1)
        self.aspp_xy = BottleneckAspp(channels)
        self.bev_attn_layer = EfficientVitBlock(channels, network.key_dims[index], self.grid[0])

    def forward(self, volume, plane):
        volume = volume.unflatten(1, tuple(self.grid)).permute(0, 4, 1, 2, 3)
        plane = plane.unflatten(1, tuple(self.grid[:2])).permute(0, 3, 1, 2)
        volume, plane = self.down_conv3d(volume), self.xy_conv(plane)
        plane = self.aspp_xy(self.bev_attn_layer(plane))
        return volume + self.combine_coeff(volume).sigmoid() * plane.unsqueeze(-1)


class ViewTransformer(nn.Module):
    """Features of three levels to volumes of levels 0 to 3."""

    def __init__(self, network: Network):
        super().__init__()
        channels = network.channels
        for i in (1, 2, 3):
            up = nn.ConvTranspose3d(channels[i], channels[i - 1], 4, 2, 1)
            setattr(self, f"up_sample{i}", nn.Sequential(up, nn.BatchNorm3d(channels[i - 1]), nn.ReLU(inplace=True)))
        for i in range(4):
            setattr(self, f"refine_lvl{i}", nn.Sequential(*conv3d_norm_relu(channels[i], channels[i], 3)))
        self.imvts = nn.ModuleList(Level(network, i) for i in range(3))

    @staticmethod
    def gather(features, rig: Rig, batch, kept=None):
        """What levels 1 to 3 gather, the only thing that they know of images: the means of each one's voxels and of its columns,
        f32 [B, rows, C]."""
        return [[matrix.mean(x, batch, kept) for matrix in matrices] for x, matrices in zip(features, rig.levels)]

    def coarse(self, gathered):
        """Refined volumes of levels 1 to 3."""
        v1, v2, v3 = (level(*means) for level, means in zip(self.imvts, gathered))
        r3 = self.refine_lvl3(v3)
        # oneDNN's bf16 gradient of a transposed convolution reads memory that nobody wrote where an axis has length 1.
        with torch.autocast(r3.device.type, enabled=False):
            up3 = self.up_sample3(r3.float())
        r2 = self.refine_lvl2(v2 + up3)
        r1 = self.refine_lvl1(v1 + self.up_sample2(r2))
        return r1, r2, r3

    def fine(self, r1):
        """The refined volume of level 0 out of that of level 1."""
        return self.refine_lvl0(self.up_sample1(r1))

    def forward(self, features, rig: Rig, batch, kept=None):
        r1, r2, r3 = self.coarse(self.gather(features, rig, batch, kept))
        return self.fine(r1), r1, r2, r3


class OccupancyHead(nn.Module):
    """Three linear layers per voxel; one head per level, of which inference uses level 0."""

    def __init__(self, network: Network):
        super().__init__()
        for i, c in enumerate(network.channels):
            layers = (nn.Linear(c, c), nn.ReLU(inplace=True), nn.Linear(c, c), nn.ReLU(inplace=True), nn.Linear(c, network.classes))
            setattr(self, f"mlp_occ_lvl{i}", nn.Sequential(*layers))

    def forward(self, volumes, levels):
        return [getattr(self, f"mlp_occ_lvl{i}")(volumes[i].permute(0, 2, 3, 4, 1)) for i in levels]


class InverseMatrixVT3D(nn.Module):
    """The whole network: images and a rig in, logits out."""

    def __init__(self, network: Network):
        super().__init__()
        self.network = network
        self.img_backbone = ResNet(network)
        self.img_neck = Fpn(self.img_backbone.outputs[1:], network.fpn)
        self.view_transformer = ViewTransformer(network)
        self.occ_head = OccupancyHead(network)
        self.register_buffer("mean", torch.tensor(MEAN_BGR).view(1, 3, 1, 1), persistent=False)

    def pyramid(self, images: Tensor) -> list:
        """Images [B, N, H, W, 3], BGR in 0..255, any float or u8 -> P3, P4, P5, each [B * N, fpn, h, w]."""
        x = images.flatten(0, 1).permute(0, 3, 1, 2).float() - self.mean
        height, width = self.network.image
        x = F.pad(x, (0, width - x.shape[3], 0, height - x.shape[2])).contiguous(memory_format=torch.channels_last)
        return self.img_neck(self.img_backbone(x))

    def volumes(self, pyramid: list, rig: Rig, batch: int, kept: Tensor | None = None) -> tuple:
        """Refined volumes [B, C, X, Y, Z] of levels 0 to 3. Cameras that `kept` [B, N] has a 0 for are masked."""
        return self.view_transformer(pyramid, rig, batch, kept)

    def forward(self, images: Tensor, rig: Rig, levels=(0,), kept: Tensor | None = None) -> list:
        """Logits [B, X, Y, Z, classes] of each level asked for."""
        return self.occ_head(self.volumes(self.pyramid(images), rig, images.shape[0], kept), levels)


def initialise(model: nn.Module) -> None:
    """He initialisation for convolutions and linear layers, biases at 0; PyTorch's defaults for the rest."""
    for module in model.modules():
        if isinstance(module, nn.ConvTranspose3d):
            nn.init.zeros_(module.bias)
        if isinstance(module, (nn.Conv2d, nn.Conv3d, nn.Linear)):
            nn.init.kaiming_normal_(module.weight, mode="fan_in" if isinstance(module, nn.Linear) else "fan_out", nonlinearity="relu")
            if module.bias is not None:
                nn.init.zeros_(module.bias)

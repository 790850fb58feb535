"""IoU and mIoU over a whole set, for all voxels and for parts of the grid."""

import torch
from torch import Tensor

from .losses import IGNORED
from .network import Network

NEAR = 25.0
"""Metres from the ego vehicle, in the plane, that part near voxels from far ones."""

CLASSES = (
    "empty", "barrier", "bicycle", "bus", "car", "construction vehicle", "motorcycle", "pedestrian", "traffic cone", "trailer",
    "truck", "driveable surface", "other flat", "sidewalk", "terrain", "manmade", "vegetation",
)  # fmt: skip

PARTS = ("all", "seen", "near", "far", "near seen", "far seen")


class Confusion:
    """Counts of (label, prediction) per part of the grid; sums over frames, so a mean of frames is never taken."""

    def __init__(self, network: Network):
        self.classes = network.classes
        x, y = (
            (torch.arange(side) + 0.5) / side * (high - low) + low
            for side, (low, high) in zip(network.output_grid()[:2], network.bounds)
        )
        distance = torch.hypot(x.view(-1, 1), y.view(1, -1))
        self.far = (distance >= NEAR).long().unsqueeze(-1)
        # [far, seen, label, prediction]
        self.counts = torch.zeros(2, 2, self.classes, self.classes, dtype=torch.int64)

    def add(self, predicted: Tensor, labels: Tensor, visible: Tensor) -> None:
        """Adds a frame; all three are [X, Y, Z]. Ignored voxels do not count."""
        counted = labels != IGNORED
        part = self.far * 2 + (visible != 0)
        index = (part * self.classes + labels) * self.classes + predicted.long()
        counts = torch.bincount(index[counted], minlength=self.counts.numel())
        self.counts += counts.view(self.counts.shape)

    def part(self, name: str) -> Tensor:
        """The confusion matrix [label, prediction] of one of PARTS."""
        counts = self.counts
        if "near" in name:
            counts = counts[:1]
        elif "far" in name:
            counts = counts[1:]
        if "seen" in name:
            counts = counts[:, 1:]
        return counts.sum((0, 1))

    def report(self) -> dict:
        """Per part: "iou" of occupied, "miou" over the classes that occur, "classes" (None for one that occurs nowhere), in percent."""
        return {name: scores(self.part(name)) for name in PARTS}


def scores(confusion: Tensor) -> dict:
    """IoU of occupied against empty, and per class TP / (TP + FP + FN); the empty class 0 is not among the classes."""
    confusion = confusion.double()
    both = confusion[1:, 1:].sum()
    either = confusion.sum() - confusion[0, 0]
    hit = confusion.diagonal()
    union = confusion.sum(0) + confusion.sum(1) - hit
    classes = [100.0 * float(h / u) if u > 0 else None for h, u in zip(hit[1:], union[1:])]
    found = [value for value in classes if value is not None]
    return {
        "iou": 100.0 * float(both / either) if either > 0 else 0.0,
        "miou": sum(found) / len(found) if found else 0.0,
        "classes": classes,
    }


def table(reports: dict) -> str:
    """Markdown: a row per class, a column per (name, part) of `reports`: {name: {part: scores}}."""
    columns = [(name, part, values) for name, parts in reports.items() for part, values in parts.items()]
    lines = ["| | " + " | ".join(f"{name}, {part}" for name, part, _ in columns) + " |", "|---|" + "---:|" * len(columns)]
    for key, title in (("iou", "**IoU**"), ("miou", "**mIoU**")):
        lines.append(f"| {title} | " + " | ".join(f"**{values[key]:.1f}**" for _, _, values in columns) + " |")
    for index in range(len(columns[0][2]["classes"])):
        title = CLASSES[index + 1] if len(columns[0][2]["classes"]) == len(CLASSES) - 1 else f"class {index + 1}"
        cells = (values["classes"][index] for _, _, values in columns)
        lines.append(f"| {title} | " + " | ".join("-" if cell is None else f"{cell:.1f}" for cell in cells) + " |")
    return "\n".join(lines)

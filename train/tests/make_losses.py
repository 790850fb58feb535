"""Writes losses.json: losses of small fixed inputs, which other implementations can be tested against.

    python tests/make_losses.py
"""

import json
import sys
from pathlib import Path

import torch

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from voxcast_train.losses import level_losses  # noqa: E402


def cases():
    """(name, logits [V, K], labels [V], class weights [K] or None)."""
    draw = torch.Generator().manual_seed(20)

    def logits(voxels, classes, scale):
        # Multiples of 1/64, which decimal JSON holds exactly.
        return (torch.randn(voxels, classes, generator=draw) * scale * 64).round() / 64

    def labels(voxels, classes):
        return torch.randint(classes, (voxels,), generator=draw)

    yield "uniform", torch.zeros(6, 3), torch.tensor([0, 0, 1, 2, 2, 2]), None
    yield "random", logits(40, 5, 1.5), labels(40, 5), None
    yield "weighted", logits(40, 5, 1.5), labels(40, 5), torch.tensor([0.25, 1.0, 2.0, 4.0, 0.5])
    ignored = labels(60, 17)
    ignored[::7] = 255
    yield "ignored", logits(60, 17, 2.0), ignored, None
    absent = labels(30, 4)
    absent[absent == 2] = 0
    yield "absent class", logits(30, 4, 1.0), absent, None
    yield "all empty", logits(20, 4, 1.0), torch.zeros(20, dtype=torch.int64), None
    yield "none empty", logits(20, 4, 1.0), labels(20, 3) + 1, None
    right = labels(30, 6)
    yield "confident and right", 12.0 * torch.nn.functional.one_hot(right, 6).float(), right, None
    yield "confident and wrong", 12.0 * torch.nn.functional.one_hot((right + 1) % 6, 6).float(), right, None


def main():
    records = []
    for name, logits, labels, weights in cases():
        # f64 throughout, so that the numbers are right to every digit that an f32 implementation has.
        losses = level_losses(logits.double(), labels, None if weights is None else weights.double())
        records.append(
            {
                "name": name,
                "logits": logits.tolist(),
                "labels": labels.tolist(),
                "class_weights": None if weights is None else weights.tolist(),
                "losses": {key: loss.item() for key, loss in losses.items()},
            }
        )
    text = ",\n".join(json.dumps(record) for record in records)
    (HERE / "losses.json").write_text(f"[\n{text}\n]\n")


if __name__ == "__main__":
    main()

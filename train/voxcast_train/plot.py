"""Pictures of a run.

    python -m voxcast_train.plot curve log.jsonl curve.png
    python -m voxcast_train.plot front front.json front.png

front.json: [{"name", "milliseconds", "iou", "miou", "megabytes", "shipped"}, ...].
"""

import argparse
import json
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

from .files import replace  # noqa: E402


def save(figure, path) -> None:
    replace(path, lambda temporary: figure.savefig(temporary, dpi=110, format="png"))
    plt.close(figure)


def smooth(values: list, width: int) -> list:
    """Means of up to `width` values around each."""
    half = width // 2
    parts = (values[max(0, i - half) : i + half + 1] for i in range(len(values)))
    return [sum(part) / len(part) for part in parts]


def draw_curve(rows: list, path) -> None:
    """Losses of the training frames at the left, IoU and mIoU of the tuning frames at the right."""
    training = [row for row in rows if row["kind"] == "train"]
    tuning = [row for row in rows if row["kind"] == "evaluate"]
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.5), layout="constrained")
    names = {"focal0": "focal", "lovasz0": "Lovász-softmax", "geometric0": "geometric affinity", "semantic0": "semantic affinity",
             "pixel_class": "class of a pixel", "pixel_depth": "depth of a pixel", "pixel_place": "place of a pixel",
             "voxel_place": "place of a voxel"}  # fmt: skip
    for key, name in names.items():
        # Not every phase has every loss.
        rows_with = [row for row in training if key in row]
        if rows_with:
            left.plot([row["step"] for row in rows_with], smooth([row[key] for row in rows_with], 15), label=name, linewidth=1.2)
    left.set(xlabel="step", ylabel="loss (level 0, and training heads)", yscale="log", title="Training frames")
    left.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=4)
    left.grid(alpha=0.3)
    steps = [row["step"] for row in tuning]
    for part, style in (("all", "-"), ("seen", "--")):
        for key, name, colour in (("iou", "IoU", "tab:blue"), ("miou", "mIoU", "tab:orange")):
            values = [row[part][key] for row in tuning]
            right.plot(steps, values, style, color=colour, marker=".", label=f"{name}, {part} voxels")
    right.set(xlabel="step", ylabel="percent", title="Tuning frames, averaged weights", ylim=(0, None))
    right.legend(fontsize=8)
    right.grid(alpha=0.3)
    save(figure, path)


def draw_front(points: list, path) -> None:
    """Quality against the time of a frame, a colour per network; mIoU at the left, IoU at the right."""
    figure, panels = plt.subplots(1, 2, figsize=(11, 4.5), layout="constrained")
    for axes, key, name in zip(panels, ("miou", "iou"), ("mIoU", "IoU")):
        for number, point in enumerate(points):
            label = f"{point['name']}, {point['megabytes']:.1f} MB" + (" (shipped)" if point.get("shipped") else "")
            axes.scatter(point["milliseconds"], point[key], s=60, color=f"C{number}", label=label)
            axes.annotate(f"{point[key]:.1f}", (point["milliseconds"], point[key]), xytext=(8, -3), textcoords="offset points")
        longest, best = (max(point[k] for point in points) for k in ("milliseconds", key))
        axes.set(xlabel="milliseconds a frame (six cameras)", ylabel="percent, held-out seeds", title=name)
        axes.set(xlim=(0, 1.2 * longest), ylim=(0, min(100.0, 1.2 * best)))
        axes.grid(alpha=0.3)
    panels[0].legend(loc="lower left", fontsize=8)
    save(figure, path)


def main() -> int:
    parser = argparse.ArgumentParser(prog="voxcast_train.plot", description="Draw a run's curve or a quality/time front.")
    parser.add_argument("what", choices=["curve", "front"])
    parser.add_argument("input", type=Path)
    parser.add_argument("output", type=Path)
    options = parser.parse_args()
    try:
        text = options.input.read_text()
        if options.what == "curve":
            draw_curve([json.loads(line) for line in text.splitlines()], options.output)
        else:
            draw_front(json.loads(text), options.output)
    except (OSError, KeyError, json.JSONDecodeError) as error:
        print(f"error: {options.input}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())

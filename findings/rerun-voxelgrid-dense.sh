#!/usr/bin/env bash
# What: Rerun's MCAP importer makes one voxel for every cell of a foxglove.VoxelGrid, the empty ones too, and takes colours
#       from fields named red, green, blue, alpha alone. A grid of one `class` field becomes a solid block without colours;
#       with colours, empty cells stay in the data and are hidden by an alpha of 0 only.
# Why it matters: who writes a semantic grid with classes alone sees a filled cuboid in the viewer; and a 200 x 200 x 16 grid
#       costs 640,000 voxels per frame in the recording however few are occupied.
# Seen with: rerun-sdk 0.41.0, foxglove-sdk 0.30.3, Python 3.11, Linux x86-64, 2026-11-28.
# Input: two grids of 4 x 3 x 2 cells, of which one is occupied, written by Foxglove's own SDK.
# Output seen: "/rgba: 24 voxels, 1 colour with alpha" and "/class: 24 voxels, no colours".
# Exit code: 0 if this is what happens, 1 if it is not any more, 2 if the packages cannot be installed.
set -euo pipefail

place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv || exit 2
venv/bin/pip install --quiet --disable-pip-version-check rerun-sdk==0.41.0 foxglove-sdk==0.30.3 || exit 2

cat > write.py <<'PYTHON'
import foxglove
from foxglove.channels import VoxelGridChannel
from foxglove.messages import (
    PackedElementField, PackedElementFieldNumericType, Pose, Quaternion, Timestamp, Vector3, VoxelGrid,
)


def grid(names, cell):
    stride = len(names)
    fields = [
        PackedElementField(name=name, offset=offset, type=PackedElementFieldNumericType.Uint8)
        for offset, name in enumerate(names)
    ]
    return VoxelGrid(
        timestamp=Timestamp(1, 0),
        frame_id="lidar",
        pose=Pose(position=Vector3(x=0.0, y=0.0, z=0.0), orientation=Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)),
        row_count=3,
        column_count=4,
        cell_size=Vector3(x=1.0, y=1.0, z=1.0),
        slice_stride=12 * stride,
        row_stride=4 * stride,
        cell_stride=stride,
        fields=fields,
        data=b"".join(cell(index) for index in range(24)),
    )


with foxglove.open_mcap("grids.mcap"):
    occupied = bytes([200, 10, 10, 255])
    rgba = grid(["red", "green", "blue", "alpha"], lambda index: occupied if index == 5 else bytes(4))
    VoxelGridChannel("/rgba").log(rgba, log_time=1)
    VoxelGridChannel("/class").log(grid(["class"], lambda index: bytes([4 if index == 5 else 0])), log_time=1)
PYTHON
venv/bin/python write.py

cat > look.py <<'PYTHON'
import sys

from rerun.chunk import McapReader

found = {}
for chunk in McapReader("grids.mcap").stream():
    batch = chunk.to_record_batch()
    if "VoxelGridMap:voxel_indices" not in batch.schema.names:
        continue
    voxels = batch.column("VoxelGridMap:voxel_indices")[0].as_py()
    colours = batch.column("VoxelGridMap:colors")[0].as_py()
    # A colour is 0xRRGGBBAA.
    seen = "no colours" if colours is None else f"{sum(c & 255 != 0 for c in colours)} colour with alpha"
    found[chunk.entity_path] = f"{len(voxels)} voxels, {seen}"
for entity, told in sorted(found.items()):
    print(f"{entity}: {told}")
sys.exit(found != {"/rgba": "24 voxels, 1 colour with alpha", "/class": "24 voxels, no colours"})
PYTHON
venv/bin/python look.py

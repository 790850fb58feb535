"""Classes of a scene from its image files, beside those from the pixels that OpenCV reads in the same files.

    python3 tests/opencv/compare.py --model MODEL SCENE [SCENE ...] [--voxcast target/release/voxcast]

SCENE is a directory with calibration.json and its images, all of one size. For each, the script decodes the images with
OpenCV, puts them into a scene of tensors, runs the program on the directory and on the tensors, and compares the classes of
every voxel. It also says how many decoded values Pillow has different from OpenCV. Exit code 1 if anything differs.

Needs numpy, opencv-python-headless, pillow and safetensors. Not part of the tests that every change runs: those pin decoded
bytes of small images (tests/images).
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile

import cv2
import numpy as np
from PIL import Image
from safetensors.numpy import save_file


def lidar2img(camera):
    """As the program has it: given, or the product in f64, rounded once."""
    if "lidar2img" in camera:
        return np.array(camera["lidar2img"], np.float64).astype(np.float32)
    intrinsic = np.eye(4)
    intrinsic[:3, :3] = camera["intrinsic"]
    return (intrinsic @ np.array(camera["lidar2camera"], np.float64)).astype(np.float32)


def main():
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("scenes", nargs="+", metavar="SCENE")
    arguments.add_argument("--model", required=True)
    arguments.add_argument("--voxcast", default="target/release/voxcast")
    arguments = arguments.parse_args()
    differ = 0
    for scene in arguments.scenes:
        with open(os.path.join(scene, "calibration.json")) as file:
            cameras = json.load(file)["cameras"]
        files = [os.path.join(scene, camera["file"]) for camera in cameras]
        images = np.stack([cv2.imread(file, cv2.IMREAD_COLOR) for file in files])
        pillow = np.stack([np.asarray(Image.open(file).convert("RGB"))[..., ::-1] for file in files])
        with tempfile.TemporaryDirectory() as place:
            tensors = os.path.join(place, "scene.safetensors")
            matrices = np.stack([lidar2img(camera) for camera in cameras])
            save_file({"images": np.ascontiguousarray(images), "lidar2img": matrices}, tensors)
            classes = []
            for source in (scene, tensors):
                out = os.path.join(place, "out.npz")
                subprocess.run([arguments.voxcast, "run", "--model", arguments.model, source, "-o", out], check=True)
                classes.append(np.load(out)["classes"])
        other = int(np.sum(classes[0] != classes[1]))
        decoders = int(np.sum(images != pillow))
        differ += (other > 0) + (decoders > 0)
        print(
            f"{scene}: {other} of {classes[0].size} voxels have another class; "
            f"Pillow and OpenCV differ in {decoders} of {images.size} values"
        )
    sys.exit(1 if differ else 0)


if __name__ == "__main__":
    main()

#!/usr/bin/env bash
# Pillow 13.0.0: a grey PNG of 16 bits (mode I;16) becomes white where one expects its high byte: convert("RGB") and
# convert("L") clip every value above 255 instead of scaling. OpenCV 5.0.0 (IMREAD_COLOR) takes the high byte, and so does
# Pillow itself for an RGB PNG of 16 bits. Whoever normalises a data set of 16-bit frames (thermal, infrared, HDR cameras)
# with Pillow and runs it with OpenCV, or the other way round, has other pixels.
#
# Seen: values 0, 255, 256, 4096, 32768, 65535
#   OpenCV, grey: 0 0 1 16 128 255      Pillow, grey: 0 255 255 255 255 255      Pillow, RGB: 0 0 1 16 128 255
#
# Needs python3 with venv. Exits 1 if either behaves otherwise.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet pillow==13.0.0 opencv-python-headless==5.0.0.93 numpy==2.4.6
"$place/venv/bin/python" - <<'PYTHON'
import io
import sys

import cv2
import numpy as np
from PIL import Image, __version__

values = np.array([[0, 255, 256, 4096, 32768, 65535]], np.uint16)


def read(pixels):
    data = cv2.imencode(".png", pixels)[1]
    image = Image.open(io.BytesIO(data.tobytes()))
    opencv = cv2.imdecode(data, cv2.IMREAD_COLOR)[0, :, 0].tolist()
    return image.mode, opencv, np.asarray(image.convert("RGB"))[0, :, 0].tolist()


high, clipped = [0, 0, 1, 16, 128, 255], [0, 255, 255, 255, 255, 255]
grey, rgb = read(values), read(np.repeat(values[..., None], 3, -1))
print(f"Pillow {__version__}, OpenCV {cv2.__version__}; values {values[0].tolist()}")
for name, (mode, opencv, pillow) in dict(grey=grey, RGB=rgb).items():
    print(f"{name}: Pillow mode {mode}; OpenCV {opencv}, Pillow {pillow}")
sys.exit(0 if grey == ("I;16", high, clipped) and rgb == ("RGB", high, high) else 1)
PYTHON

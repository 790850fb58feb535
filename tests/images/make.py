"""Draws the JPEGs beside this file and decodes them; `expected.json` holds what came out.

    python3 make.py

Needs numpy, pillow, opencv-python-headless and xxhash. The images are drawn here and depict nothing. Pillow and OpenCV must
decode each to the same bytes, or nothing is written: that is what the program promises to do as well.
"""

import io
import json
import os

import cv2
import numpy as np
import PIL
import xxhash
from PIL import Image, ImageCms, features

PLACE = os.path.dirname(os.path.abspath(__file__))


def drawn(height, width, seed, channels=3):
    """Waves of another length in each channel, some grain, and a patch with hard edges."""
    y, x = np.mgrid[0:height, 0:width]
    grain = np.random.default_rng(seed)
    wave = lambda c: 127 + 90 * np.sin(x / (3 + 2 * c) + c) * np.cos(y / (4 + c)) + grain.normal(0, 18, (height, width))
    pixels = np.clip(np.stack([wave(c) for c in range(channels)], -1), 0, 255).astype(np.uint8)
    pixels[height // 3 : height // 2, width // 3 : width // 2] = (255, 0, 40, 90)[:channels]
    return Image.fromarray(pixels if channels > 1 else pixels[..., 0], mode={1: "L", 3: "RGB", 4: "CMYK"}[channels])


def pillow(image, **options):
    out = io.BytesIO()
    image.save(out, "JPEG", **options)
    return out.getvalue()


def opencv(image, factor):
    options = [cv2.IMWRITE_JPEG_QUALITY, 85, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, factor]
    return cv2.imencode(".jpg", np.asarray(image)[..., ::-1], options)[1].tobytes()


def exif(orientation):
    tags = Image.Exif()
    tags[0x0112] = orientation
    return tags


files = {
    "420": pillow(drawn(24, 40, 1), quality=85, subsampling="4:2:0"),
    "422": pillow(drawn(24, 40, 2), quality=85, subsampling="4:2:2"),
    "444": pillow(drawn(24, 40, 3), quality=85, subsampling="4:4:4"),
    "440": opencv(drawn(30, 41, 16), cv2.IMWRITE_JPEG_SAMPLING_FACTOR_440),
    "411": opencv(drawn(30, 41, 17), cv2.IMWRITE_JPEG_SAMPLING_FACTOR_411),
    "420_odd": pillow(drawn(19, 37, 4), quality=75, subsampling="4:2:0"),
    "422_odd": pillow(drawn(17, 23, 5), quality=75, subsampling="4:2:2"),
    "444_odd": pillow(drawn(13, 11, 6), quality=92, subsampling="4:4:4"),
    "progressive": pillow(drawn(33, 47, 7), quality=80, subsampling="4:2:0", progressive=True),
    "progressive_444": pillow(drawn(21, 30, 8), quality=80, subsampling="4:4:4", progressive=True),
    "restart": pillow(drawn(40, 56, 9), quality=80, subsampling="4:2:0", restart_marker_blocks=3),
    "restart_progressive": pillow(
        drawn(40, 57, 15), quality=80, subsampling="4:2:2", restart_marker_rows=1, progressive=True
    ),
    "grey": pillow(drawn(19, 29, 10, 1), quality=80),
    "grey_progressive": pillow(drawn(20, 30, 11, 1), quality=80, progressive=True),
    "coarse": pillow(drawn(24, 40, 12), quality=5, subsampling="4:2:0", optimize=True),
    "finest": pillow(drawn(24, 40, 13), quality=100, subsampling="4:4:4"),
    "one_pixel": pillow(drawn(16, 16, 18).crop((0, 0, 1, 1)), quality=80, subsampling="4:2:0"),
    "two_wide": pillow(drawn(16, 16, 19).crop((0, 0, 2, 16)), quality=80, subsampling="4:2:0"),
    "two_high": pillow(drawn(16, 16, 21).crop((0, 0, 16, 2)), quality=80, subsampling="4:2:0"),
    "rgb": pillow(drawn(18, 26, 20), quality=85, subsampling="4:4:4", keep_rgb=True),
    "upright": pillow(drawn(18, 26, 22), quality=85, exif=exif(1)),
    "profile": pillow(drawn(18, 26, 23), quality=85, icc_profile=ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()),
    # These two are refused; there is nothing to expect.
    "turned": pillow(drawn(18, 26, 24), quality=85, exif=exif(6)),
    "cmyk": pillow(drawn(18, 26, 25, 4), quality=85),
}
REFUSED = ["turned", "cmyk"]

expected = {}
for name, data in files.items():
    if name not in REFUSED:
        bgr = np.ascontiguousarray(np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))[..., ::-1])
        other = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert bgr.shape == other.shape and (bgr == other).all(), f"{name}: Pillow and OpenCV differ"
        height, width, _ = bgr.shape
        expected[name] = {"height": height, "width": width, "bgr": xxhash.xxh3_64_hexdigest(bgr.tobytes())}
for name, data in files.items():
    with open(os.path.join(PLACE, f"{name}.jpg"), "wb") as file:
        file.write(data)
producer = f"Pillow {PIL.__version__} with libjpeg-turbo {features.version('libjpeg_turbo')}, OpenCV {cv2.__version__}"
with open(os.path.join(PLACE, "expected.json"), "w") as file:
    json.dump({"producer": producer, "images": expected}, file, indent=1)
    file.write("\n")
print(f"{len(files)} images, {producer}")

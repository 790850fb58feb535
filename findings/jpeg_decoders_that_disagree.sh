#!/usr/bin/env bash
# The crate `image` 0.25.10 (its JPEG decoder is zune-jpeg 0.5) does not decode a JPEG to the bytes that Pillow 13.0.0
# (libjpeg-turbo) does: some percent of the values differ, by several steps, although both are conforming decoders and the
# file is whole. OpenCV and torchvision use libjpeg-turbo too. A network that is trained through Pillow or OpenCV and run
# through `image` sees pixels that its training never saw. The crate `libjpeg-turbo-rs` 0.9.0 gives Pillow's bytes.
#
# Needs python3 with venv, and cargo. Exits 1 if the two agree, or if `libjpeg-turbo-rs` does not.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet pillow==13.0.0 numpy==2.4.6
# A drawn street: a gradient, some edges in colour, some grain.
"$place/venv/bin/python" - "$place" <<'PYTHON'
import sys

import numpy as np
from PIL import Image

y, x = np.mgrid[0:225, 0:400]
grain = np.random.default_rng(0).normal(0, 6, (225, 400, 3))
pixels = np.stack([90 + 120 * y / 225, 110 + 40 * np.sin(x / 9), 160 - 100 * y / 225], -1) + grain
for i in range(12):
    pixels[60 + 8 * i : 66 + 8 * i, 30 * i + 10 : 30 * i + 26] = (210 - 15 * i, 40 + 12 * i, 20 * (i % 3) + 60)
image = Image.fromarray(np.clip(pixels, 0, 255).astype(np.uint8))
image.save(f"{sys.argv[1]}/street.jpg", quality=90, subsampling="4:2:0")
np.asarray(Image.open(f"{sys.argv[1]}/street.jpg").convert("RGB")).tofile(f"{sys.argv[1]}/street.rgb")
PYTHON
mkdir -p "$place/decode/src"
cat >"$place/decode/Cargo.toml" <<'TOML'
[package]
name = "decode"
version = "0.0.0"
edition = "2021"

[workspace]

[dependencies]
image = { version = "=0.25.10", default-features = false, features = ["jpeg"] }
libjpeg-turbo-rs = { version = "=0.9.0", default-features = false, features = ["std"] }
TOML
cat >"$place/decode/src/main.rs" <<'RUST'
fn main() {
    let place = std::env::args().nth(1).unwrap();
    let jpeg = std::fs::read(format!("{place}/street.jpg")).unwrap();
    let pillow = std::fs::read(format!("{place}/street.rgb")).unwrap();
    let image = image::load_from_memory(&jpeg).unwrap().into_rgb8().into_raw();
    let turbo = libjpeg_turbo_rs::decompress_to(&jpeg, libjpeg_turbo_rs::PixelFormat::Rgb).unwrap().data;
    let compare = |name: &str, other: &[u8]| {
        let differ = other.iter().zip(&pillow).filter(|(a, b)| a != b).count();
        let most = other.iter().zip(&pillow).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
        let percent = 100.0 * differ as f64 / pillow.len() as f64;
        println!("{name}: {percent:.2} % of {} values differ from Pillow's, by up to {most}", pillow.len());
        differ
    };
    let (image, turbo) = (compare("image 0.25.10", &image), compare("libjpeg-turbo-rs 0.9.0", &turbo));
    std::process::exit(i32::from(image == 0 || turbo != 0));
}
RUST
cargo run --quiet --manifest-path "$place/decode/Cargo.toml" -- "$place"

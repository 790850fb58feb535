#!/usr/bin/env bash
# Importing MNN's converter in Python runs `pip install`.
#
# `MNN.tools.mnnconvert` (the module behind the command `mnnconvert`, of the package MNN) imports a logger. Where the
# package aliyun-log-python-sdk is not installed, the logger's module calls whatever `pip` is first in PATH to install it, newest
# version, before anything has been converted. That pip need not belong to the environment that MNN was installed in; in a container that
# runs as root it may be the system's. What it is for: by its source, the command's options and the models' sizes are sent to a
# service after a conversion (not tried here).
#
# Version: MNN 3.6.1, Linux x86-64. Here a `pip` that only writes down its arguments stands first in PATH.
#
# For users of several engines on one machine: convert in a container or with a PATH of your own, or call the converter's extension
# module `_tools`, which does none of this.
set -euo pipefail
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check MNN==3.6.1 numpy

mkdir "$work/bin"
printf '#!/bin/sh\necho "$@" >>"%s/calls"\nexit 1\n' "$work" >"$work/bin/pip"
chmod +x "$work/bin/pip"
: >"$work/calls"

echo "the extension module alone:"
PATH="$work/bin:$PATH" "$work/venv/bin/python" -c 'import MNN, _tools; print(callable(_tools.mnnconvert))'
[ ! -s "$work/calls" ] || { echo "it ran pip too: $(cat "$work/calls")"; exit 1; }

echo "the module of the command:"
PATH="$work/bin:$PATH" "$work/venv/bin/python" -c 'import MNN.tools.mnnconvert' || true
found="$(sort -u "$work/calls")"
echo "pip was called with: $found"
[ "$found" = "install -U aliyun-log-python-sdk" ]

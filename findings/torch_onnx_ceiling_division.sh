#!/usr/bin/env bash
# PyTorch's exporter by tracing turns `-(-height // side)`, Python's usual division that rounds up, into one that rounds down.
#
# While a module is traced, sizes are integers that are recorded. `//` of a negative one becomes ONNX's `Div`, which rounds towards
# zero where Python rounds down, so -(-100 // 7) is 15 in PyTorch and 14 in the exported graph. Padding to whole windows thus becomes cropping, without a warning,
# for the very size that was traced: the graph gives fewer rows than the module, or fails later on, far from the cause.
# `(height + side - 1) // side` is exported as it is meant.
#
# Version: torch 2.15.0, `torch.onnx.export(..., dynamo=False)`, opset 19; run by onnxruntime 1.32.0.
#
# For users who compare a network with its export: window attention pads this way. `train/` divides positive numbers.
set -euo pipefail
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.15.0 onnx==1.23.2 onnxruntime==1.32.0

cat >"$work/pad.py" <<'PYTHON'
import io
import warnings

import numpy as np
import onnxruntime
import torch

warnings.simplefilter("ignore")


class Pad(torch.nn.Module):
    def __init__(self, rows):
        super().__init__()
        self.rows = rows

    def forward(self, x):
        height = x.shape[2]
        return torch.nn.functional.pad(x, (0, 0, 0, 7 * self.rows(height) - height))


for name, rows in (("-(-height // 7)", lambda height: -(-height // 7)), ("(height + 6) // 7", lambda height: (height + 6) // 7)):
    module, file = Pad(rows), io.BytesIO()
    torch.onnx.export(module, (torch.ones(1, 1, 100, 7),), file, opset_version=19, dynamo=False, input_names=["x"])
    session = onnxruntime.InferenceSession(file.getvalue(), providers=["CPUExecutionProvider"])
    exported = session.run(None, {"x": np.ones((1, 1, 100, 7), np.float32)})[0]
    print(f"{name}: PyTorch {module(torch.ones(1, 1, 100, 7)).shape[2]} rows, exported {exported.shape[2]}")
PYTHON
found="$("$work/venv/bin/python" "$work/pad.py" 2>/dev/null)"
echo "$found"
[ "$found" = "-(-height // 7): PyTorch 105 rows, exported 98
(height + 6) // 7: PyTorch 105 rows, exported 105" ]

"""Writes the weights of a run for `voxcast import`.

    python -m voxcast_train.export --state state.pt -o checkpoint.safetensors

The averaged weights and BatchNorm statistics go out under the published names; training heads and counters do not.
"""

import argparse
import sys

import torch
from safetensors.torch import save_file

from .errors import InputError
from .files import replace


def export(weights: dict, path, half: bool = False) -> None:
    """Writes a state dict of `InverseMatrixVT3D` as .safetensors; with `half`, matrices and filters as f16."""
    tensors = {name: tensor.cpu().contiguous() for name, tensor in weights.items() if not name.endswith("num_batches_tracked")}
    if half:
        tensors = {name: tensor.half() if tensor.ndim > 1 else tensor for name, tensor in tensors.items()}
    replace(path, lambda temporary: save_file(tensors, temporary))


def main() -> int:
    parser = argparse.ArgumentParser(prog="voxcast_train.export", description="Write a run's weights for voxcast import.")
    parser.add_argument("--state", required=True, help="state.pt of a run")
    parser.add_argument("-o", "--output", required=True, help="the .safetensors to write")
    options = parser.parse_args()
    try:
        state = torch.load(options.state, map_location="cpu", weights_only=True)
        if "average" not in state:
            raise InputError(f'{options.state}: no "average": not the state of a run')
        export(state["average"], options.output)
    except (InputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"{options.output}: the averaged weights of step {state['step']}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""The `voxcast` program, which draws frames and makes rigs and models."""

import subprocess
from pathlib import Path

from .errors import InputError


class Program:
    """Runs it; `make_set` completes a set of frames."""

    def __init__(self, path: Path):
        self.path = Path(path)

    def command(self, *arguments) -> list:
        return [str(self.path), *map(str, arguments)]

    def __call__(self, *arguments) -> None:
        command = self.command(*arguments)
        print("+", " ".join(command), flush=True)
        try:
            subprocess.run(command, check=True)
        except (OSError, subprocess.CalledProcessError) as error:
            raise InputError(f"{' '.join(command)}: {error}") from error

    def make_set(self, directory: Path, first: int, count: int, network: Path, calibration: Path | None = None) -> None:
        """Writes the frames of these seeds, unless they are there."""
        if len(list(directory.glob("[0-9]*.safetensors"))) < count:
            other = () if calibration is None else ("--calibration", calibration)
            self("synth", "--set", directory, "--seed", first, "--count", count, "--network", network, "--pixels", *other)

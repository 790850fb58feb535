"""Frames that are drawn beside the training and used as they come.

Processes of `voxcast synth` write blocks of seeds into a directory, rig after rig. A thread reads each frame when it is whole and
takes its file away; the training's own thread copies what was read to the device between two steps (`Pool.take`). So a run can
see as many frames as the machine draws, and the disk holds none of them for long.
"""

import queue
import subprocess
import threading
import time
from pathlib import Path

import torch
from torch import Tensor

from .data import read_frame, pool_frame
from .errors import InputError
from .network import Network
from .program import Program

BLOCK = 16
"""Seeds that a process draws before the next one starts."""


class Drawing:
    """Processes that draw seeds `first` to `first + count - 1`. Block n is seen by the rig `order[n % len(order)]`, whose number
    in `calibrations` that is (None: the plain ring)."""

    def __init__(self, program: Program, network: Path, directory: Path, calibrations: list, order: list, first: int, count: int,
                 processes: int):  # fmt: skip
        self.program, self.network, self.directory = program, network, directory
        self.calibrations, self.order = calibrations, order
        self.first, self.end, self.processes = first, first + count, processes
        self.next_block = 0
        self.running = []

    def poll(self) -> None:
        """Starts processes for those that have ended. Raises InputError if one failed."""
        for process in [process for process in self.running if process.poll() is not None]:
            self.running.remove(process)
            if process.returncode != 0:
                raise InputError(f"{' '.join(process.args)}: {process.stderr.read().strip()}")
        while len(self.running) < self.processes and (seed := self.first + self.next_block * BLOCK) < self.end:
            rig = self.order[self.next_block % len(self.order)]
            self.next_block += 1
            calibration = self.calibrations[rig]
            command = self.program.command(
                "synth", "--set", self.directory / f"{rig:02}", "--seed", seed, "--count", min(BLOCK, self.end - seed),
                "--network", self.network, "--pixels", "--threads", 1,
                *(() if calibration is None else ("--calibration", calibration)),
            )  # fmt: skip
            self.running.append(subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True))

    @property
    def done(self) -> bool:
        return not self.running and self.first + self.next_block * BLOCK >= self.end

    def stop(self) -> None:
        for process in self.running:
            process.terminate()
        for process in self.running:
            process.wait()
        self.running.clear()


class Pool:
    """Frames on the device, which grow in number. A frame belongs to a rig."""

    def __init__(self, network: Network, drawing: Drawing, rigs: int, capacity: int, device: torch.device):
        self.network, self.drawing, self.device, self.capacity = network, drawing, device, capacity
        self.columns, self.filled = {}, 0
        # Numbers of the frames of each rig, and how many there are.
        self.of_rig = torch.zeros(rigs, capacity, dtype=torch.int64, device=device)
        self.counts = torch.zeros(rigs, dtype=torch.int64, device=device)
        self.host_counts = [0] * rigs
        self.read = queue.Queue(maxsize=64)
        # Held while a step is recorded, during which nobody else may ask the device for anything.
        self.device_lock = threading.Lock()
        self.failure, self.stopping = None, False
        self.thread = threading.Thread(target=self._reader, daemon=True)
        self.thread.start()

    def _reader(self) -> None:
        try:
            seen = set()
            while not self.stopping:
                self.drawing.poll()
                ready = [path for rig in range(len(self.host_counts)) for path in self._files(rig) if path not in seen]
                for path in ready:
                    frame = read_frame(path, self.network, pixels=True)
                    if self.device.type == "cuda":
                        with self.device_lock:
                            frame = {name: tensor.pin_memory() for name, tensor in frame.items()}
                    path.unlink()
                    while not self.stopping:
                        try:
                            self.read.put((int(path.parent.name), frame), timeout=0.2)
                            break
                        except queue.Full:
                            continue
                    self.drawing.poll()
                    if self.stopping:
                        break
                if not ready:
                    if self.drawing.done:
                        return
                    time.sleep(0.02)
        except Exception as error:  # handed to the training's thread, which raises it
            self.failure = error
        finally:
            self.drawing.stop()

    def _files(self, rig: int) -> list:
        return sorted((self.drawing.directory / f"{rig:02}").glob("[0-9]*.safetensors"))

    def take(self) -> int:
        """Copies what was read to the device. Returns how many frames came."""
        if self.failure is not None:
            raise InputError(f"drawing frames failed: {self.failure}") from self.failure
        came = 0
        while self.filled < self.capacity:
            try:
                rig, frame = self.read.get_nowait()
            except queue.Empty:
                break
            frame = {name: tensor.to(self.device, non_blocking=True) for name, tensor in frame.items()}
            for name, value in pool_frame(frame, self.network).items():
                if name not in self.columns:
                    self.columns[name] = torch.empty((self.capacity, *value.shape), dtype=value.dtype, device=self.device)
                self.columns[name][self.filled].copy_(value)
            self.of_rig[rig, self.host_counts[rig]] = self.filled
            self.host_counts[rig] += 1
            self.counts[rig] += 1
            self.filled += 1
            came += 1
        if self.filled == self.capacity:
            self.stop()
        return came

    def wait_for(self, frames: int) -> None:
        """Until there are so many frames, some of each rig."""
        while self.filled < frames or min(self.host_counts) == 0:
            if self.take() == 0:
                if not self.thread.is_alive() and self.read.empty():
                    if self.failure is None and min(self.host_counts) > 0:
                        return
                    raise InputError(f"drawing frames ended: {self.failure or 'a rig has none'}")
                time.sleep(0.05)

    def batch(self, rig: Tensor, count: int) -> dict:
        """Random frames of a rig, whose number is a tensor [1] on the device."""
        places = (torch.rand(count, device=self.device) * self.counts.index_select(0, rig)).long()
        numbers = self.of_rig.index_select(0, rig)[0].index_select(0, places)
        batch = {name: column.index_select(0, numbers) for name, column in self.columns.items()}
        batch["labels"] = [batch.pop(f"labels{level}") for level in range(4)]
        return batch

    def class_counts(self, most: int = 1000) -> Tensor:
        """Voxels of each class at level 0, over up to so many of the frames."""
        labels = self.columns["labels0"][: min(self.filled, most)]
        classes = torch.arange(self.network.classes, device=self.device, dtype=labels.dtype)
        return sum((part.flatten().unsqueeze(1) == classes).sum(0) for part in labels.split(16))

    def stop(self) -> None:
        """Ends the processes that draw."""
        self.stopping = True
        if self.thread is not threading.current_thread():
            self.thread.join()

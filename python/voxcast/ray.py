"""Evaluation and runs on a Ray cluster: `pip install voxcast[ray]`.

    report = voxcast.ray.evaluate(voxcast.Model.open("model.safetensors"), "synthetic:heldout")
    for result in voxcast.ray.run(model, ["drive/000", "drive/001"]): ...

Actors hold sessions. A frame that was lost with its actor or node is given to another. Because bits do not depend on the
machine, a sample of the frames is computed once more on another node, and both must give the same digests and counts; so
a cluster with a machine that computes wrongly is found out.

Data sets and scenes are read where the actors run, so they must have the same path on every node. A model that was opened
from a file is opened by that path as well; one from bytes (`Model.from_bytes`) is sent.
"""

from __future__ import annotations

import logging
import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any, Generic, TypeVar

import numpy
import ray
from numpy.typing import NDArray
from ray.exceptions import ObjectLostError, RayActorError, RayTaskError

from ._errors import MismatchError, UnsupportedError
from ._evaluate import terminal_progress
from ._native import Evaluation, Model, Report, Rig, Scene, Session, Worker

__all__ = ["Result", "evaluate", "run"]

logger = logging.getLogger("voxcast.ray")

Item = TypeVar("Item")

TICK = 1.0
"""Seconds between looks at the actors."""

ATTEMPTS = 5
"""How often a frame may be lost with its actor before that is taken for the frame's own doing."""


@dataclass(frozen=True)
class Result:
    """What a scene gave."""

    scene: str
    """Its path."""
    classes: NDArray[numpy.uint8]
    """[X, Y, Z], the class of each voxel; 0 is empty."""
    support: NDArray[numpy.uint16]
    """[X, Y, Z], by how many feature pixels each voxel is seen."""
    logits: NDArray[numpy.float32] | None
    """[X, Y, Z, classes], if they were asked for."""
    confidence_occupied: NDArray[numpy.uint8] | None
    """[X, Y, Z], the probability that the voxel is occupied, 0 to 255 for 0 to 1, if it was asked for."""
    confidence_class: NDArray[numpy.uint8] | None
    """[X, Y, Z], that of its class, likewise."""
    digest: str
    """XXH3-64 of the classes."""
    node: str
    """The node that computed it."""


def evaluate(
    model: Model | Sequence[Model],
    data: str,
    *,
    losses: bool = False,
    calibration: bool = False,
    limit: int | None = None,
    resume: str | os.PathLike[str] | None = None,
    actors: int | None = None,
    threads: int = 1,
    check: int = 8,
    patience: float = 300.0,
    progress: Callable[[int, int], None] | None = None,
) -> Report:
    """`voxcast.evaluate` on all nodes of the cluster: the same numbers to the last bit.

    resume: a journal on the driver's machine, from which the same call goes on after the driver has stopped.
    actors: how many frames at a time; one for every `threads` CPUs of the cluster by default.
    check: so many frames, spread over the set, are computed on two nodes and compared. With one node there is no second.
    patience: seconds to wait while no actor can run at all.
    progress: called with the frames done and all that were left; by default a line on a terminal.

    Raises MismatchError if two nodes disagree, naming the frame and the nodes; what voxcast raises for a frame; and
    UnsupportedError if a frame is lost time after time, or no actor can run.
    """
    models = [model] if isinstance(model, Model) else list(model)
    journal = None if resume is None else os.fspath(resume)
    evaluation = Evaluation(models, data, losses=losses, calibration=calibration, limit=limit, resume=journal)
    left = evaluation.left
    told = progress or terminal_progress("scoring")
    arguments = (models, data, losses, calibration, limit, threads)
    done = 0
    with _Crew[int, str](_Scorer, arguments, actors, threads, patience) as crew:
        for _, line, _ in crew.compute(left, _spread(len(left), check), lambda line: line):
            evaluation.add(line)
            done += 1
            told(done, len(left))
    return evaluation.report()


def run(
    model: Model,
    scenes: Sequence[str | os.PathLike[str]],
    *,
    logits: bool = False,
    confidence: bool = False,
    actors: int | None = None,
    threads: int = 1,
    check: int = 8,
    patience: float = 300.0,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[Result]:
    """Runs a model on scenes, on all nodes of the cluster. Results come as they are ready, not in the order of the scenes.

    scenes: directories or .safetensors files, as `Scene.open` takes them.
    logits, confidence: what else results have, as of a `Session`. The other arguments are those of `evaluate`.
    """
    paths = [os.fspath(scene) for scene in scenes]
    told = progress or terminal_progress("running")
    with _Crew[str, _Frame](_Runner, (model, logits, confidence, threads), actors, threads, patience) as crew:
        places = _spread(len(paths), check)
        for done, (path, frame, node) in enumerate(crew.compute(paths, places, lambda frame: frame.digests), 1):
            told(done, len(paths))
            occupied, of_class = frame.confidence or (None, None)
            yield Result(
                path, frame.classes, frame.support, frame.logits, occupied, of_class, frame.digests[0], node
            )


def _spread(count: int, wanted: int) -> set[int]:
    """`wanted` places of `count`, evenly spread."""
    wanted = min(max(wanted, 0), count)
    return {place * count // wanted for place in range(wanted)}


class _Scorer:
    """The actor that scores frames."""

    def __init__(
        self, models: list[Model], data: str, losses: bool, calibration: bool, limit: int | None, threads: int
    ) -> None:
        self.arguments = (models, data, losses, calibration, limit, threads)

    def ready(self) -> str:
        """Opens what is needed. Errors are the caller's to see, which those of a constructor are not."""
        models, data, losses, calibration, limit, threads = self.arguments
        evaluation = Evaluation(models, data, losses=losses, calibration=calibration, limit=limit)
        self.worker = Worker(evaluation, threads=threads)
        return str(ray.get_runtime_context().get_node_id())

    def compute(self, index: int) -> str:
        return self.worker.score(index)


@dataclass(frozen=True)
class _Frame:
    classes: NDArray[numpy.uint8]
    support: NDArray[numpy.uint16]
    logits: NDArray[numpy.float32] | None
    confidence: tuple[NDArray[numpy.uint8], NDArray[numpy.uint8]] | None
    digests: tuple[str, ...]
    """Of all that was asked for: what two nodes must agree on."""


class _Runner:
    """The actor that runs scenes. The matrices are built anew where the cameras have moved."""

    def __init__(self, model: Model, logits: bool, confidence: bool, threads: int) -> None:
        self.model, self.threads = model, threads
        self.logits, self.confidence = logits, confidence
        self.calibration = numpy.empty((0, 4, 4), numpy.float32)
        self.session: Session | None = None

    def ready(self) -> str:
        return str(ray.get_runtime_context().get_node_id())

    def compute(self, path: str) -> _Frame:
        scene = Scene.open(path)
        calibration = scene.lidar2img
        if self.session is None or not numpy.array_equal(calibration, self.calibration):
            rig = Rig.build(self.model, scene, threads=self.threads)
            if self.session is None or self.session.cameras != rig.cameras:
                self.session = Session(
                    self.model, rig, threads=self.threads, logits=self.logits, confidence=self.confidence
                )
            else:
                self.session.set_rig(rig)
            self.calibration = calibration
        result = self.session.run(scene)
        digests, confidence = [result.digest], None
        if result.logits_digest is not None:
            digests.append(result.logits_digest)
        if result.confidence_occupied is not None and result.confidence_class is not None:
            confidence = (result.confidence_occupied, result.confidence_class)
            digests += [blake2b(codes.tobytes(), digest_size=8).hexdigest() for codes in confidence]
        return _Frame(result.classes, result.support, result.logits, confidence, tuple(digests))


Value = TypeVar("Value")


@dataclass
class _Job(Generic[Item, Value]):
    """A frame to compute. One that was computed already, on a node, is to be compared."""

    item: Item
    checked: bool
    attempts: int = 0
    first: tuple[Value, str] | None = None


class _Crew(Generic[Item, Value]):
    """Actors, each with one frame at a time. Lost ones are replaced, and wait until the cluster has room for them."""

    def __init__(
        self, kind: type, arguments: tuple[Any, ...], actors: int | None, threads: int, patience: float
    ) -> None:
        if threads < 1 or (actors is not None and actors < 1):
            raise ValueError(f"actors: found {actors}, threads: found {threads}, expected at least 1")
        if not ray.is_initialized():
            ray.init(log_to_driver=False)
        self.patience = patience
        self.kind = ray.remote(kind).options(
            num_cpus=threads, max_restarts=0, max_task_retries=0, scheduling_strategy="SPREAD"
        )
        # Weights are put into the cluster once.
        self.arguments = [ray.put(argument) for argument in arguments]
        count = actors or max(1, int(ray.cluster_resources().get("CPU", 1)) // threads)
        self.nodes: dict[Any, str] = {}
        """Actors that have answered, and where they are."""
        self.idle: list[Any] = []
        self.running: dict[Any, tuple[Any, _Job[Item, Value] | None]] = {}
        """What is awaited of which actor; without a job, its first answer."""
        self.stillborn = 0
        """Actors in a row that were lost before they answered."""
        self.expected = {self.hire() for _ in range(count)}
        """Actors for which the cluster had room, and which have not answered. Those that replace lost ones may never."""

    def __enter__(self) -> _Crew[Item, Value]:
        return self

    def __exit__(self, *raised: object) -> None:
        for actor in {*self.idle, *(actor for actor, _ in self.running.values())}:
            ray.kill(actor)

    def hire(self) -> Any:
        actor = self.kind.remote(*self.arguments)
        self.running[actor.ready.remote()] = (actor, None)
        return actor

    def compute(
        self, items: Sequence[Item], checked: set[int], essence: Callable[[Value], object]
    ) -> Iterator[tuple[Item, Value, str]]:
        """Yields every item with its value and its node, once. Of those at the places `checked`, the essence is
        computed on a second node."""
        jobs = deque(_Job[Item, Value](item, place in checked) for place, item in enumerate(items))
        again: list[_Job[Item, Value]] = []
        heard = time.monotonic()
        while True:
            self.assign(jobs, again)
            busy = any(job is not None for _, job in self.running.values())
            late = time.monotonic() - heard > self.patience
            if not jobs and not busy and (not again or not self.expected or late):
                # What is left to compare has no node but the first.
                for left in again:
                    logger.warning("frame %s is not compared: no second node", left.item)
                return
            if not busy and late:
                raise UnsupportedError(f"no actor could run for {self.patience:.0f} s: the cluster has no room")
            ready, _ = ray.wait(list(self.running), timeout=TICK)
            if ready or busy:
                heard = time.monotonic()
            for reference in ready:
                actor, job = self.running.pop(reference)
                self.expected.discard(actor)
                try:
                    value = ray.get(reference)
                except (RayActorError, ObjectLostError) as error:
                    self.lose(actor, job, jobs, again, error)
                    continue
                except RayTaskError as error:
                    raise (error.cause if isinstance(error.cause, Exception) else error) from None
                self.idle.append(actor)
                if job is None:
                    self.nodes[actor] = value
                    self.stillborn = 0
                elif job.first is None:
                    node = self.nodes[actor]
                    if job.checked:
                        job.first = (value, node)
                        again.append(job)
                    yield job.item, value, node
                else:
                    compare(job.item, job.first, (value, self.nodes[actor]), essence)

    def assign(self, jobs: deque[_Job[Item, Value]], again: list[_Job[Item, Value]]) -> None:
        """Gives idle actors work: first what is to be compared and was computed on another node."""
        for actor in list(self.idle):
            node = self.nodes[actor]
            elsewhere = next((job for job in again if job.first is not None and job.first[1] != node), None)
            if elsewhere is not None:
                job = elsewhere
                again.remove(job)
            elif jobs:
                job = jobs.popleft()
            else:
                continue
            self.idle.remove(actor)
            self.running[actor.compute.remote(job.item)] = (actor, job)

    def lose(
        self,
        actor: Any,
        job: _Job[Item, Value] | None,
        jobs: deque[_Job[Item, Value]],
        again: list[_Job[Item, Value]],
        error: Exception,
    ) -> None:
        """An actor is gone. Its frame goes to another."""
        node = self.nodes.pop(actor, "unknown")
        if job is None:
            self.stillborn += 1
            if self.stillborn >= ATTEMPTS:
                raise UnsupportedError(f"{self.stillborn} actors in a row were lost before they could run: {error}")
        else:
            job.attempts += 1
            logger.warning("an actor on node %s is lost; frame %s goes to another", node, job.item)
            if job.attempts >= ATTEMPTS:
                raise UnsupportedError(f"frame {job.item} was lost {job.attempts} times, the last time with {error}")
            if job.first is None:
                jobs.appendleft(job)
            else:
                again.append(job)
        self.hire()


def compare(item: object, first: tuple[Any, str], second: tuple[Any, str], essence: Callable[[Any], object]) -> None:
    """Raises MismatchError if two nodes gave other values."""
    (one, here), (other, there) = first, second
    if essence(one) == essence(other):
        logger.info("frame %s is the same on nodes %s and %s", item, here, there)
        return
    raise MismatchError(f"frame {item}: nodes {here} and {there} disagree, found {essence(one)} and {essence(other)}")

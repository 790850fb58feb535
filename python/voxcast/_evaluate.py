"""Whole evaluations in one process."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Sequence

from ._native import Evaluation, Model, Report


def evaluate(
    model: Model | Sequence[Model],
    data: str,
    *,
    losses: bool = False,
    calibration: bool = False,
    limit: int | None = None,
    shard: str | None = None,
    resume: str | os.PathLike[str] | None = None,
    workers: int | None = None,
    threads: int | None = None,
    isa: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Report:
    """Scores a model on a data set with labels; two models are scored on the same frames and compared.

    data: as on the command line: "synthetic:DIR", "surroundocc:ROOT:LABELS[:SCENES]", "occ3d:ROOT:LABELS[:SCENES]",
        "semantickitti:ROOT[:SPLIT[:stereo][:all]]", "uniocc:ROOT[:IMAGES]" and others (docs/evaluation.md).
    losses: also the four losses of the training.
    calibration: also how often what the network says is so likely comes true. limit: only the first frames. shard: "I/N", see docs/many-machines.md.
    resume: a journal of every frame's score, from which the same call goes on, if the labels are the same.
    workers: frames at a time, with `threads` in all; by default as many as `voxcast eval` takes. None of it changes a number.
    progress: called with the frames done and all that were left; by default a line on a terminal.

    What images say that is not obeyed is a warning, `voxcast.Note`, of the first that says it.
    The interpreter's lock is free meanwhile, and an interrupt ends the evaluation after the frames under way.
    """
    models = [model] if isinstance(model, Model) else list(model)
    journal = None if resume is None else os.fspath(resume)
    evaluation = Evaluation(models, data, losses=losses, calibration=calibration, limit=limit, shard=shard, resume=journal)
    left = len(evaluation.left)
    told = progress or terminal_progress("scoring")
    evaluation.run(workers=workers, threads=threads, isa=isa, watch=lambda done: told(done, left))
    return evaluation.report()


def terminal_progress(what: str) -> Callable[[int, int], None]:
    """Writes a line with what is done and how long the rest may take, to a terminal; to nothing else."""
    if not sys.stderr.isatty():
        return lambda done, total: None
    start = time.monotonic()

    def tell(done: int, total: int) -> None:
        elapsed = time.monotonic() - start
        rest = f", {elapsed / done * (total - done):.0f} s left" if 0 < done < total else ""
        print(f"\r{what} {done}/{total}, {elapsed:.0f} s{rest}\x1b[K", end="" if done < total else "\n", file=sys.stderr)

    return tell

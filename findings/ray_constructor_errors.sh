#!/usr/bin/env bash
# An exception that an actor's constructor raises does not reach the caller as itself. Ray 2.60.0 raises ActorDiedError, which
# is no instance of the exception's class, as one of a method is, and keeps it nowhere but in its text: neither `cause` nor
# `__cause__`. Code that handles errors of actors by their class must raise them in a method.
set -euo pipefail
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check ray==2.60.0
"$work/venv/bin/python" - <<'PROGRAM'
import ray

ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level="ERROR")


class Missing(Exception):
    pass


@ray.remote
class InConstructor:
    def __init__(self):
        raise Missing("no such file")

    def work(self):
        return 1


@ray.remote
class InMethod:
    def work(self):
        raise Missing("no such file")


def raised(actor):
    try:
        ray.get(actor.remote().work.remote())
    except Exception as error:
        return error


method, constructor = raised(InMethod), raised(InConstructor)
print("ray", ray.__version__)
print("from a method:     ", type(method).__name__, isinstance(method, Missing), repr(method.cause))
print("from a constructor:", type(constructor).__name__, isinstance(constructor, Missing),
      getattr(constructor, "cause", None), constructor.__cause__, "no such file" in str(constructor))
assert isinstance(method, Missing) and isinstance(method.cause, Missing)
assert type(constructor).__name__ == "ActorDiedError" and not isinstance(constructor, Missing)
assert getattr(constructor, "cause", None) is None and constructor.__cause__ is None
assert "no such file" in str(constructor)
PROGRAM

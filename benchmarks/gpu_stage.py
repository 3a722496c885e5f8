"""What a stage of `on_gpu` is: how much it measures, and the process that measures it.

`python -m benchmarks.gpu_stage` reads a line of JSON a stage, `{"stage", "place", "seconds", "toy", "seed"}`, and
answers with lines of JSON: `{"machine"}` once, then `{"figure", "value"}` and `{"note", "text"}` as they are measured,
and `{"ended", "compiling"}`. It stands alone: what a library prints goes to standard error.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import importlib.metadata
import importlib.util
import json
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from benchmarks.harness import machine
from dipn_jax.commands import console
from dipn_jax.world import scenes

MEASURED = "measured"
"""How a stage ended of which all was measured; the others begin with `partly measured`, `not measured` or `failed`."""
OTHERS = ("warp-lang", "torch", "jax-cuda13-plugin", "jax-cuda12-plugin")
"""Packages whose versions matter here, where they are installed."""
Found = Iterator[tuple[str, float | str]]
"""What a stage measures: names behind its own (empty: its main figure), each with a figure or with a line of text."""


class Wrong(Exception):
    """Raised where a result is not right; the message is one line with the result and what it should be."""


class NotMeasured(Exception):
    """Raised where something cannot be measured; the message is one line that says why."""


@dataclasses.dataclass(frozen=True)
class Size:
    """The amounts of a run."""

    seed: int
    objects: int = 7  # in a scene
    timestep: float | None = None  # seconds, of MJX and Warp where their own settings are not what is measured
    batches: tuple[int, ...] = (1024, 4096)  # scenes simulated at once; the first is what most is measured with
    tail: int = 128  # to which the last scenes of a data set are padded
    agreeing: int = 256  # scenes on which engines are compared
    most_millimetres: float = 1.0  # between an engine and MuJoCo C (p50), 5 cm into a push
    heap_seconds: float = 0.2  # for which falling heaps are simulated
    shard: int = 2790  # push episodes: 1,024 scenes
    least_seconds: float = 15.0  # that a data set has to take for its rate to count
    variants: int = 100  # of MuJoCo Warp's settings, the first of them
    mjx_variants: int = 100  # likewise of MJX's
    tables: int = 64  # decided on at once
    candidates: int = 64  # pushes considered a table
    cases: int = 10  # hard tables on which one action is made
    images: int = 256  # rendered at once
    presets: tuple[str, ...] = ("compact", "paper")
    precisions: tuple[str, ...] = ("float32", "bfloat16")
    examples: int | None = None  # in a training step; the preset's number if not given
    steps: int = 20  # of training that are timed at once
    repeats: int = 5
    written: int = 2000  # episodes a shard whose writing is timed

    def mixed(self) -> scenes.SceneConfig:
        """Return scenes of 1 to `objects` objects, with as many slots as those of just `objects`."""
        return scenes.parse_objects(f"1:{self.objects}")


def size_of(*, toy: bool, seed: int) -> Size:
    """Return the amounts of a run on a GPU, or of a rehearsal on a CPU."""
    if not toy:
        return Size(seed)
    return Size(
        seed,
        objects=1,
        timestep=0.005,
        batches=(2,),
        tail=2,
        agreeing=1,
        most_millimetres=5.0,
        heap_seconds=0.02,
        shard=2,
        least_seconds=0.0,
        variants=1,
        mjx_variants=2,  # the Warp kernel is in the rehearsal
        tables=1,
        candidates=4,
        cases=1,
        images=2,
        presets=("compact",),
        precisions=("bfloat16",),
        examples=2,
        steps=1,
        repeats=1,
        written=20,
    )


def installed(package: str) -> bool:
    """Return whether a package can be imported."""
    return importlib.util.find_spec(package) is not None


def facts() -> dict[str, Any]:
    """Return `harness.machine()` with the versions of the packages that only a GPU needs, and of its driver."""
    import jax

    found = machine()
    for name in OTHERS:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found["versions"][name] = importlib.metadata.version(name)
    return found | {"platform": jax.local_devices()[0].client.platform_version.splitlines()[0]}


class Compiling:
    """Seconds in which something was compiled: by JAX, which says so, or inside of `counted`."""

    def __init__(self) -> None:
        self._spans: list[tuple[float, float]] = []

    def listen(self) -> None:
        """Take note of what JAX traces and compiles from here on."""
        import jax

        jax.monitoring.register_event_duration_secs_listener(self._hear)

    def _hear(self, event: str, duration_secs: float, **_: Any) -> None:
        if event.startswith("/jax/core/compile/"):
            now = time.monotonic()
            self._spans.append((now - duration_secs, now))

    @contextlib.contextmanager
    def counted(self) -> Iterator[None]:
        """Count the time in this context, which is for a first call."""
        begun = time.monotonic()
        try:
            yield
        finally:
            self._spans.append((begun, time.monotonic()))

    def taken(self) -> float:
        """Return the seconds of compiling since the last call; simultaneous compilations count once."""
        total, end = 0.0, -np.inf
        for first, last in sorted(self._spans):
            total += max(0.0, last - max(first, end))
            end = max(end, last)
        self._spans.clear()
        return total


COMPILING = Compiling()
"""The seconds of this process."""


def measure(request: dict[str, Any], say: Callable[[dict[str, Any]], None]) -> str:
    """Measure a stage as far as its time allows, passing each figure to `say`; return how it ended."""
    module, _, name = request["place"].partition(":")
    begun = time.monotonic()
    try:
        work: Found = getattr(importlib.import_module(f"benchmarks.{module}"), name)(
            size_of(toy=request["toy"], seed=request["seed"])
        )
        for figure, value in work:
            full = "/".join(filter(None, (request["stage"], figure)))
            if isinstance(value, str):
                say({"note": full, "text": value})
            elif np.isfinite(value):
                say({"figure": full, "value": float(value)})
            else:
                say({"note": full, "text": f"not measured: it came out as {value}"})
            if time.monotonic() - begun > request["seconds"]:
                return f"partly measured: its {request['seconds']:.0f} s were over after {figure or 'the first figure'}"
    except NotMeasured as reason:
        return f"not measured: {reason}"
    except Exception as error:
        traceback.print_exc()
        return f"failed: {brief(error)}"
    return MEASURED


def brief(error: Exception) -> str:
    """Return an error's message in one line of at most 300 characters; with its type, unless it is a `Wrong`."""
    said = " ".join(str(error).split())[:300]
    return said if isinstance(error, Wrong) else f"{type(error).__name__}: {said}".rstrip(": ")


def main() -> None:
    """Measure the stages that are asked for on standard input."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)

    def say(answer: dict[str, Any]) -> None:
        print(json.dumps(answer), file=answers, flush=True)

    console.enable_compilation_cache()
    say({"machine": facts()})
    COMPILING.listen()
    for line in sys.stdin:
        ended = measure(json.loads(line), say)
        say({"ended": ended, "compiling": COMPILING.taken()})


if __name__ == "__main__":
    sys.modules["benchmarks.gpu_stage"] = sys.modules["__main__"]  # the stages import it: it is there once
    main()

"""What all benchmarks use: scales, alternating measurements, silent data sets, facts about the machine."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import io
import pathlib
import platform
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from typing import Any, Literal

from dipn_jax.datagen import generate

from dipn_jax.system import files
from dipn_jax.system.machine import commit, cores, processor

Figures = dict[str, float]
Scale = Literal["small", "full"]


class Skipped(Exception):
    """Raised where a benchmark cannot run; the message is one line that says what is missing."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """The settings of a run of benchmarks."""

    scale: Scale
    seed: int

    def pick(self, small: int, full: int) -> int:
        """Return the amount for this scale."""
        return small if self.scale == "small" else full


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """A benchmark as the command line names it."""

    what: str
    goal: str
    place: str  # module:function

    def load(self) -> Callable[[Setting], Iterator[tuple[str, float]]]:
        """Import the benchmark's function, hiding what packages print while they are imported."""
        module, _, function = self.place.partition(":")
        with quiet():
            return getattr(importlib.import_module(f"benchmarks.{module}"), function)


def seconds(work: Callable[[], Any]) -> float:
    """Return the wall-clock seconds that `work` takes."""
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun


def alternate(*works: Callable[[], Any], repeats: int) -> tuple[float, ...]:
    """Return the median seconds of pieces of work, run in turns so that all meet the same state of the machine.

    Args:
      works: two pieces of work or more.
      repeats: runs of each; who begins changes from turn to turn.
    """
    times: list[list[float]] = [[] for _ in works]
    for repeat in range(repeats):
        for place in range(len(works)):
            which = (repeat + place) % len(works)
            times[which].append(seconds(works[which]))
    return tuple(map(statistics.median, times))


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Hide what the commands print about their progress."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        yield


def make_data(job: generate.Job) -> int:
    """Write the data set of `job` in a temporary folder and return the bytes of its files."""
    with tempfile.TemporaryDirectory() as name, quiet():
        folder = pathlib.Path(name) / "data"
        generate.generate(job, folder)
        return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def machine() -> dict[str, Any]:
    """Return processor, accelerator, versions and commit, which figures must be read with."""
    import jax

    return {
        "processor": processor(),
        "cores": cores(),
        "devices": [device.device_kind for device in jax.local_devices()],
        "python": platform.python_version(),
        "versions": files.package_versions(),
        "commit": commit(),
    }

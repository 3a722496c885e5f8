"""What a data set of many shards costs besides physics: the launcher, writing, and the list of shards."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import multiprocessing
import pathlib
import resource
import sys
import tempfile
from collections.abc import Generator, Iterator, Sequence
from typing import Any
from unittest import mock

from dipn_jax.datagen import generate, shard_tasks
from dipn_jax.datagen.generate import Job

from benchmarks.harness import Setting, Skipped, quiet, seconds
from dipn_jax.commands import launch
from dipn_jax.commands.launch import Launch
from dipn_jax.world import scenes

JOB = Job(kind="push", scene=scenes.fixed_count(1), episodes=1, seed=0, shard_size=1, actions=1, engine="native")
"""A data set whose shards have one push each."""
COUNTS: dict[str, dict[str, tuple[int, ...]]] = {
    "small": {"local": (100,), "ray": (100,)},
    "full": {"local": (1_000, 10_000), "ray": (1_000, 10_000, 100_000)},
}
"""Numbers of shards of each launcher."""


@functools.cache
def _one_push() -> tuple[Any, dict[str, int]]:
    """Return the episodes of a shard, and counts, as `generate.shard` does; simulated once a process."""
    return generate.shard(JOB, 0, generate.make_engine("native", threads=1))


def make_shard(*arguments: Any) -> tuple[str, dict[str, Any]]:
    """Make and write a shard as `shard_tasks.make_shard` does, but simulate nothing: the task of a job."""
    push = _one_push()
    with mock.patch.object(generate, "shard", lambda *_: push):
        return shard_tasks.make_shard(*arguments)


def _do_nothing(index: int) -> int:
    """Return the task's number: a task that costs only its launch."""
    return index


def _elsewhere(job: Job, todo: Sequence[int], out: pathlib.Path) -> Generator[tuple[str, dict[str, Any]], None, None]:
    """See `generate.Elsewhere`: shards as tasks of Ray."""
    tasks = [(job, job.describe(), index, out, 1, None) for index in todo]
    for _, made in launch.run(make_shard, tasks, launch=Launch("ray")):
        yield made


def _run(name: str, count: int, folder: pathlib.Path) -> dict[str, float]:
    """Make a data set of `count` shards, then ask for it again, and return the figures; in a process of its own."""
    job = dataclasses.replace(JOB, episodes=count)
    push = _one_push()
    fresh = _peak()
    with quiet(), mock.patch.object(generate, "shard", lambda *_: push):
        elsewhere = _elsewhere if name == "ray" else None
        work = functools.partial(generate.generate, job, folder / "data", threads=1, elsewhere=elsewhere)
        made, again = seconds(work), seconds(work)
    return {
        "milliseconds": 1000 * made / count,
        "again_milliseconds": 1000 * again / count,
        "peak_megabytes": _peak(),
        "megabytes_more": _peak() - fresh,
        "manifest_bytes": (folder / "data" / "manifest.json").stat().st_size / count,
    }


def _peak() -> float:
    """Return the most memory that this process has had, in MB."""
    scale = 1e-6 if sys.platform == "darwin" else 1024e-6
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * scale


def overhead(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure `jobs.overhead/LAUNCHER/SHARDS/...` for shards of one push each, nothing of which is simulated.

    `jobs.overhead/launch_milliseconds` is of a task of Ray's that does nothing: the driver's own time.
    """
    if importlib.util.find_spec("ray") is None:
        raise Skipped("Ray is not installed; run pip install 'dipn-jax[ray]'")
    for name, counts in COUNTS[setting.scale].items():
        for count in counts:
            with tempfile.TemporaryDirectory() as folder, multiprocessing.get_context("spawn").Pool(1) as pool:
                for key, value in pool.apply(_run, (name, count, pathlib.Path(folder))).items():
                    yield f"jobs.overhead/{name}/{count}/{key}", value
    count = setting.pick(200, 20_000)
    with quiet():
        taken = seconds(lambda: list(launch.run(_do_nothing, [(i,) for i in range(count)], launch=Launch("ray"))))
    yield "jobs.overhead/launch_milliseconds", 1000 * taken / count

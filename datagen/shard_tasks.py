"""Shards as tasks of a cluster: each is made and written where it runs, and its entry in the manifest comes back."""

from __future__ import annotations

import functools
import pathlib
from collections.abc import Generator, Sequence
from typing import Any

from dipn_jax.commands import launch
from dipn_jax.commands.launch import Launch
from dipn_jax.engine import Engine
from dipn_jax.errors import UserError
from dipn_jax.names import EngineName
from dipn_jax.physics import make_engine
from dipn_jax.planning import scorers
from dipn_jax.planning.planner import Scorer
from dipn_jax.storage import checkpoint, places, shards

from . import generate
from .generate import Elsewhere, Job


def elsewhere(where: Launch, *, threads: int | None, network: pathlib.Path | None) -> Elsewhere:
    """Return the function that makes shards as tasks.

    Args:
      where: the cluster, and what a task needs.
      threads: that native simulates on in a task.
      network: run with the network of `job.weights`, which every machine can read, or builtin.
    """

    def make(job: Job, todo: Sequence[int], out: pathlib.Path) -> Generator[tuple[str, dict[str, Any]], None, None]:
        tasks = [(job, job.describe(), index, out, where.threads(threads), network) for index in todo]
        for _, made in launch.run(make_shard, tasks, launch=where):
            yield made

    return make


def make_shard(
    job: Job, described: dict[str, Any], index: int, out: pathlib.Path, threads: int, network: pathlib.Path | None
) -> tuple[str, dict[str, Any]]:
    """Make and write one shard, and return its name and its entry. Runs as a Ray task, so it may be retried.

    Args:
      job: everything that determines the data set.
      described: the job as the folder was begun with.
      index: the shard's number.
      out: folder of the data set, which all machines share, or its URL.
      threads: that native simulates on.
      network: run with the network of `job.weights`.

    Raises:
      UserError: this machine would make other episodes, or does not see the folder.
    """
    if job.describe() != described:
        raise UserError(f"{out}: begun with {described.get('device')}, a task has {job.describe().get('device')}")
    with places.opened(out, look=False) as place:
        if not place.begun():
            raise UserError(f"{out}: a task does not see it; give an --out that all machines of the cluster share")
        if place.counts([index]).get(index) == job.size(index):  # before the worker was lost
            return shards.shard_path(out, index).name, place.entry(index)
        scorer = _scorer(network, job.weights) if network else None
        return generate.write_one(job, index, place, _engine(job.engine, job.timestep, threads), None, scorer)


@functools.cache
def _engine(name: EngineName, timestep: float | None, threads: int) -> Engine:
    """Return an engine, which a worker keeps from task to task."""
    return make_engine(name, timestep=timestep, threads=threads)


@functools.cache
def _scorer(run: pathlib.Path, digest: str) -> Scorer:
    """Return the scorer of a network, which a worker keeps from task to task."""
    network: Any = checkpoint.load_network(run, network="grasp")
    if checkpoint.digest(network) != digest:
        raise UserError(f"--grasp-net {run}: a task finds other weights there; give a run that all machines share")
    return scorers.aided_scorer(network)

"""Episodes -> shards. A shard is a pure function of (config, shard index): any worker, any time, the same
bytes (from the same versions, on the same kind of processor).
"""

from __future__ import annotations

import collections
import dataclasses
import json
import pathlib
from typing import Any

import jax

from datagen import episodes
from dipn_jax import clutter, console, files, records, structs
from dipn_jax.errors import UserError
from dipn_jax.physics import Engine, EngineName, make_engine, resolve
from dipn_jax.scenes import SceneConfig

MAX_ATTEMPTS = 100
"""Batches without a single usable episode before giving up."""
MAX_ACTIONS = 256
"""Actions tried on one scene."""


@dataclasses.dataclass(frozen=True)
class Job:
    """Everything that a data set is a function of."""

    kind: str
    scene: SceneConfig
    episodes: int
    seed: int
    shard_size: int
    actions: int
    engine: EngineName
    timestep: float | None  # seconds; the engine's own if None

    def shards(self) -> int:
        """How many shards the data set has."""
        return -(-self.episodes // self.shard_size)

    def describe(self) -> dict[str, Any]:
        """As JSON, beside the shards."""
        return json.loads(json.dumps(dataclasses.asdict(self)))

    def size(self, index: int) -> int:
        """Episodes of shard `index`."""
        return min(self.shard_size, self.episodes - index * self.shard_size)


def shard(job: Job, index: int, engine: Engine, progress: console.Progress) -> tuple[Any, dict[str, int]]:
    """The episodes of one shard and what was counted while making them."""
    want = job.size(index)
    key = jax.random.fold_in(jax.random.key(job.seed), index)
    done: list[Any] = []
    counts: collections.Counter[str] = collections.Counter()
    have = empty = 0
    while have < want:
        key, batch_key = jax.random.split(key)
        # a tenth more than needed, for scenes that are dropped
        count = min(clutter.BATCH, int(1.1 * (want - have) / job.actions) + 1)
        batch = episodes.MAKERS[job.kind](batch_key, engine, job.scene, count=count, actions=job.actions)
        counts.update(batch.counts)
        empty = empty + 1 if batch.episodes is None else 0
        if empty == MAX_ATTEMPTS:
            raise UserError(f"no usable episode in {MAX_ATTEMPTS} batches ({dict(counts)}); loosen the scene config")
        if batch.episodes is not None:
            fresh = min(len(batch.episodes.fault), want - have)
            done.append(structs.take(batch.episodes, slice(0, fresh)))
            have += fresh
            progress.advance(fresh, f"{counts['dropped_scenes']} scenes let fall")
    return structs.concatenate(done), dict(counts)


def generate(job: Job, out: pathlib.Path, *, part: int = 0, of: int = 1) -> None:
    """Write the shards of `job` that are missing; `part` of `of` workers takes every `of`-th.

    Raises:
      UserError: the folder holds a data set of another config.
    """
    console.require_positive(episodes=job.episodes, shard_size=job.shard_size, actions=job.actions, of=of)
    console.require_between(1, MAX_ACTIONS, actions=job.actions)
    console.require_seed(job.seed)
    console.require_out(out)
    if not 0 <= part < of:
        raise UserError(f"--shard {part} --of {of}: want 0 <= shard < of")
    job = dataclasses.replace(job, engine=resolve(job.engine))
    engine = make_engine(job.engine, timestep=job.timestep)
    _claim(job, out)
    # the content of a shard does not depend on how many others there are
    config = {key: value for key, value in job.describe().items() if key != "episodes"}
    mine = range(part, job.shards(), of)
    todo = [index for index in mine if not _written(out, index, job)]
    total = sum(map(job.size, mine))
    with console.Progress(job.kind, total, unit="episodes", done=total - sum(map(job.size, todo))) as progress:
        for index in todo:
            made, counts = shard(job, index, engine, progress)
            records.write_shard(out, index, made, kind=job.kind, config=config, faults=counts)
            records.update_manifest(out)
    manifest = records.update_manifest(out)
    console.say(f"{out}: {manifest['episodes']} {job.kind} episodes in {len(manifest['shards'])} shards")


def _written(out: pathlib.Path, index: int, job: Job) -> bool:
    """Whether shard `index` is there with all its episodes; one that is too short is made anew."""
    path = records.shard_path(out, index)
    return path.exists() and records.count(path) == job.size(index)


def _claim(job: Job, out: pathlib.Path) -> None:
    """A folder holds one config; more episodes of it may be asked for later, not fewer."""
    files.claim(out, job.describe() | {"episodes": max(job.episodes, _begun_with(out))}, free=("episodes",))
    if job.episodes < _begun_with(out):
        raise UserError(
            f"{out}: begun with {_begun_with(out)} episodes, asked for {job.episodes}; give another --out, or as many"
        )


def _begun_with(out: pathlib.Path) -> int:
    path = out / "config.json"
    return int(files.read_json(path).get("episodes", 0)) if path.exists() else 0

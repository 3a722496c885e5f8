"""Episodes -> shards. A shard is a pure function of (config, shard index): any worker, any time, the same bytes."""

from __future__ import annotations

import collections
import dataclasses
import json
import pathlib
from typing import Any

import jax

from datagen import episodes
from dipn_jax import clutter, console, records
from dipn_jax.errors import UserError
from dipn_jax.physics import Engine, EngineName, make_engine, resolve
from dipn_jax.scenes import SceneConfig

MAX_ATTEMPTS = 100
"""Batches without a single usable episode before giving up."""


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
        """As JSON, in each shard's metadata and beside the shards; the number of episodes may grow."""
        return json.loads(json.dumps(dataclasses.asdict(self)))


def shard(job: Job, index: int, engine: Engine, progress: console.Progress) -> tuple[Any, dict[str, int]]:
    """The episodes of one shard and what was counted while making them."""
    want = min(job.shard_size, job.episodes - index * job.shard_size)
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
            done.append(records.take(batch.episodes, slice(0, fresh)))
            have += fresh
            progress.advance(fresh, f"{counts['dropped_scenes']} scenes dropped")
    return records.concatenate(done), dict(counts)


def generate(job: Job, out: pathlib.Path, *, part: int = 0, of: int = 1) -> None:
    """Write the shards of `job` that are missing; `part` of `of` workers takes every `of`-th.

    Raises:
      UserError: the folder holds a data set of another config.
    """
    console.require_positive(episodes=job.episodes, shard_size=job.shard_size, actions=job.actions, of=of)
    if not 0 <= part < of:
        raise UserError(f"--shard {part} --of {of}: want 0 <= shard < of")
    job = dataclasses.replace(job, engine=resolve(job.engine))
    engine = make_engine(job.engine, timestep=job.timestep)
    _check_same(job, out)
    todo = [i for i in range(part, job.shards(), of) if not _written(out, i, job)]
    mine = range(part, job.shards(), of)
    size = lambda i: min(job.shard_size, job.episodes - i * job.shard_size)  # noqa: E731
    total = sum(size(i) for i in mine)
    with console.Progress(job.kind, total, unit="episodes", done=total - sum(map(size, todo))) as progress:
        for index in todo:
            made, counts = shard(job, index, engine, progress)
            records.write_shard(out, index, made, kind=job.kind, config=job.describe(), faults=counts)
            records.update_manifest(out)
    manifest = records.update_manifest(out)
    console.say(f"{out}: {manifest['episodes']} {job.kind} episodes in {len(manifest['shards'])} shards")


def _written(out: pathlib.Path, index: int, job: Job) -> bool:
    path = records.shard_path(out, index)
    if not path.exists():
        return False
    meta = records.read_meta(path)
    return meta["config"]["episodes"] == job.episodes or (index + 1) * job.shard_size <= min(
        job.episodes, meta["config"]["episodes"]
    )


def _check_same(job: Job, out: pathlib.Path) -> None:
    """A folder holds one config; more episodes of it may be asked for later."""
    path = out / "config.json"
    mine = job.describe()
    if path.exists():
        theirs = json.loads(path.read_text())
        different = [k for k in mine if k != "episodes" and theirs.get(k) != mine[k]]
        if different:
            key = different[0]
            raise UserError(
                f"{out}: holds a data set with {key}={theirs.get(key)}, asked for {key}={mine[key]}; "
                "give another --out or the same config"
            )
    records.write_json(path, mine)

"""Make shards of episodes.

A shard depends on the configuration and its index only: every worker writes the same bytes at any time (with the same
versions, on the same kind of processor).
"""

from __future__ import annotations

import collections
import concurrent.futures
import contextlib
import dataclasses
import functools
import json
import pathlib
import threading
from collections.abc import Callable, Generator, Sequence
from typing import Any

import jax

from dipn_jax import seeds, structs
from dipn_jax.commands import console
from dipn_jax.engine import DeviceEngine, Engine
from dipn_jax.errors import UserError
from dipn_jax.names import EngineName
from dipn_jax.physics import make_engine, resolve
from dipn_jax.planning.planner import Scorer
from dipn_jax.seeds import Purpose
from dipn_jax.storage import accounting, places, shards
from dipn_jax.storage.places import Place
from dipn_jax.system import files, typed
from dipn_jax.workspace import PUSH_STEPS
from dipn_jax.world.scenes import SceneConfig

from . import episodes, on_device

PURPOSES = {"push": Purpose.PUSH_DATA, "grasp": Purpose.GRASP_DATA, "images": Purpose.IMAGE_DATA}
"""The purpose of the random numbers of each kind of data."""
MAX_ATTEMPTS = 100
"""Batches without a single usable episode after which a shard is given up."""
MAX_ACTIONS = 256
"""Actions that may be tried on one scene."""
STORED_AS = {"unsure": "hard"}
"""Fields of a job that have another name in `config.json` and in shards, where data sets in use have it."""
SHARDS_AT_ONCE = 2
"""Shards that are made at the same time: one uses the cores that the other leaves idle."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Job:
    """Everything that determines a data set."""

    kind: str
    scene: SceneConfig
    episodes: int
    seed: int
    shard_size: int
    actions: int
    engine: EngineName = "auto"
    timestep: float | None = None  # seconds; the engine's own if None
    distances: tuple[float, ...] = (PUSH_STEPS * 0.01,)  # metres: each push is made once for every one of them
    guided: float = 0.0  # share of grasps that a network scores high
    unsure: float = 0.0  # share of grasps that the network is unsure of
    weights: str = ""  # SHA-256 of that network

    def __post_init__(self) -> None:
        console.require_positive(episodes=self.episodes, shard_size=self.shard_size)
        console.require_between(1, MAX_ACTIONS, actions=self.actions)
        console.require_seed(self.seed)
        for distance in self.distances:
            console.require_between(0.01, PUSH_STEPS * 0.01, distances=distance)
        if self.shards() > shards.MOST_SHARDS:
            raise UserError(
                f"--episodes {self.episodes} --shard-size {self.shard_size}: {self.shards()} shards, more than their "
                f"names can number ({shards.MOST_SHARDS}); give a larger --shard-size"
            )
        number = len(self.distances)
        if len(set(self.distances)) < max(number, 1):
            raise UserError(f"--distances {' '.join(map(str, self.distances))}: want at least one, and none twice")
        if self.episodes % number or self.shard_size % number:
            raise UserError(
                f"--episodes {self.episodes} --shard-size {self.shard_size}: want multiples of {number}, the number of "
                "distances, so that no push is without some of them"
            )

    def shards(self) -> int:
        """Return how many shards the data set has."""
        return accounting.RequestedSize(self.episodes, self.shard_size).shards()

    def describe(self) -> dict[str, Any]:
        """Return the job as it is written beside the shards; with the kind of device if batches depend on it."""
        device = {} if self.engine == "native" else {"device": jax.default_backend()}
        fields = {STORED_AS.get(name, name): value for name, value in dataclasses.asdict(self).items()}
        return json.loads(json.dumps(fields)) | device

    def size(self, index: int) -> int:
        """Return the number of episodes of shard `index`."""
        return accounting.RequestedSize(self.episodes, self.shard_size).size(index)


Elsewhere = Callable[[Job, Sequence[int], pathlib.Path], Generator[tuple[str, dict[str, Any]], None, None]]
"""(job, numbers of shards, folder) -> name and entry of each shard, in any order, when it is written."""


class _Tally:
    """Counts of all shards of this run, shown beside the progress bar. Threads share it."""

    def __init__(self, progress: console.Progress) -> None:
        self.progress, self.counts, self.lock = progress, collections.Counter[str](), threading.Lock()

    def add(self, fresh: int, counts: dict[str, int]) -> None:
        """Add `fresh` episodes, and the `counts` of the batch that they are from."""
        with self.lock:
            self.counts.update(counts)
            faults = {name: n for name, n in sorted(self.counts.items()) if n and name != "dropped_scenes"}
            said = ", ".join(f"{n} {name}" for name, n in faults.items()) or "no faults"
            self.progress.advance(fresh, f"{self.counts['dropped_scenes']} scenes dropped; {said}")


def _maker(job: Job, engine: Engine, scorer: Scorer | None) -> Callable[..., episodes.Batch]:
    """Return the function that makes a batch of episodes of `job` with `engine`: (key, *, count)."""
    guide = episodes.Guide(scorer, job.guided, job.unsure) if scorer else None
    queued = engine.on_device() if isinstance(engine, DeviceEngine) and job.kind != "images" else None
    module = on_device if queued else episodes
    makers: dict[str, Callable[..., episodes.Batch]] = {
        "push": functools.partial(module.push_batch, actions=job.actions, distances=job.distances),
        "grasp": functools.partial(module.grasp_batch, actions=job.actions, guide=guide),
        "images": episodes.image_batch,
    }
    return functools.partial(makers[job.kind], engine=queued or engine, config=job.scene)


def shard(
    job: Job, index: int, engine: Engine, tally: _Tally | None = None, scorer: Scorer | None = None
) -> tuple[Any, dict[str, int]]:
    """Return the episodes of one shard and the counts of the batches that they are from."""
    want = job.size(index)
    key = jax.random.fold_in(seeds.key(job.seed, PURPOSES[job.kind]), index)
    make = _maker(job, engine, scorer)
    each = job.actions * (len(job.distances) if job.kind == "push" else 1)
    done: list[Any] = []
    counts: collections.Counter[str] = collections.Counter()
    have = empty = 0
    while have < want:
        key, batch_key = jax.random.split(key)
        # a tenth more than needed, for scenes that are dropped
        count = min(engine.batch, int(1.1 * (want - have) / each) + 1)
        batch = make(batch_key, count=count)
        counts.update(batch.counts)
        empty = empty + 1 if batch.episodes is None else 0
        if empty == MAX_ATTEMPTS:
            said = ", ".join(f"{number} {name}" for name, number in counts.items())
            raise UserError(f"no usable episode in {MAX_ATTEMPTS} batches ({said}); give fewer --objects, or others")
        fresh = 0 if batch.episodes is None else min(len(batch.episodes.fault), want - have)
        if fresh:
            done.append(structs.take(batch.episodes, slice(0, fresh)))
        have += fresh
        if tally is not None:
            tally.add(fresh, batch.counts)
    return structs.concatenate(done), dict(counts)


def generate(
    job: Job,
    out: pathlib.Path,
    *,
    part: int = 0,
    of: int = 1,
    threads: int | None = None,
    scorer: Scorer | None = None,
    command: Sequence[str] | None = None,
    elsewhere: Elsewhere | None = None,
) -> None:
    """Write the shards of `job` that are missing; worker `part` of `of` workers takes every `of`-th.

    Two shards are made at a time: while one is simulated, the other is simulated, too, or drawn, rendered or written.

    Args:
      job: everything that determines the data set.
      out: its folder, or its URL.
      part: number of this worker.
      of: number of workers.
      threads: that `native` simulates on; shards are then made one at a time, so that no more are used.
      scorer: the network of `job.weights`, for guided and unsure grasps.
      command: what makes the data set, as `accounting.save_command` keeps it.
      elsewhere: makes the shards on other machines; all are made here if not given.

    Raises:
      UserError: the folder holds a data set of another config, or cannot be written to.
    """
    console.require_positive(of=of)
    if not 0 <= part < of:
        raise UserError(f"--shard {part} --of {of}: want 0 <= shard < of")
    job = dataclasses.replace(job, engine=resolve(job.engine))
    with places.opened(out) as place:
        engine = make_engine(job.engine, timestep=job.timestep, threads=threads)
        place.claim(functools.partial(_claim, job))
        if command is not None:
            place.note(command, of=of)
        mine = range(part, job.shards(), of)
        if not mine:
            said = f"no shard is left for this worker: there are {job.shards()}; want --of {job.shards()} at most"
            console.warn(f"--shard {part} --of {of}: {said}")
        held = place.counts(mine)
        todo = [index for index in mine if held.get(index) != job.size(index)]
        total = sum(map(job.size, mine))
        place.forget(todo)
        made: dict[str, Any] = {}
        try:
            with console.Progress(job.kind, total, unit="episodes", done=total - sum(map(job.size, todo))) as progress:
                tally = _Tally(progress)
                if elsewhere is None:
                    at_once = 1 if threads else SHARDS_AT_ONCE
                    _write_all(job, todo, place, engine, tally, scorer, made, at_once=at_once)
                else:
                    _gather(elsewhere(job, todo, out), tally, made)
        except BaseException:
            if of == 1:
                with contextlib.suppress(UserError, OSError):  # what ended the work is said
                    place.list(made)
            raise
        sizes = {index: job.size(index) for index in range(job.shards())}
        console.say(places.end(place, made, sizes=sizes, alone=of == 1))


def _gather(finished: Generator[tuple[str, dict[str, Any]], None, None], tally: _Tally, made: dict[str, Any]) -> None:
    """Add the entry of each shard to `made` as the cluster finishes it."""
    with contextlib.closing(finished):
        for name, entry in finished:
            made[name] = entry
            tally.add(entry["episodes"], entry["faults"])


def _write_all(
    job: Job,
    todo: list[int],
    place: Place,
    engine: Engine,
    tally: _Tally,
    scorer: Scorer | None,
    made: dict[str, Any],
    *,
    at_once: int,
) -> None:
    """Make and write the shards `todo`, `at_once` at a time; the first error stops all.

    `made` gets the entries of the shards in the manifest, by name.
    """

    def one(index: int) -> None:
        name, entry = write_one(job, index, place, engine, tally, scorer)
        made[name] = entry

    with concurrent.futures.ThreadPoolExecutor(at_once) as pool:
        futures: list[concurrent.futures.Future[None]] = []
        try:
            futures += [pool.submit(one, index) for index in todo]
            for future in concurrent.futures.as_completed(futures):
                future.result()
        except BaseException:
            for future in futures:
                future.cancel()
            engine.stop()
            raise


def write_one(
    job: Job, index: int, place: Place, engine: Engine, tally: _Tally | None, scorer: Scorer | None
) -> tuple[str, dict[str, Any]]:
    """Make and write one shard; return its name and its entry in the manifest."""
    # the content of a shard does not depend on how many others there are
    config = {key: value for key, value in job.describe().items() if key != "episodes"}
    episodes, counts = shard(job, index, engine, tally, scorer)
    entry = shards.write_shard(place.folder, index, episodes, kind=job.kind, config=config, faults=counts)
    return shards.shard_path(place.folder, index).name, place.commit(index, entry)


def _claim(job: Job, out: pathlib.Path) -> None:
    """Claim the folder, which holds data of one config; a later run may ask for more episodes, not for fewer."""
    files.claim(out, job.describe() | {"episodes": max(job.episodes, _begun_with(out))}, free=("episodes",))
    if job.episodes < _begun_with(out):
        raise UserError(
            f"{out}: begun with {_begun_with(out)} episodes, asked for {job.episodes}; give another --out, or as many"
        )


def _begun_with(out: pathlib.Path) -> int:
    """Return the number of episodes that the folder was begun with; 0 if it was not."""
    path = out / "config.json"
    if accounting.merged(out) is not None:
        raise UserError(f"{out}: a merged data set, which no command extends; give another --out")
    return int(files.read_json(path, wanted={"episodes": typed.Whole()})["episodes"]) if path.exists() else 0

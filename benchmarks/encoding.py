"""What a data set costs besides physics: encoding and writing episodes, and everything around a simulation."""

from __future__ import annotations

import pathlib
import tempfile
from collections.abc import Iterator
from typing import Any
from unittest import mock

import jax
import numpy as np
from dipn_jax.datagen import generate

from benchmarks.datagen_native import ACTIONS
from benchmarks.harness import Setting, make_data, quiet, seconds
from dipn_jax import structs
from dipn_jax.engine import PhysicsConfig
from dipn_jax.storage import records
from dipn_jax.structs import PushEpisode, Rollout, Scene, Trajectory
from dipn_jax.world import scenes, shapes

OBJECTS = 7
"""Number of objects in a scene."""
SHIFT = 0.01
"""Metres (standard deviation) by which an episode that is used again is moved, so that no two are alike."""


def job(objects: int, episodes: int, *, shards: int, seed: int) -> generate.Job:
    """Return the job of a data set of pushes with `episodes` in each of its shards."""
    return generate.Job(
        kind="push",
        scene=scenes.fixed_count(objects),
        episodes=shards * episodes,
        seed=seed,
        shard_size=episodes,
        actions=ACTIONS["push"],
        engine="native",
    )


def real(objects: int, count: int, seed: int) -> PushEpisode:
    """Return `count` push episodes of MuJoCo C."""
    with tempfile.TemporaryDirectory() as name, quiet():
        folder = pathlib.Path(name) / "data"
        generate.generate(job(objects, count, shards=1, seed=seed), folder)
        made: PushEpisode = jax.tree.map(np.asarray, records.read_episodes(folder))
    return made


def synthetic(made: PushEpisode, count: int, seed: int) -> PushEpisode:
    """Return `count` push episodes: copies of those of `made`, each at another place.

    All poses of an episode move alike, so what rests in it still rests, and compresses as it does in a real one.
    """
    found = structs.take(made, np.arange(count) % len(made.fault))
    shift = np.random.default_rng(seed).normal(0.0, SHIFT, (count, 2)).astype(np.float32)
    poses, after = np.array(found.poses), np.array(found.after)
    poses[..., :2] += shift[:, None, None]
    after[..., :2] += shift[:, None]
    return found.replace(poses=poses, after=after)


class Resting:
    """An `Engine` without physics: objects stand at once where they are dropped, and nothing moves them.

    What a data set then takes is all that is not physics.
    """

    name, config, batch = "native", PhysicsConfig(), 1024

    def simulate(
        self,
        scenes: Scene,
        poses: Any,
        trajectories: Trajectory,
        samples: Any,
        *,
        settle: bool = False,
        fence: float = 0.0,
    ) -> Rollout:
        """See `Engine.simulate`."""
        scenes, there = jax.tree.map(np.asarray, scenes), np.array(poses)
        there[..., 2] -= shapes.lowest_corner(scenes.shape, scenes.size, there, xp=np)
        batch, count = len(there), len(samples)
        gripper = np.zeros((batch, count, 5), np.float32)
        return Rollout(np.repeat(there[:, None], count, 1), gripper, np.zeros(batch, np.int32))

    def stop(self) -> None:
        """See `Engine.stop`; a call takes no time."""


def writing_rate(objects: int, episodes: int, *, shards: int, few: int, seed: int) -> float:
    """Measure how many push episodes a second are encoded and written; they are copies of `few` real ones."""
    made = synthetic(real(objects, few, seed), episodes, seed)
    task = job(objects, episodes, shards=shards, seed=seed)
    with mock.patch.object(generate, "shard", lambda *_: (made, {})):
        make_data(task)
        return task.episodes / seconds(lambda: make_data(task))


def reading_rate(objects: int, episodes: int, *, shards: int, few: int, seed: int) -> float:
    """Measure how many push episodes a second `read_episodes` checks and decodes from files that were just written."""
    made = synthetic(real(objects, few, seed), episodes, seed)
    task = job(objects, episodes, shards=shards, seed=seed)
    with tempfile.TemporaryDirectory() as name, quiet(), mock.patch.object(generate, "shard", lambda *_: (made, {})):
        folder = pathlib.Path(name) / "data"
        generate.generate(task, folder)
        return task.episodes / seconds(lambda: records.load(folder, kind="push"))


def make_without_physics(task: generate.Job) -> int:
    """Make a data set as `harness.make_data` does, with `Resting` as its engine."""
    with mock.patch.object(generate, "make_engine", lambda *_, **__: Resting()):
        return make_data(task)


def pipeline_rate(objects: int, episodes: int, *, shards: int, seed: int) -> float:
    """Measure push episodes a second on disk, with drawing, rendering and aiming, with `Resting` as engine."""
    task = job(objects, episodes, shards=shards, seed=seed)
    make_without_physics(task)  # compiles
    return task.episodes / seconds(lambda: make_without_physics(task))


def encoding(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure `datagen.encoding`, `writing_rate` of seven objects, `/without_physics`, `pipeline_rate`, and `/read`."""
    many, few, files = setting.pick(2000, 8000), setting.pick(200, 2000), setting.pick(20, 200)
    yield "datagen.encoding", writing_rate(OBJECTS, many, shards=4, few=48, seed=setting.seed)
    yield "datagen.encoding/without_physics", pipeline_rate(OBJECTS, few, shards=2, seed=setting.seed)
    yield "datagen.encoding/read", reading_rate(OBJECTS, 500, shards=files, few=48, seed=setting.seed)

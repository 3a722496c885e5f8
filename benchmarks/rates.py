"""Absolute rates: to document one machine, not to compare two."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import statistics
from collections.abc import Iterator
from unittest import mock

import jax
import numpy as np
from dipn_jax.datagen import generate

from benchmarks.datagen_mjx import engine as mjx_engine
from benchmarks.datagen_mjx import heaps
from benchmarks.datagen_native import ACTIONS
from benchmarks.harness import Setting, Skipped, make_data, seconds
from dipn_jax.engine import Engine
from dipn_jax.names import EngineName
from dipn_jax.physics import make_engine
from dipn_jax.physics.mjx import MjxEngine
from dipn_jax.physics.warp import WarpEngine
from dipn_jax.world import primitives, scenes

COUNTS = (1, 3, 7, 10, 20, 30)
"""Numbers of objects."""
FEW_ON_CPU = 4
"""Episodes of each kind that MJX and Warp make on a CPU at small scale, where their rate is below one per second."""
BATCHES = (512, 1024, 2048, 4096)
"""Numbers of heaps simulated at once on an accelerator, for `scene_seconds`."""
SIMULATED_SECONDS = 0.2
"""Seconds for which they are simulated."""


def _engine_kept(engine: EngineName) -> contextlib.AbstractContextManager[object]:
    """Make all data sets in this context use one engine, which keeps its compiled programs.

    The native one is left alone: it remembers models, which a second run of the same job must not find.
    """
    if engine == "native":
        return contextlib.nullcontext()
    made = mjx_engine() if engine == "mjx" else make_engine(engine)
    return mock.patch.object(generate, "make_engine", lambda *_, **__: made)


def rate(engine: EngineName, kind: str, objects: int, episodes: int, seed: int) -> float:
    """Measure episodes on disk per second; compilation by JAX is not counted."""
    scene = scenes.parse_objects(str(objects))
    shard = -(-episodes // (4 if engine == "native" else 2))
    job = generate.Job(
        kind=kind, scene=scene, episodes=episodes, seed=seed, shard_size=shard, actions=ACTIONS[kind], engine=engine
    )
    with _engine_kept(engine):
        make_data(job)
        return episodes / seconds(lambda: make_data(job))


def _rates(engine: EngineName, setting: Setting, episodes: int) -> Iterator[tuple[str, float]]:
    """Measure `rates.ENGINE/KIND/OBJECTS`; fewer episodes where there are many objects."""
    for kind in ("push", "grasp"):
        for objects in COUNTS:
            value = rate(engine, kind, objects, max(episodes * 7 // max(objects, 7), 4), setting.seed)
            yield f"rates.{engine}/{kind}/{objects}", value


def scene_seconds(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure `engines.scene_seconds/ENGINE/BATCH`: seconds of heaps of seven objects simulated per second."""
    names: tuple[EngineName, ...] = ("native", "mjx", "warp")
    for name in names[: 3 if importlib.util.find_spec("warp") else 2]:
        for batch in (64,) if jax.default_backend() == "cpu" else BATCHES:
            scene, poses = heaps(setting.seed, batch)
            still, end = primitives.parked_trajectory(batch, SIMULATED_SECONDS), np.array([SIMULATED_SECONDS])
            work = functools.partial(_sized(name, batch).simulate, scene, poses, still, end)
            work()  # compiles
            taken = statistics.median(seconds(work) for _ in range(setting.pick(1, 5)))
            yield f"engines.scene_seconds/{name}/{batch}", batch * SIMULATED_SECONDS / taken


def _sized(name: EngineName, batch: int) -> Engine:
    """Return an engine that takes a whole batch at once, where its batch can be chosen."""
    if name == "mjx" and jax.default_backend() != "cpu":
        return MjxEngine(chunk=batch)
    if name == "warp":
        return WarpEngine(chunk=batch)
    return make_engine(name)


def native(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure the rates of MuJoCo C on all cores."""
    return _rates("native", setting, setting.pick(96, 960))


def mjx(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure the rates of MJX, on XLA."""
    few = setting.pick(FEW_ON_CPU, 24)
    return _rates("mjx", setting, few if jax.default_backend() == "cpu" else setting.pick(384, 3840))


def warp(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure the rates of MuJoCo Warp."""
    if importlib.util.find_spec("warp") is None:
        raise Skipped("MuJoCo Warp is not installed; run pip install 'dipn-jax[warp]'")
    few = setting.pick(FEW_ON_CPU, 24)
    return _rates("warp", setting, few if jax.default_backend() == "cpu" else setting.pick(384, 3840))

"""Stages of `on_gpu` about engines: push episodes on disk against MuJoCo C, and rates of drops and of pushes."""

from __future__ import annotations

import dataclasses
import functools
import statistics
from collections.abc import Iterator
from typing import Any
from unittest import mock

import jax
import numpy as np
from dipn_jax.datagen import episodes, generate

from benchmarks import encoding as encoding_alone
from benchmarks.datagen_mjx import heaps
from benchmarks.gpu_stage import COMPILING, Found, NotMeasured, Size, installed
from benchmarks.harness import make_data, seconds
from dipn_jax import batching, structs
from dipn_jax.engine import DeviceEngine, Engine
from dipn_jax.names import EngineName
from dipn_jax.physics import cores, make_engine, mjx, warp
from dipn_jax.physics.mjx import MjxEngine
from dipn_jax.physics.warp import WarpEngine
from dipn_jax.structs import Fault, Push, Rollout, Scene, Trajectory
from dipn_jax.world import primitives, scenes

ACCELERATORS: tuple[EngineName, ...] = ("mjx", "mjx_warp", "warp")
"""Engines that simulate on a GPU."""
MOST_LONGER = 16
"""How many times as long a data set is made at once, where one took too little time to count."""


class Padded:
    """An engine that is only given batches of two sizes: for others it would compile in the middle of a measurement.

    The last few scenes of a data set get a small batch, all others whole ones; what fills a batch up is simulated for
    nothing.
    """

    def __init__(self, engine: Engine, *, small: int, full: int) -> None:
        self.engine, self.small, self.full = engine, small, full
        self.name, self.config, self.batch = engine.name, engine.config, full

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
        count = len(poses)
        room = self.small if count <= self.small else -(-count // self.full) * self.full
        rows = np.arange(room) % count
        scenes, poses, trajectories = jax.tree.map(lambda leaf: leaf[rows], (scenes, poses, trajectories))
        out = self.engine.simulate(scenes, poses, trajectories, samples, settle=settle, fence=fence)
        return jax.tree.map(lambda leaf: leaf[:count], out)

    def on_device(self) -> Engine | None:
        """See `DeviceEngine.on_device`."""
        queued = self.engine.on_device() if isinstance(self.engine, DeviceEngine) else None
        return Padded(queued, small=self.small, full=self.full) if queued else None

    def stop(self) -> None:
        """See `Engine.stop`."""
        self.engine.stop()


def engine(name: EngineName, size: Size, *, batch: int = 0) -> Engine:
    """Return an engine by its name; an accelerator's takes batches of `batch` scenes, or `size.batches[0]`, and a tail.

    Engines are kept with their programs.

    Raises:
      NotMeasured: it is not installed.
    """
    if name == "native":
        return make_engine("native")
    full = batch or size.batches[0]
    return Padded(_kept(name, full, size.timestep), small=min(size.tail, full), full=full)


@functools.cache
def _kept(name: EngineName, batch: int, timestep: float | None) -> Engine:
    """Return MJX or Warp for `batch` scenes at once, with another time step if one is given."""
    if name.endswith("warp") and not installed("warp"):
        raise NotMeasured("NVIDIA Warp is not installed; install the extra `warp`")
    kind, config = (WarpEngine, warp.DEFAULTS) if name == "warp" else (MjxEngine, mjx.DEFAULTS)
    solver = "warp" if name == "mjx_warp" else config.solver
    config = dataclasses.replace(config, timestep=timestep or config.timestep, solver=solver)
    made: Engine = kind(config, chunk=batch)
    return made


def make_ready(engine: Engine, scene: Scene, poses: Any) -> None:
    """Let an engine compile what it needs for scenes `[B]`, and count that as compiling."""
    with COMPILING.counted():
        primitives.settle(engine, scene, poses, duration=0.01)


@functools.cache
def drawn(size: Size, count: int) -> tuple[Scene, np.ndarray]:
    """Return `count` random scenes of `size.objects` objects in mid-air, all different, and their poses."""
    config = scenes.fixed_count(size.objects)
    draw = jax.jit(jax.vmap(lambda key: scenes.random_scene(key, config=config)))
    found: tuple[Scene, np.ndarray] = jax.device_get(
        batching.in_batches(draw, jax.random.split(jax.random.key(size.seed), count))
    )
    return found


@functools.cache
def heaps_of(size: Size, batch: int) -> tuple[Scene, np.ndarray]:
    """Return `batch` falling heaps of one scene, and their poses, as `datagen_mjx.heaps`."""
    return heaps(size.seed, batch, objects=size.objects)


def push_episodes_vs_native(size: Size) -> Found:
    """Measure push episodes on disk a second, by MuJoCo C on all cores and by each accelerator, and the best ratio."""
    encoding_alone.make_without_physics(
        encoding_alone.job(size.objects, size.shard, shards=1, seed=size.seed)
    )  # compiles
    native = episode_rate("native", size)
    yield "native_episodes_per_second", native
    yield "native_cores", cores()
    best = 0.0
    for name in ACCELERATORS:
        try:
            rate = episode_rate(name, size)
        except NotMeasured as reason:
            yield name, f"not measured: {reason}"
            continue
        best = max(best, rate / native)
        yield f"{name}_episodes_per_second", rate
        yield name, rate / native
        yield "", best


def episode_rate(name: EngineName, size: Size) -> float:
    """Measure push episodes on disk a second: drop, look, aim, push, encode and write.

    A data set that took too little time is made again, larger and of other scenes.
    """
    made = engine(name, size)
    if name != "native":
        for count in (size.tail, size.batches[0]):
            make_ready(made, *drawn(size, count))
    shards = 1
    while True:
        job = encoding_alone.job(size.objects, size.shard, shards=shards, seed=size.seed + shards)
        with mock.patch.object(generate, "make_engine", lambda *_, **__: made):
            taken = seconds(functools.partial(make_data, job))
        if taken >= size.least_seconds:
            return job.episodes / taken
        shards *= min(MOST_LONGER, 1 + int(size.least_seconds / taken))


def engines(size: Size) -> Found:
    """Measure each engine at each batch size: heaps, drops and pushes; the largest batches come last."""
    best: dict[str, float] = {}
    for batch in size.batches:
        for name in ("native", *ACCELERATORS):
            try:
                made = engine(name, size, batch=batch)
            except NotMeasured as reason:
                yield f"{name}/{batch}", f"not measured: {reason}"
                continue
            for what, value in _rates(made, size, batch):
                best[name] = max(best.get(name, 0.0), value if what == "scene_seconds" else 0.0)
                yield f"{what}/{name}/{batch}", value
        yield "", max(best.get(name, 0.0) for name in ACCELERATORS) / best["native"]


def _rates(engine: Engine, size: Size, batch: int) -> Iterator[tuple[str, float]]:
    """Measure an engine's scene seconds, drops and pushes a second, in a batch."""
    scene, poses = heaps_of(size, batch)
    begun = seconds(lambda: make_ready(engine, scene, poses))
    yield "first_call_seconds", begun
    yield "scene_seconds", heap_rate(engine, scene, poses, size)
    scene, poses = drawn(size, batch)
    dropping = functools.partial(primitives.settle, engine, scene, poses, fence=primitives.FENCE_TIME)
    yield "drops_per_second", batch / seconds(dropping)
    scene, poses, pushes = _tables(size, batch)
    yield "pushes_per_second", batch / seconds(lambda: primitives.push(engine, scene, poses, pushes))


def heap_rate(engine: Engine, scene: Scene, poses: np.ndarray, size: Size) -> float:
    """Measure simulated seconds a second, of all heaps `[B]` together, as they fall on."""
    still, end = primitives.parked_trajectory(len(poses), size.heap_seconds), np.array([size.heap_seconds])
    taken = [seconds(lambda: engine.simulate(scene, poses, still, end)) for _ in range(size.repeats)]
    return len(poses) * size.heap_seconds / statistics.median(taken)


@functools.cache
def _tables(size: Size, batch: int) -> tuple[Scene, np.ndarray, Push]:
    """Return `batch` scenes at rest in MuJoCo C and a feasible push on each; some are there more than once."""
    scene, poses = drawn(size, batch)
    rollout = primitives.settle(make_engine("native"), scene, poses, fence=primitives.FENCE_TIME)
    rested = np.asarray(rollout.poses)[:, -1]
    keys = jax.random.split(jax.random.key(size.seed), batch)
    pushes, feasible = episodes.aim_pushes(keys, scene, rested, actions=1)
    good = np.flatnonzero(np.asarray(feasible)[:, 0] & Fault.usable(rollout.fault))
    if not len(good):
        raise NotMeasured(f"none of {batch} scenes has a feasible push")
    rows = np.resize(good, batch)
    return structs.take(scene, rows), rested[rows], jax.tree.map(lambda leaf: np.asarray(leaf)[rows, 0], pushes)


def encoding(size: Size) -> Found:
    """Measure how many push episodes a second are encoded and written, and are made where physics costs nothing."""
    yield (
        "",
        encoding_alone.writing_rate(size.objects, size.written, shards=4, few=min(48, size.written), seed=size.seed),
    )
    yield (
        "without_physics",
        encoding_alone.pipeline_rate(size.objects, size.shard, shards=2, seed=size.seed),
    )

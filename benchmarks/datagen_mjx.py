"""The MJX engine against stepping MJX as its manual shows, and against itself at another batch size."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
from collections.abc import Callable, Iterator
from typing import Any
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from benchmarks.harness import Setting, Skipped, alternate
from dipn_jax import geometry, structs
from dipn_jax.engine import Engine, PhysicsConfig
from dipn_jax.names import EngineName
from dipn_jax.physics import make_engine, substeps
from dipn_jax.physics.mjx import MjxEngine
from dipn_jax.physics.native import NativeEngine
from dipn_jax.structs import Scene
from dipn_jax.world import model, primitives, scenes
from dipn_jax.world.model import GRIPPER_DOF

OBJECTS = 7
"""Number of objects in a scene."""
FALL_SECONDS = 0.5
"""Seconds for which objects have fallen before the measurement begins: the heap still moves."""


@functools.cache
def engine(name: EngineName = "mjx") -> MjxEngine:
    """Return one engine for all benchmarks: it keeps its compiled programs."""
    made = make_engine(name)
    assert isinstance(made, MjxEngine)
    return made


def heaps(seed: int, batch: int, *, objects: int = OBJECTS) -> tuple[Scene, np.ndarray]:
    """Return one random scene `batch` times, and poses `[batch, N, 7]` of a different heap of it in each."""
    key = jax.random.key(seed)
    scene, poses = scenes.random_scene(key, config=scenes.fixed_count(objects))
    repeated = structs.take(jax.tree.map(lambda leaf: np.asarray(leaf)[None], scene), np.zeros(batch, int))
    start = np.tile(np.asarray(poses), (batch, 1, 1))
    # objects start between the bounding spheres of one another, so they may be turned at will
    start[..., 3:] = np.asarray(geometry.random_quat(jax.random.fold_in(key, 1), shape=(batch, objects)))
    rollout = primitives.settle(make_engine("native"), repeated, start, duration=FALL_SECONDS)
    return repeated, np.asarray(rollout.poses)[:, -1]


def plain_mjcf(scene: Scene, config: PhysicsConfig) -> str:
    """Return the world of one scene without the geoms that only keep memory layouts equal."""
    root = ElementTree.fromstring(model.mjcf(scene, config=config))
    gone = {geom.get("name") for geom in root.iter("geom") if geom.get("contype") == "8"}
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag == "geom" and child.get("name") in gone:
                parent.remove(child)
            if child.tag == "pair" and {child.get("geom1"), child.get("geom2")} & gone:
                parent.remove(child)
    return ElementTree.tostring(root, encoding="unicode")


class PlainLoop:
    """The loop to compare with: `jax.vmap(mjx.step)`, jitted, called in Python, with no limit on contacts."""

    def __init__(self, scene: Scene, poses: np.ndarray, config: PhysicsConfig) -> None:
        """Compile for the scene `scene [B]` (the same in every row) from `poses [B, N, 7]`."""
        config = dataclasses.replace(config, geom_pairs=None, contact_points=None)
        compiled = mujoco.MjModel.from_xml_string(plain_mjcf(structs.take(scene, 0), config))
        self.model = mjx.put_model(compiled, impl="jax")
        still = primitives.parked_trajectory(1, 1.0).target[0, 0]
        control = jnp.concatenate([still[:4], still[4:] / 2, still[4:] / 2])
        first = mjx.make_data(self.model)
        qpos = jnp.asarray(poses, jnp.float32).reshape(len(poses), -1)
        qpos = jnp.concatenate([jnp.broadcast_to(control, (len(poses), GRIPPER_DOF)), qpos], -1)
        first = first.replace(ctrl=control)
        self.first = jax.vmap(lambda q: first.replace(qpos=q))(qpos)
        self.first = jax.tree.map(lambda leaf: leaf.astype(leaf.dtype), self.first)
        self.step = jax.jit(self._step)
        self.last = self.run(2)

    @staticmethod
    def _step(m: Any, data: Any) -> Any:
        """Step all scenes once; weak types, some of which MJX returns, would make the second call compile again."""
        new = jax.vmap(mjx.step, in_axes=(None, 0))(m, data)
        return jax.tree.map(lambda leaf, old: jnp.asarray(leaf).astype(old.dtype), new, data)

    def run(self, steps: int) -> Any:
        """Step from the beginning."""
        data = self.first
        for _ in range(steps):
            data = self.step(self.model, data)
        self.last = jax.block_until_ready(data)
        return self.last


def ours(scene: Scene, poses: np.ndarray, duration: float, *, by: Engine | None = None) -> Callable[[], Any]:
    """Return work for the clock: the program of an engine, `mjx` if none is given, for `duration` seconds."""
    still, end = primitives.parked_trajectory(len(poses), duration), np.array([duration])
    return lambda: (by or engine()).simulate(scene, poses, still, end)


def vs_naive(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure seconds of the loop over seconds of the engine, for the same steps of the same scenes."""
    duration = setting.pick(10, 30) / 100
    config = engine().config
    steps = round(duration / 0.01) * substeps(config)
    for batch in (32, 128):
        scene, poses = heaps(setting.seed, batch)
        work = ours(scene, poses, duration)
        work()  # compiles
        with jax.numpy_rank_promotion("allow"):
            naive = PlainLoop(scene, poses, config)
            mine, theirs = alternate(work, functools.partial(naive.run, steps), repeats=setting.pick(3, 5))
        if not np.isfinite(np.asarray(naive.last.qpos)).all():
            raise RuntimeError("the naive loop diverged: its time means nothing; try another --seed")
        yield f"datagen_mjx.vs_naive/{batch}", theirs / mine


def batch_scaling(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure the cost of a step of one scene in a batch of 128 over that in one of 16."""
    duration = setting.pick(10, 30) / 100
    few, many = (ours(*heaps(setting.seed, batch), duration) for batch in (16, 128))
    few(), many()  # compile
    small, large = alternate(few, many, repeats=setting.pick(3, 7))
    yield "datagen_mjx.batch_scaling", (large / 128) / (small / 16)


def kernel(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure seconds of the engine, and of MuJoCo C on one core, over those of the Warp kernel, and of a scene's step.

    All make the same time steps of the same scenes.
    """
    if importlib.util.find_spec("warp") is None:
        raise Skipped("datagen_mjx.kernel: warp is not installed; want pip install '.[warp]'")
    duration, batch = setting.pick(10, 30) / 100, 32 if jax.default_backend() == "cpu" else 1024
    steps = batch * round(duration / 0.01) * substeps(engine().config)
    scene, poses = heaps(setting.seed, batch)
    core = NativeEngine(engine().config, threads=1)
    plain, kernels, native = (ours(scene, poses, duration, by=by) for by in (None, engine("mjx_warp"), core))
    plain(), kernels()  # compile
    by_xla, mine, by_core = alternate(plain, kernels, native, repeats=setting.pick(5, 7))
    yield f"datagen_mjx.kernel/{batch}", by_xla / mine
    yield "datagen_mjx.kernel/milliseconds", 1000 * mine / steps
    yield "datagen_mjx.kernel/milliseconds_without", 1000 * by_xla / steps
    yield "datagen_mjx.kernel/native_core", by_core / mine
    yield "datagen_mjx.kernel/milliseconds_native_core", 1000 * by_core / steps

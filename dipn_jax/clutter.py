"""key -> scenes at rest, and what the camera sees of many scenes. Data generation and evaluation both begin here."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dipn_jax import primitives, render, scenes, structs
from dipn_jax.errors import UserError
from dipn_jax.physics import Engine
from dipn_jax.structs import Array, Fault, Grasp, Observation, Scene, SettledScene

BATCH, FEW = 64, 16
"""Scenes that compiled functions take at a time, of many and of few."""
MAX_DROPS = 128
"""Drops in a row without a usable scene before giving up."""


def settled(
    key: jax.Array, engine: Engine, config: scenes.SceneConfig, count: int
) -> tuple[SettledScene, dict[str, int]]:
    """Drop `count` random scenes and keep those that came to rest inside the workspace without a fault.

    Args:
      key: random key.
      engine: physics.
      config: distributions.
      count: scenes dropped.

    Returns:
      The scenes kept `[K]`, and how many were dropped and why others were not kept.
    """
    draw = functools.partial(_random_scenes, config=config)
    scene, poses = jax.tree.map(np.asarray, in_chunks(draw, jax.random.split(key, count)))
    rollout = primitives.settle(engine, scene, poses, fence=primitives.FENCE_TIME)
    fault = np.asarray(rollout.fault)
    everything = SettledScene(scene, np.asarray(rollout.poses)[:, -1], fault)
    counts = {f"settle_{name}": n for name, n in Fault.count(fault).items()}
    return structs.take(everything, fault == 0), {"dropped_scenes": count, **counts}


def settled_exactly(key: jax.Array, engine: Engine, config: scenes.SceneConfig, count: int) -> SettledScene:
    """`count` scenes at rest, however many drops it takes.

    Raises:
      UserError: `MAX_DROPS` drops in a row gave none.
    """
    kept: list[SettledScene] = []
    in_vain = 0
    while (missing := count - sum(len(batch.fault) for batch in kept)) > 0:
        key, drop = jax.random.split(key)
        tries = min(engine.batch, int(1.2 * missing) + 2)
        batch, counts = settled(drop, engine, config, tries)
        in_vain = 0 if len(batch.fault) else in_vain + tries
        if in_vain >= MAX_DROPS:
            raise UserError(
                f"scenes: {in_vain} drops, none at rest inside the workspace ({counts}); ask for fewer objects"
            )
        kept.append(structs.take(batch, slice(0, missing)))
    return structs.concatenate(kept)


def grasp_away(
    engine: Engine, scene: Scene, poses: Array, grasps: Grasp
) -> tuple[Scene, np.ndarray, np.ndarray, np.ndarray]:
    """Execute one grasp a scene, take away what is held, let the rest come to rest.

    Args:
      engine: physics.
      scene: `[B, N]`.
      poses: `[B, N, 7]`.
      grasps: `[B]`.

    Returns:
      Scenes and poses `[B, N, 7]` afterwards, objects held `[B, N]` bool, and faults `[B]` of both simulations.
    """
    rollout, outcome = primitives.grasp(engine, scene, poses, grasps)
    held = np.asarray(outcome.held)
    scene, after = jax.device_get(scenes.remove(scene, np.asarray(rollout.poses)[:, -1], held))
    rest = primitives.settle(engine, scene, after, duration=primitives.RESETTLE_TIME)
    return scene, np.asarray(rest.poses)[:, -1], held, np.asarray(rollout.fault) | np.asarray(rest.fault)


@functools.partial(jax.jit, static_argnames="config")
def _random_scenes(keys: jax.Array, config: scenes.SceneConfig) -> tuple[Scene, jax.Array]:
    return jax.vmap(lambda k: scenes.random_scene(k, config=config))(keys)


def in_chunks(function: Callable[..., Any], *args: Any) -> Any:
    """`function(*args)` for any number of rows: BATCH or FEW at a time, so that two compiled shapes serve all.

    Args:
      function: jitted, of pytrees with a leading axis, each row by itself.
      args: pytrees with a leading axis.

    Returns:
      What `function` returns, its rows joined.
    """
    count = len(jax.tree.leaves(args)[0])
    parts, start = [], 0
    while start < count:
        size = BATCH if count - start > BATCH - FEW else FEW
        rows = np.arange(start, start + size) % count
        parts.append(function(*jax.tree.map(lambda leaf, rows=rows: leaf[rows], args)))
        start += size
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:count], *parts)


def in_few(function: Callable[..., Any], *args: Any) -> Any:
    """As `in_chunks`, FEW at a time, for functions that are dear: `function(*rows, real)` is told which rows count.

    Args:
      function: jitted, of pytrees with a leading axis, and of `real [FEW]` bool.
      args: pytrees with a leading axis.
    """
    count = len(jax.tree.leaves(args)[0])
    parts = []
    for start in range(0, count, FEW):
        rows = np.arange(start, start + FEW)
        some = jax.tree.map(lambda leaf, rows=rows % count: leaf[rows], args)
        parts.append(jax.device_get(function(*some, rows < count)))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts)


def observe(scene: Scene, poses: Array) -> Observation:
    """Observations `[B]` of scenes `[B, N]` and poses `[B, N, 7]`, in memory on the device."""
    return in_chunks(_observe, scene, poses)


@jax.jit
def _observe(scene: Scene, poses: jax.Array) -> Observation:
    height, label = jax.lax.map(lambda pair: render.render_depth(*pair), (scene, poses))
    return Observation(height, jax.vmap(render.paint_labels)(label, scene.color), label)

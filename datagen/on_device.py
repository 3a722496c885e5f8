"""Batches of episodes from a random key, for an engine whose arrays stay on its device.

They are those of `episodes`. Nothing waits for the host between the drop and the last pose: scenes that fell badly are
sorted to the end, as are pushes that are not feasible, and their places are filled up with others, which are not kept.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from dipn_jax.datagen import episodes
from dipn_jax.datagen.episodes import Batch, Guide
from jaxtyping import Bool, Float, Int

from dipn_jax import structs
from dipn_jax.engine import Engine
from dipn_jax.storage import codec
from dipn_jax.structs import Array, Grasp, GraspEpisode, Push, PushEpisode, SettledScene
from dipn_jax.workspace import PUSH_STEPS
from dipn_jax.world import clutter, primitives, scenes


def push_batch(
    key: jax.Array,
    engine: Engine,
    config: scenes.SceneConfig,
    *,
    count: int,
    actions: int,
    distances: tuple[float, ...] = (PUSH_STEPS * 0.01,),
) -> Batch:
    """Return the pushes of `episodes.push_batch`, made on the device of `engine`, which returns arrays there."""
    queued = push_episodes(key, engine, config, count=count, actions=actions, distances=distances)
    made, kept, infeasible, fault = jax.device_get(queued)
    counts = clutter.drop_counts(fault) | {"infeasible_pushes": int(infeasible)}
    return _first(made, int(kept), counts, together=len(distances))


def grasp_batch(
    key: jax.Array,
    engine: Engine,
    config: scenes.SceneConfig,
    *,
    count: int,
    actions: int,
    guide: Guide | None = None,
) -> Batch:
    """Return the grasps of `episodes.grasp_batch`, made on the device of `engine`, which returns arrays there."""
    queued = grasp_episodes(key, engine, config, count=count, actions=actions, guide=guide)
    made, kept, fault = jax.device_get(queued)
    return _first(made, int(kept), clutter.drop_counts(fault))


def push_episodes(
    key: jax.Array,
    engine: Engine,
    config: scenes.SceneConfig,
    *,
    count: int,
    actions: int,
    distances: tuple[float, ...],
) -> tuple[PushEpisode, Int[Array, ""], Int[Array, ""], Int[Array, " B"]]:
    """Drop, look, aim, round and push without waiting for anything; can be traced.

    Returns:
      `count * actions * len(distances)` episodes; how many of them count, the first ones; how many of the pushes drawn
      were not feasible; and the fault codes of all drops.
    """
    drop, aim = jax.random.split(key)
    dropped = clutter.drop(drop, engine, config, count)
    items, good = _good_first(dropped)
    pushes, feasible = episodes.aim_pushes(jax.random.split(aim, count), items.scene, items.poses, actions=actions)
    repeated, pushes, kept = _feasible_first(
        items, pushes, feasible, good, np.array(distances, np.float32), codec.STEPS
    )
    rollout = primitives.push(engine, repeated.scene, repeated.poses, pushes)
    poses = jnp.asarray(rollout.poses).at[:, 0].set(repeated.poses)  # as in `episodes.push_batch`
    made = PushEpisode(repeated.scene, poses[:, : PUSH_STEPS + 1], poses[:, -1], pushes, rollout.fault)
    return made, kept * len(distances), good * actions - kept, dropped.fault


def grasp_episodes(
    key: jax.Array,
    engine: Engine,
    config: scenes.SceneConfig,
    *,
    count: int,
    actions: int,
    guide: Guide | None,
) -> tuple[GraspEpisode, Int[Array, ""], Int[Array, " B"]]:
    """Drop, look, aim, round and grasp without waiting for anything; can be traced.

    Returns:
      `count * actions` episodes; how many of them count, the first ones; and the fault codes of all drops.
    """
    drop, aim = jax.random.split(key)
    dropped = clutter.drop(drop, engine, config, count)
    items, good = _good_first(dropped)
    keys = jax.random.split(aim, count)
    grasps = episodes.aim_grasps(keys, items.scene, items.poses, actions=actions, guide=guide)
    repeated, grasps = _each_grasp(items, grasps, codec.STEPS)
    rollout, outcome = primitives.grasp(engine, repeated.scene, repeated.poses, grasps)
    made = GraspEpisode(
        scene=repeated.scene,
        poses=repeated.poses,
        after=rollout.poses[:, -1],
        grasp=grasps,
        held=outcome.held,
        success=outcome.success,
        fault=rollout.fault,
    )
    return made, good * actions, dropped.fault


@jax.jit
def _good_first(items: SettledScene) -> tuple[SettledScene, Int[Array, ""]]:
    """Return scenes `[B]` of which the first are those without a fault, and how many they are.

    The others are repetitions of the first.
    """
    rows, good = _first_rows(items.fault == 0)
    return items[rows], good


@jax.jit
def _feasible_first(
    items: SettledScene,
    pushes: Push,
    feasible: Bool[Array, "B A"],
    good: Int[Array, ""],
    distances: Float[Array, " D"],
    steps: dict[str, Any],
) -> tuple[SettledScene, Push, Int[Array, ""]]:
    """Return each push `[B, A]` once for each distance, rounded, with its scene `[B A D]`: the feasible ones first.

    Returns:
      Scenes, pushes, and how many pushes on the first `good` scenes are feasible.
    """
    actions = feasible.shape[1]
    rows, kept = _first_rows((feasible & (jnp.arange(len(feasible)) < good)[:, None]).reshape(-1))
    flat: Push = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[rows].repeat(len(distances), 0), pushes)
    flat = flat.replace(distance=jnp.tile(distances, len(rows)))
    repeated = items[(rows // actions).repeat(len(distances))]
    rounded = functools.partial(codec.rounded_on_device, steps=steps)
    return rounded(repeated), rounded(flat, prefix="push."), kept


@jax.jit
def _each_grasp(items: SettledScene, grasps: Grasp, steps: dict[str, Any]) -> tuple[SettledScene, Grasp]:
    """Return each grasp `[B, A]`, rounded, with its scene `[B A]`."""
    actions = grasps.angle.shape[1]
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), grasps)
    repeated = items[jnp.arange(len(items.fault)).repeat(actions)]
    rounded = functools.partial(codec.rounded_on_device, steps=steps)
    return rounded(repeated), rounded(flat, prefix="grasp.")


def _first_rows(keep: Bool[Array, " B"]) -> tuple[Int[Array, " B"], Int[Array, ""]]:
    """Return the numbers of rows to `keep`, in order and again from the first until there are B, and their count."""
    count = keep.sum()
    return jnp.argsort(~keep)[jnp.arange(len(keep)) % jnp.maximum(count, 1)], count


def _first(made: Any, kept: int, counts: dict[str, int], *, together: int = 1) -> Batch:
    """Return the first `kept` episodes without those that cannot be used."""
    return episodes.drop_unusable(structs.take(made, slice(0, kept)), counts, together=together)

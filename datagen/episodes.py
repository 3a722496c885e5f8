"""key -> a batch of episodes: set up, settle, look, act, read. Nothing here knows a file."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from dipn_jax import candidates, clutter, primitives, scenes, structs
from dipn_jax.physics import Engine
from dipn_jax.structs import (
    Fault,
    Grasp,
    GraspEpisode,
    Observation,
    Push,
    PushEpisode,
    SettledScene,
)
from dipn_jax.workspace import PUSH_STEPS


@dataclasses.dataclass
class Batch:
    """Episodes that passed and what was counted on the way."""

    episodes: Any
    counts: dict[str, int]


def _look(
    key: jax.Array, engine: Engine, config: scenes.SceneConfig, count: int
) -> tuple[SettledScene, Observation | None, dict[str, int]]:
    """Settled scenes, what the camera sees of them (None if there are none), and counts.

    Observations are `[clutter.BATCH]`, scenes repeated to fill them, so that compiled shapes stay few.
    """
    items, counts = clutter.settled(key, engine, config, count)
    if not len(items.fault):
        return items, None, counts
    filled = structs.take(items, np.arange(clutter.BATCH) % len(items.fault))
    return items, clutter.observe(filled.scene, filled.poses), counts


def push_batch(
    key: jax.Array,
    engine: Engine,
    config: scenes.SceneConfig,
    *,
    count: int,
    actions: int,
    distances: tuple[float, ...] = (PUSH_STEPS * 0.01,),
) -> Batch:
    """`actions` different pushes on each of up to `count` settled scenes, each once for every one of `distances`."""
    drop, aim = jax.random.split(key)
    items, observation, counts = _look(drop, engine, config, count)
    if observation is None:
        return Batch(None, counts)
    n = len(items.fault)
    pushes, feasible = aim_pushes(jax.random.split(aim, clutter.BATCH), observation, actions, config.slots)
    keep = np.asarray(feasible)[:n].reshape(-1)
    pushes = jax.tree.map(lambda leaf: np.asarray(leaf)[:n].reshape(-1, *leaf.shape[2:])[keep], pushes)
    counts["infeasible_pushes"] = int((~keep).sum())
    if not keep.any():
        return Batch(None, counts)
    repeated = structs.take(items, np.repeat(np.arange(n), actions)[keep].repeat(len(distances)))
    each = np.tile(np.asarray(distances, np.float32), int(keep.sum()))
    pushes = structs.take(pushes, np.arange(int(keep.sum())).repeat(len(distances))).replace(distance=each)
    rollout = primitives.push(engine, repeated.scene, repeated.poses, pushes)
    poses = np.asarray(rollout.poses)
    episodes = PushEpisode(repeated.scene, poses[:, : PUSH_STEPS + 1], poses[:, -1], pushes, np.asarray(rollout.fault))
    return _drop_unusable(episodes, counts)


@functools.partial(jax.jit, static_argnames=("actions", "slots"))
def aim_pushes(keys: jax.Array, observation: Observation, actions: int, slots: int) -> tuple[Push, jax.Array]:
    """Random pushes `[B, actions]` of observations `[B]`, and which are feasible."""

    def one(args: tuple[jax.Array, Observation]) -> tuple[Push, jax.Array]:
        return candidates.sample_pushes(args[0], args[1], count=actions, slots=slots, distance=PUSH_STEPS * 0.01)

    return jax.lax.map(one, (keys, observation))


def grasp_batch(
    key: jax.Array, engine: Engine, config: scenes.SceneConfig, *, count: int, actions: int, **_: Any
) -> Batch:
    """`actions` grasps at random foreground pixels and angles on each of up to `count` settled scenes."""
    drop, aim = jax.random.split(key)
    items, observation, counts = _look(drop, engine, config, count)
    if observation is None:
        return Batch(None, counts)
    n = len(items.fault)
    grasps = aim_grasps(jax.random.split(aim, clutter.BATCH), observation, actions)
    grasps = jax.tree.map(lambda leaf: np.asarray(leaf)[:n].reshape(-1, *leaf.shape[2:]), grasps)
    repeated = structs.take(items, np.repeat(np.arange(n), actions))
    rollout, outcome = primitives.grasp(engine, repeated.scene, repeated.poses, grasps)
    episodes = GraspEpisode(
        repeated.scene,
        repeated.poses,
        np.asarray(rollout.poses)[:, -1],
        grasps,
        np.asarray(outcome.held),
        np.asarray(outcome.success),
        np.asarray(rollout.fault),
    )
    return _drop_unusable(episodes, counts)


@functools.partial(jax.jit, static_argnames="actions")
def aim_grasps(keys: jax.Array, observation: Observation, actions: int) -> Grasp:
    """Random grasps `[B, actions]` of the foreground of observations `[B]`."""
    return jax.lax.map(lambda args: candidates.random_grasps(args[0], args[1], count=actions), (keys, observation))


def image_batch(key: jax.Array, engine: Engine, config: scenes.SceneConfig, *, count: int, **_: Any) -> Batch:
    """Settled scenes, nothing done to them."""
    items, counts = clutter.settled(key, engine, config, count)
    return Batch(items if len(items.fault) else None, counts)


def _drop_unusable(episodes: Any, counts: dict[str, int]) -> Batch:
    fault = episodes.fault
    counts.update({f"action_{name}": n for name, n in Fault.count(fault).items()})
    good = (fault & Fault.UNUSABLE) == 0
    return Batch(structs.take(episodes, good) if good.any() else None, counts)


MAKERS: dict[str, Callable[..., Batch]] = {"push": push_batch, "grasp": grasp_batch, "images": image_batch}

"""Batches of episodes from a random key: draw scenes, settle them, look, act and record. Nothing here knows a file."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import numpy as np

from dipn_jax import batching, structs
from dipn_jax.engine import Engine
from dipn_jax.planning import candidates
from dipn_jax.planning.planner import Scorer
from dipn_jax.sight import render
from dipn_jax.storage import codec
from dipn_jax.structs import (
    Array,
    Fault,
    Grasp,
    GraspEpisode,
    Push,
    PushEpisode,
    Scene,
)
from dipn_jax.workspace import PUSH_STEPS
from dipn_jax.world import clutter, primitives, scenes


@dataclasses.dataclass
class Batch:
    """Usable episodes, and counts of drops and faults."""

    episodes: Any
    counts: dict[str, int]


def push_batch(
    key: jax.Array,
    engine: Engine,
    config: scenes.SceneConfig,
    *,
    count: int,
    actions: int,
    distances: tuple[float, ...] = (PUSH_STEPS * 0.01,),
) -> Batch:
    """Push `actions` times on each of up to `count` settled scenes, each push once for each of `distances`."""
    drop, aim = jax.random.split(key)
    items, counts = clutter.settled(drop, engine, config, count)
    n = len(items.fault)
    if not n:
        return Batch(None, counts)
    pushes, feasible = aim_pushes(jax.random.split(aim, n), items.scene, items.poses, actions=actions)
    keep = np.asarray(feasible).reshape(-1)
    pushes = jax.tree.map(lambda leaf: np.asarray(leaf).reshape(-1, *leaf.shape[2:])[keep], pushes)
    counts["infeasible_pushes"] = int((~keep).sum())
    if not keep.any():
        return Batch(None, counts)
    repeated = structs.take(items, np.repeat(np.arange(n), actions)[keep].repeat(len(distances)))
    each = np.tile(np.asarray(distances, np.float32), int(keep.sum()))
    pushes = structs.take(pushes, np.arange(int(keep.sum())).repeat(len(distances))).replace(distance=each)
    repeated, pushes = codec.rounded(repeated), codec.rounded(pushes, prefix="push.")  # so that it can be replayed
    rollout = primitives.push(engine, repeated.scene, repeated.poses, pushes)
    poses = np.array(rollout.poses)
    poses[:, 0] = repeated.poses  # where the simulation began; as the gripper arrives, they are a few micrometres off
    episodes = PushEpisode(repeated.scene, poses[:, : PUSH_STEPS + 1], poses[:, -1], pushes, np.asarray(rollout.fault))
    return drop_unusable(episodes, counts, together=len(distances))


def aim_pushes(keys: jax.Array, scene: Scene, poses: Array, *, actions: int) -> tuple[Push, jax.Array]:
    """Draw 10 cm pushes `[B, actions]` on the visible objects of scenes `[B, N]` at `poses [B, N, 7]`.

    Returns:
      The pushes, and which of them are feasible `[B, actions]`.
    """
    return batching.in_batches(functools.partial(_aim_pushes, actions=actions), keys, scene, poses)


@functools.partial(jax.jit, static_argnames="actions")
def _aim_pushes(keys: jax.Array, scene: Scene, poses: jax.Array, *, actions: int) -> tuple[Push, jax.Array]:
    def one(args: tuple[jax.Array, Scene, jax.Array]) -> tuple[Push, jax.Array]:
        seen = render.render(*args[1:])
        return candidates.sample_pushes(args[0], seen, count=actions, distance=PUSH_STEPS * 0.01)

    return batching.each_row(one, (keys, scene, poses))


@dataclasses.dataclass(frozen=True)
class Guide:
    """Network that chooses grasps to try, and the shares of those grasps."""

    scorer: Scorer
    guided: float  # share of grasps that it scores high
    unsure: float  # share of grasps that it is unsure of


def grasp_batch(
    key: jax.Array,
    engine: Engine,
    config: scenes.SceneConfig,
    *,
    count: int,
    actions: int,
    guide: Guide | None = None,
) -> Batch:
    """Grasp `actions` times on each of up to `count` settled scenes: at random foreground pixels, or guided."""
    drop, aim = jax.random.split(key)
    items, counts = clutter.settled(drop, engine, config, count)
    n = len(items.fault)
    if not n:
        return Batch(None, counts)
    grasps = aim_grasps(jax.random.split(aim, n), items.scene, items.poses, actions=actions, guide=guide)
    grasps = jax.tree.map(lambda leaf: np.asarray(leaf).reshape(-1, *leaf.shape[2:]), grasps)
    repeated = codec.rounded(structs.take(items, np.repeat(np.arange(n), actions)))  # so that it can be replayed
    grasps = codec.rounded(grasps, prefix="grasp.")
    rollout, outcome = primitives.grasp(engine, repeated.scene, repeated.poses, grasps)
    episodes = GraspEpisode(
        scene=repeated.scene,
        poses=repeated.poses,
        after=np.asarray(rollout.poses)[:, -1],
        grasp=grasps,
        held=np.asarray(outcome.held),
        success=np.asarray(outcome.success),
        fault=np.asarray(rollout.fault),
    )
    return drop_unusable(episodes, counts)


def aim_grasps(keys: jax.Array, scene: Scene, poses: Array, *, actions: int, guide: Guide | None = None) -> Grasp:
    """Draw grasps `[B, actions]` on the visible foreground of scenes `[B, N]` at `poses [B, N, 7]`."""
    return batching.in_batches(functools.partial(_aim_grasps, actions=actions, guide=guide), keys, scene, poses)


@functools.partial(jax.jit, static_argnames=("actions", "guide"))
def _aim_grasps(keys: jax.Array, scene: Scene, poses: jax.Array, *, actions: int, guide: Guide | None) -> Grasp:
    def one(args: tuple[jax.Array, Scene, jax.Array]) -> Grasp:
        seen = render.render(*args[1:])
        if guide is None:
            return candidates.random_grasps(args[0], seen, count=actions)
        scores = guide.scorer(render.rgbd(seen)[None])[0]
        return candidates.sample_grasps(args[0], seen, scores, count=actions, guided=guide.guided, unsure=guide.unsure)

    return batching.each_row(one, (keys, scene, poses))


def image_batch(key: jax.Array, engine: Engine, config: scenes.SceneConfig, *, count: int) -> Batch:
    """Return settled scenes on which nothing has been done."""
    items, counts = clutter.settled(key, engine, config, count)
    return Batch(items if len(items.fault) else None, counts)


def drop_unusable(episodes: Any, counts: dict[str, int], *, together: int = 1) -> Batch:
    """Return the usable episodes; where one of `together` neighbours is faulty, all of them are left out."""
    fault = episodes.fault
    counts.update({f"action_{name}": n for name, n in Fault.count(fault).items()})
    good = Fault.usable(fault).reshape(-1, together).all(-1).repeat(together)
    return Batch(structs.take(episodes, good) if good.any() else None, counts)

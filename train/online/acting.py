"""Observations, choices and rewards of a learner of pushes and grasps, on many tables at once."""

from __future__ import annotations

import functools
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Float

from dipn_jax import structs
from dipn_jax.engine import Engine
from dipn_jax.networks.vpg import VPG
from dipn_jax.planning import candidates, memory, scorers
from dipn_jax.planning.planner import Scorer
from dipn_jax.sight import fingers, render
from dipn_jax.storage import serialization
from dipn_jax.structs import Array, Fault, Grasp, Push, Pytree, Scene
from dipn_jax.world import clutter, primitives

EXPLORED_AT_FIRST = 0.5
"""Share of actions whose primitive is random at the beginning. Source: VPG's released code."""
EXPLORED_AT_LEAST = 0.1
"""Share of actions whose primitive stays random. Source: VPG's released code."""
EXPLORATION_DECAY = 0.9998
"""Factor of the share of random primitives, for every action. Source: VPG's released code."""
OBJECT_HEIGHT = 0.01
"""Metres above which a pixel shows an object."""
CHANGED_TABLE_PIXELS = 300
"""Pixels that have to change for the table to count as changed."""
CHANGE_REWARD = 0.5
"""VPG's reward of a push that changes the scene."""
DISCOUNT = 0.5
"""VPG's discount of the next action's value."""
HIGHEST_VALUE = 1 / (1 - DISCOUNT)
"""Highest value that is possible, because rewards are at most 1. Estimates of the next value are cut off there: the
greatest of a million estimates is too high, and would raise itself (without this, values are 5 after 2,500 actions)."""
SCORE_RISE = 1.1
"""DQN+GN: factor by which the best grasp score has to rise for a reward, the mean of both. Source: DIPN's code."""
UNCOVERED_PIXELS = 300
"""DQN+GN: pixels more that have to show objects for UNCOVERED_REWARD. Source: DIPN's code."""
COVERED_PIXELS = -100
"""DQN+GN: change of the pixels that show objects below which a push gets no reward. Source: DIPN's code."""
UNCOVERED_REWARD = 0.8
"""DQN+GN: least reward of a push that spreads objects out. Source: DIPN's code."""


@serialization.register
@flax.struct.dataclass
class Look(Pytree):
    """A table as a learner sees it, and the actions that it may choose."""

    height: Float[Array, "*b H W"]  # metres
    push: Push  # the best one
    push_value: Float[Array, "*b"]  # -inf if no push can be begun
    grasp: Grasp  # the best one
    grasp_value: Float[Array, "*b"]


@functools.partial(jax.jit, static_argnums=0, static_argnames=("scorer", "distance"))
def look(
    graph: Any,
    params: Any,
    rest: Any,
    scene: Scene,
    poses: jax.Array,
    wanted: jax.Array,
    *,
    scorer: Scorer | None,
    distance: float,
) -> Look:
    """Return images and best actions of the tables `[T]` that are `wanted [T]`; zeros for the other tables."""
    network: VPG = nnx.merge(graph, params, rest)
    network.eval()
    pushes, grasps = scorers.value_scorers(network)
    grasps = scorer or grasps

    def one(args: tuple[Scene, jax.Array]) -> Look:
        seen = render.render(*args)
        image = render.rgbd(seen)[None]
        possible = fingers.pushable(seen.height)
        values = pushes(image)[0] if pushes else jnp.zeros(possible.shape)
        push_index, push_value = candidates.best_grasp(jnp.where(possible, values, -jnp.inf))
        assert grasps is not None
        grasp_index, grasp_value = candidates.best_grasp(grasps(image)[0])
        return Look(
            height=seen.height,
            push=candidates.push_at(push_index, distance),
            push_value=push_value,
            grasp=candidates.grasp_at(grasp_index, seen.height),
            grasp_value=grasp_value,
        )

    def some(args: tuple[Scene, jax.Array, jax.Array]) -> Look:
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(one, args[:2]))
        return jax.lax.cond(args[2], lambda: one(args[:2]), lambda: nothing)

    return jax.lax.map(some, (scene, poses, wanted))


def choose(now: Look, rng: np.random.Generator, actions: int, *, may_push: bool) -> np.ndarray:
    """Choose between the best push and the best grasp on each table: the higher value, or now and then either.

    So the released codes of VPG and of DIPN (for DQN+GN) explore; a learner of grasps alone has no choice.

    Args:
      now: the tables `[T]`.
      rng: random numbers of the exploration.
      actions: number of actions that were made before.
      may_push: whether pushes are allowed, too.

    Returns:
      Which tables are pushed on `[T]` bool; none where no push can be begun.
    """
    count = len(now.grasp_value)
    explored = max(EXPLORED_AT_FIRST * EXPLORATION_DECAY**actions, EXPLORED_AT_LEAST)
    random, coin = rng.uniform(size=count) < explored, rng.uniform(size=count) < 0.5
    pushing = np.where(random, coin, now.push_value > now.grasp_value)
    return pushing & np.isfinite(now.push_value) & may_push


def execute(
    engine: Engine, scene: Scene, poses: np.ndarray, pushing: np.ndarray, push: Push, grasp: Grasp
) -> tuple[Scene, np.ndarray, np.ndarray, np.ndarray]:
    """Push or grasp on each of the tables `[T]`.

    Returns:
      Scenes and poses afterwards, objects held `[T, N]` bool, and which simulations went without a fault `[T]` bool.
    """
    shape, poses = np.array(scene.shape), np.array(poses)
    held, good = np.zeros(shape.shape, bool), np.ones(len(shape), bool)
    rows = np.flatnonzero(pushing)
    if len(rows):
        rollout = primitives.push(engine, structs.take(scene, rows), poses[rows], structs.take(push, rows))
        poses[rows], good[rows] = np.asarray(rollout.poses)[:, -1], Fault.usable(rollout.fault)
    rows = np.flatnonzero(~pushing)
    if len(rows):
        after = clutter.grasp_away(engine, structs.take(scene, rows), poses[rows], structs.take(grasp, rows))
        shape[rows], poses[rows], held[rows], good[rows] = after[0].shape, after[1], after[2], Fault.usable(after[3])
    return scene.replace(shape=shape), poses, held, good


def changed(now: Look, then: Look) -> np.ndarray:
    """Return which of the tables `[T]` look different."""
    return (np.abs(then.height - now.height) > memory.CHANGED_HEIGHT).sum((1, 2)) > CHANGED_TABLE_PIXELS


def push_reward(now: Look, then: Look, *, method: str) -> np.ndarray:
    """Return the rewards `[T]` of pushes."""
    different = changed(now, then)
    if method != "dqn":
        return CHANGE_REWARD * different
    gained = (then.height > OBJECT_HEIGHT).sum((1, 2)) - (now.height > OBJECT_HEIGHT).sum((1, 2))
    better = then.grasp_value > SCORE_RISE * now.grasp_value
    reward = np.where(better, (now.grasp_value + then.grasp_value) / 2, 0.0)
    reward = np.where(gained > UNCOVERED_PIXELS, np.maximum(reward, UNCOVERED_REWARD), reward)
    return np.where(different & (gained >= COVERED_PIXELS), reward, 0.0)


def q_targets(reward: np.ndarray, then: Look, more: Array) -> np.ndarray:
    """Return targets `[T]` of Q-learning: reward, plus the discounted value of the best next action if there is one.

    Args:
      reward: `[T]`.
      then: the tables after the action.
      more: `[T]` bool: there is a next action.
    """
    future = np.minimum(np.maximum(then.push_value, then.grasp_value), HIGHEST_VALUE)
    return reward + DISCOUNT * np.where(more & np.isfinite(future), future, 0.0)

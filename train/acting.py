"""What a learner of pushes and grasps sees, chooses and gets: many tables at once."""

from __future__ import annotations

import functools
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from dipn_jax import structs
from dipn_jax.engine import Engine
from dipn_jax.networks.vpg import VPG
from dipn_jax.planning import candidates, policy
from dipn_jax.planning.planner import Scorer
from dipn_jax.sight import fingers, render
from dipn_jax.structs import Array, Fault, Grasp, Push, Pytree, Scene
from dipn_jax.world import clutter, primitives

EXPLORE = (0.5, 0.1, 0.9998)
"""Share of random actions at first and at last, and its decay per action. Source: VPG's released code."""
CHANGED = (0.01, 300)
"""Metres of height and pixels of it that make a change."""
CHANGE_REWARD = 0.5
"""VPG's reward of a push that changes the scene."""
DISCOUNT = 0.5
"""VPG's discount of what comes next."""
MOST = 1 / (1 - DISCOUNT)
"""The highest value there is, of rewards of at most 1. What comes next is not believed to be worth more: the greatest
of a million estimates is too great, and would feed on itself (without this, values are 5 after 2,500 actions)."""
BETTER, UNCOVERED, COVERED, UNCOVERED_REWARD = 1.1, 300, -100, 0.8
"""DQN+GN's push reward: the mean of the best grasp scores before and after if it rose so many times; at least so much
if so many more pixels are covered with objects, nothing if so many fewer. Source: DIPN's released code."""


@flax.struct.dataclass
class Look(Pytree):
    """What a learner knows of a table."""

    height: Array  # [H, W] metres
    push: Push  # the best one
    push_value: Array  # [] -inf if no push can be begun
    random_push: Push
    can_push: Array  # [] bool: the random push can be begun
    grasp: Grasp  # the best one
    grasp_value: Array  # []
    random_grasp: Grasp


@functools.partial(jax.jit, static_argnums=0, static_argnames=("scorer", "distance"))
def look(
    graph: Any,
    params: Any,
    rest: Any,
    keys: jax.Array,
    scene: Scene,
    poses: jax.Array,
    wanted: jax.Array,
    *,
    scorer: Scorer | None,
    distance: float,
) -> Look:
    """What there is to do on each of the tables `[T]` that are `wanted [T]`; zeros of the others."""
    network: VPG = nnx.merge(graph, params, rest)
    network.eval()
    pushes, grasps = policy.value_scorers(network)
    grasps = scorer or grasps

    def one(args: tuple[jax.Array, Scene, jax.Array]) -> Look:
        push_key, grasp_key = jax.random.split(args[0])
        seen = render.render(*args[1:])
        image = render.rgbd(seen)[None]
        possible = fingers.pushable(seen.height)
        values = pushes(image)[0] if pushes else jnp.zeros(possible.shape)
        push_index, push_value = candidates.best_grasp(jnp.where(possible, values, -jnp.inf))
        slots = args[1].shape.shape[0]
        sampled, feasible = candidates.sample_pushes(push_key, seen, count=1, slots=slots, distance=distance)
        where = candidates.push_index(jax.tree.map(lambda leaf: leaf[0], sampled))
        assert grasps is not None
        grasp_index, grasp_value = candidates.best_grasp(grasps(image)[0])
        anywhere = candidates.random_grasps(grasp_key, seen, count=1)
        return Look(
            height=seen.height,
            push=candidates.push_at(push_index, distance),
            push_value=push_value,
            random_push=candidates.push_at(where, distance),
            can_push=feasible[0],
            grasp=candidates.grasp_at(grasp_index, seen.height),
            grasp_value=grasp_value,
            random_grasp=jax.tree.map(lambda leaf: leaf[0], anywhere),
        )

    def some(args: tuple[jax.Array, Scene, jax.Array, jax.Array]) -> Look:
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(one, args[:3]))
        return jax.lax.cond(args[3], lambda: one(args[:3]), lambda: nothing)

    return jax.lax.map(some, (keys, scene, poses, wanted))


def choose(now: Look, rng: np.random.Generator, actions: int, *, may_push: bool) -> tuple[np.ndarray, Push, Grasp]:
    """Which tables are pushed on `[T]` bool, and a push and a grasp for each: the best ones, or random ones.

    Args:
      now: of the tables `[T]`.
      rng: of the exploration.
      actions: that were made before.
      may_push: grasps only if not.
    """
    count = len(now.grasp_value)
    first, last, decay = EXPLORE
    random = rng.uniform(size=count) < max(first * decay**actions, last)
    coin = rng.uniform(size=count) < 0.5
    pushing = np.where(random, coin & now.can_push, now.push_value > now.grasp_value)
    pushing &= may_push

    def pick(best: Array, other: Array) -> Array:
        return np.where(random.reshape(-1, *[1] * (best.ndim - 1)), other, best)

    return pushing, jax.tree.map(pick, now.push, now.random_push), jax.tree.map(pick, now.grasp, now.random_grasp)


def execute(
    engine: Engine, scene: Scene, poses: np.ndarray, pushing: np.ndarray, push: Push, grasp: Grasp
) -> tuple[Scene, np.ndarray, np.ndarray, np.ndarray]:
    """Scenes and poses afterwards, objects held `[T, N]` bool, simulations that can be believed `[T]` bool."""
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
    """Which of the tables `[T]` look different."""
    return (np.abs(then.height - now.height) > CHANGED[0]).sum((1, 2)) > CHANGED[1]


def push_reward(now: Look, then: Look, *, method: str) -> np.ndarray:
    """Rewards `[T]` of pushes."""
    different = changed(now, then)
    if method != "dqn":
        return CHANGE_REWARD * different
    gained = (then.height > CHANGED[0]).sum((1, 2)) - (now.height > CHANGED[0]).sum((1, 2))
    better = then.grasp_value > BETTER * now.grasp_value
    reward = np.where(better, (now.grasp_value + then.grasp_value) / 2, 0.0)
    reward = np.where(gained > UNCOVERED, np.maximum(reward, UNCOVERED_REWARD), reward)
    return np.where(different & (gained >= COVERED), reward, 0.0)


def with_future(reward: np.ndarray, then: Look, more: Array) -> np.ndarray:
    """Targets `[T]` of Q-learning: reward, and discounted value of the best next action where there is `more`."""
    future = np.minimum(np.maximum(then.push_value, then.grasp_value), MOST)
    return reward + DISCOUNT * np.where(more & np.isfinite(future), future, 0.0)

"""Decisions on many tables at once: by a method's policy, or with the engine itself as predictor."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from dipn_jax import batching
from dipn_jax.engine import Engine
from dipn_jax.planning import methods
from dipn_jax.planning.methods import Act, Networks, Policy, PolicyConfig
from dipn_jax.planning.planner import Rule
from dipn_jax.sight import render
from dipn_jax.structs import Array, Decision, Scene

from . import rollouts

TablePolicy = Callable[[jax.Array, Scene, Array, Array], Decision]
"""(keys [B], scenes [B, N], poses [B, N, 7], grasps that missed [B, M, 3]) -> brief decisions [B], NumPy."""


def load(method: str, networks: Networks, engine: Engine, configs: list[PolicyConfig]) -> list[TablePolicy]:
    """Load a method once and return its policy for each of several configs; they share compiled programs.

    Args:
      method: a name of `methods.METHODS`.
      networks: runs.
      engine: physics, for `physics+gn`.
      configs: equal in everything, the number of candidates included, except distances and rule.

    Raises:
      UserError: a network that the method needs was not given, or is another.
    """
    build, runs = methods.find(method).build, networks.runs(method)
    if build is None:
        scorer, summarize = methods.gn_scores(runs["grasp"], configs[0])
        decide = functools.partial(rollouts.decide, scorer=scorer, summarize=summarize, engine=engine)
        return [functools.partial(decide, rule=each.rule(), distances=each.spread()) for each in configs]
    policy = build(runs, configs[0])
    if not methods.find(method).pushes:
        return [in_lockstep(policy)] * len(configs)
    return [in_lockstep(policy.with_config(each)) for each in configs]


def in_lockstep(policy: Policy) -> TablePolicy:
    """Make a policy of one table into one of many, which are rendered and decided on in one call."""

    def decide(keys: jax.Array, scene: Scene, poses: Array, missed: Array) -> Decision:
        each = functools.partial(_decide_each, act=policy.act, rule=policy.rule, distances=policy.distances)
        decisions: Decision = batching.in_small_batches(each, keys, scene, poses, missed)
        return decisions

    return decide


@functools.partial(jax.jit, static_argnames="act")
def _decide_each(
    keys: jax.Array,
    scene: Scene,
    poses: jax.Array,
    missed: jax.Array,
    real: jax.Array,
    *,
    act: Act,
    rule: Rule,
    distances: jax.Array,
) -> Decision:
    """Decide on the tables that are real, one after another: a decision is itself a batch of images."""

    def one(key: jax.Array, scene: Scene, poses: jax.Array, missed: jax.Array) -> Decision:
        return act(key, render.render(scene, poses), missed, rule, distances).brief()

    def some(args: tuple[jax.Array, Scene, jax.Array, jax.Array, jax.Array]) -> Decision:
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(one, *args[:4]))
        return jax.lax.cond(args[4], lambda: one(*args[:4]), lambda: nothing)

    return jax.lax.map(some, (keys, scene, poses, missed, real))

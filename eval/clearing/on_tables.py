"""Decisions on many tables at once: by a method's policy, or with the engine itself as predictor."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from dipn_jax import batching
from dipn_jax.engine import Engine
from dipn_jax.errors import UserError
from dipn_jax.planning import methods
from dipn_jax.planning.decide_functions import DecideFunction
from dipn_jax.planning.methods import Networks, Policy
from dipn_jax.planning.planner import Rule
from dipn_jax.planning.policy_config import PolicyConfig
from dipn_jax.structs import Array, Decision, Observation, Scene

from . import rollouts
from .camera import DEFAULT_CAMERA, Camera

Recall = Callable[[Array], Array]
"""height maps [B, H, W] metres -> grasps (rotation, row, col) that missed on the tables as they look [B, M, 3]."""
TablePolicy = Callable[[jax.Array, Scene, Array, Recall], tuple[Decision, Observation]]
"""(keys [B], scenes [B, N], poses [B, N, 7], recall) -> brief decisions [B], and what was seen [B]; both NumPy."""


def load(
    method: str, networks: Networks, engine: Engine, configs: list[PolicyConfig], *, camera: Camera = DEFAULT_CAMERA
) -> list[TablePolicy]:
    """Load a method once and return its policy for each of several configs; they share compiled programs.

    Args:
      method: a name of `methods.METHODS`.
      networks: runs.
      engine: physics, for `physics+gn`.
      configs: equal in everything, the number of candidates included, except distances and rule.
      camera: what the policy sees; `physics+gn` needs the simulator's masks without noise.

    Raises:
      UserError: a network that the method needs was not given, or is another; or a camera for `physics+gn`.
    """
    found, runs = methods.find(method), networks.runs(method)
    if found.needs_state:
        if camera.noisy or camera.masks != "true":
            raise UserError(f"--method {method}: decides on the simulator's state; give --masks true, and no noise")
        scorer, summarize = methods.gn_scores(runs["grasp"], configs[0])
        decide = functools.partial(rollouts.decide_by_simulation, scorer=scorer, summarize=summarize, engine=engine)
        return [functools.partial(decide, rule=each.rule(), distances=each.candidate_distances()) for each in configs]
    policy = methods.build(found, runs, configs[0])
    if not found.pushes:
        return [in_lockstep(policy, camera=camera)] * len(configs)
    return [in_lockstep(policy.with_config(each), camera=camera) for each in configs]


def in_lockstep(policy: Policy, *, camera: Camera = DEFAULT_CAMERA) -> TablePolicy:
    """Make a policy of one table into one of many, which are looked at and decided on together."""

    def decide(keys: jax.Array, scene: Scene, poses: Array, recall: Recall) -> tuple[Decision, Observation]:
        seen = camera.look(keys, scene, poses)
        function, rule, distances = policy.decide_function, policy.rule, policy.distances
        each = functools.partial(_decide_each, decide_function=function, rule=rule, distances=distances)
        return batching.in_small_batches(each, keys, seen, recall(seen.height)), seen

    return decide


@functools.partial(jax.jit, static_argnames="decide_function")
def _decide_each(
    keys: jax.Array,
    seen: Observation,
    missed: jax.Array,
    real: jax.Array,
    *,
    decide_function: DecideFunction,
    rule: Rule,
    distances: jax.Array,
) -> Decision:
    """Decide on the tables that are real, one after another: a decision is itself a batch of images."""

    def one(key: jax.Array, observation: Observation, misses: jax.Array) -> Decision:
        return decide_function(key, observation, misses, rule, distances).brief()

    def some(args: tuple[jax.Array, Observation, jax.Array, jax.Array]) -> Decision:
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(one, *args[:3]))
        return jax.lax.cond(args[3], lambda: one(*args[:3]), lambda: nothing)

    return jax.lax.map(some, (keys, seen, missed, real))

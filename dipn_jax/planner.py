"""Alg. 2 of the paper: push or grasp? Predictor and scorer arrive as functions.

`decide` is one jitted call: candidates, predicted images and the scores of every grasp on each of them
never leave the device.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from dipn_jax import candidates, imagine, render
from dipn_jax.structs import Decision, Observation, Push

Predictor = Callable[[Observation, Push], jax.Array]
"""(observation, pushes [P]) -> motion [P, N, 3]: dx, dy (metres) of each mask's centroid, dtheta (radians)."""
Scorer = Callable[[jax.Array], jax.Array]
"""images [M, 224, 224, 4] -> scores [M, 16, 224, 224] in [0, 1]."""


_Imagined = tuple[jax.Array, jax.Array, jax.Array, jax.Array]
"""Values [P], image [H, W, 4] and motion [N, 3] of the best push, allowed [P]."""


def _imagine_each(
    observation: Observation,
    pushes: Push,
    feasible: jax.Array,
    predictor: Predictor,
    scorer: Scorer,
    slots: int,
    gamma: jax.Array | float,
) -> _Imagined:
    """Predict and score every candidate."""
    centers, area = candidates.mask_centers(observation.label, slots)
    motion = predictor(observation, pushes)
    inside = jax.vmap(candidates.stays_inside, in_axes=(None, None, 0))(centers, area, motion)
    allowed = feasible & inside
    images = jax.lax.map(lambda m: render.rgbd(imagine.imagine(observation, centers, m)), motion)
    mean = jax.lax.map(lambda image: scorer(image[None]).mean(), images)
    value = jnp.where(allowed, gamma * mean, -jnp.inf)
    best = jnp.argmax(value)
    return value, images[best], motion[best], allowed


def _imagine_none(observation: Observation, feasible: jax.Array, slots: int) -> _Imagined:
    """What stands in for `_imagine_each` where no push is considered."""
    value = jnp.full(feasible.shape, -jnp.inf)
    return value, render.rgbd(observation), jnp.zeros((slots, 3)), feasible


@functools.partial(jax.jit, static_argnames=("predictor", "scorer", "count", "slots"))
def decide(
    key: jax.Array,
    observation: Observation,
    predictor: Predictor,
    scorer: Scorer,
    *,
    count: int,
    slots: int,
    distance: jax.Array | float,
    gamma: jax.Array | float = 0.9,
    threshold: jax.Array | float = 0.7,
) -> Decision:
    """Choose between the best grasp and the best push.

    Args:
      key: random key, for the candidates.
      observation: what the camera sees now.
      predictor: motions of every object for every candidate.
      scorer: scores of every grasp on every image.
      count: number of candidate pushes P.
      slots: number of object slots N in the labels.
      distance: push distance, metres.
      gamma: discount of a push's value.
      threshold: grasp at once if the best score is higher (1 switches the short cut off).

    Returns:
      The decision. A push is chosen when gamma times the mean score of all grasps on its predicted image
      exceeds the mean score now; a push that would move any centre out of the workspace is dropped.
    """
    now = scorer(render.rgbd(observation)[None])[0]
    index, best_score = candidates.best_grasp(now)
    pushes, feasible = candidates.sample_pushes(key, observation, count=count, slots=slots, distance=distance)

    consider = functools.partial(_imagine_each, observation, pushes, feasible, predictor, scorer, slots, gamma)
    skip = functools.partial(_imagine_none, observation, feasible, slots)
    value_now = now.mean()
    short_cut = best_score > threshold
    value, predicted, motion, allowed = jax.lax.cond(short_cut, skip, consider)
    best = jnp.argmax(value).astype(jnp.int32)
    return Decision(
        is_push=~short_cut & (value[best] > value_now),
        push=jax.tree.map(lambda leaf: leaf[best], pushes),
        grasp_pixel=index,
        grasp_score=best_score,
        value_now=value_now,
        value_push=value[best],
        predicted=predicted,
        best=best,
        pushes=pushes,
        feasible=allowed,
        values=value,
        motion=motion,
    )

"""Push or grasp? Alg. 2 of the paper, and the rule of two score maps. Predictor and scorer arrive as functions.

`decide` is one jitted call: candidates, predicted images and the scores of every grasp on each of them
never leave the device. Its two halves, `propose` and `choose`, are for predictors that are no function of an image.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from dipn_jax.planning import candidates
from dipn_jax.sight import fingers, imagine, masks, render
from dipn_jax.structs import Array, Decision, Observation, Push, Pytree

Predictor = Callable[[Observation, Push], jax.Array]
"""(observation, pushes [P]) -> motion [P, N, 3]: dx, dy (metres) of each mask's centroid, dtheta (radians)."""
Scorer = Callable[[jax.Array], jax.Array]
"""images [M, 224, 224, 4] -> scores [M, 16, 224, 224] in [0, 1]."""
Appraiser = Callable[[jax.Array, jax.Array, jax.Array], tuple[jax.Array, jax.Array]]
"""(image now [224, 224, 4], images [P, ...], wanted [P] bool) -> mean and highest of all scores on each, [1 + P] both.

The first are those of the image now. Of images that are not wanted it may say anything finite."""

NONE_MISSED = np.full((1, 3), -1, np.int32)
"""No grasp has missed."""
STILL = (0.001, np.deg2rad(1.0))
"""Metres and radians of a predicted motion that is not drawn: half a pixel at an object's centre and at its end."""


@flax.struct.dataclass
class Rule(Pytree):
    """How Alg. 2 decides; every field is traced. The defaults are the paper's rule."""

    gamma: Array = 0.9  # discount of a push's value
    threshold: Array = 0.7  # grasp at once if the best score is higher; 1 switches the short cut off
    reach: Array = 1.0  # of a predicted motion, when it is judged whether an object leaves the workspace
    # clauses that only DIPN's released code has
    several: Array = False  # a lone object is grasped
    better: Array = False  # a push must raise the best score, too
    sure: Array = 0.0  # gamma discounts only pushes after which the best score is over this (released code: 0.5)


RELEASED = Rule(reach=2.0, several=True, better=True, sure=0.5)
"""The rule of DIPN's released code, which predicts 5 cm of a push and makes 10."""


@flax.struct.dataclass
class Proposal(Pytree):
    """What there is to choose from."""

    pushes: Push  # [P]
    feasible: Array  # [P] bool
    grasp_pixel: Array  # [3] int32: rotation, row, col of the best grasp
    grasp_score: Array  # [] its score
    value_now: Array  # [] mean score of all grasps
    settled: Array  # [] bool: the best grasp is to be taken, whatever pushes promise


def plain(scorer: Scorer) -> Appraiser:
    """Every image scored whole."""

    def appraise(now: jax.Array, images: jax.Array, wanted: jax.Array) -> tuple[jax.Array, jax.Array]:
        def one(args: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            image, want = args
            nothing = (jnp.zeros(()), jnp.zeros(()))
            return jax.lax.cond(want, lambda: _mean_and_best(scorer(image[None])), lambda: nothing)

        every, asked = jnp.concatenate([now[None], images]), jnp.append(wanted.any(), wanted)
        return jax.lax.map(one, (every, asked))

    return appraise


def _mean_and_best(scores: jax.Array) -> tuple[jax.Array, jax.Array]:
    return scores.mean(), scores.max()


def propose(
    key: jax.Array,
    observation: Observation,
    scorer: Scorer,
    rule: Rule,
    *,
    count: int,
    slots: int,
    distance: Array,
    missed: Array = NONE_MISSED,
) -> Proposal:
    """Score the grasps, and sample `count` pushes; arguments as of `decide`."""
    now = scorer(render.rgbd(observation)[None])[0]
    index, best = candidates.best_grasp(candidates.doubted(now, missed))
    pushes, feasible = candidates.sample_pushes(key, observation, count=count, slots=slots, distance=distance)
    _, area = masks.mask_centers(observation.label, slots)
    alone = jnp.asarray(rule.several) & ((area > 0).sum() < 2)
    settled = (best > rule.threshold) | alone
    return Proposal(pushes, feasible, index, best, now.mean(), settled)


def choose(
    observation: Observation, proposal: Proposal, motion: jax.Array, appraise: Appraiser, rule: Rule
) -> Decision:
    """Push or grasp, given what each push would do.

    Args:
      observation: what the camera sees now.
      proposal: of `propose`.
      motion: `[P, N, 3]` dx, dy (metres) of each mask's centroid, dtheta (radians).
      appraise: what all grasps on an image are worth.
      rule: how to compare.
    """
    centers, area = masks.mask_centers(observation.label, motion.shape[1])
    small = (jnp.linalg.norm(motion[..., :2], axis=-1) < STILL[0]) & (jnp.abs(motion[..., 2]) < STILL[1])
    drawn = jnp.where(small[..., None], 0.0, motion)
    inside = jax.vmap(candidates.stays_inside, in_axes=(None, None, 0))(centers, area, rule.reach * motion)
    allowed = proposal.feasible & inside & ~proposal.settled
    now = render.rgbd(observation)

    def imagined(args: tuple[jax.Array, jax.Array]) -> jax.Array:
        return jax.lax.cond(
            args[1], lambda m: render.rgbd(imagine.imagine(observation, centers, m)), lambda _: now, args[0]
        )

    images = jax.lax.map(imagined, (drawn, allowed))
    means, tops = appraise(now, images, allowed)
    mean, highest = means[1:], tops[1:]
    value_now = jnp.where(allowed.any(), means[0], proposal.value_now)
    taken = allowed & (~jnp.asarray(rule.better) | ((highest > tops[0]) & (mean > means[0])))
    value = jnp.where(taken, jnp.where(highest > rule.sure, rule.gamma, 1.0) * mean, -jnp.inf)
    best = jnp.argmax(jnp.where(taken, mean, -jnp.inf)).astype(jnp.int32)
    return Decision(
        is_push=value[best] > value_now,
        push=jax.tree.map(lambda leaf: leaf[best], proposal.pushes),
        grasp_pixel=proposal.grasp_pixel,
        grasp_score=proposal.grasp_score,
        value_now=value_now,
        value_push=value[best],
        predicted=images[best],
        best=best,
        pushes=proposal.pushes,
        feasible=allowed,
        values=value,
        motion=motion[best],
    )


@functools.partial(jax.jit, static_argnames=("predictor", "scorer", "count", "slots", "appraise"))
def decide(
    key: jax.Array,
    observation: Observation,
    predictor: Predictor,
    scorer: Scorer,
    *,
    count: int,
    slots: int,
    distance: Array,
    rule: Rule = Rule(),  # noqa: B008
    appraise: Appraiser | None = None,
    missed: Array = NONE_MISSED,
) -> Decision:
    """Choose between the best grasp and the best push.

    Args:
      key: random key, for the candidates.
      observation: what the camera sees now.
      predictor: motions of every object for every candidate.
      scorer: scores of every grasp on every image.
      count: number of candidate pushes P.
      slots: number of object slots N in the labels.
      distance: push distance, metres: one `[]`, or each candidate's own `[P]`.
      rule: how to compare.
      appraise: what all grasps on a predicted image are worth; every image is scored whole by default.
      missed: `[M, 3]` grasps that missed on this table as it is; see `candidates.doubted`.

    Returns:
      The decision. A push is chosen when gamma times the mean score of all grasps on its predicted image
      exceeds the mean score now; a push that would move any centre out of the workspace is dropped.
    """
    proposal = propose(key, observation, scorer, rule, count=count, slots=slots, distance=distance, missed=missed)
    still = lambda: jnp.zeros((count, slots, 3))  # noqa: E731
    motion = jax.lax.cond(proposal.settled, still, lambda: predictor(observation, proposal.pushes))
    return choose(observation, proposal, motion, appraise or plain(scorer), rule)


@functools.partial(jax.jit, static_argnames=("push_scorer", "scorer", "slots"))
def compare(
    observation: Observation,
    push_scorer: Scorer,
    scorer: Scorer,
    *,
    slots: int,
    distance: jax.Array | float,
    threshold: jax.Array | float = jnp.inf,
    missed: Array = NONE_MISSED,
) -> Decision:
    """Choose without imagining, as VPG does: the best of all grasps, or the best of all pushes.

    Args:
      observation: what the camera sees now.
      push_scorer: values of pushes that start at each pixel in each of 16 directions.
      scorer: values of grasps.
      slots: number of object slots N in the labels.
      distance: push distance, metres.
      threshold: grasp at once if the best grasp's value is higher.
      missed: `[M, 3]` as of `decide`.

    Returns:
      The decision; its only candidate is the best push that the closed gripper can begin.
    """
    image = render.rgbd(observation)
    index, grasp_value = candidates.best_grasp(candidates.doubted(scorer(image[None])[0], missed))
    possible = fingers.pushable(observation.height)
    values = jnp.where(possible, push_scorer(image[None])[0], -jnp.inf)
    where, push_value = candidates.best_grasp(values)
    push = candidates.push_at(where, distance)
    return Decision(
        is_push=(push_value > grasp_value) & (grasp_value <= threshold),
        push=push,
        grasp_pixel=index,
        grasp_score=grasp_value,
        value_now=grasp_value,
        value_push=push_value,
        predicted=image,
        best=jnp.zeros((), jnp.int32),
        pushes=jax.tree.map(lambda leaf: leaf[None], push),
        feasible=possible.any()[None],
        values=push_value[None],
        motion=jnp.zeros((slots, 3)),
    )

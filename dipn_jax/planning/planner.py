"""Push or grasp? Alg. 2 of the paper, and the comparison of two score maps. Predictor and scorer are arguments.

`decide` is one jitted call: candidates, predicted images and the scores of every grasp on each of them never leave the
device. Its two halves are `find_candidates` and `decide_among`; they serve predictors that need the simulator's state.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Key

from dipn_jax.planning import candidates, memory
from dipn_jax.sight import fingers, imagine, masks, observed, render
from dipn_jax.structs import Array, Candidates, Decision, Observation, Push, Pytree

Predictor = Callable[[Observation, Push], jax.Array]
"""(observation, pushes [P]) -> motion [P, N, 3]: dx, dy (metres) of each mask's centroid, dtheta (radians)."""
Scorer = Callable[[jax.Array], jax.Array]
"""images [M, 224, 224, 4] -> scores [M, 16, 224, 224] in [0, 1]."""
ScoreSummary = Callable[[jax.Array, jax.Array, jax.Array], tuple[jax.Array, jax.Array]]
"""(image now [224, 224, 4], images [P, ...], wanted [P] bool) -> mean and highest of all scores on each, [1 + P] both.

Index 0 is the image now. Images that are not wanted may get any finite numbers."""
Estimate = Callable[[Observation, jax.Array], jax.Array]
"""(observation, grasps that missed [M, 3]) -> how many grasps are expected to miss until the table is empty []."""

NONE_MISSED = np.full((1, 3), -1, np.int32)
"""The value of `missed` when no grasp has missed."""
TOP_MARGIN = 0.05
"""Value of `Rule.top_margin` with the aid `top`."""
UNDRAWN_SHIFT = 0.001
"""Metres: a predicted motion smaller than this, with a turn below UNDRAWN_TURN, is not drawn (half a pixel)."""
UNDRAWN_TURN = np.deg2rad(1.0)
"""Radians; see UNDRAWN_SHIFT. At the end of an object this is half a pixel, too."""


@flax.struct.dataclass
class Rule(Pytree):
    """How Alg. 2 decides; every field is traced. The defaults are the paper's rule.

    Example:
      from dipn_jax.planning.planner import Rule

      decision = dipn_jax.decide(key, observation, predictor, scorer, rule=Rule(gamma=0.8))
    """

    gamma: Float[Array, ""] | float = 0.9  # discount of a push's value
    # grasp at once if the best score is higher; 1 switches this short cut off
    grasp_above: Float[Array, ""] | float = 0.7
    # a predicted motion is multiplied by it to judge whether an object leaves the workspace
    edge_factor: Float[Array, ""] | float = 1.0
    draw_all: Bool[Array, ""] | bool = False  # draw also motions below UNDRAWN_SHIFT and UNDRAWN_TURN
    top_margin: Float[Array, ""] | float = 0.0  # see `candidates.grasp_from_top`
    grasp_lone: Bool[Array, ""] | bool = False  # released code only: a lone object is grasped
    # released code only: a push must raise the best score, too
    push_must_raise_best: Bool[Array, ""] | bool = False
    # released code only (0.5): gamma discounts only pushes after which the best score is higher than this
    discount_above: Float[Array, ""] | float = 0.0


RELEASED = Rule(edge_factor=2.0, grasp_lone=True, push_must_raise_best=True, discount_above=0.5)
"""The rule of DIPN's released code, which predicts 5 cm of a push and makes 10."""


def summarize_whole(scorer: Scorer) -> ScoreSummary:
    """Return the summary that scores every wanted image whole."""

    def summarize(
        now: Float[jax.Array, "H W 4"], images: Float[jax.Array, "P H W 4"], wanted: Bool[jax.Array, " P"]
    ) -> tuple[Float[jax.Array, " Q"], Float[jax.Array, " Q"]]:
        def one(args: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            image, want = args
            nothing = (jnp.zeros(()), jnp.zeros(()))
            return jax.lax.cond(want, lambda: _mean_and_best(scorer(image[None])), lambda: nothing)

        every, asked = jnp.concatenate([now[None], images]), jnp.append(wanted.any(), wanted)
        return jax.lax.map(one, (every, asked))

    return summarize


def _mean_and_best(scores: jax.Array) -> tuple[jax.Array, jax.Array]:
    return scores.mean(), scores.max()


def find_candidates(
    key: Key[Array, ""],
    observation: Observation,
    scorer: Scorer,
    rule: Rule,
    *,
    count: int,
    distance: Float[Array, "*p"] | float,
    missed: Int[Array, "M 3"] = NONE_MISSED,
) -> Candidates:
    """Score all grasps and sample `count` pushes; arguments as of `decide`."""
    now = scorer(render.rgbd(observation)[None])[0]
    known = candidates.discount_missed(now, missed)
    index, best = candidates.grasp_from_top(known, observation.height, rule.top_margin)
    pushes, feasible = candidates.sample_pushes(key, observation, count=count, distance=distance)
    _, area = masks.mask_centers(observation.label, observation.slots)
    lone = jnp.asarray(rule.grasp_lone) & ((area > 0).sum() < 2)
    return Candidates(pushes, feasible, index, best, now.mean(), (best > rule.grasp_above) | lone)


def decide_among(
    observation: Observation, found: Candidates, motion: Float[Array, "P N 3"], summarize: ScoreSummary, rule: Rule
) -> Decision:
    """Choose between the best grasp and the best push, given what each push would do.

    Args:
      observation: what the camera sees now.
      found: candidates, of `find_candidates`.
      motion: `[P, N, 3]` dx, dy (metres) of each mask's centroid, dtheta (radians).
      summarize: mean and highest score of all grasps on images.
      rule: how to compare.
    """
    centers, area = masks.mask_centers(observation.label, observation.slots)
    drawn = _drawn(motion, rule)
    inside = jax.vmap(candidates.stays_inside, in_axes=(None, None, 0))(centers, area, rule.edge_factor * motion)
    allowed = found.feasible & inside & ~found.grasp_now
    now = render.rgbd(observation)

    def imagined(args: tuple[jax.Array, jax.Array]) -> jax.Array:
        return jax.lax.cond(
            args[1], lambda m: render.rgbd(imagine.imagine(observation, centers, m)), lambda _: now, args[0]
        )

    images = jax.lax.map(imagined, (drawn, allowed))
    means, highest = summarize(now, images, jnp.asarray(allowed))
    mean, top = means[1:], highest[1:]
    value_now = jnp.where(allowed.any(), means[0], found.value_now)
    taken = allowed & (~jnp.asarray(rule.push_must_raise_best) | ((top > highest[0]) & (mean > means[0])))
    value = jnp.where(taken, jnp.where(top > rule.discount_above, rule.gamma, 1.0) * mean, -jnp.inf)
    best = jnp.argmax(jnp.where(taken, mean, -jnp.inf)).astype(jnp.int32)
    return Decision(
        is_push=value[best] > value_now,
        push=found.pushes[best],
        grasp=candidates.grasp_at(found.grasp_pixel, observation.height),
        grasp_pixel=found.grasp_pixel,
        grasp_score=found.grasp_score,
        value_now=value_now,
        value_push=value[best],
        motion=motion[best],
        best=best,
        values=value,
        candidates=found.replace(feasible=allowed),
        predicted=images[best],
    )


def _drawn(motion: Float[Array, "*b 3"], rule: Rule) -> Float[jax.Array, "*b 3"]:
    """Return motions as they are drawn: small ones are 0, unless the rule has `draw_all`."""
    small = jnp.linalg.norm(motion[..., :2], axis=-1) < UNDRAWN_SHIFT
    small &= jnp.abs(motion[..., 2]) < UNDRAWN_TURN
    return jnp.where(small[..., None] & ~jnp.asarray(rule.draw_all), 0.0, motion)


def _count_actions(
    decision: Decision, observation: Observation, missed: Int[jax.Array, "M 3"], estimate: Estimate, rule: Rule
) -> Decision:
    """Return the decision made again, comparing the same grasp and push by how many actions each leads to.

    A push is one action, and has to save more than one grasp that misses. `value_now` and `value_push` become minus the
    expected numbers of actions besides one for each object; `values` of the candidates stay mean scores.
    """
    centers, _ = masks.mask_centers(observation.label, observation.slots)
    now = estimate(observation, missed)

    def after() -> jax.Array:
        there = imagine.imagine(observation, centers, _drawn(decision.motion, rule))
        return 1.0 + estimate(there, memory.forget_changed(missed, observation.height, there.height))

    cost = jax.lax.cond(jnp.isfinite(decision.value_push), after, lambda: jnp.float32(jnp.inf))
    return decision.replace(is_push=cost < now, value_now=-now, value_push=-cost)


@functools.partial(observed.guarded, refuse_low_tables=True)
@functools.partial(jax.jit, static_argnames=("predictor", "scorer", "count", "summarize", "estimate"))
def decide(
    key: Key[Array, ""],
    observation: Observation,
    predictor: Predictor,
    scorer: Scorer,
    *,
    count: int = 32,
    distance: Float[Array, "*p"] | float = 0.1,
    rule: Rule = Rule(),  # noqa: B008
    summarize: ScoreSummary | None = None,
    missed: Int[Array, "M 3"] = NONE_MISSED,
    estimate: Estimate | None = None,
) -> Decision:
    """Choose between the best grasp and the best push (Alg. 2 of the paper).

    Example:
      from dipn_jax.planning import predictors, scorers

      predictor, scorer = predictors.load_predictor("builtin"), scorers.load_scorer("builtin")
      decision = dipn_jax.decide(jax.random.key(0), observation, predictor, scorer)

    Args:
      key: random key, for the candidates.
      observation: what the camera sees now.
      predictor: motions of every object for every candidate.
      scorer: scores of every grasp on every image.
      count: number of candidate pushes P.
      distance: push distance, metres: one `[]`, or each candidate's own `[P]`.
      rule: how to compare.
      summarize: mean and highest score of all grasps on images; every image is scored whole by default.
      missed: `[M, 3]` grasps that missed on this table as it is; see `candidates.discount_missed`.
      estimate: misses to come; if given, the best push is made when it saves more than the action that it costs.

    Returns:
      The decision. A push is chosen when gamma times the mean score of all grasps on its predicted image
      exceeds the mean score now; a push that would move any centre out of the workspace is dropped.

    Raises:
      UserError: the observation is none of those that `dipn_jax.check_observation` lets through.
    """
    found = find_candidates(key, observation, scorer, rule, count=count, distance=distance, missed=missed)
    if estimate is not None:
        found = found.replace(grasp_now=found.grasp_now | (estimate(observation, jnp.asarray(missed)) <= 1.0))
    still = lambda: jnp.zeros((count, observation.slots, 3))  # noqa: E731
    motion = jax.lax.cond(found.grasp_now, still, lambda: predictor(observation, found.pushes))
    decision = decide_among(observation, found, motion, summarize or summarize_whole(scorer), rule)
    if estimate is None:
        return decision
    return _count_actions(decision, observation, jnp.asarray(missed), estimate, rule)


@functools.partial(jax.jit, static_argnames=("push_scorer", "scorer", "network_scores"))
def decide_without_imagining(
    observation: Observation,
    push_scorer: Scorer,
    scorer: Scorer,
    *,
    network_scores: Scorer | None = None,
    distance: Float[Array, ""] | float,
    grasp_above: Float[Array, ""] | float = jnp.inf,
    top_margin: Float[Array, ""] | float = 0.0,
    missed: Int[Array, "M 3"] = NONE_MISSED,
) -> Decision:
    """Choose the best of all grasps and pushes by their values, without imagining images, as VPG does.

    Args:
      observation: what the camera sees now.
      push_scorer: values of pushes that start at each pixel in each of 16 directions.
      scorer: values of grasps, the best of which is chosen.
      network_scores: values of grasps that are compared with those of pushes, where `scorer` lowers them; `scorer`
        by default.
      distance: push distance, metres.
      grasp_above: grasp at once if the best grasp's value by `scorer` is higher.
      top_margin: as of `Rule`.
      missed: `[M, 3]` as of `decide`.

    Returns:
      The decision; its only candidate is the best push that the closed gripper can begin.
    """
    image = render.rgbd(observation)
    known = candidates.discount_missed(scorer(image[None])[0], missed)
    pixel, score = candidates.grasp_from_top(known, observation.height, top_margin)
    values = (network_scores or scorer)(image[None])[0]
    grasp_value = candidates.discount_missed(values, missed)[tuple(pixel)]
    possible = fingers.pushable(observation.height)
    values = jnp.where(possible, push_scorer(image[None])[0], -jnp.inf)
    where, push_value = candidates.best_grasp(values)
    push = candidates.push_at(where, distance)
    grasp_now = score > grasp_above
    only = jax.tree.map(lambda leaf: leaf[None], push)
    return Decision(
        is_push=(push_value > grasp_value) & ~grasp_now,
        push=push,
        grasp=candidates.grasp_at(pixel, observation.height),
        grasp_pixel=pixel,
        grasp_score=score,
        value_now=grasp_value,
        value_push=push_value,
        motion=jnp.zeros((observation.slots, 3)),
        best=jnp.zeros((), jnp.int32),
        values=push_value[None],
        candidates=Candidates(only, possible.any()[None], pixel, score, grasp_value, grasp_now),
        predicted=image,
    )

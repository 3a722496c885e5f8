"""The functions by which a policy decides: by Alg. 2, which imagines what pushes would do, or by values alone."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp

from dipn_jax.planning import planner
from dipn_jax.planning.planner import Rule, Scorer, ScoreSummary
from dipn_jax.structs import Array, Decision, Observation

DecideFunction = Callable[[Array, Observation, Array, Rule, Array], Decision]
"""(key, observation, grasps that missed [M, 3], rule, distances of the candidates [P] metres) -> decision."""


def decide_by_imagining(
    predictor: planner.Predictor,
    scorer: Scorer,
    summarize: ScoreSummary | None,
    *,
    estimate: planner.Estimate | None = None,
) -> DecideFunction:
    """Return the function that decides by Alg. 2: it imagines the image after every candidate push.

    With an `estimate` of the misses to come a push has to save more than the action that it costs.
    """

    def decide(key: Array, seen: Observation, missed: Array, rule: Rule, distances: Array) -> Decision:
        return planner.decide(
            key,
            seen,
            predictor,
            scorer,
            count=len(distances),
            distance=distances,
            rule=rule,
            summarize=summarize,
            missed=missed,
            estimate=estimate,
        )

    return decide


def decide_by_values(
    push_scorer: Scorer, scorer: Scorer, network_scores: Scorer, *, grasp_at_once: bool
) -> DecideFunction:
    """Return the function that compares the best push and the best grasp by value; pushes go the first distance.

    Args:
      push_scorer: values of pushes.
      scorer: values of grasps, to choose one by.
      network_scores: values of grasps as the network gives them, to compare the chosen one with pushes.
      grasp_at_once: whether to grasp at once above the rule's `grasp_above`.
    """

    def decide(_: Array, seen: Observation, missed: Array, rule: Rule, distances: Array) -> Decision:
        above = rule.grasp_above if grasp_at_once else jnp.inf
        return planner.decide_without_imagining(
            seen,
            push_scorer,
            scorer,
            network_scores=network_scores,
            distance=distances[0],
            grasp_above=above,
            top_margin=rule.top_margin,
            missed=missed,
        )

    return decide

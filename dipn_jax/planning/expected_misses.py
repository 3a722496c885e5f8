"""Estimate how many grasps will miss before a table is empty, from the scores."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from dipn_jax.planning import candidates
from dipn_jax.planning.planner import Estimate, Scorer
from dipn_jax.sight import render
from dipn_jax.structs import Array, Observation

SURE_SCORE = 0.7
"""Score of an object's best grasp from which on no miss is expected; the paper's threshold to grasp at once."""
MISSES_PER_SHORTFALL = 1 / 2.4
"""Misses to be expected for an object that scores 0. Chosen by `experiments/push_or_grasp.py` on the ten hard tables at
a seed of their own: of the 34 states on which no grasp was over SURE_SCORE, a push saved most actions where the
shortfalls add up to 2.4 (14 pushes, 15 actions fewer, their own counted; a push on all 34: 4 fewer)."""


def misses_to_come(scorer: Scorer) -> Estimate:
    """Return the function that estimates how many grasps will miss until a table is empty.

    An object falls short by `1 - score / SURE_SCORE` of its best grasp, if that is positive; the estimate is the sum
    over all objects in sight times MISSES_PER_SHORTFALL. Objects that stand close keep one another from being grasped,
    which the sum counts for each of them and the mean over all scores, mostly of empty table, does not.

    Args:
      scorer: scores of every grasp, those by which grasps are chosen.
    """

    def estimate(observation: Observation, missed: Int[Array, "M 3"]) -> Float[jax.Array, ""]:
        scores = candidates.discount_missed(scorer(render.rgbd(observation)[None])[0], missed).max(0)
        best = jnp.stack(
            [jnp.where(observation.label == slot, scores, -jnp.inf).max() for slot in range(observation.slots)]
        )
        short = jnp.where(jnp.isneginf(best), 0.0, jnp.maximum(1 - best / SURE_SCORE, 0.0))
        return MISSES_PER_SHORTFALL * short.sum()

    return estimate

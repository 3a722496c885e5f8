"""What was chosen for one table, whoever chose."""

from __future__ import annotations

import flax.struct
import jax.numpy as jnp

from dipn_jax.planning import candidates
from dipn_jax.structs import Array, Decision, Grasp, Observation, Push, Pytree


@flax.struct.dataclass
class Choice(Pytree):
    """What was chosen for one table, and what it was chosen by."""

    is_push: Array  # [] bool
    push: Push  # the best one
    grasp: Grasp  # the best one
    grasp_pixel: Array  # [3] int32: rotation, row, col of it
    values: Array  # [3] its score; mean score now (or its value); gamma times the mean after the push (or its value)
    motion: Array  # [N, 3] dx, dy (metres), dtheta (radians) predicted for the push


def choice(seen: Observation, decision: Decision) -> Choice:
    """The actions of a decision on what was seen."""
    return Choice(
        is_push=decision.is_push,
        push=decision.push,
        grasp=candidates.grasp_at(decision.grasp_pixel, seen.height),
        grasp_pixel=decision.grasp_pixel,
        values=jnp.stack([decision.grasp_score, decision.value_now, decision.value_push]),
        motion=decision.motion,
    )

"""Misses to come, and pushes that have to save more than one of them."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dipn_jax.planning import candidates, expected_misses, planner, predictors
from dipn_jax.sight import masks
from dipn_jax.structs import ABSENT, Observation, Push

SLOTS = 5
COUNT = 4


@pytest.fixture(scope="module")
def row() -> Observation:
    """Return four blocks of 12 pixels in a row; the fifth slot is empty."""
    label = np.full((224, 224), ABSENT, np.int32)
    for slot in range(4):
        label[100:112, 80 + 13 * slot : 92 + 13 * slot] = slot
    height = np.where(label >= 0, 0.05, 0.0).astype(np.float32)
    return Observation(height, np.full((224, 224, 3), 0.5, np.float32), label, SLOTS)


def apart(images: jax.Array) -> jax.Array:
    """Score 0.14 between neighbours, and 0.9 where the 20 pixels to the left and right of a block are free."""
    top = images[..., 3] > 0
    near = jax.lax.reduce_window(top.astype(jnp.float32), 0.0, jax.lax.add, (1, 1, 41), (1, 1, 1), "SAME")
    return jnp.broadcast_to(jnp.where(top, jnp.where(near < 13, 0.9, 0.14), 0.0)[:, None], (len(images), 16, 224, 224))


def spread(observation: Observation, pushes: Push) -> jax.Array:
    """Predict that every push takes the blocks far apart."""
    centers, _ = masks.mask_centers(observation.label, SLOTS)
    there = jnp.array([[-0.12, 0.1], [-0.04, 0.1], [0.04, 0.1], [0.12, 0.1], [0, 0]])
    return jnp.zeros((COUNT, SLOTS, 3)).at[..., :2].set(there - centers)


def test_every_object_in_sight_counts_by_what_its_best_grasp_lacks(row: Observation) -> None:
    scores = np.zeros((16, 224, 224), np.float32)
    for slot, (rotation, score) in enumerate(((0, 0.7), (3, 0.35), (15, 0.0), (8, 0.95))):
        scores[rotation][row.label == slot] = score / 2
        scores[rotation, 105, 85 + 13 * slot] = score
    estimate = expected_misses.misses_to_come(lambda images: jnp.asarray(scores)[None])
    short = 0 + 0.5 + 1 + 0
    assert float(estimate(row, planner.NONE_MISSED)) == pytest.approx(
        expected_misses.MISSES_PER_SHORTFALL * short, rel=1e-5
    )
    missed = np.array([[8, 105, 85 + 39]], np.int32)  # the fourth object's grasps now score 0.475 at most
    near = candidates.discount_missed(jnp.asarray(scores), missed)[:, row.label == 3].max()
    assert near == pytest.approx(0.475)
    more = 1 - 0.475 / 0.7
    assert float(estimate(row, missed)) == pytest.approx(
        expected_misses.MISSES_PER_SHORTFALL * (short + more), rel=1e-5
    )


def _decide(seen: Observation, predictor: Any, scorer: Any, missed: Any = planner.NONE_MISSED) -> Any:
    rule, estimate, key = planner.Rule(grasp_above=0.7), expected_misses.misses_to_come(scorer), jax.random.key(0)
    return planner.decide(key, seen, predictor, scorer, count=COUNT, rule=rule, missed=missed, estimate=estimate)


def test_a_push_is_made_where_it_saves_more_than_itself(row: Observation) -> None:
    decision = _decide(row, spread, apart)
    four = 4 * (1 - 0.14 / 0.7) * expected_misses.MISSES_PER_SHORTFALL
    assert decision.value_now == pytest.approx(-four, rel=1e-5) and four > 1
    assert decision.value_push == pytest.approx(-1.0) and decision.is_push
    still = _decide(row, predictors.static_predictor, apart)
    assert still.value_push == pytest.approx(-1 - four, rel=1e-5) and not still.is_push, "it changes nothing"


def staggered(observation: Observation, pushes: Push) -> jax.Array:
    """Predict that every push moves the blocks by 7 pixels along the columns, one up and the next one down."""
    return jnp.zeros((COUNT, SLOTS, 3)).at[:, :4, 1].set(jnp.array([0.014, -0.014, 0.014, -0.014]))


def test_a_miss_is_held_against_what_has_not_moved_only(row: Observation) -> None:
    places = [(turn, at, 85 + 13 * slot) for slot in range(4) for turn in (0, 3, 6) for at in (97, 105, 113)]
    missed = np.array(places, np.int32)
    decision, before = _decide(row, staggered, apart, missed), _decide(row, staggered, apart)
    assert decision.value_now < before.value_now - 0.1
    assert before.value_push == pytest.approx(-1.0), "all four are apart"
    assert decision.value_push == pytest.approx(-1.0), "all four have moved, and not out of reach of the misses"
    still = _decide(row, predictors.static_predictor, apart, missed)
    assert still.value_push == pytest.approx(float(decision.value_now) - 1, rel=1e-5)


def test_where_too_little_can_be_saved_no_push_is_considered(row: Observation) -> None:
    fewer = row.replace(label=np.where(row.label > 1, ABSENT, row.label), height=np.where(row.label > 1, 0, row.height))
    decision = _decide(fewer, spread, apart)
    assert -1 < decision.value_now < 0 and np.isneginf(decision.values).all() and not decision.is_push
    assert np.isneginf(decision.value_push)

"""Alg. 2 with a predictor and a scorer whose answers are known."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dipn_jax import candidates, planner, policy, render, structs
from dipn_jax.structs import Observation, Push

SLOTS, COUNT = 5, 8


def covered(images: jax.Array) -> jax.Array:
    """Scores that grow with the height of what is seen; the best is that of the highest pixel."""
    return jnp.broadcast_to(jnp.clip(images[..., 3] * 5, 0, 1)[:, None], (images.shape[0], 16, 224, 224))


def bare(images: jax.Array) -> jax.Array:
    """Scores that grow with the table seen."""
    return 1 - covered(images)


def stack_for_the_third(observation: Observation, pushes: Push) -> jax.Array:
    """With the third candidate every object ends in the middle, on top of one another: less is covered."""
    centers, _ = candidates.mask_centers(observation.label, SLOTS)
    still = jnp.zeros((COUNT, SLOTS, 3))
    return still.at[2, :, :2].set(-centers)


def bare_squared(images: jax.Array) -> jax.Array:
    """High where nothing is, only if nearly nothing is anywhere: one stack scores far more than a full table."""
    share = (images[..., 3] > 0).mean((1, 2))
    return jnp.broadcast_to(jnp.exp(-20 * share)[:, None, None, None], (images.shape[0], 16, 224, 224))


static = policy.static_predictor(SLOTS)


def away(observation: Observation, pushes: Push) -> jax.Array:
    """Everything slides off the table."""
    return static(observation, pushes).at[..., 0].set(0.5)


@pytest.fixture(scope="module")
def seen(settled: Any) -> Observation:
    return render.render(structs.take(settled.scene, 0), settled.poses[0])


def _decide(seen: Observation, predictor: Any, scorer: Any, **rule: Any) -> Any:
    options = {"count": COUNT, "slots": SLOTS, "distance": 0.1, "rule": planner.Rule(**rule)}
    return planner.decide(jax.random.key(0), seen, predictor, scorer, **options)


def test_a_sure_grasp_is_taken_at_once(seen: Observation) -> None:
    decision = _decide(seen, static, covered, threshold=0.01)
    assert not decision.is_push
    row, col = np.unravel_index(np.argmax(seen.height), (224, 224))
    assert decision.grasp_pixel.tolist() == [0, row, col]
    assert np.isneginf(decision.values).all(), "no push was considered"


def test_a_push_that_changes_nothing_is_not_worth_it(seen: Observation) -> None:
    decision = _decide(seen, static, covered, threshold=1.0)
    assert not decision.is_push
    feasible = np.asarray(decision.feasible)
    np.testing.assert_allclose(decision.values[feasible], 0.9 * decision.value_now, rtol=1e-4)
    assert np.isneginf(decision.values[~feasible]).all()


def test_gamma_and_threshold_are_values(seen: Observation) -> None:
    # with gamma above 1 even a push that changes nothing wins
    decision = _decide(seen, static, covered, threshold=1.0, gamma=1.1)
    assert decision.is_push and decision.value_push > decision.value_now


def test_a_push_that_clears_the_view_is_dropped_as_out_of_the_workspace(seen: Observation) -> None:
    decision = _decide(seen, away, bare, threshold=1.0)
    assert not decision.is_push and not decision.feasible.any()


def test_the_push_that_raises_the_mean_most_is_chosen(seen: Observation) -> None:
    decision = _decide(seen, stack_for_the_third, bare_squared, threshold=2.0)
    assert decision.feasible[2] and decision.best == 2 and decision.is_push
    np.testing.assert_array_equal(decision.push.start, decision.pushes.start[2])
    now, after = (np.asarray(bare_squared(image[None])).mean() for image in (render.rgbd(seen), decision.predicted))
    np.testing.assert_allclose([decision.value_now, decision.value_push], [now, 0.9 * after], rtol=1e-4)
    assert not _decide(seen, stack_for_the_third, bare_squared, threshold=2.0, gamma=0.1).is_push


def test_trans_moves_only_the_pushed_object_by_the_push_length(seen: Observation) -> None:
    decision = _decide(seen, static, covered, threshold=1.0)
    motion = np.asarray(policy.trans_predictor(SLOTS)(seen, decision.pushes))
    length = np.linalg.norm(motion[..., :2], axis=-1)
    feasible = np.asarray(decision.feasible)
    assert ((length > 0).sum(-1)[feasible] == 1).all()
    np.testing.assert_allclose(length.max(-1)[feasible], 0.1, rtol=1e-5)

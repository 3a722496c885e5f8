"""Alg. 2 with predictors and scorers whose results are known."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dipn_jax import structs
from dipn_jax.planning import candidates, planner, predictors
from dipn_jax.sight import fingers, masks, render
from dipn_jax.structs import Observation, Push

SLOTS = 5
"""Object slots of a scene."""
COUNT = 8
"""Number of candidates."""


def covered(images: jax.Array) -> jax.Array:
    """Return scores that grow with the height of objects; the best is at the highest pixel."""
    return jnp.broadcast_to(jnp.clip(images[..., 3] * 5, 0, 1)[:, None], (images.shape[0], 16, 224, 224))


def bare(images: jax.Array) -> jax.Array:
    """Return scores that grow with the visible area of the table."""
    return 1 - covered(images)


def stack_for_the_third(observation: Observation, pushes: Push) -> jax.Array:
    """Predict that the third candidate moves every object to the middle, on top of one another."""
    centers, _ = masks.mask_centers(observation.label, SLOTS)
    still = jnp.zeros((COUNT, SLOTS, 3))
    return still.at[2, :, :2].set(-centers)


def bare_squared(images: jax.Array) -> jax.Array:
    """Return scores that are high on bare table, and far higher if nearly all of it is bare."""
    share = (images[..., 3] > 0).mean((1, 2))
    return jnp.broadcast_to(jnp.exp(-20 * share)[:, None, None, None], (images.shape[0], 16, 224, 224))


static = predictors.static_predictor


def away(observation: Observation, pushes: Push) -> jax.Array:
    """Predict that everything slides off the table."""
    return static(observation, pushes).at[..., 0].set(0.5)


@pytest.fixture(scope="module")
def seen(settled: Any) -> Observation:
    return render.render(structs.take(settled.scene, 0), settled.poses[0])


def _decide(seen: Observation, predictor: Any, scorer: Any, **rule: Any) -> Any:
    return planner.decide(jax.random.key(0), seen, predictor, scorer, count=COUNT, rule=planner.Rule(**rule))


def test_a_grasp_above_the_threshold_is_taken_at_once(seen: Observation) -> None:
    decision = _decide(seen, static, covered, grasp_above=0.01)
    assert not decision.is_push
    row, col = np.unravel_index(np.argmax(seen.height), (224, 224))
    assert decision.grasp_pixel.tolist() == [0, row, col]
    assert np.isneginf(decision.values).all(), "no push was considered"


def test_a_push_that_changes_nothing_is_not_chosen(seen: Observation) -> None:
    decision = _decide(seen, static, covered, grasp_above=1.0)
    assert not decision.is_push
    feasible = np.asarray(decision.candidates.feasible)
    np.testing.assert_allclose(decision.values[feasible], 0.9 * decision.value_now, rtol=1e-4)
    assert np.isneginf(decision.values[~feasible]).all()


def test_gamma_and_threshold_are_traced_values(seen: Observation) -> None:
    # with gamma above 1 even a push that changes nothing wins
    decision = _decide(seen, static, covered, grasp_above=1.0, gamma=1.1)
    assert decision.is_push and decision.value_push > decision.value_now


def test_a_push_that_clears_the_view_is_dropped_as_out_of_the_workspace(seen: Observation) -> None:
    decision = _decide(seen, away, bare, grasp_above=1.0)
    assert not decision.is_push and not decision.candidates.feasible.any()


def test_the_push_that_raises_the_mean_most_is_chosen(seen: Observation) -> None:
    decision = _decide(seen, stack_for_the_third, bare_squared, grasp_above=2.0)
    assert decision.candidates.feasible[2] and decision.best == 2 and decision.is_push
    np.testing.assert_array_equal(decision.push.start, decision.candidates.pushes.start[2])
    now, after = (np.asarray(bare_squared(image[None])).mean() for image in (render.rgbd(seen), decision.predicted))
    np.testing.assert_allclose([decision.value_now, decision.value_push], [now, 0.9 * after], rtol=1e-4)
    assert not _decide(seen, stack_for_the_third, bare_squared, grasp_above=2.0, gamma=0.1).is_push


def test_trans_moves_only_the_pushed_object_by_the_push_length(seen: Observation) -> None:
    decision = _decide(seen, static, covered, grasp_above=1.0)
    motion = np.asarray(predictors.trans_predictor(seen, decision.candidates.pushes))
    length = np.linalg.norm(motion[..., :2], axis=-1)
    feasible = np.asarray(decision.candidates.feasible)
    assert ((length > 0).sum(-1)[feasible] == 1).all()
    np.testing.assert_allclose(length.max(-1)[feasible], 0.1, rtol=1e-5)


def test_clauses_of_the_released_code(seen: Observation) -> None:
    tempting = {"grasp_above": 2.0, "gamma": 1.1}
    assert _decide(seen, static, covered, **tempting).is_push
    assert not _decide(seen, static, covered, push_must_raise_best=True, **tempting).is_push, (
        "the best score does not rise"
    )
    # gamma counts only where the best score after the push is over `discount_above`
    assert not _decide(seen, static, covered, discount_above=1.0, **tempting).is_push
    one = seen.replace(label=jnp.where(seen.label == 0, 0, -1), height=jnp.where(seen.label == 0, seen.height, 0.0))
    assert _decide(one, static, covered, **tempting).is_push
    assert not _decide(one, static, covered, grasp_lone=True, **tempting).is_push, "a lone object is grasped"
    released = planner.RELEASED
    assert (released.edge_factor, released.grasp_lone, released.push_must_raise_best) == (2.0, True, True)


def test_a_predicted_motion_is_extended_by_the_edge_factor(seen: Observation) -> None:
    def some(observation: Observation, pushes: Push) -> jax.Array:
        return static(observation, pushes).at[..., 0].set(0.06)

    near = _decide(seen, some, covered, grasp_above=2.0).candidates.feasible
    far = _decide(seen, some, covered, grasp_above=2.0, edge_factor=4.0).candidates.feasible
    assert near.any() and not far.any()


def test_the_action_of_the_higher_value_is_chosen(seen: Observation) -> None:
    def valued(value: float) -> Any:
        return lambda images: jnp.full((images.shape[0], 16, 224, 224), value).at[:, 2, 112, 30].add(0.1)

    decision = planner.decide_without_imagining(seen, valued(0.7), valued(0.5), distance=0.1)
    assert decision.is_push and decision.push.distance == np.float32(0.1)
    possible = fingers.pushable(seen.height)
    assert possible[tuple(candidates.push_index(decision.push))]
    assert not planner.decide_without_imagining(seen, valued(0.7), valued(0.5), grasp_above=0.4, distance=0.1).is_push
    assert not planner.decide_without_imagining(seen, valued(0.4), valued(0.5), distance=0.1).is_push
    assert decision.grasp_pixel.tolist() == [2, 112, 30]


def test_a_grasp_is_chosen_by_one_value_and_compared_by_another(seen: Observation) -> None:
    def valued(value: float, peak: float = 0.0) -> Any:
        return lambda images: jnp.full((images.shape[0], 16, 224, 224), value).at[:, 2, 112, 30].add(peak)

    def decide(push: float, **options: Any) -> Any:
        return planner.decide_without_imagining(
            seen, valued(push), valued(0.1, 0.2), network_scores=valued(0.5, 0.1), distance=0.1, **options
        )

    decision = decide(0.55)
    assert not decision.is_push and decision.grasp_pixel.tolist() == [2, 112, 30]
    np.testing.assert_allclose([decision.grasp_score, decision.value_now], [0.3, 0.6], rtol=1e-6)
    assert decide(0.65).is_push
    assert not decide(0.65, grasp_above=0.29).is_push and decide(0.65, grasp_above=0.31).is_push
    missed = np.array([[2, 112, 30]] * 2, np.int32)
    assert decide(0.55, missed=missed).grasp_pixel.tolist() != [2, 112, 30]


def test_the_highest_of_nearly_equal_grasps_is_made(seen: Observation) -> None:
    low, high = (2, 112, 30), (5, 40, 50)
    seen = seen.replace(height=seen.height.at[high[1:]].set(0.095))

    def scores(images: jax.Array) -> jax.Array:
        table = jnp.full((images.shape[0], 16, 224, 224), 0.1)
        return table.at[:, *low].set(0.9).at[:, *high].set(0.86)

    for margin, pixel, score in ((0.0, low, 0.9), (0.03, low, 0.9), (0.05, high, 0.86)):
        decision = _decide(seen, static, scores, top_margin=margin)
        assert tuple(decision.grasp_pixel.tolist()) == pixel and not decision.is_push
        np.testing.assert_allclose(decision.grasp_score, score, rtol=1e-6)
        by_value = planner.decide_without_imagining(seen, scores, scores, distance=0.1, top_margin=margin)
        assert tuple(by_value.grasp_pixel.tolist()) == pixel

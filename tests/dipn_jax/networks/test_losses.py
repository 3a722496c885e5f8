import jax.numpy as jnp
import numpy as np
import pytest

from dipn_jax.networks import losses


def test_motion_loss_is_numpys(rng: np.random.Generator) -> None:
    predicted, target = rng.normal(size=(2, 3, 4, 3)) * 3
    mask = rng.random((3, 4)) < 0.6
    error = np.abs(predicted - target)
    each = np.where(error < 1, 0.5 * error**2, error - 0.5).sum(-1)
    got = losses.motion_loss(jnp.array(predicted), jnp.array(target), jnp.array(mask))
    np.testing.assert_allclose(got, each[mask].mean(), rtol=1e-5)


def test_score_loss_is_numpys(rng: np.random.Generator) -> None:
    logits, target, weight = rng.normal(size=50) * 4, rng.integers(0, 2, 50), rng.random(50)
    p = 1 / (1 + np.exp(-logits))
    want = -(target * np.log(p) + (1 - target) * np.log(1 - p))
    got = losses.score_loss(jnp.array(logits), jnp.array(target), jnp.array(weight))
    np.testing.assert_allclose(got, (want * weight).sum() / weight.sum(), rtol=1e-4)


def test_mask_errors_of_known_squares() -> None:
    true = jnp.full((40, 40), -1).at[10:20, 10:20].set(0)
    moved = jnp.full((40, 40), -1).at[10:20, 15:25].set(0)
    iou, xor = losses.mask_errors(moved, true, 2)
    np.testing.assert_allclose(iou, [1 - 50 / 150, 0.0])
    np.testing.assert_allclose(xor, [100 / 200, 0.0])


def test_mask_errors_of_single_pixels_and_of_empty_masks() -> None:
    true = jnp.full((4, 6), -1).at[0, 0].set(0)
    predicted = true.at[2:4, 3:6].set(1)  # the second is predicted where there is none, the third nowhere
    iou, xor = losses.mask_errors(predicted, true, 3)
    np.testing.assert_allclose(iou, [0, 1, 0])
    np.testing.assert_allclose(xor, [0, 1, 0])
    iou, xor = losses.mask_errors(true, predicted, 3)  # the second is not predicted
    np.testing.assert_allclose(iou, [0, 1, 0])
    np.testing.assert_allclose(xor, [0, 0.5, 0])
    elsewhere = jnp.full((4, 6), -1).at[3, 4:6].set(0)  # two pixels for the one of the first
    iou, xor = losses.mask_errors(elsewhere, true, 1)
    assert (iou[0], xor[0]) == (1, 1.5)


def test_a_mean_over_few_or_none() -> None:
    predicted, target = jnp.array([[3.0, 0.0, 0.0], [9.0, 9.0, 9.0]]), jnp.zeros((2, 3))
    assert losses.motion_loss(predicted, target, jnp.array([True, False])) == 2.5
    assert losses.motion_loss(predicted, target, jnp.zeros(2, bool)) == 0
    logits, target, half = jnp.zeros(2), jnp.ones(2), jnp.array([0.5, 0.0])
    assert losses.score_loss(logits, target, half) == pytest.approx(np.log(2))
    assert losses.score_loss(logits, target, jnp.zeros(2)) == 0


def test_the_loss_is_in_pixels_and_degrees() -> None:
    np.testing.assert_allclose(np.array([0.002, 0.004, np.pi]) * losses.PIXELS_DEGREES, [1, 2, 180], rtol=1e-6)


def test_moved_is_over_3_mm_or_3_degrees() -> None:
    motion = np.zeros((2, 5, 3), np.float32)
    motion[0, :, 0] = [0.0029, 0.0031, -0.0031, 0.0, 0.0022]
    motion[0, :, 1] = [0.0, 0.0, 0.0, 0.0031, 0.0022]
    motion[1, :, 2] = np.deg2rad([2.9, 3.1, -3.1, -2.9, 3.0])
    got = losses.moved(jnp.array(motion))
    assert got.tolist() == [[False, True, True, True, True], [False, True, True, False, False]]


def test_what_is_exactly_at_the_limit_has_not_moved() -> None:
    at = np.zeros((2, 3), np.float32)
    at[0, 0], at[1, 2] = losses.MOVED_DISTANCE, losses.MOVED_ANGLE
    assert float(jnp.linalg.norm(at[0, :2])) == np.float32(losses.MOVED_DISTANCE), "no rounding decides"
    assert not losses.moved(jnp.array(at)).any()


def test_a_small_turn_is_no_distance() -> None:
    assert not losses.moved(jnp.array([0.002, 0.0, 0.05]))

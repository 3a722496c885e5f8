import jax.numpy as jnp
import numpy as np

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


def test_moved_is_by_distance_or_angle() -> None:
    motion = jnp.array([[0.002, 0.0, 0.0], [0.004, 0.0, 0.0], [0.0, 0.0, 0.1]])
    assert losses.moved(motion).tolist() == [False, True, True]

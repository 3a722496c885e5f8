from typing import Any

import jax.numpy as jnp
import numpy as np

from dipn_jax import structs
from dipn_jax.networks import push_frame, stepwise
from dipn_jax.sight import masks, render
from dipn_jax.workspace import GRIPPER


def test_outlines_are_the_extents_of_the_pixels(settled: Any) -> None:
    height, label = render.render_depth(structs.take(settled.scene, 0), settled.poses[0])
    centers, _ = masks.mask_centers(label, 5)
    got = np.asarray(push_frame.outlines(label, height, jnp.float32(0.4), centers))
    at = (np.arange(224) - 111.5) * 0.002
    c, s = np.cos(0.4), np.sin(0.4)
    normals = push_frame.directions() @ np.array([[c, s], [-s, c]])
    for i in range(5):
        for which, mask in enumerate((label == i, (label == i) & (height > GRIPPER.push_tip))):
            rows, cols = np.nonzero(np.asarray(mask))
            points = np.stack([at[cols], at[rows]], -1) - np.asarray(centers[i])
            want = (points @ normals.T).max(0) if len(points) else np.zeros(push_frame.OUTLINE_DIRECTIONS)
            np.testing.assert_allclose(got[i, :, which], want, atol=1e-5)


def _box(half: tuple[float, float], angle: float) -> np.ndarray:
    """Return the support function of a box about its middle."""
    c, s = np.cos(angle), np.sin(angle)
    own = push_frame.directions() @ np.array([[c, -s], [s, c]])  # directions as the box sees them
    return (np.abs(own) @ np.array(half)).astype(np.float32)


def test_turning_an_outline_turns_the_object() -> None:
    got = stepwise.turn(jnp.asarray(_box((0.05, 0.02), 0.0))[:, None], jnp.float32(0.5))[:, 0]
    np.testing.assert_allclose(got, _box((0.05, 0.02), 0.5), atol=1e-3)


def test_the_largest_gap_is_the_distance() -> None:
    first, second = _box((0.05, 0.02), 0.0), _box((0.01, 0.03), 0.0)
    apart = np.asarray(stepwise.gaps(jnp.array([0.1, 0.0]), jnp.asarray(first), jnp.asarray(second)))
    np.testing.assert_allclose(apart.max(), 0.1 - 0.05 - 0.01, atol=1e-6)
    assert apart.argmax() == 0, "the direction from one to the other"
    touching = stepwise.gaps(jnp.array([0.0, -0.05]), jnp.asarray(first), jnp.asarray(second))
    np.testing.assert_allclose(touching.max(), 0.0, atol=1e-6)

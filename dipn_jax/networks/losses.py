"""Losses and the error measures that are reported."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Num

from dipn_jax.structs import Array
from dipn_jax.workspace import WORKSPACE

PIXELS_DEGREES = np.array([1 / WORKSPACE.pixel, 1 / WORKSPACE.pixel, 180 / np.pi], np.float32)
"""Factors from metres, metres, radians to the units of DIPN's loss: pixels, pixels, degrees (its released code)."""
MOVED_DISTANCE = 0.003
"""Metres beyond which an object counts as moved."""
MOVED_ANGLE = np.deg2rad(3.0)
"""Radians beyond which an object counts as moved."""


def smooth_l1(error: Float[Array, "*b"]) -> Float[jax.Array, "*b"]:
    """Return 0.5 e^2 where |e| < 1, and |e| - 0.5 elsewhere."""
    size = jnp.abs(error)
    return jnp.where(size < 1, 0.5 * size**2, size - 0.5)


def motion_loss(
    predicted: Float[Array, "*b 3"], target: Float[Array, "*b 3"], mask: Bool[Array, "*b"]
) -> Float[jax.Array, ""]:
    """Return the mean over objects of SmoothL1 summed over (dx, dy, dtheta).

    Args:
      predicted: pixels, pixels, degrees.
      target: in the same units.
      mask: which objects count.
    """
    each = smooth_l1(predicted - target).sum(-1)
    return (each * mask).sum() / jnp.maximum(mask.sum(), 1)


def score_loss(logits: Float[Array, "*b"], target: Num[Array, "*b"], weight: Num[Array, "*b"]) -> Float[jax.Array, ""]:
    """Return the weighted mean binary cross entropy of `logits` against `target` in [0, 1]."""
    each = jnp.maximum(logits, 0) - logits * target + jnp.log1p(jnp.exp(-jnp.abs(logits)))
    return (each * weight).sum() / jnp.maximum(weight.sum(), 1e-6)


def moved(motion: Float[Array, "*b 3"]) -> Bool[jax.Array, "*b"]:
    """Return which true motions (metres, radians) count as moved: over 3 mm or 3 degrees."""
    return (jnp.linalg.norm(motion[..., :2], axis=-1) > MOVED_DISTANCE) | (jnp.abs(motion[..., 2]) > MOVED_ANGLE)


def mask_errors(
    predicted: Int[Array, "H W"], true: Int[Array, "H W"], slots: int
) -> tuple[Float[jax.Array, " {slots}"], Float[jax.Array, " {slots}"]]:
    """Return both error measures of predicted label maps.

    Args:
      predicted: labels.
      true: labels.
      slots: number of object slots.

    Returns:
      `1 - IoU`, and what DIPN's released code plots, `|pred XOR true| / (2 |true|)`, of each object. Both are 1
      where the true mask is empty and the predicted one is not, 0 where both are empty.
    """
    slot = jnp.arange(slots)[:, None, None]
    p, t = predicted == slot, true == slot
    both, either, size = (p & t).sum((1, 2)), (p | t).sum((1, 2)), t.sum((1, 2))
    iou = 1 - both / jnp.maximum(either, 1)
    xor = jnp.where(size > 0, (either - both) / (2 * jnp.maximum(size, 1)), 1.0)
    empty = either == 0
    return jnp.where(empty, 0.0, iou), jnp.where(empty, 0.0, xor)

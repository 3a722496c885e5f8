"""Losses and the error measures that are reported."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from dipn_jax.workspace import WORKSPACE

PIXELS_DEGREES = np.array([1 / WORKSPACE.pixel, 1 / WORKSPACE.pixel, 180 / np.pi], np.float32)
"""Factors from metres, metres, radians to the units of DIPN's loss: pixels, pixels, degrees (its released code)."""
MOVED_DISTANCE = 0.003
"""Metres beyond which an object counts as moved."""
MOVED_ANGLE = np.deg2rad(3.0)
"""Radians beyond which an object counts as moved."""


def smooth_l1(error: jax.Array) -> jax.Array:
    """Return 0.5 e^2 where |e| < 1, and |e| - 0.5 elsewhere."""
    size = jnp.abs(error)
    return jnp.where(size < 1, 0.5 * size**2, size - 0.5)


def motion_loss(predicted: jax.Array, target: jax.Array, mask: jax.Array) -> jax.Array:
    """Return the mean over objects of SmoothL1 summed over (dx, dy, dtheta).

    Args:
      predicted: `[..., N, 3]` pixels, pixels, degrees.
      target: `[..., N, 3]` in the same units.
      mask: `[..., N]` which objects count.
    """
    each = smooth_l1(predicted - target).sum(-1)
    return (each * mask).sum() / jnp.maximum(mask.sum(), 1)


def score_loss(logits: jax.Array, target: jax.Array, weight: jax.Array) -> jax.Array:
    """Return the weighted mean binary cross entropy of `logits [...]` against `target [...]` in [0, 1]."""
    each = jnp.maximum(logits, 0) - logits * target + jnp.log1p(jnp.exp(-jnp.abs(logits)))
    return (each * weight).sum() / jnp.maximum(weight.sum(), 1e-6)


def moved(motion: jax.Array) -> jax.Array:
    """Return which true motions `[..., 3]` (metres, radians) count as moved: over 3 mm or 3 degrees."""
    return (jnp.linalg.norm(motion[..., :2], axis=-1) > MOVED_DISTANCE) | (jnp.abs(motion[..., 2]) > MOVED_ANGLE)


def mask_errors(predicted: jax.Array, true: jax.Array, slots: int) -> tuple[jax.Array, jax.Array]:
    """Return both error measures of predicted label maps.

    Args:
      predicted: `[H, W]` int32 labels.
      true: `[H, W]` int32 labels.
      slots: N.

    Returns:
      `1 - IoU` `[N]`, and what DIPN's released code plots, `|pred XOR true| / (2 |true|)` `[N]`. Both are 1
      where the true mask is empty and the predicted one is not, 0 where both are empty.
    """
    slot = jnp.arange(slots)[:, None, None]
    p, t = predicted == slot, true == slot
    both, either, size = (p & t).sum((1, 2)), (p | t).sum((1, 2)), t.sum((1, 2))
    iou = 1 - both / jnp.maximum(either, 1)
    xor = jnp.where(size > 0, (either - both) / (2 * jnp.maximum(size, 1)), 1.0)
    empty = either == 0
    return jnp.where(empty, 0.0, iou), jnp.where(empty, 0.0, xor)

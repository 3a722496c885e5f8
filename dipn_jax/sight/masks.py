"""What label maps say: where masks are, and their contours."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from dipn_jax.structs import Array
from dipn_jax.workspace import WORKSPACE


def mask_centers(
    label: Int[Array, "H W"], slots: int
) -> tuple[Float[jax.Array, "{slots} 2"], Float[jax.Array, " {slots}"]]:
    """Centroids of the visible masks.

    Args:
      label: object slots, ABSENT on the table.
      slots: number of object slots.

    Returns:
      Centroids in metres (workspace, of a map centred on it) and sizes in pixels; the centroid of an
      object out of sight is 0.
    """
    h, w = label.shape
    hot = label == jnp.arange(slots)[:, None, None]
    # along the rows, where memory is contiguous: a count and a sum of columns in one number, exact up to 1,448 columns
    packed = jnp.where(hot, (1 << 20) + jnp.arange(w), 0).sum(-1)
    rows, cols = (packed >> 20).astype(jnp.float32), (packed & 0xFFFFF).astype(jnp.float32)
    area = rows.sum(-1)
    x = cols.sum(-1) - (w - 1) / 2 * area
    y = (rows * (jnp.arange(h) - (h - 1) / 2)).sum(-1)
    total = jnp.stack([x, y], -1) * WORKSPACE.pixel
    return total / jnp.maximum(area, 1.0)[:, None], area


def contour(foreground: Bool[Array, "H W"]) -> Bool[Array, "H W"]:
    """Foreground pixels with a neighbour (of eight) on the table or outside the map."""
    padded = jnp.pad(foreground, 1)
    across = padded[:, :-2] & padded[:, 1:-1] & padded[:, 2:]
    return foreground & ~(across[:-2] & across[1:-1] & across[2:])

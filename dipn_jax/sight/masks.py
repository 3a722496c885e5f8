"""Masks of a label map: their centroids and sizes, and their contours."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from dipn_jax.structs import Array
from dipn_jax.workspace import WORKSPACE

_COLUMN_BITS = 20
"""Low bits of a packed sum that hold the sum of columns; the number of pixels is in the bits above."""


def mask_centers(
    label: Int[Array, "H W"], slots: int
) -> tuple[Float[jax.Array, "{slots} 2"], Float[jax.Array, " {slots}"]]:
    """Return the centroids and sizes of the visible masks.

    Args:
      label: object slots, ABSENT on the table.
      slots: number of object slots.

    Returns:
      Centroids in metres (workspace, of a map centred on it) and sizes in pixels; the centroid of an
      object out of sight is 0.
    """
    h, w = label.shape
    hot = label == jnp.arange(slots)[:, None, None]
    count, columns = _row_sums(hot)
    area = count.sum(-1)
    x = columns.sum(-1) - (w - 1) / 2 * area
    y = (count * (jnp.arange(h) - (h - 1) / 2)).sum(-1)
    total = jnp.stack([x, y], -1) * WORKSPACE.pixel
    return total / jnp.maximum(area, 1.0)[:, None], area


def _row_sums(hot: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the number of pixels in every row of masks `[..., W]` bool and the sum of their columns, float32 `[...]`.

    Both are packed into one integer and summed at once, along the rows, where memory is contiguous: this reads the
    masks once. Exact up to 1,448 columns, from where on the sum of columns does not fit into its bits.
    """
    columns = jnp.arange(hot.shape[-1])
    packed = jnp.where(hot, (1 << _COLUMN_BITS) + columns, 0).sum(-1)
    count, total = packed >> _COLUMN_BITS, packed & ((1 << _COLUMN_BITS) - 1)
    return count.astype(jnp.float32), total.astype(jnp.float32)


def contour(foreground: Bool[Array, "H W"]) -> Bool[Array, "H W"]:
    """Return the foreground pixels with a neighbour (of eight) on the table or outside the map."""
    padded = jnp.pad(foreground, 1)
    across = padded[:, :-2] & padded[:, 1:-1] & padded[:, 2:]
    return foreground & ~(across[:-2] & across[1:-1] & across[2:])

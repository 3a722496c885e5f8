"""The image predicted from motions: each object's pixels are moved and painted into the emptied scene."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from dipn_jax import geometry
from dipn_jax.sight import observed, render
from dipn_jax.structs import ABSENT, Array, Observation
from dipn_jax.workspace import WORKSPACE

WINDOW = 80
"""Pixels around a moved mask's centroid; wider than the renderer's window, since a half-hidden mask is off centre."""


@observed.guarded
@jax.jit
def imagine(observation: Observation, centers: Float[Array, "N 2"], motion: Float[Array, "N 3"]) -> Observation:
    """Predict the observation after every object has moved rigidly in the plane.

    Example:
      from dipn_jax.sight import masks

      centers, _ = masks.mask_centers(observation.label, observation.slots)
      after = dipn_jax.imagine(observation, centers, motion)

    Args:
      observation: maps before, 224 x 224.
      centers: metres, centroid of each visible mask (`masks.mask_centers`).
      motion: dx, dy (metres) of that centroid and rotation about it (radians).

    Returns:
      The predicted observation; where two objects overlap, the higher one is seen.

    Raises:
      UserError: the observation is none of those that `dipn_jax.check_observation` lets through.
    """
    label, pixels = observation.label, observation.label.shape[0]
    target = geometry.metres_to_pixels(centers + motion[:, :2])
    source = geometry.metres_to_pixels(centers)
    corner = jnp.clip(jnp.round(target - WINDOW / 2).astype(jnp.int32), 0, pixels - WINDOW)
    grid = geometry.view_grid(WINDOW, WINDOW)
    packed = jnp.concatenate([render.rgbd(observation), label[..., None].astype(jnp.float32)], -1)

    def paint(i: jax.Array, image: jax.Array) -> jax.Array:
        moved = grid + corner[i] - target[i]
        back = geometry.rotate2d(moved, -motion[i, 2]) + source[i]
        patch = geometry.sample_nearest(packed, back, ABSENT)
        at = (corner[i, 1], corner[i, 0], 0)
        old = jax.lax.dynamic_slice(image, at, (WINDOW, WINDOW, 5))
        seen = (patch[..., 4] == i) & (patch[..., 3] > old[..., 3])
        return jax.lax.dynamic_update_slice(image, jnp.where(seen[..., None], patch, old), at)

    table = jnp.array([*render.TABLE_COLOR, 0.0, ABSENT], jnp.float32)
    image = jnp.broadcast_to(table, (pixels, pixels, 5))
    image = jax.lax.fori_loop(0, centers.shape[0], paint, image)
    return Observation(image[..., 3], image[..., :3], image[..., 4].astype(jnp.int32), observation.slots)


def first_object_hit(
    label: Int[Array, "H W"], start: Float[Array, " 2"], angle: Float[Array, ""] | float
) -> Int[jax.Array, ""]:
    """Return the object that the middle of a push from `start` (metres) along `angle` meets first, or ABSENT."""
    steps = jnp.arange(0.0, 0.2, WORKSPACE.pixel / 2)
    path = start + steps[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    met = geometry.sample_nearest(label, geometry.metres_to_pixels(path), ABSENT)
    first = jnp.argmax(met != ABSENT)
    return met[first]

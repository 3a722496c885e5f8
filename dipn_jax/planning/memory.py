"""Remember grasps that missed on one table, as long as the table looks the same around them."""

from __future__ import annotations

import dataclasses

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from dipn_jax import geometry
from dipn_jax.storage import serialization
from dipn_jax.structs import Array
from dipn_jax.workspace import WORKSPACE

REMEMBERED = 8
"""Number of the latest grasps that missed that are remembered."""
RADIUS = round(0.06 / WORKSPACE.pixel)
"""Pixels (6 cm) around the centre of a grasp within which the height map is compared."""
CHANGED_HEIGHT = 0.01
"""Metres by which a pixel's height must have changed to count. Source: VPG's released code, for a changed scene."""
CHANGED_PIXELS = 40
"""Pixels that must have changed for a grasp to be worth trying again: a cube of 4 cm that moved by 4 mm changes 80."""
SMOOTHED_PIXELS = 5
"""Side in pixels of the median filter that takes noise out of the two height maps before they are compared."""


@serialization.register
@dataclasses.dataclass(frozen=True)
class MissedGrasps:
    """Grasps that missed on one table, and what the height map around each was before it. It is never changed.

    Example:
      memory = dipn_jax.MissedGrasps()
      decision = policy(key, observation, missed=memory.pixels())
      memory = memory.add(decision.grasp_pixel, observation.height)   # if the grasp held nothing
      memory = memory.recall(observation.height)                      # when the table is seen again
    """

    grasps: tuple[np.ndarray, ...] = ()  # [3] int32 rotation, row, col; the latest last
    around: tuple[np.ndarray, ...] = ()  # [2 RADIUS + 1, 2 RADIUS + 1] metres around each

    def add(self, grasp: Int[Array, " 3"], height: Float[Array, "H W"]) -> MissedGrasps:
        """Return the memory with one grasp more, the latest `REMEMBERED` in all.

        Args:
          grasp: rotation, row and column of the grasp that missed.
          height: the height map before it was made, metres.
        """
        pixel = np.asarray(grasp, np.int32)
        grasps, around = (*self.grasps, pixel), (*self.around, _around(pixel, height))
        return MissedGrasps(grasps[-REMEMBERED:], around[-REMEMBERED:])

    def recall(self, height: Float[Array, "H W"]) -> MissedGrasps:
        """Return the memory without the grasps around which the height map is not what it was before they were made."""
        pairs = zip(self.grasps, self.around, strict=True)
        kept = [pair for pair in pairs if not looks_changed(pair[1], _around(pair[0], height))]
        return MissedGrasps(tuple(grasp for grasp, _ in kept), tuple(around for _, around in kept))

    def pixels(self) -> Int[np.ndarray, "8 3"]:
        """Return the grasps (rotation, row, col) as policies take them, filled up with -1."""
        nothing = np.full((REMEMBERED - len(self.grasps), 3), -1, np.int32)
        return np.concatenate([np.reshape(self.grasps, (-1, 3)).astype(np.int32), nothing])


def looks_changed(before: Float[Array, "S S"], after: Float[Array, "S S"]) -> bool:
    """Return whether something within `RADIUS` of the middle of two height maps (metres) has moved between them."""
    smooth = [cv2.medianBlur(np.ascontiguousarray(one, np.float32), SMOOTHED_PIXELS) for one in (before, after)]
    offset = np.arange(len(smooth[0])) - RADIUS
    disk = np.hypot(*np.meshgrid(offset, offset)) <= RADIUS
    return int((np.abs(smooth[0] - smooth[1]) > CHANGED_HEIGHT)[disk].sum()) > CHANGED_PIXELS


def forget_changed(
    missed: Int[Array, "M 3"], before: Float[Array, "H W"], after: Float[Array, "H W"]
) -> Int[jax.Array, "M 3"]:
    """Return grasps that missed, with -1 for those around which a predicted height map differs from the one before it.

    Neither map is smoothed, because what is predicted keeps the noise of what is seen.

    Args:
      missed: rotation, row, col; -1: none.
      before: metres.
      after: metres.
    """
    changed = jnp.abs(jnp.asarray(after) - jnp.asarray(before)) > CHANGED_HEIGHT
    away = geometry.view_grid(*changed.shape) - jnp.asarray(missed)[:, None, None, :0:-1]
    near = jnp.linalg.norm(away, axis=-1) <= RADIUS
    other = (near & changed).sum((1, 2)) > CHANGED_PIXELS
    return jnp.where(other[:, None], -1, jnp.asarray(missed))


def _around(grasp: np.ndarray, height: Array) -> np.ndarray:
    """Return the height map around a grasp; beyond the border it is 0."""
    row, col = grasp[1:]
    padded = np.pad(np.asarray(height, np.float32), RADIUS)
    return padded[row : row + 2 * RADIUS + 1, col : col + 2 * RADIUS + 1].copy()

"""What a height map alone tells about grasps and pushes: where the fingers would come down."""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from dipn_jax import geometry
from dipn_jax.structs import Array
from dipn_jax.workspace import GRIPPER, LOWEST_TIP, ROTATIONS, TURNED_PIXELS, WORKSPACE, grasp_angles

EMPTY_HEIGHT = 0.005
"""Height in metres up to which a pixel counts as empty table: no grasp is centred there, and none is learnt."""
FREE_HEIGHT = 0.01
"""Height in metres below which a pixel counts as free where a push starts. Source: DIPN's released code."""
START_RANGE = (10, 214)
"""First and last row and column, in pixels, where a push may start. Source: DIPN's released code."""
_MARGIN = 0.004  # metres around the closed gripper's footprint

MIN_DEPTH = 0.002
"""Metres of object that must be between the fingers; objects 25 mm high reach 5 mm above the lowest fingertip."""
FINGER_COLUMNS = tuple(
    round(off / WORKSPACE.pixel) for off in (GRIPPER.stroke / 2, GRIPPER.stroke / 2 + GRIPPER.thickness)
)
"""Distances in pixels from the middle of a grasp to where a finger begins and ends."""
BLOCKED_HEIGHT = 0.02
"""Metres above a fingertip's goal from which something under it blocks the grasp: it can rarely be pushed aside."""
HIDDEN_WIDTH = 12
"""Pixels by which an object that reaches the border may extend beyond it, out of sight: half a large object."""
HIDDEN_HEIGHT = 1.0
"""Assumed height in metres of the hidden part of such an object."""


def grasp_height(local_height: Float[Array, "*b"] | float) -> Float[jax.Array, "*b"]:
    """Return the fingertips' height for a surface `local_height` metres high. Source: DIPN's released code."""
    return jnp.maximum(jnp.asarray(local_height) - 0.04, LOWEST_TIP)


def under_fingers(
    height: Float[Array, "H W"], center: Float[Array, "*b 2"], angle: Float[Array, "*b"]
) -> Float[jax.Array, "*b"]:
    """Return the highest point, in metres, that the open fingers of each grasp come down on.

    An object that reaches the border of the map is assumed to extend beyond it.

    Args:
      height: metres.
      center: metres, workspace.
      angle: radians, of the closing axis.
    """
    step = WORKSPACE.pixel / 2
    off = jnp.arange(GRIPPER.stroke / 2, GRIPPER.stroke / 2 + GRIPPER.thickness + step, step)
    across = jnp.arange(-GRIPPER.pad_width / 2, GRIPPER.pad_width / 2 + step, step)
    local = jnp.stack(jnp.meshgrid(jnp.concatenate([-off, off]), across), -1).reshape(-1, 2)
    at = center[..., None, :] + geometry.rotate2d(local, angle[..., None])
    pixels = jnp.clip(geometry.metres_to_pixels(at), 0, jnp.array(height.shape[::-1]) - 1)
    return geometry.sample_nearest(height, pixels).max(-1)


def footprint_free(
    height: Float[Array, "H W"], start: Float[Array, " 2"], angle: Float[Array, ""] | float
) -> Bool[jax.Array, ""]:
    """Return whether the closed gripper can come down at `start` (metres), broad side toward `angle` (radians)."""
    along = jnp.linspace(-0.5, 0.5, 7) * (GRIPPER.pad_width + _MARGIN)
    across = jnp.linspace(-0.5, 0.5, 13) * (GRIPPER.push_width + _MARGIN)
    local = jnp.stack(jnp.meshgrid(along, across, indexing="ij"), -1).reshape(-1, 2)
    pixels = geometry.metres_to_pixels(start + geometry.rotate2d(local, angle))
    return jnp.all(geometry.sample_nearest(height, pixels, 0.0) < FREE_HEIGHT)


def pushable(height: Float[Array, "H W"]) -> Bool[jax.Array, "16 H W"]:
    """Return where on a height map the closed gripper can come down, in each direction."""
    size = height.shape[0]
    rows, cols = (2 * math.ceil(side / 2 / WORKSPACE.pixel) + 1 for side in (GRIPPER.push_width, GRIPPER.pad_width))
    pixel = jnp.arange(size)
    near = (pixel >= START_RANGE[0]) & (pixel <= START_RANGE[1])

    def one(angle: jax.Array) -> jax.Array:
        top = geometry.rotate_map(height, angle, TURNED_PIXELS)
        for window in ((rows, 1), (1, cols)):
            top = jax.lax.reduce_window(top, -jnp.inf, jax.lax.max, window, (1, 1), "SAME")
        return geometry.unrotate_map(top, angle, size)

    half = jax.lax.map(one, jnp.asarray(grasp_angles()[: ROTATIONS // 2]))  # the gripper is its own mirror image
    return jnp.tile(half < FREE_HEIGHT, (2, 1, 1)) & near[:, None] & near


def geometric_labels(height: Float[jax.Array, "H W"]) -> Float[jax.Array, "H W"]:
    """Return which grasps look possible, judged from the height map of a turned view alone.

    A grasp centred on a pixel and closing along its row is positive when there is object between the
    fingers at the depth they would reach, and none where they come down: a pad's width of rows, and
    `FINGER_COLUMNS` on each side (DIPN's released code has rows +-4, columns 19 to 28 of its own gripper).

    Args:
      height: metres.

    Returns:
      1 for positive, 0 else.
    """
    tip = grasp_height(height)
    return ((height > tip + MIN_DEPTH) & (_under_fingers(height) < tip)).astype(jnp.float32)


def _under_fingers(height: Float[Array, "H W"]) -> Float[jax.Array, "H W"]:
    """Return the highest point, in metres, that the fingers of a grasp centred on each pixel come down on."""

    def highest(low: int, high: int, half_rows: int) -> jax.Array:
        rows, cols = 2 * half_rows + 1, high - low + 1
        pad = ((half_rows, half_rows), (-low if low < 0 else 0, high if high > 0 else 0))
        top = jnp.pad(height, pad)
        for window in ((rows, 1), (1, cols)):  # a maximum over a rectangle is one of rows, then one of columns
            top = jax.lax.reduce_window(top, -jnp.inf, jax.lax.max, window, (1, 1), "VALID")
        begin = low if low > 0 else 0
        return top[:, begin : begin + height.shape[1]]

    near, far = FINGER_COLUMNS
    rows = round(GRIPPER.pad_width / 2 / WORKSPACE.pixel)
    return jnp.maximum(highest(-far, -near, rows), highest(near, far, rows))


def label_image(height: Float[Array, "224 224"]) -> Float[jax.Array, "16 224 224"]:
    """Return `geometric_labels` of every grasp on a height map, in the layout of `score_image`."""
    return _of_every_grasp(height, geometric_labels)


def blocked_image(
    height: Float[Array, "224 224"], *, inside: bool = True, beyond: bool = True
) -> Float[jax.Array, "16 224 224"]:
    """Return 1 for each grasp on a height map whose finger would land on something, else 0.

    Args:
      height: metres.
      inside: count what is seen to stand BLOCKED_HEIGHT over where a fingertip is to go.
      beyond: count what is out of sight: something that reaches the border is assumed to extend beyond it.
    """
    height = jnp.pad(height, (TURNED_PIXELS - WORKSPACE.pixels) // 2, mode="edge")
    outside = jnp.abs(jnp.arange(TURNED_PIXELS) - (TURNED_PIXELS - 1) / 2) > WORKSPACE.pixels / 2
    outside = outside[:, None] | outside
    cut = jnp.where(outside, height, 0.0)
    hidden = jax.lax.reduce_window(cut, 0.0, jax.lax.max, (2 * HIDDEN_WIDTH + 1,) * 2, (1, 1), "SAME") > EMPTY_HEIGHT
    obstacles = jnp.where(outside, jnp.where(hidden & beyond, HIDDEN_HEIGHT, 0.0), height if inside else 0.0)

    def judge(turned: jax.Array) -> jax.Array:
        goal = grasp_height(turned[..., 0]) + BLOCKED_HEIGHT
        return (_under_fingers(turned[..., 1]) > goal).astype(jnp.float32)

    return _of_every_grasp(jnp.stack([height, obstacles], -1), judge)


def _of_every_grasp(
    height: Float[Array, "H W *maps"], judge: Callable[[jax.Array], jax.Array]
) -> Float[jax.Array, "16 224 224"]:
    """Apply `judge` to turned views and turn the results back; a grasp turned by half a turn is the same grasp."""

    def one(angle: jax.Array) -> jax.Array:
        return geometry.unrotate_map(judge(geometry.rotate_map(height, angle, TURNED_PIXELS)), angle, WORKSPACE.pixels)

    half = jax.lax.map(one, jnp.asarray(grasp_angles()[: ROTATIONS // 2]))
    return jnp.tile(half, (2, 1, 1))
